//! Promise: over zenoh a drive lives by the same rules as over gRPC, and its map is the same, byte by byte.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

mod misuse;
mod routers;

use std::{
    fs::{self, File},
    io::{BufRead, BufReader},
    path::Path,
    process::{Child, Command, Stdio},
};

use lanemap_proto::{
    encode,
    v1::{self, stream_observations_response::Message as Response},
};
use lanemap_server::{
    RunningServer, Server, ServerConfig,
    config::ZenohMode,
    session::{SessionId, SessionState},
};
use lanemap_tests::{
    drives::{self, Drive, assert_same_map},
    endpoints::HeldEndpoint,
    raw_stream::RawStream,
    raw_zenoh::{self, RawZenohStream},
    servers::{self, map_bytes},
};
use tonic::Code;

/// Frames that the tests leave unacked; the server takes 64.
const IN_FLIGHT: usize = 32;

fn config(folder: &Path, endpoint: &str) -> ServerConfig {
    ServerConfig { zenoh_mode: ZenohMode::Router, zenoh_listen: endpoint.parse().unwrap(), ..servers::config(folder) }
}

/// A server that is a zenoh router, and a vehicle's connection to it.
async fn server_and_session(folder: &Path) -> (RunningServer, zenoh::Session) {
    let (server, _, session) = server_with(folder, |config| config).await;
    (server, session)
}

/// A server that is a zenoh router with settings of its own, its endpoint, and a vehicle's connection to it.
async fn server_with(
    folder: &Path,
    set: impl FnOnce(ServerConfig) -> ServerConfig,
) -> (RunningServer, HeldEndpoint, zenoh::Session) {
    let endpoint = HeldEndpoint::tcp();
    let server = Server::start(set(config(folder, &endpoint))).await.unwrap();
    let session = raw_zenoh::connect(&endpoint).await;
    (server, endpoint, session)
}

fn start_of(drive: &Drive, vehicle: &str) -> v1::SessionStart {
    v1::SessionStart { vehicle_id: vehicle.to_owned(), ..drive.wire_start() }
}

/// `lanemap serve` in a process of its own, to be killed; its log lies beside its store.
struct Process {
    child: Child,
    url: String,
}

impl Process {
    fn start(folder: &Path, endpoint: &str) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--zenoh-mode", "router", "--zenoh-listen", endpoint]);
        let log = File::create(folder.join("log")).unwrap();
        let command = command.arg("--data-dir").arg(folder.join("store")).env_remove("RUST_LOG");
        let mut child = command.stdout(Stdio::piped()).stderr(log).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.split([' ', ',']).find(|word| word.starts_with("http://")).unwrap_or_else(|| panic!("{line:?}"));
        Self { child, url: url.to_owned() }
    }

    fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have been killed before.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_gives_the_same_bytes_over_grpc_over_zenoh_and_from_the_journal() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let server = Process::start(folder.path(), &endpoint);
    let session = raw_zenoh::connect(&endpoint).await;
    let drive = drives::simulated(5, 150);

    let (mut over_zenoh, zenoh_session) = RawZenohStream::started(&session, start_of(&drive, "zenoh/ä 1")).await;
    over_zenoh.stream(&drive.frames, IN_FLIGHT).await;
    let (mut over_grpc, grpc_session) = RawStream::started(&server.url, start_of(&drive, "grpc")).await;
    for frame in &drive.frames {
        over_grpc.send_frame(encode::frame(frame)).await;
    }
    over_grpc.acked(150).await;

    // Neither drive has ended, and no snapshot is due: what the next server knows comes from the journal.
    server.kill();
    let server = Process::start(folder.path(), &endpoint);
    for id in [&zenoh_session.session_id, &grpc_session.session_id] {
        assert_same_map(&map_bytes(&server.url, id).await, &drive);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_is_acked_mapped_and_ended_and_its_poses_come_back() {
    let folder = tempfile::tempdir().unwrap();
    let (server, session) = server_and_session(folder.path()).await;
    let drive = drives::simulated(6, 60);
    let start = v1::SessionStart { wants_local_map: true, ..drive.wire_start() };
    let (mut stream, accepted) = RawZenohStream::started(&session, start).await;
    assert_eq!(accepted.resume_after_sequence, None);
    stream.stream(&drive.frames, 1).await;
    for number in (0..120).step_by(2) {
        let (attachment, pose) = stream.pose().await;
        assert_eq!((attachment.nonce, attachment.number), (stream.nonce, number));
        assert!(matches!(pose, Response::Pose(pose) if pose.sequence == number / 2 + 1));
        let (attachment, map) = stream.pose().await;
        assert_eq!(attachment.number, number + 1);
        assert!(matches!(map, Response::LocalMap(map) if map.sequence == number / 2 + 1));
    }
    assert_eq!(stream.end_drive().await.acked_sequence_inclusive, Some(60));
    assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &drive);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_that_vanishes_closes_its_stream_and_resumes_later() {
    let folder = tempfile::tempdir().unwrap();
    let (server, session) = server_and_session(folder.path()).await;
    let endpoint = session.info().links().await.next().unwrap().dst().to_string();
    let drive = drives::simulated(7, 40);
    let (mut stream, accepted) = RawZenohStream::started(&session, drive.wire_start()).await;
    stream.stream(&drive.frames[..20], IN_FLIGHT).await;
    let mut publications = server.sessions().publications();
    session.close().await.unwrap();
    let id: SessionId = accepted.session_id.parse().unwrap();
    while server.sessions().get(&id).unwrap().state != SessionState::Idle {
        publications.changed().await.unwrap();
    }

    let session = raw_zenoh::connect(&endpoint).await;
    let (mut stream, resumed) = RawZenohStream::started(&session, drive.wire_start()).await;
    assert_eq!((&resumed.session_id, resumed.resume_after_sequence), (&accepted.session_id, Some(20)));
    stream.stream(&drive.frames[20..], IN_FLIGHT).await;
    stream.end_drive().await;
    assert_same_map(&map_bytes(&server.url(), &resumed.session_id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_that_goes_closes_the_stream_and_keeps_what_came_before() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, session) = server_and_session(folder.path()).await;
    let drive = drives::simulated(7, 10);
    let (mut stream, _) = RawZenohStream::started(&session, drive.wire_start()).await;
    stream.stream(&drive.frames, IN_FLIGHT).await;
    stream.drop_token().await;
    assert_eq!(stream.closed().await.code, Code::Ok as i32);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_without_a_token_is_closed() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, session) = server_and_session(folder.path()).await;
    let drive = drives::simulated(7, 10);
    let start = drive.wire_start();
    let mut stream = RawZenohStream::open_without_token(&session, &start.fleet_id, &start.vehicle_id).await;
    stream.start(start).await;
    assert_eq!(stream.closed().await.code, Code::FailedPrecondition as i32);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_newer_stream_takes_over_whichever_way_it_comes() {
    let folder = tempfile::tempdir().unwrap();
    let (server, session) = server_and_session(folder.path()).await;
    let drive = drives::simulated(7, 5);
    let (mut first, accepted) = RawZenohStream::started(&session, drive.wire_start()).await;
    first.stream(&drive.frames[..1], 1).await;
    let (mut second, resumed) = RawZenohStream::started(&session, drive.wire_start()).await;
    assert_eq!((&resumed.session_id, resumed.resume_after_sequence), (&accepted.session_id, Some(1)));
    assert_eq!(first.closed().await.code, Code::Aborted as i32);
    second.stream(&drive.frames[1..2], 1).await;

    let (mut over_grpc, resumed) = RawStream::started(&server.url(), drive.wire_start()).await;
    assert_eq!((&resumed.session_id, resumed.resume_after_sequence), (&accepted.session_id, Some(2)));
    assert_eq!(second.closed().await.code, Code::Aborted as i32);
    over_grpc.send_frame(encode::frame(&drive.frames[2])).await;
    over_grpc.acked(3).await;

    let (mut third, resumed) = RawZenohStream::started(&session, drive.wire_start()).await;
    assert_eq!(resumed.resume_after_sequence, Some(3));
    assert_eq!(over_grpc.end().await.unwrap_err().code(), Code::Aborted);
    third.stream(&drive.frames[3..], 1).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_killed_in_mid_drive_is_found_again_and_the_drive_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let server = Process::start(folder.path(), &endpoint);
    let session = raw_zenoh::connect(&endpoint).await;
    let drive = drives::simulated(8, 120);
    let (mut stream, _) = RawZenohStream::started(&session, drive.wire_start()).await;
    stream.stream(&drive.frames[..70], IN_FLIGHT).await;
    server.kill();

    let server = Process::start(folder.path(), &endpoint);
    raw_zenoh::server_is_there(&session, true).await;
    stream.send_frame(encode::frame(&drive.frames[70])).await;
    assert_eq!(stream.closed().await.code, Code::Unavailable as i32, "the new server knows no such stream");
    let (mut stream, resumed) = RawZenohStream::started(&session, drive.wire_start()).await;
    assert_eq!(resumed.resume_after_sequence, Some(70));
    stream.stream(&drive.frames[70..], IN_FLIGHT).await;
    stream.end_drive().await;
    assert_same_map(&map_bytes(&server.url, &resumed.session_id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_shutdown_closes_streams_with_unavailable_and_keeps_what_was_acked() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let server = Server::start(config(folder.path(), &endpoint)).await.unwrap();
    let session = raw_zenoh::connect(&endpoint).await;
    let drive = drives::simulated(9, 40);
    let (mut stream, _) = RawZenohStream::started(&session, drive.wire_start()).await;
    stream.stream(&drive.frames[..25], IN_FLIGHT).await;
    server.shutdown().await;
    let closed = stream.closed().await;
    assert_eq!(closed.code, Code::Unavailable as i32, "{closed:?}");

    let server = Server::start(config(folder.path(), &endpoint)).await.unwrap();
    raw_zenoh::server_is_there(&session, true).await;
    let (_, resumed) = RawZenohStream::started(&session, drive.wire_start()).await;
    assert_eq!(resumed.resume_after_sequence, Some(25));
    server.shutdown().await;
    raw_zenoh::server_is_there(&session, false).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_link_loses_is_fetched_again_and_the_map_is_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let server = Server::start(config(folder.path(), &endpoint)).await.unwrap();
    // A vehicle whose link lets five messages a second through, and loses all others.
    let mut lossy = raw_zenoh::configuration("client", &[], &[&endpoint]);
    let rules = r#"[{ "key_expr": "lanemap/v1/*/*/observations", "freq": 5.0 }]"#;
    let loss = format!(r#"[{{ "flows": ["egress"], "messages": ["put"], "rules": {rules} }}]"#);
    lossy.insert_json5("downsampling", &loss).unwrap();
    let session = zenoh::open(lossy).await.unwrap();
    let drive = drives::simulated(5, 90);
    let start = drive.wire_start();
    let mut stream = RawZenohStream::open(&session, &start.fleet_id, &start.vehicle_id).await;
    stream.make_recoverable(2 * IN_FLIGHT).await;
    let accepted = stream.start(start).await;
    stream.stream(&drive.frames, IN_FLIGHT).await;
    stream.end_drive().await;
    assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn no_log_and_no_metric_names_a_vehicle_that_streams_over_zenoh() {
    const VEHICLE: &str = "nobody-may-read-this";
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let server = Process::start(folder.path(), &endpoint);
    let session = raw_zenoh::connect(&endpoint).await;
    let drive = drives::simulated(7, 10);
    let (mut stream, _) = RawZenohStream::started(&session, start_of(&drive, VEHICLE)).await;
    stream.stream(&drive.frames, IN_FLIGHT).await;
    stream.next_number += 1;
    stream.send_frame(encode::frame(&drive.frames[0])).await;
    assert_eq!(Code::from(stream.closed().await.code), Code::DataLoss);
    stream.put(Vec::new(), None).await;
    assert!(matches!(stream.any_answer().await, (_, Response::Closed(_))));
    // A link that breaks in mid-stream.
    let other = raw_zenoh::connect(&endpoint).await;
    let (_lost, _) = RawZenohStream::started(&other, start_of(&drive, VEHICLE)).await;
    other.close().await.unwrap();

    let metrics = lanemap_tests::http::get(format!("{}/metrics", server.url)).await.unwrap().text().await.unwrap();
    for counted in [
        "lanemap_zenoh_streams_broken_total{code=\"DataLoss\"} 1",
        "lanemap_zenoh_messages_turned_away_total 1",
        "lanemap_zenoh_messages_repeated_total 0",
    ] {
        assert!(metrics.contains(counted), "{counted} is missing from {metrics}");
    }
    assert!(!metrics.contains(VEHICLE));
    server.kill();
    let log = fs::read_to_string(folder.path().join("log")).unwrap();
    assert!(log.contains("taking observations over zenoh"), "{log}");
    assert!(!log.contains(VEHICLE), "{log}");
}
