//! The `lanemap` command. Its inside is a library, so that the end-to-end tests run the same command from a build of
//! their own.

use std::process::ExitCode;

/// Frames are many small allocations, made on one thread and freed on another.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    lanemap_cli::run()
}
