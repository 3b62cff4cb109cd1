//! Promise: memory is flat however long vehicles come, stream, lose their connection and come back.
//!
//! `SOAK_MINUTES=30 cargo nextest run --release -p lanemap-tests --test soak --run-ignored only --no-capture`

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    path::Path,
    process::Command,
    sync::Arc,
    time::{Duration, Instant},
};

use lanemap_client::{IngestClient, Reconnect, SessionStart};
use lanemap_core::Sequence;
use lanemap_tests::{
    drives::{self, Drive},
    servers::ServerProcess,
};

/// Vehicles at a time.
const VEHICLES: usize = 40;
/// Frames of a vehicle between two breaks of its connection.
const FRAMES_PER_CONNECTION: usize = 150;
/// Time between two frames of a vehicle.
const FRAME_INTERVAL: Duration = Duration::from_millis(50);
/// Time between two looks at the memory.
const SAMPLE_INTERVAL: Duration = Duration::from_secs(5);
/// Growth over the measured time that counts as none: what the allocator and the store's tables breathe.
const MOST_GROWTH: f64 = 0.10;

#[tokio::test(flavor = "multi_thread")]
#[ignore = "half an hour; see the head of this file"]
async fn memory_is_flat_under_traffic_that_comes_and_goes() {
    let minutes: f64 = std::env::var("SOAK_MINUTES").map_or(30.0, |minutes| minutes.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    // What is bounded is soon full: growth beyond it is a leak.
    let mut command = Command::new(env!("CARGO_BIN_EXE_killable-server"));
    command.arg(folder.path()).env("LANEMAP_MAX_CACHED_MAP_BYTES", "4000000").env("LANEMAP_UNLOAD_AFTER_S", "5");
    let server = ServerProcess::spawn(&mut command).listening();
    let drives: Arc<[Drive]> = (0..4).map(|seed| drives::simulated(20 + seed, 600)).collect();
    let vehicles: Vec<_> = (0..VEHICLES)
        .map(|vehicle| tokio::spawn(come_and_go(server.url.clone(), Arc::clone(&drives), vehicle)))
        .collect();

    let (began, length) = (Instant::now(), Duration::from_secs_f64(60.0 * minutes));
    let mut samples = Vec::new();
    while began.elapsed() < length {
        tokio::time::sleep(SAMPLE_INTERVAL).await;
        samples.push((began.elapsed().as_secs_f64() / 60.0, resident_mb(server.id())));
        assert!(vehicles.iter().all(|vehicle| !vehicle.is_finished()), "a vehicle stopped");
    }
    vehicles.iter().for_each(tokio::task::JoinHandle::abort);

    // The first third fills what is bounded.
    let steady = &samples[samples.len() / 3..];
    let (slope, mean) = (slope_per_minute(steady), mean(steady.iter().map(|sample| sample.1)));
    let growth = slope * (minutes * 2.0 / 3.0) / mean;
    let disk_mb = folder_mb(folder.path());
    println!(
        "{minutes} min: {mean:.1} MB resident on average, slope {slope:+.3} MB/min ({:+.1} % over the time measured), \
         first {:.1}, last {:.1}; {disk_mb:.0} MB on disk",
        100.0 * growth,
        samples[0].1,
        samples[samples.len() - 1].1
    );
    assert!(growth < MOST_GROWTH, "memory grows: {samples:?}");
}

/// Streams drive after drive, and breaks the connection again and again.
async fn come_and_go(url: String, drives: Arc<[Drive]>, vehicle: usize) {
    for number in 0.. {
        let drive = &drives[(vehicle + number) % drives.len()];
        let mut start = SessionStart { reconnect: Reconnect::forever(), sensor: drive.sensor, ..drive.start() };
        start.vehicle = format!("vehicle-{vehicle}");
        start.drive = format!("drive-{number}");
        let mut acked = None;
        loop {
            let client = IngestClient::connect(&url).await.unwrap();
            let (mut session, _events) = match client.start_session(start.clone()).await {
                Ok(started) => started,
                Err(error) if error.is_transient() => {
                    eprintln!("vehicle {vehicle} tries again: {error}");
                    tokio::time::sleep(Duration::from_secs(1)).await;
                    continue;
                }
                Err(error) => panic!("{error}"),
            };
            assert!(session.resume_after() >= acked, "acked {acked:?}, kept {:?}", session.resume_after());
            let had = drive.frames.partition_point(|frame| Some(frame.sequence()) <= session.resume_after());
            let rest = &drive.frames[had..];
            for frame in rest.iter().take(FRAMES_PER_CONNECTION) {
                session.send(frame).await.unwrap();
                tokio::time::sleep(FRAME_INTERVAL).await;
            }
            if rest.len() <= FRAMES_PER_CONNECTION {
                session.finish().await.unwrap();
                break;
            }
            acked = session.acked().max(session.resume_after());
            assert!(acked < Some(Sequence(u64::MAX)));
            // Gone without a word.
            drop(session);
        }
    }
}

fn resident_mb(process: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

/// Least squares.
fn slope_per_minute(samples: &[(f64, f64)]) -> f64 {
    let at = mean(samples.iter().map(|sample| sample.0));
    let level = mean(samples.iter().map(|sample| sample.1));
    let rise: f64 = samples.iter().map(|(time, value)| (time - at) * (value - level)).sum();
    rise / samples.iter().map(|(time, _)| (time - at).powi(2)).sum::<f64>()
}

fn folder_mb(folder: &Path) -> f64 {
    use std::os::unix::fs::MetadataExt;
    let bytes = |entry: std::io::Result<std::fs::DirEntry>| {
        let entry = entry.unwrap();
        match entry.metadata() {
            Ok(meta) if meta.is_dir() => folder_mb(&entry.path()),
            Ok(meta) => (512 * meta.blocks()) as f64 / 1e6,
            Err(_) => 0.0,
        }
    };
    std::fs::read_dir(folder).map_or(0.0, |entries| entries.map(bytes).sum())
}
