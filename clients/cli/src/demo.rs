//! `lanemap demo`: the service with a simulated fleet, until a signal ends it.

mod fleet;

use std::{net::SocketAddr, path::PathBuf, process::ExitCode, time::Duration};

use anyhow::Context;
use clap::Args;
use lanemap_client::IngestClient;
use lanemap_server::{ConfigOverrides, Server, ServerConfig};
use lanemap_simulator::{FleetScenario, Seed, fleet::FleetRoutes};

use crate::signal;

/// Time that vehicles get to end their streams before the server does.
const FLEET_GRACE: Duration = Duration::from_secs(3);

/// The service with a simulated fleet.
#[derive(Args, Debug)]
pub struct DemoArgs {
    /// Address and port for gRPC and HTTP; port 0 takes any free one
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8080")]
    listen: SocketAddr,
    /// Folder of the embedded store; made where it does not exist. Delete it to begin with an empty map
    #[arg(long, value_name = "DIR", default_value = "lanemap-data")]
    data_dir: PathBuf,
    /// Number of vehicles
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    vehicles: u32,
    /// Length of one drive, km; at its end the vehicle starts anew elsewhere
    #[arg(long, value_name = "KM", default_value_t = 4.0, value_parser = drive_km)]
    drive_km: f64,
    /// Seed of the town and its drives
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
}

/// Serves and drives until SIGINT or SIGTERM.
#[tokio::main]
pub async fn run(args: &DemoArgs) -> anyhow::Result<ExitCode> {
    let overrides = ConfigOverrides {
        listen: Some(args.listen),
        data_dir: Some(args.data_dir.clone()),
        ..ConfigOverrides::default()
    };
    let settings = ServerConfig::load(None, overrides).context("the settings cannot be used")?;
    let stop = signal::stop_signals()?;
    let server = Server::start(settings)
        .await
        .context("the demo does not start; --listen and --data-dir choose another address and another folder")?;
    let client = IngestClient::connect(server.url()).await.context("the demo's own server cannot be reached")?;
    let fleet = fleet::Fleet::start(args.vehicles, town(args), &client);
    let url = server.url();
    println!("viewer  {url}/viewer\nlanes   {url}/collections/lanes/items\ngRPC    {url}");
    println!("{} vehicles are driving; Ctrl-C stops", args.vehicles);
    stop.await;
    fleet.stop(FLEET_GRACE).await;
    server.shutdown().await;
    Ok(ExitCode::SUCCESS)
}

fn drive_km(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(km) if (0.01..=100.0).contains(&km) => Ok(km),
        _ => Err(format!("{text:?} is not a length from 0.01 to 100 km")),
    }
}

/// A small town, in which the ways of the vehicles overlap.
fn town(args: &DemoArgs) -> lanemap_simulator::Fleet {
    let routes = FleetRoutes::Random { length_m: args.drive_km * 1e3 };
    FleetScenario { routes, ..FleetScenario::small_town(args.vehicles) }.fleet(Seed(args.seed))
}
