//! What peers get wrong, and send too much of: they are told, and their neighbours go on.

use lanemap_proto::{
    encode,
    v1::{self, stream_observations_request::Message as Request, stream_observations_response::Message as Response},
};
use lanemap_server::{
    ServerConfig,
    session::{SessionId, SessionState},
};
use lanemap_tests::{
    drives::{self, assert_same_map},
    raw_stream::RawStream,
    raw_zenoh::{self, RawZenohStream},
    servers::map_bytes,
};
use tonic::Code;

use super::{IN_FLIGHT, server_and_session, server_with, start_of};

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
    let (server, endpoint, session) =
        server_with(folder.path(), |config| ServerConfig { max_message_bytes: 100_000, ..config }).await;
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
    let (_server, _, session) =
        server_with(folder.path(), |config| ServerConfig { max_frames_in_flight: 1, ..config }).await;
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
    let (server, _, session) =
        server_with(folder.path(), |config| ServerConfig { max_live_sessions: 1, ..config }).await;
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
