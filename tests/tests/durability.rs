//! Promise: what was acked outlives restarts and kills, and a drive that was interrupted gives the map of one that was
//! not, byte by byte.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    fs::File,
    hash::{BuildHasher, RandomState},
    io::Write,
    path::Path,
    process::Command,
    sync::Arc,
    time::{Duration, Instant},
};

use lanemap_client::{ClientError, IngestClient, Reconnect, SessionStart};
use lanemap_core::Sequence;
use lanemap_proto::{
    encode,
    v1::{
        self, ingest_service_client::IngestServiceClient, stream_observations_request::Message,
        stream_observations_response::Message as Response,
    },
};
use lanemap_server::{Server, ServerConfig};
use lanemap_tests::{
    drives::{self, Drive, assert_same_map},
    http,
    raw_stream::RawStream,
    servers::{self, ServerProcess, map_bytes},
};
use tonic::Code;
use tonic_types::StatusExt;

#[tokio::test(flavor = "multi_thread")]
async fn a_client_rides_through_a_restart_and_the_map_is_that_of_an_undisturbed_drive() {
    let folder = tempfile::tempdir().unwrap();
    let drive = drives::simulated(3, 120);
    let server = servers::start(folder.path()).await;
    let (listen, url) = (server.address(), server.url());
    let client = IngestClient::connect(&url).await.unwrap();
    let (mut session, _events) = client.start_session(drive.start()).await.unwrap();
    for frame in &drive.frames[..60] {
        session.send(frame).await.unwrap();
    }
    session.wait_acked(Sequence(20)).await.unwrap();
    server.shutdown().await;

    let config = ServerConfig { listen, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    for frame in &drive.frames[60..] {
        session.send(frame).await.unwrap();
    }
    let id = session.id().to_owned();
    let summary = session.finish().await.unwrap();
    assert_eq!((summary.acked, summary.refused), (Some(Sequence(120)), 0));
    assert!(summary.reconnections >= 1);
    assert_same_map(&map_bytes(&url, &id).await, &drive);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn maps_are_served_again_after_a_restart_before_any_vehicle_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let drive = drives::simulated(3, 60);
    let server = servers::start(folder.path()).await;
    let client = IngestClient::connect(server.url()).await.unwrap();
    let (mut session, _events) = client.start_session(drive.start()).await.unwrap();
    for frame in &drive.frames {
        session.send(frame).await.unwrap();
    }
    let id = session.id().to_owned();
    session.close().await.unwrap();
    server.shutdown().await;

    let server = servers::start(folder.path()).await;
    assert_same_map(&map_bytes(&server.url(), &id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_leaves_memory_when_its_vehicle_is_gone_and_goes_on_when_it_is_back() {
    let folder = tempfile::tempdir().unwrap();
    let drive = drives::simulated(4, 90);
    let config = ServerConfig { unload_after_s: 0, snapshot_every_frames: 7, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let client = IngestClient::connect(server.url()).await.unwrap();
    let mut ids = Vec::new();
    for part in drive.frames.chunks(10) {
        let (mut session, _events) = client.start_session(drive.start()).await.unwrap();
        assert_eq!(session.resume_after(), part[0].sequence().0.checked_sub(1).filter(|last| *last > 0).map(Sequence));
        for frame in part {
            session.send(frame).await.unwrap();
        }
        ids.push(session.id().to_owned());
        session.close().await.unwrap();
    }
    ids.dedup();
    assert_eq!(ids.len(), 1, "one drive is one session");
    assert_same_map(&map_bytes(&server.url(), &ids[0]).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn no_acked_frame_is_lost_when_the_server_is_killed_again_and_again() {
    const VEHICLES: u64 = 3;
    const FRAMES_PER_LIFE: u64 = 40;
    // More of them by `TEST_KILLS=200`.
    let kills: u64 = std::env::var("TEST_KILLS").map_or(10, |kills| kills.parse().unwrap());
    let binary = env!("CARGO_BIN_EXE_killable-server");
    let folder = tempfile::tempdir().unwrap();
    let frames = usize::try_from(kills * FRAMES_PER_LIFE).unwrap();
    let drives: Vec<_> = (0..VEHICLES).map(|seed| Arc::new(drives::simulated(10 + seed, frames))).collect();
    let mut acked = vec![None; drives.len()];
    let mut starts = Vec::new();

    for kill in 1..=kills {
        let started = Instant::now();
        let mut server = ServerProcess::spawn(Command::new(binary).arg(folder.path()));
        if kill % 5 == 0 {
            // While it starts.
            random_pause(60).await;
            server.kill();
            continue;
        }
        server = server.listening();
        starts.push(started.elapsed());
        let until = Sequence(kill * FRAMES_PER_LIFE);
        let streams: Vec<_> = drives
            .iter()
            .zip(&acked)
            .map(|(drive, acked)| {
                tokio::spawn(stream_until_killed(server.url.clone(), Arc::clone(drive), *acked, until))
            })
            .collect();
        random_pause(200).await;
        server.kill();
        for (acked, stream) in acked.iter_mut().zip(streams) {
            *acked = stream.await.unwrap();
        }
    }
    starts.sort();
    println!("{kills} kills, acked up to {acked:?}; from start to listening: {:?} at most", starts.last());

    let server = ServerProcess::start(binary, folder.path());
    for (drive, acked) in drives.iter().zip(&acked) {
        let client = IngestClient::connect(&server.url).await.unwrap();
        let (mut session, _events) = client.start_session(drive.start()).await.unwrap();
        assert!(session.resume_after() >= *acked, "acked {acked:?}, kept {:?}", session.resume_after());
        for frame in rest(drive, session.resume_after()) {
            session.send(frame).await.unwrap();
        }
        let id = session.id().to_owned();
        session.finish().await.unwrap();
        assert_same_map(&map_bytes(&server.url, &id).await, drive);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_out_of_order_are_put_in_order_and_no_ack_runs_ahead_of_one_that_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    // What is missing here comes, however slow the machine is.
    let config = ServerConfig { reorder_wait_ms: 60_000, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let drive = drives::simulated(3, 120);
    let (mut stream, accepted) = RawStream::started(&server.url(), drive.wire_start()).await;
    let send = async |stream: &RawStream, index: usize| {
        stream.send_frame(encode::frame(&drive.frames[index])).await;
    };
    for index in [0, 2, 3, 4] {
        send(&stream, index).await;
    }
    stream.acked(1).await;
    // The first frame again: it is acked after what came before it, so that an ack of the others would be seen here.
    send(&stream, 0).await;
    assert_eq!(next_ack(&mut stream).await, 1);
    send(&stream, 1).await;
    stream.acked(5).await;
    for eight in (5..120).collect::<Vec<_>>().chunks(8) {
        // Each eight backwards.
        for index in eight.iter().rev() {
            send(&stream, *index).await;
        }
    }
    stream.acked(120).await;
    stream.send(Message::End(v1::SessionEnd {})).await;
    stream.end().await.unwrap();
    assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_that_never_come_are_told_as_a_gap_and_refused_afterwards() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(3, 10);
    let (mut stream, _) = RawStream::started(&server.url(), drive.wire_start()).await;
    for index in [0, 1, 4, 5] {
        stream.send_frame(encode::frame(&drive.frames[index])).await;
    }
    let gap = loop {
        match stream.answer().await {
            Response::Gap(gap) => break gap,
            Response::Ack(ack) => assert!(ack.acked_sequence_inclusive <= 2, "acked before the gap was given up"),
            _ => {}
        }
    };
    assert_eq!((gap.first_missing_sequence, gap.last_missing_sequence), (3, 4));
    stream.acked(6).await;
    stream.send_frame(encode::frame(&drive.frames[3])).await;
    assert_eq!(stream.refusal().await.reason(), v1::RefusalReason::Sequence);
}

#[tokio::test(flavor = "multi_thread")]
async fn gaps_of_an_upload_are_in_its_answer_and_its_frames_are_put_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(3, 10);
    let mut client = IngestServiceClient::connect(server.url()).await.unwrap();
    let frames = [3, 0, 1, 7].map(|index: usize| encode::frame(&drive.frames[index])).to_vec();
    let request = v1::UploadObservationsRequest { start: Some(drive.wire_start()), frames, end: false };
    let answer = client.upload_observations(request).await.unwrap().into_inner();
    let gap = |first_missing_sequence, last_missing_sequence| v1::Gap { first_missing_sequence, last_missing_sequence };
    assert_eq!(answer.gaps, [gap(3, 3), gap(5, 7)]);
    assert_eq!((answer.acked_sequence_inclusive, answer.refusals), (Some(8), vec![]));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_disk_that_runs_low_refuses_loses_nothing_and_goes_on_when_there_is_room() {
    rides_through_a_full_disk(100 << 20).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_write_that_fails_on_a_full_disk_loses_nothing_and_the_store_goes_on_when_there_is_room() {
    rides_through_a_full_disk(0).await;
}

/// Fills the disk under a server while a vehicle streams, and empties it again.
async fn rides_through_a_full_disk(min_free_disk_bytes: u64) {
    let folder = tempfile::tempdir().unwrap();
    let binary = env!("CARGO_BIN_EXE_killable-server");
    let small = [("LANEMAP_MIN_FREE_DISK_BYTES", min_free_disk_bytes.to_string())];
    let Some(server) = ServerProcess::start_on_small_disk(binary, folder.path(), 256 << 20, &small) else {
        eprintln!("no user may mount a disk here: not tested");
        return;
    };
    let drive = drives::simulated(3, 400);
    let client = IngestClient::connect(&server.url).await.unwrap();
    let start = SessionStart { reconnect: Reconnect::forever(), ..drive.start() };
    let (mut session, _events) = client.start_session(start).await.unwrap();
    for frame in &drive.frames[..100] {
        session.send(frame).await.unwrap();
    }
    session.wait_acked(Sequence(100)).await.unwrap();

    let filler = server.path_within(folder.path()).join("filler");
    fill_disk(&filler);
    let sending = tokio::spawn(async move {
        for frame in &drive.frames[100..] {
            session.send(frame).await.unwrap();
        }
        (session, drive)
    });
    let ready = format!("{}/readyz", server.url);
    let refused = wait_for_status(&ready, 503).await;
    assert!(refused.contains("frames cannot be made durable"), "{refused}");
    // Whoever comes now is told to come back later.
    let status = RawStream::open(&server.url).await.start_error(drives::simulated(4, 1).wire_start()).await;
    assert!(matches!(status.code(), Code::ResourceExhausted | Code::Unavailable), "{status:?}");
    assert!(status.get_details_retry_info().unwrap().retry_delay.is_some());

    std::fs::remove_file(&filler).unwrap();
    wait_for_status(&ready, 200).await;
    let (session, drive) = sending.await.unwrap();
    let id = session.id().to_owned();
    let summary = session.finish().await.unwrap();
    assert_eq!((summary.acked, summary.refused), (Some(Sequence(400)), 0));
    assert_same_map(&map_bytes(&server.url, &id).await, &drive);
}

/// Writes until there is no room.
fn fill_disk(filler: &Path) {
    let mut file = File::create(filler).unwrap();
    let block = vec![1; 64 << 10];
    while file.write_all(&block).is_ok() {}
}

/// Asks until the answer has this status; gives what it says.
async fn wait_for_status(url: &str, status: u16) -> String {
    let asking = async {
        loop {
            let answer = http::get(url).await.unwrap();
            if answer.status().as_u16() == status {
                return answer.text().await.unwrap();
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(Duration::from_mins(1), asking).await.expect("the status stays as it is")
}

#[tokio::test]
async fn a_second_server_on_the_same_store_is_refused_and_the_first_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let first = servers::start(folder.path()).await;
    let error = Server::start(servers::config(folder.path())).await.unwrap_err().to_string();
    assert!(error.contains(&folder.path().display().to_string()) && error.contains("Locked"), "{error}");
    IngestClient::connect(first.url()).await.unwrap();
}

/// Streams a drive from where the server says, no further than `until`; gives the last ack that was heard before the
/// stream broke.
async fn stream_until_killed(
    url: String,
    drive: Arc<Drive>,
    acked: Option<Sequence>,
    until: Sequence,
) -> Option<Sequence> {
    let Ok(client) = IngestClient::connect(&url).await else { return acked };
    let reconnect = Reconnect { max_tries: 0, ..Reconnect::default() };
    let start = SessionStart { reconnect, ..drive.start() };
    let Ok((mut session, _events)) = client.start_session(start).await else { return acked };
    let kept = session.resume_after();
    assert!(kept >= acked, "acked {acked:?}, kept {kept:?}");
    for frame in rest(&drive, kept).iter().take_while(|frame| frame.sequence() <= until) {
        match session.send(frame).await {
            Ok(()) => {}
            Err(ClientError::Status(_) | ClientError::Unreachable(_)) => return session.acked().max(kept),
            Err(error) => panic!("{error}"),
        }
    }
    // All is sent: only the kill ends the stream now.
    session.wait_acked(Sequence(u64::MAX)).await.unwrap_err();
    session.acked().max(kept)
}

/// Waits for any time up to `longest_ms`.
async fn random_pause(longest_ms: u64) {
    let random = RandomState::new().hash_one(0);
    tokio::time::sleep(Duration::from_micros(random % (1000 * longest_ms))).await;
}

/// The number of the next ack.
async fn next_ack(stream: &mut RawStream) -> u64 {
    loop {
        if let Response::Ack(ack) = stream.answer().await {
            return ack.acked_sequence_inclusive;
        }
    }
}

/// The frames after `after`.
fn rest(drive: &Drive, after: Option<Sequence>) -> &[lanemap_core::Frame] {
    let had = drive.frames.partition_point(|frame| Some(frame.sequence()) <= after);
    &drive.frames[had..]
}
