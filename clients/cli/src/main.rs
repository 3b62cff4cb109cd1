//! The `lanemap` command: serve, replay, simulate, demo.
//!
//! Results go to stdout; logs, progress and errors to stderr. The exit code is 0 only where everything was done:
//! 1 where something failed (the message says what, and what to do), 2 where the command line is wrong.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

mod demo;
mod replay;
mod serve;
mod signal;
mod simulate;

/// Streams lane detections into lane maps.
#[derive(Debug, Parser)]
#[command(name = "lanemap", version, max_term_width = 110)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Serves vehicles over gRPC and map readers over HTTP.
    Serve(Box<serve::ServeArgs>),
    /// Replays recorded drives (OpenLane folders) into a server, or into a mapper in this process.
    Replay(Box<replay::ReplayArgs>),
    /// Serves, with a simulated fleet driving through a town: something to look at.
    Demo(demo::DemoArgs),
    /// Makes synthetic drives with their truth, as OpenLane folders.
    Simulate(simulate::SimulateArgs),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    log_to_stderr();
    let done = match cli.command {
        Command::Serve(args) => serve::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Simulate(args) => simulate::run(&args),
    };
    match done {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Logs at `info`, or as `RUST_LOG` says.
fn log_to_stderr() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
}
