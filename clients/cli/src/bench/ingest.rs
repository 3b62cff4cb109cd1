//! `lanemap bench ingest`: a fleet's load on a server.

use std::{path::PathBuf, process::ExitCode, sync::Arc, time::SystemTime};

use anyhow::Context;
use clap::{Args, ValueEnum};
use lanemap_core::geometry::georeference::Georeference;
use tokio::{
    sync::{mpsc, watch},
    task::JoinSet,
    time::{Duration, Instant},
};

use super::{
    grpc::Connections,
    rate::FrameRate,
    report::{LoadPlan, LoadReport},
    server_process::{self, ServerProcess},
    tally::Tally,
    tape::Tape,
    vehicle::{Fleet, Link},
    zenoh::Sessions,
};
use crate::replay::frames::parse_origin;

/// The method of the ingest service that vehicles call.
const STREAM_OBSERVATIONS: &str = "/lanemap.v1.IngestService/StreamObservations";
/// Where servers listen unless told otherwise.
const DEFAULT_URL: &str = "http://127.0.0.1:8080";
const DEFAULT_ENDPOINT: &str = "tcp/127.0.0.1:7447";
/// Time between the last opened drive and the first frame.
const SETTLING: Duration = Duration::from_millis(200);

/// The load, and the server that bears it.
#[derive(Args, Debug)]
pub struct IngestArgs {
    #[command(flatten)]
    load: LoadArgs,
    /// How frames travel
    #[arg(long, value_enum, default_value_t = Transport::Grpc)]
    transport: Transport,
    /// The server to stream to [default: 127.0.0.1, port 8080 over http, port 7447 over zenoh]
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    /// Start a server for the length of the run, its store in a temporary folder; LANEMAP_ variables set it up
    #[arg(long, conflicts_with = "server")]
    spawn: bool,
}

/// The load.
#[derive(Args, Debug)]
pub struct LoadArgs {
    /// Vehicles that stream at a time
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub vehicles: u32,
    /// Frames per second of each vehicle; max: as fast as acks allow
    #[arg(long, value_name = "R|max", default_value = "10")]
    pub hz: FrameRate,
    /// Time in which frames are sent, seconds; acks are waited for after it
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = seconds)]
    pub seconds: f64,
    /// Folder of recorded drives in OpenLane's format; without it, simulated drives. A vehicle that comes to the end of
    /// a drive begins it again as a new one
    #[arg(long, value_name = "DIR")]
    pub drives: Option<PathBuf>,
    /// Only drives whose name contains one of these texts
    #[arg(long, value_name = "NAME,..", value_delimiter = ',', requires = "drives")]
    pub only: Vec<String>,
    /// Latitude and longitude (degrees) of the origin of the drives' world: frames carry GNSS fixes, so that the server fuses
    /// the drives, too; all vehicles are on the same few roads then
    #[arg(long, value_name = "LAT,LON", value_parser = parse_origin, allow_hyphen_values = true)]
    pub origin: Option<Georeference>,
    /// Most frames of a vehicle unacked; never more than the server allows
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub window: u32,
    /// Print one JSON object on stdout instead of a summary
    #[arg(long)]
    pub json: bool,
}

/// How frames travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Transport {
    /// One bidirectional stream per vehicle
    Grpc,
    /// One key per vehicle, by a router or a server that is one
    Zenoh,
}

impl LoadArgs {
    /// What the vehicles stream.
    pub fn tapes(&self) -> anyhow::Result<Vec<Tape>> {
        Tape::load(self.drives.as_deref(), &self.only, self.origin.as_ref())
    }
}

/// Runs the load; the exit code is 1 where a frame was lost.
pub fn run(args: &IngestArgs) -> anyhow::Result<ExitCode> {
    let tapes = args.load.tapes()?;
    match args.transport {
        Transport::Grpc => over_grpc(args, tapes),
        Transport::Zenoh => over_zenoh(args, tapes),
    }
}

fn over_grpc(args: &IngestArgs, tapes: Vec<Tape>) -> anyhow::Result<ExitCode> {
    let spawned = if args.spawn { Some(ServerProcess::serve(None)?) } else { None };
    let url = spawned.as_ref().map_or(args.server.as_deref().unwrap_or(DEFAULT_URL), |server| &server.url);
    runtime()?.block_on(async {
        let link = Link::Grpc(Connections::open(url, args.load.vehicles, STREAM_OBSERVATIONS).await?);
        let memory = || async {
            let of_server = match &spawned {
                Some(server) => server.rss_mb(),
                None => server_process::rss_mb_by_metrics(url).await,
            };
            of_server.inspect_err(|error| tracing::warn!("the server's memory is not known: {error:#}")).ok()
        };
        load(&args.load, "grpc", link, tapes, Tally::new()?, memory).await
    })
}

fn over_zenoh(args: &IngestArgs, tapes: Vec<Tape>) -> anyhow::Result<ExitCode> {
    let (free, _held) = server_process::free_zenoh_endpoint()?;
    let spawned = if args.spawn { Some(ServerProcess::serve(Some(&free))?) } else { None };
    let given = args.server.as_deref().unwrap_or(DEFAULT_ENDPOINT);
    let endpoint = if spawned.is_some() { &free } else { given };
    // Zenoh does not run within a runtime of one thread.
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    runtime.block_on(async {
        let tally = Tally::new()?;
        let link = Link::Zenoh(Sessions::open(endpoint, args.load.vehicles, &tally).await?);
        let memory = || async { spawned.as_ref().and_then(|server| server.rss_mb().ok()) };
        load(&args.load, "zenoh", link, tapes, tally, memory).await
    })
}

/// One thread: the load must leave the machine to the server.
pub fn runtime() -> anyhow::Result<tokio::runtime::Runtime> {
    Ok(tokio::runtime::Builder::new_current_thread().enable_all().build()?)
}

/// Puts the load on a service and reports.
pub async fn load<M: Future<Output = Option<f64>>>(
    args: &LoadArgs,
    transport: &'static str,
    link: Link,
    tapes: Vec<Tape>,
    tally: Tally,
    memory: impl FnOnce() -> M,
) -> anyhow::Result<ExitCode> {
    let (start, run) = watch::channel(None);
    let fleet = Arc::new(Fleet {
        name: run_name(),
        tapes: tapes.into_iter().map(Arc::new).collect(),
        vehicles: args.vehicles,
        rate: args.hz,
        window: args.window as usize,
        link,
        tally: tally.clone(),
        run,
    });
    let (ready, mut are_ready) = mpsc::channel(1);
    let mut vehicles = JoinSet::new();
    for vehicle in 0..args.vehicles {
        vehicles.spawn(Arc::clone(&fleet).drive(vehicle, ready.clone()));
    }
    drop((ready, fleet));
    for _ in 0..args.vehicles {
        tokio::select! {
            one = are_ready.recv() => one.context("a vehicle gave up")?,
            Some(ended) = vehicles.join_next() => ended??,
        }
    }
    let began = Instant::now() + SETTLING;
    let stopped = began + Duration::from_secs_f64(args.seconds);
    start.send_replace(Some((began, stopped)));
    while let Some(ended) = vehicles.join_next().await {
        ended??;
    }
    let plan = LoadPlan { transport, vehicles: args.vehicles, rate: args.hz, began, stopped };
    let report = LoadReport::new(&plan, &tally, memory().await);
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print!("{report}");
    }
    Ok(if report.is_whole() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn run_name() -> String {
    let since_epoch = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    format!("bench-{}", since_epoch.as_millis())
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.1..=86_400.0).contains(&seconds) => Ok(seconds),
        _ => Err(format!("{text:?} is not a time from 0.1 to 86400 s")),
    }
}
