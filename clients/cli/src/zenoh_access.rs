//! `lanemap zenoh-access`: the rules that keep vehicles to their own keys, for a zenoh router that runs elsewhere.

use std::{path::PathBuf, process::ExitCode};

use clap::{ArgGroup, Args};
use lanemap_server::ingest::zenoh::access::AccessRules;
use serde_json::json;

/// Who may use the router.
#[derive(Args, Debug)]
#[command(group = ArgGroup::new("proofs").required(true).multiple(true).args(["vehicles", "passwords"]))]
pub struct ZenohAccessArgs {
    /// Vehicles that connect with a certificate: a common name fleet/vehicle on each line
    #[arg(long, value_name = "FILE")]
    vehicles: Option<PathBuf>,
    /// Vehicles that connect with a password: fleet/vehicle:password on each line. With --vehicles, both are asked for
    #[arg(long, value_name = "FILE")]
    passwords: Option<PathBuf>,
    /// Who may read the shared map, and nothing else: a common name, or user name, on each line
    #[arg(long, value_name = "FILE")]
    readers: Option<PathBuf>,
    /// Common name, or user name, with which a lanemap server connects to the router; may stand more than once
    #[arg(long, value_name = "NAME", required = true)]
    server: Vec<String>,
}

/// Prints the section `access_control` of the router's configuration.
pub fn run(args: &ZenohAccessArgs) -> anyhow::Result<ExitCode> {
    let (vehicles, passwords, readers) = (&args.vehicles, &args.passwords, &args.readers);
    let rules =
        AccessRules::for_router(vehicles.as_deref(), passwords.as_deref(), readers.as_deref(), args.server.clone())?;
    println!("{}", serde_json::to_string_pretty(&json!({ "access_control": rules.to_json() }))?);
    Ok(ExitCode::SUCCESS)
}
