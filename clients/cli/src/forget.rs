//! `lanemap forget`: has a service delete what it has of a vehicle, or of one drive.

use std::{path::PathBuf, process::ExitCode};

use anyhow::Context;
use clap::Args;
use lanemap_client::{AdminClient, ConnectOptions, Credentials, IdentityFiles, Token};

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
    /// File of a bearer token of scope admin
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Certificates that sign the service's, PEM, for an address that begins with https
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// The operator's own certificate, PEM, for a service that asks for one
    #[arg(long, value_name = "FILE", requires = "key")]
    cert: Option<PathBuf>,
    /// Its private key, PEM
    #[arg(long, value_name = "FILE", requires = "cert")]
    key: Option<PathBuf>,
}

impl ForgetArgs {
    fn credentials(&self) -> Credentials {
        let identity = self.cert.clone().zip(self.key.clone());
        Credentials {
            ca: self.ca.clone(),
            identity: identity.map(|(cert, key)| IdentityFiles { cert, key }),
            token: self.token_file.clone().map(Token::File),
            ..Credentials::default()
        }
    }
}

/// Asks for the deletion and waits until the data are gone from the disk.
#[tokio::main]
pub async fn run(args: &ForgetArgs) -> anyhow::Result<ExitCode> {
    let options = ConnectOptions { credentials: args.credentials(), ..ConnectOptions::default() };
    let client = AdminClient::connect(&args.server, &options).await;
    let client = client.with_context(|| format!("{} cannot be reached", args.server))?;
    let drives = client.forget(&args.fleet, &args.vehicle, args.drive.as_deref()).await;
    let drives = drives.context("nothing was deleted, or it is not finished; it is safe to try again")?;
    println!("deleted: {drives} drives");
    Ok(ExitCode::SUCCESS)
}
