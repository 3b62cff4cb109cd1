//! The `lanemap` command. Its inside is a library, so that the end-to-end tests run the same command from a build of
//! their own.

use std::process::ExitCode;

fn main() -> ExitCode {
    lanemap_cli::run()
}
