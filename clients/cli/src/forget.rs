//! `lanemap forget`: has a service delete what it has of a vehicle, or of one drive.

use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use lanemap_client::{AdminClient, ConnectOptions};

use crate::credentials::CredentialArgs;

/// Whom to forget, and where.
#[derive(Args, Debug)]
pub struct ForgetArgs {
    /// The service
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8080")]
    server: String,
    /// The fleet, as the vehicle names it when it streams
    #[arg(long, value_name = "ID")]
    fleet: String,
    /// The vehicle, as it names itself
    #[arg(long, value_name = "ID")]
    vehicle: String,
    /// One drive of the vehicle; without it, all of them
    #[arg(long, value_name = "ID")]
    drive: Option<String>,
    /// Who asks; a token must have the scope admin
    #[command(flatten)]
    credentials: CredentialArgs,
}

/// Asks for the deletion and waits until the data are gone from the disk.
#[tokio::main]
pub async fn run(args: &ForgetArgs) -> anyhow::Result<ExitCode> {
    let options = ConnectOptions { credentials: args.credentials.read(), ..ConnectOptions::default() };
    let client = AdminClient::connect(&args.server, &options).await;
    let client = client.with_context(|| format!("{} cannot be reached", args.server))?;
    let drives = client.forget(&args.fleet, &args.vehicle, args.drive.as_deref()).await;
    let drives = drives.context("nothing was deleted, or it is not finished; it is safe to try again")?;
    println!("deleted: {drives} drives");
    Ok(ExitCode::SUCCESS)
}
