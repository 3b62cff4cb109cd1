//! The `lanemap` command: serve, replay, record, export, evaluate, bench, simulate, demo, zenoh-access.
//!
//! Results go to stdout; logs, progress and errors to stderr. The exit code is 0 only where everything was done:
//! 1 where something failed (the message says what, and what to do), 2 where the command line is wrong.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

mod bench;
mod credentials;
mod demo;
mod evaluate;
mod export;
mod forget;
mod logging;
mod record;
mod recordings;
mod replay;
mod serve;
mod signal;
mod simulate;
mod zenoh_access;

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
    /// Replays recorded drives (OpenLane folders, MCAP, ROS 1 bags) into a server, or into a mapper in this process.
    Replay(Box<replay::ReplayArgs>),
    /// Records drives as MCAP, which Foxglove opens: OpenLane folders, ROS 1 bags, or MCAP again.
    Record(Box<record::RecordArgs>),
    /// Writes the shared map for other programs: GeoJSON, FlatGeobuf, PMTiles, Lanelet2, OpenDRIVE.
    Export(export::ExportArgs),
    /// Measures maps, poses and associations as the paper's tables do.
    Evaluate(evaluate::EvaluateArgs),
    /// Deletes what a service has of a vehicle, or of one drive, and waits until it is gone.
    Forget(forget::ForgetArgs),
    /// Serves, with a simulated fleet driving through a town: something to look at.
    Demo(demo::DemoArgs),
    /// Measures what a server bears: a load of many vehicles, and what the transport alone costs.
    Bench(bench::BenchArgs),
    /// Makes synthetic drives with their truth, as OpenLane folders.
    Simulate(simulate::SimulateArgs),
    /// Prints the access control of a zenoh router: each vehicle may use its own keys only.
    ZenohAccess(zenoh_access::ZenohAccessArgs),
}

/// Runs the command line of this process.
#[must_use]
pub fn run() -> ExitCode {
    let cli = Cli::parse();
    if !matches!(cli.command, Command::Serve(_)) {
        logging::to_stderr();
    }
    let done = match cli.command {
        Command::Serve(args) => serve::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Record(args) => record::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Forget(args) => forget::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::ZenohAccess(args) => zenoh_access::run(&args),
    };
    match done {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
