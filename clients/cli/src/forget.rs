//! `lanemap forget`: has a service delete what it has of a vehicle, or of one drive.

use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use lanemap_proto::v1::{ForgetRequest, admin_service_client::AdminServiceClient};

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
}

/// Asks for the deletion and waits until the data are gone from the disk.
#[tokio::main]
pub async fn run(args: &ForgetArgs) -> anyhow::Result<ExitCode> {
    let client = AdminServiceClient::connect(args.server.clone()).await;
    let mut client = client.with_context(|| format!("{} cannot be reached", args.server))?;
    let request =
        ForgetRequest { fleet_id: args.fleet.clone(), vehicle_id: args.vehicle.clone(), drive_id: args.drive.clone() };
    let answer = client.forget(request).await.context("nothing was deleted, or it is not finished: try again")?;
    println!("deleted: {} drives", answer.into_inner().drives);
    Ok(ExitCode::SUCCESS)
}
