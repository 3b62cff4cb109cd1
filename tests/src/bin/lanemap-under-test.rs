//! The `lanemap` command, built with the tests: never stale, and wherever cargo puts it.

use std::process::ExitCode;

fn main() -> ExitCode {
    lanemap_cli::run()
}
