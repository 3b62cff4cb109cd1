//! `lanemap bench`: what a server bears, and what it costs.

mod answer;
mod echo;
mod flow;
mod freshness;
mod grpc;
mod ingest;
mod rate;
mod report;
mod server_process;
mod tally;
mod tape;
mod vehicle;
mod zenoh;

use std::process::ExitCode;

use clap::{Args, Subcommand};

/// What to measure.
#[derive(Args, Debug)]
pub struct BenchArgs {
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Debug, Subcommand)]
enum BenchCommand {
    /// Streams drives as many vehicles and measures how long acks take.
    Ingest(ingest::IngestArgs),
    /// Streams one vehicle through a mapped town and measures how long it takes until readers of the shared map have what it sees.
    Freshness(freshness::FreshnessArgs),
    /// Streams the same bytes to a gRPC service that only sends them back: what the transport costs by itself.
    Echo(echo::EchoArgs),
    /// The service of `bench echo`.
    #[command(hide = true)]
    EchoServer,
}

/// Runs a benchmark.
pub fn run(args: &BenchArgs) -> anyhow::Result<ExitCode> {
    match &args.command {
        BenchCommand::Ingest(args) => ingest::run(args),
        BenchCommand::Freshness(args) => freshness::run(args),
        BenchCommand::Echo(args) => echo::run(args),
        BenchCommand::EchoServer => echo::serve(),
    }
}
