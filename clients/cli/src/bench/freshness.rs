//! `lanemap bench freshness`: how long it takes until others read of the shared map what a vehicle sees.
//!
//! So many drives through a simulated town are streamed and ended first, and once more a few seconds of one, so that the service is
//! at work. Then one vehicle drives at its cameras' rate while another client follows the map. A frame is readable once that
//! client's copy has a line that was seen last in it, or later.

use std::{
    fmt,
    process::ExitCode,
    sync::{Arc, Mutex, PoisonError},
};

use anyhow::{Context, ensure};
use clap::Args;
use lanemap_client::{IngestClient, MapNews, MapWatch, SessionStart, WatchOptions};
use lanemap_core::{Frame, fleet::CellId};
use lanemap_simulator::{Fleet, FleetScenario, Seed};
use serde::Serialize;
use tokio::time::{Duration, Instant, interval, timeout};

use super::{
    rate::FrameRate,
    server_process::{self, ServerProcess},
};

/// Longest wait for a line after the last frame.
const PATIENCE: Duration = Duration::from_secs(15);
/// Longest wait until the map has all that the drives before said.
const SETTLING: Duration = Duration::from_mins(10);
/// Frames of the drive that sets the service to work, and rest after it.
const WARMING: usize = 100;
const REST: Duration = Duration::from_secs(10);

/// The town, and the vehicle.
#[derive(Args, Debug)]
pub struct FreshnessArgs {
    /// Drives through the town before
    #[arg(long, value_name = "N", default_value_t = 120, value_parser = clap::value_parser!(u32).range(1..=1000))]
    drives: u32,
    /// Seed of the simulated town
    #[arg(long, value_name = "N", default_value_t = 3)]
    seed: u64,
    /// Frames per second of the vehicle; max: as fast as acks allow
    #[arg(long, value_name = "R|max", default_value = "10")]
    hz: FrameRate,
    /// The server, whose map should be empty; without it one is started for the length of the run, its store in a temporary
    /// folder; LANEMAP_ variables set it up
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    /// Print one JSON object on stdout instead of a summary
    #[arg(long)]
    json: bool,
}

/// What was found.
#[derive(Debug, Serialize)]
struct FreshnessReport {
    /// Drives through the town before.
    drives: u32,
    /// Frames that the vehicle sent, and those that became readable.
    frames: usize,
    readable: usize,
    /// Versions of cells that came meanwhile.
    versions: usize,
    /// Time from sending a frame until it was readable, seconds, by share of the frames.
    p50_s: f64,
    p90_s: f64,
    p99_s: f64,
    max_s: f64,
}

/// Drives, watches and reports; the exit code is 1 where fewer than nine tenths of the frames became readable.
pub fn run(args: &FreshnessArgs) -> anyhow::Result<ExitCode> {
    let spawned = if args.server.is_none() { Some(ServerProcess::serve(None)?) } else { None };
    let url = args.server.as_deref().or(spawned.as_ref().map(|server| server.url.as_str()));
    let url = url.context("there is no server")?;
    let fleet = town(args);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let report = runtime.block_on(async {
        for number in 0..args.drives {
            stream(url, &fleet, number, usize::MAX, FrameRate::Max).await?;
        }
        settled(url).await?;
        stream(url, &fleet, args.drives, WARMING, args.hz).await?;
        settled(url).await?;
        tokio::time::sleep(REST).await;
        freshness(url, &fleet, args).await
    })?;
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print!("{report}");
    }
    Ok(if 10 * report.readable >= 9 * report.frames { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// A small town in the middle of a cell.
fn town(args: &FreshnessArgs) -> Fleet {
    let mut scenario = FleetScenario::small_town(args.drives + 2);
    if let Some(cell) = CellId::containing(&scenario.anchor) {
        let middle = cell.anchor().place();
        scenario.anchor.latitude_deg = middle.latitude_deg;
        scenario.anchor.longitude_deg = middle.longitude_deg;
    }
    scenario.fleet(Seed(args.seed))
}

/// When each frame of the vehicle was sent.
type Sent = Arc<Mutex<Vec<Instant>>>;

/// Streams a drive, or its first frames, and ends it: as fast as acks allow, or at a rate.
async fn stream(url: &str, fleet: &Fleet, number: u32, frames: usize, hz: FrameRate) -> anyhow::Result<()> {
    let frames: Vec<Frame> = fleet.drive(number).frames().take(frames).collect();
    stream_frames(url, fleet, number, &frames, hz, &Sent::default()).await
}

async fn stream_frames(
    url: &str,
    fleet: &Fleet,
    number: u32,
    frames: &[Frame],
    hz: FrameRate,
    sent: &Sent,
) -> anyhow::Result<()> {
    let client = IngestClient::connect(url).await?;
    let sensor = fleet.drive(number).sensor();
    let start = SessionStart { sensor, ..SessionStart::new("bench", format!("vehicle-{number}"), "drive") };
    let (mut session, _events) = client.start_session(start).await?;
    let mut ticks = hz.hz().map(|hz| interval(Duration::from_secs_f64(1.0 / hz)));
    for frame in frames {
        if let Some(ticks) = &mut ticks {
            ticks.tick().await;
        }
        session.send(frame).await?;
        sent.lock().unwrap_or_else(PoisonError::into_inner).push(Instant::now());
    }
    let summary = session.finish().await?;
    ensure!(summary.refused == 0, "{} frames of drive {number} were refused", summary.refused);
    Ok(())
}

/// Waits until the map has all that drives have said.
async fn settled(url: &str) -> anyhow::Result<()> {
    let asking = async {
        loop {
            let cells = server_process::text(&format!("{url}/cells")).await?;
            let cells: serde_json::Value = serde_json::from_str(&cells)?;
            if cells["settled"] == true {
                return Ok(());
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    };
    timeout(SETTLING, asking).await.context("the map does not settle")?
}

/// Drives one vehicle and watches the map meanwhile.
async fn freshness(url: &str, fleet: &Fleet, args: &FreshnessArgs) -> anyhow::Result<FreshnessReport> {
    let number = args.drives + 1;
    let frames: Vec<Frame> = fleet.drive(number).frames().collect();
    let times: Vec<i64> = frames.iter().map(|frame| frame.time().0).collect();
    let mut watch = MapWatch::new(url, WatchOptions::default()).await?;
    // The map as it is comes first.
    while timeout(Duration::from_secs(2), watch.next()).await.is_ok_and(|news| news.is_ok()) {}
    let sent = Sent::default();
    let reading = tokio::spawn(readable(watch, times, Arc::clone(&sent)));
    stream_frames(url, fleet, number, &frames, args.hz, &sent).await?;
    let (mut readable_s, versions) = reading.await??;
    readable_s.sort_by(f64::total_cmp);
    let at = |share: f64| {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an index")]
        let index = (readable_s.len().saturating_sub(1) as f64 * share) as usize;
        readable_s.get(index).copied().unwrap_or(f64::INFINITY)
    };
    Ok(FreshnessReport {
        drives: args.drives,
        frames: frames.len(),
        readable: readable_s.len(),
        versions,
        p50_s: at(0.5),
        p90_s: at(0.9),
        p99_s: at(0.99),
        max_s: at(1.0),
    })
}

/// How long each frame took to be readable, seconds, and how many versions came, until none comes any more.
async fn readable(mut watch: MapWatch, times: Vec<i64>, sent: Sent) -> anyhow::Result<(Vec<f64>, usize)> {
    let (mut readable_s, mut versions) = (Vec::new(), 0);
    while let Ok(news) = timeout(PATIENCE, watch.next()).await {
        let MapNews::Cell { cell, .. } = news? else { continue };
        let now = Instant::now();
        versions += 1;
        let Some(map) = watch.copy().cell(&cell) else { continue };
        let seen_last = map.lanes.iter().map(|lane| lane.last_seen_unix_ns).max().unwrap_or(0);
        let sent = sent.lock().unwrap_or_else(PoisonError::into_inner);
        let until = times.partition_point(|time| *time <= seen_last).min(sent.len());
        let new = sent.iter().take(until).skip(readable_s.len());
        let new: Vec<f64> = new.map(|sent| now.saturating_duration_since(*sent).as_secs_f64()).collect();
        readable_s.extend(new);
    }
    Ok((readable_s, versions))
}

impl fmt::Display for FreshnessReport {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { drives, frames, readable, versions, p50_s, p90_s, p99_s, max_s } = self;
        writeln!(
            formatter,
            "one vehicle after {drives} drives: {readable} of {frames} frames readable, {versions} versions"
        )?;
        writeln!(formatter, "readable  p50 {p50_s:.2} s, p90 {p90_s:.2} s, p99 {p99_s:.2} s, max {max_s:.2} s")
    }
}
