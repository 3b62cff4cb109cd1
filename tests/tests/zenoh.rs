//! Promise: over zenoh a drive lives by the same rules as over gRPC, and its map is the same, byte by byte.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    fs::{self, File},
    io::{BufRead, BufReader},
    path::Path,
    process::{Child, Command, Stdio},
};

use lanemap_proto::{
    encode,
    v1::{self, stream_observations_request::Message as Request, stream_observations_response::Message as Response},
};
use lanemap_server::{
    RunningServer, Server, ServerConfig,
    config::ZenohMode,
    session::{SessionId, SessionState},
};
use lanemap_tests::{
    drives::{self, Drive, assert_same_map},
    raw_stream::RawStream,
    raw_zenoh::{self, RawZenohStream, free_endpoint},
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
    let endpoint = free_endpoint();
    let server = Server::start(config(folder, &endpoint)).await.unwrap();
    (server, raw_zenoh::connect(&endpoint).await)
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
    let endpoint = free_endpoint();
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
    let endpoint = free_endpoint();
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
    let endpoint = free_endpoint();
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
async fn a_server_that_is_a_client_of_a_router_serves_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
    let router = zenoh::open(raw_zenoh::configuration("router", &[&endpoint], &[])).await.unwrap();
    let settings = ServerConfig {
        zenoh_mode: ZenohMode::Client,
        zenoh_connect: endpoint.parse().unwrap(),
        ..servers::config(folder.path())
    };
    let server = Server::start(settings).await.unwrap();
    let session = raw_zenoh::connect(&endpoint).await;
    raw_zenoh::server_is_there(&session, true).await;
    let drive = drives::simulated(5, 80);
    let (mut stream, accepted) = RawZenohStream::started(&session, drive.wire_start()).await;
    stream.stream(&drive.frames, IN_FLIGHT).await;
    stream.end_drive().await;
    assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &drive);
    let mut publications = server.sessions().publications();
    let (_gone, other) = RawZenohStream::started(&session, start_of(&drive, "another")).await;
    session.close().await.unwrap();
    let id: SessionId = other.session_id.parse().unwrap();
    while server.sessions().get(&id).unwrap().state != SessionState::Idle {
        publications.changed().await.unwrap();
    }
    server.shutdown().await;
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bad_frame_is_refused_with_its_field_and_the_stream_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, session) = server_and_session(folder.path()).await;
    let drive = drives::simulated(7, 3);
    let (mut stream, _) = RawZenohStream::started(&session, drive.wire_start()).await;
    stream.send_frame(v1::Frame { odometry: None, ..encode::frame(&drive.frames[0]) }).await;
    let refusal = stream.refusal().await;
    assert_eq!((refusal.reason(), refusal.field.as_str()), (v1::RefusalReason::Missing, "frame.odometry"));
    stream.stream(&drive.frames, 1).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn whatever_a_peer_gets_wrong_it_is_told_and_its_neighbour_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let (server, session) = server_and_session(folder.path()).await;
    let drive = drives::simulated(5, 60);
    let (mut neighbour, accepted) = RawZenohStream::started(&session, start_of(&drive, "neighbour")).await;
    let mut pieces = drive.frames.chunks(10);
    let closed_with = |closed: v1::StreamClosed| Code::from(closed.code);

    // Bytes that are no message, first of all and in mid-stream.
    let mut garbage = RawZenohStream::open(&session, "test-fleet", "garbage").await;
    garbage.send_bytes(vec![0xff; 40]).await;
    assert_eq!(closed_with(garbage.closed().await), Code::InvalidArgument);
    let (mut garbage, _) = RawZenohStream::started(&session, start_of(&drive, "garbage")).await;
    garbage.send_bytes(b"no protobuf".to_vec()).await;
    assert_eq!(closed_with(garbage.closed().await), Code::InvalidArgument);
    neighbour.stream(pieces.next().unwrap(), 5).await;

    // A start that names another vehicle than the key.
    let mut impostor = RawZenohStream::open(&session, "test-fleet", "impostor").await;
    impostor.send(Request::Start(start_of(&drive, "neighbour"))).await;
    assert_eq!(closed_with(impostor.closed().await), Code::PermissionDenied);
    neighbour.stream(pieces.next().unwrap(), 5).await;

    // No attachment, or none that can be read.
    let lost = RawZenohStream::open(&session, "test-fleet", "lost").await;
    for attachment in [None, Some("0123"), Some("no hexadecimal digits, all of it")] {
        lost.put(Vec::new(), attachment).await;
        let (answered, answer) = lost.any_answer().await;
        let Response::Closed(closed) = answer else { panic!("{answer:?}") };
        assert_eq!((answered.nonce.0, closed_with(closed)), (0, Code::InvalidArgument));
    }
    neighbour.stream(pieces.next().unwrap(), 5).await;

    // A frame of a stream that nobody opened.
    let mut unopened = RawZenohStream::open(&session, "test-fleet", "unopened").await;
    unopened.next_number = 7;
    unopened.send_frame(encode::frame(&drive.frames[0])).await;
    assert_eq!(closed_with(unopened.closed().await), Code::Unavailable);

    // A message that did not arrive.
    let (mut gap, _) = RawZenohStream::started(&session, start_of(&drive, "gap")).await;
    gap.next_number += 1;
    gap.send_frame(encode::frame(&drive.frames[0])).await;
    assert_eq!(closed_with(gap.closed().await), Code::DataLoss);
    neighbour.stream(pieces.next().unwrap(), 5).await;

    // A frame before the start is refused; the stream waits for its start.
    let mut early = RawZenohStream::open(&session, "test-fleet", "early").await;
    early.send_frame(encode::frame(&drive.frames[0])).await;
    assert_eq!(early.refusal().await.reason(), v1::RefusalReason::OutOfTurn);
    early.start(start_of(&drive, "early")).await;
    neighbour.stream(pieces.next().unwrap(), 5).await;

    // The nonce of a neighbour's stream: his goes on.
    let mut thief = RawZenohStream::open(&session, "test-fleet", "thief").await;
    thief.nonce = neighbour.nonce;
    thief.send(Request::Start(start_of(&drive, "thief"))).await;
    assert_eq!(closed_with(thief.closed().await), Code::AlreadyExists);

    neighbour.stream(pieces.next().unwrap(), 5).await;
    neighbour.end_drive().await;
    assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_beyond_the_limit_closes_its_stream_only() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
    let settings = ServerConfig { max_message_bytes: 100_000, ..config(folder.path(), &endpoint) };
    let server = Server::start(settings).await.unwrap();
    let session = raw_zenoh::connect(&endpoint).await;
    let drive = drives::simulated(5, 60);
    let (mut neighbour, accepted) = RawZenohStream::started(&session, start_of(&drive, "neighbour")).await;
    let (mut large, _) = RawZenohStream::started(&session, start_of(&drive, "large")).await;
    large.send_bytes(vec![0; 100_001]).await;
    assert_eq!(Code::from(large.closed().await.code), Code::OutOfRange);
    // Far beyond the limit it is not even put together: whoever sends it sees a gap with the next message, or is cut.
    let other = raw_zenoh::connect(&endpoint).await;
    let huge = RawZenohStream::open(&other, "test-fleet", "huge").await;
    huge.put(vec![0; 10_000_000], Some(&"0".repeat(32))).await;
    neighbour.stream(&drive.frames, IN_FLIGHT).await;
    neighbour.end_drive().await;
    assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_that_sends_more_than_may_be_in_flight_loses_its_stream_and_no_acked_frame() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
    let settings = ServerConfig { max_frames_in_flight: 1, ..config(folder.path(), &endpoint) };
    let _server = Server::start(settings).await.unwrap();
    let session = raw_zenoh::connect(&endpoint).await;
    let drive = drives::simulated(5, 300);
    let (mut greedy, accepted) = RawZenohStream::started(&session, drive.wire_start()).await;
    // Frames that take far longer to map than to send.
    let heavy: Vec<_> = drive.frames.iter().map(|frame| with_detections(encode::frame(frame), 60)).collect();
    for frame in &heavy {
        greedy.send_frame(frame.clone()).await;
    }
    let mut acked = 0;
    let closed = loop {
        match greedy.answer().await {
            Response::Ack(ack) => acked = ack.acked_sequence_inclusive,
            Response::Closed(closed) => break closed,
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(Code::from(closed.code), Code::ResourceExhausted, "{closed:?}");
    // It hears the same key, and would hold back what it does not read.
    drop(greedy);
    let (mut again, resumed) = RawZenohStream::started(&session, drive.wire_start()).await;
    assert_eq!(resumed.resume_after_sequence, Some(acked));
    assert_eq!(resumed.session_id, accepted.session_id);
    for frame in &heavy[usize::try_from(acked).unwrap()..] {
        again.send_frame(frame.clone()).await;
        again.acked(frame.sequence).await;
    }
    assert_eq!(again.end_drive().await.acked_sequence_inclusive, Some(300));
}

/// The frame with its detections repeated up to `count`.
fn with_detections(frame: v1::Frame, count: usize) -> v1::Frame {
    let detections = frame.detections.iter().cycle().take(count).cloned().collect();
    v1::Frame { detections, ..frame }
}

#[tokio::test(flavor = "multi_thread")]
async fn streams_over_zenoh_count_among_all_streams() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
    let settings = ServerConfig { max_live_sessions: 1, ..config(folder.path(), &endpoint) };
    let server = Server::start(settings).await.unwrap();
    let session = raw_zenoh::connect(&endpoint).await;
    let drive = drives::simulated(5, 5);
    let (_one, _) = RawStream::started(&server.url(), start_of(&drive, "one")).await;
    let mut two = RawZenohStream::open(&session, "test-fleet", "two").await;
    two.send(Request::Start(start_of(&drive, "two"))).await;
    let closed = two.closed().await;
    assert_eq!(Code::from(closed.code), Code::ResourceExhausted);
    assert!(closed.retry_after_ms.is_some());
    // The place that it takes in zenoh itself is bounded too.
    let mut three = RawZenohStream::open(&session, "test-fleet", "three").await;
    three.send(Request::Start(start_of(&drive, "three"))).await;
    assert_eq!(Code::from(three.closed().await.code), Code::ResourceExhausted);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_link_loses_is_fetched_again_and_the_map_is_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
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
async fn a_vehicle_that_never_reads_slows_no_neighbour_and_loses_its_stream() {
    let folder = tempfile::tempdir().unwrap();
    let (server, session) = server_and_session(folder.path()).await;
    let deaf_session = {
        let endpoint = session.info().links().await.next().unwrap().dst().to_string();
        raw_zenoh::connect(&endpoint).await
    };
    let drive = drives::simulated(5, 200);
    let (mut deaf, deaf_accepted) = RawZenohStream::started(&deaf_session, start_of(&drive, "deaf")).await;
    // Refusals may not be dropped: once nobody reads them, they wait, and then the link is cut.
    let deaf_id: SessionId = deaf_accepted.session_id.parse().unwrap();
    let cut = async {
        while server.sessions().get(&deaf_id).unwrap().state != SessionState::Idle {
            for frame in &drive.frames[..8] {
                deaf.send_frame(v1::Frame { odometry: None, ..encode::frame(frame) }).await;
            }
        }
    };
    let neighbour = async {
        let (mut stream, accepted) = RawZenohStream::started(&session, start_of(&drive, "neighbour")).await;
        stream.stream(&drive.frames, IN_FLIGHT).await;
        stream.end_drive().await;
        assert_same_map(&map_bytes(&server.url(), &accepted.session_id).await, &drive);
    };
    tokio::join!(cut, neighbour);
}

#[tokio::test(flavor = "multi_thread")]
async fn no_log_and_no_metric_names_a_vehicle_that_streams_over_zenoh() {
    const VEHICLE: &str = "nobody-may-read-this";
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
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

#[tokio::test(flavor = "multi_thread")]
async fn a_router_that_is_started_anew_is_found_again_by_the_server() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
    let start_router = || zenoh::open(raw_zenoh::configuration("router", &[&endpoint], &[]));
    let router = start_router().await.unwrap();
    let settings = ServerConfig {
        zenoh_mode: ZenohMode::Client,
        zenoh_connect: endpoint.parse().unwrap(),
        ..servers::config(folder.path())
    };
    let server = Server::start(settings).await.unwrap();
    let session = raw_zenoh::connect(&endpoint).await;
    raw_zenoh::server_is_there(&session, true).await;
    let drive = drives::simulated(5, 60);
    let (mut stream, _) = RawZenohStream::started(&session, drive.wire_start()).await;
    stream.stream(&drive.frames[..30], IN_FLIGHT).await;
    router.close().await.unwrap();
    session.close().await.unwrap();

    let router = start_router().await.unwrap();
    let session = raw_zenoh::connect(&endpoint).await;
    raw_zenoh::server_is_there(&session, true).await;
    let (mut stream, resumed) = RawZenohStream::started(&session, drive.wire_start()).await;
    assert_eq!(resumed.resume_after_sequence, Some(30));
    stream.stream(&drive.frames[30..], IN_FLIGHT).await;
    stream.end_drive().await;
    assert_same_map(&map_bytes(&server.url(), &resumed.session_id).await, &drive);
    server.shutdown().await;
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_waits_for_its_router_a_while_and_then_says_which_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
    let settings = ServerConfig {
        zenoh_mode: ZenohMode::Client,
        zenoh_connect: endpoint.parse().unwrap(),
        ..servers::config(folder.path())
    };
    let (server, router) = tokio::join!(
        Server::start(settings.clone()),
        zenoh::open(raw_zenoh::configuration("router", &[&endpoint], &[]))
    );
    server.unwrap().shutdown().await;
    router.unwrap().close().await.unwrap();
    let error = Server::start(settings).await.unwrap_err().to_string();
    assert!(error.contains(&endpoint), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_endpoint_that_is_taken_is_named() {
    let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let endpoint = free_endpoint();
    let _server = Server::start(config(folder.path(), &endpoint)).await.unwrap();
    let error = Server::start(config(other.path(), &endpoint)).await.unwrap_err().to_string();
    assert!(error.contains(&endpoint), "{error}");
}
