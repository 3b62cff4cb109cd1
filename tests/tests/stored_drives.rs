//! Promise: a start takes no longer for a store of a hundred thousand drives than balancers wait for.
//!
//! `STORED_DRIVES=100000 cargo nextest run --release --workspace -E 'binary(stored_drives)' --run-ignored only --no-capture`

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    path::Path,
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use lanemap_proto::{
    encode,
    v1::{self, ingest_service_client::IngestServiceClient},
};
use lanemap_tests::{
    drives::{self, Drive},
    http,
    raw_stream::RawStream,
    servers::ServerProcess,
};

/// Frames of each drive.
const FRAMES: usize = 10;
/// Uploads at a time.
const AT_A_TIME: u32 = 128;
/// Longest time from the start of the process to the first answer of `/readyz` that is 200.
const LONGEST_START: Duration = Duration::from_secs(10);

fn server(folder: &Path) -> ServerProcess {
    let mut command = Command::new(env!("CARGO_BIN_EXE_killable-server"));
    ServerProcess::spawn(command.arg(folder).env("LANEMAP_MAX_SESSIONS", "1000000")).listening()
}

fn start_of(drive: &Drive, number: u32) -> v1::SessionStart {
    let drive_id = format!("drive-{number}");
    v1::SessionStart { vehicle_id: format!("vehicle-{}", number % 1_000), drive_id, ..drive.wire_start() }
}

async fn fill(url: String, drive: Arc<Drive>, next: Arc<AtomicU32>, drives: u32) {
    let mut client = IngestServiceClient::connect(url).await.unwrap();
    let frames: Vec<v1::Frame> = drive.frames.iter().map(encode::frame).collect();
    loop {
        let number = next.fetch_add(1, Ordering::Relaxed);
        if number >= drives {
            return;
        }
        let start = Some(start_of(&drive, number));
        let request = v1::UploadObservationsRequest { start, frames: frames.clone(), end: true };
        let answer = client.upload_observations(request).await.unwrap().into_inner();
        assert_eq!(answer.acked_sequence_inclusive, Some(FRAMES as u64));
    }
}

fn resident_mb(process: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "minutes; see the head of this file"]
async fn a_store_of_many_drives_is_ready_in_seconds() {
    let drives: u32 = std::env::var("STORED_DRIVES").map_or(100_000, |drives| drives.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let drive = Arc::new(drives::simulated(3, FRAMES));
    let mut before = server(folder.path());
    let (began, next) = (Instant::now(), Arc::new(AtomicU32::new(0)));
    let filling =
        (0..AT_A_TIME).map(|_| tokio::spawn(fill(before.url.clone(), Arc::clone(&drive), Arc::clone(&next), drives)));
    for filled in filling.collect::<Vec<_>>() {
        filled.await.unwrap();
    }
    println!("{drives} drives filled in {:.0?}, {:.0} MB resident", began.elapsed(), resident_mb(before.id()));
    before.kill();

    let began = Instant::now();
    let after = server(folder.path());
    let listening = began.elapsed();
    while http::get(format!("{}/readyz", after.url)).await.unwrap().status().as_u16() != 200 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let ready = began.elapsed();
    let (mut stream, _) = RawStream::started(&after.url, start_of(&drive, drives)).await;
    stream.send_frame(encode::frame(&drive.frames[0])).await;
    stream.acked(1).await;
    let acked = began.elapsed();
    let (mut resumed, accepted) = RawStream::started(&after.url, start_of(&drive, 0)).await;
    assert_eq!(accepted.resume_after_sequence, Some(FRAMES as u64));
    resumed.send(v1::stream_observations_request::Message::End(v1::SessionEnd {})).await;
    resumed.end().await.unwrap();
    println!(
        "after kill -9: listening after {listening:.2?}, ready after {ready:.2?}, first frame of a new drive acked after \
         {acked:.2?}, an old drive resumed after {:.2?}, {:.0} MB resident",
        began.elapsed(),
        resident_mb(after.id())
    );
    assert!(ready <= LONGEST_START, "{ready:?}");
}
