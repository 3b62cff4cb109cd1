//! Promise: a shutdown ends within 10 s with streams open, and loses nothing that was acked.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::time::Duration;

use lanemap_proto::encode;
use lanemap_tests::{drives, raw_stream::RawStream, servers};
use tokio::time::timeout;
use tonic::{Code, transport::Channel};
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};

/// The longest that a shutdown may take.
const LONGEST: Duration = Duration::from_secs(10);

#[tokio::test(flavor = "multi_thread")]
async fn a_shutdown_ends_open_streams_and_keeps_what_was_acked() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let mut streams = Vec::new();
    for seed in 0..8 {
        let drive = drives::simulated(seed, 20);
        let (mut stream, accepted) = RawStream::started(&server.url(), drive.wire_start()).await;
        for frame in &drive.frames {
            stream.send_frame(encode::frame(frame)).await;
        }
        stream.acked(20).await;
        streams.push((drive, stream, accepted));
    }

    timeout(LONGEST, server.shutdown()).await.expect("the shutdown takes too long");
    for (_, stream, _) in &mut streams {
        let status = stream.end().await.unwrap_err();
        assert_eq!(status.code(), Code::Unavailable, "{status:?}");
    }

    let server = servers::start(folder.path()).await;
    for (drive, _, accepted) in &streams {
        let (_, resumed) = RawStream::started(&server.url(), drive.wire_start()).await;
        assert_eq!(resumed.session_id, accepted.session_id);
        assert_eq!(resumed.resume_after_sequence, Some(20));
    }
    timeout(LONGEST, server.shutdown()).await.expect("the shutdown takes too long");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_that_never_reads_holds_no_shutdown() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(1, 300);
    let (deaf, _) = RawStream::started(&server.url(), drive.wire_start()).await;
    let filling = async {
        for frame in drive.frames.iter().cycle() {
            deaf.send_frame(lanemap_proto::v1::Frame { odometry: None, ..encode::frame(frame) }).await;
        }
    };
    // Frames without odometry are refused; once nobody reads the refusals, the stream takes no more frames.
    timeout(Duration::from_secs(2), filling).await.unwrap_err();
    timeout(LONGEST, server.shutdown()).await.expect("the shutdown takes too long");
}

#[tokio::test(flavor = "multi_thread")]
async fn who_watches_health_hears_of_a_shutdown_before_the_connection_closes() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let channel = Channel::from_shared(server.url()).unwrap().connect().await.unwrap();
    let mut client = HealthClient::new(channel);
    let service = "lanemap.v1.IngestService".to_owned();
    let mut health = client.watch(HealthCheckRequest { service }).await.unwrap().into_inner();
    assert_eq!(health.message().await.unwrap().unwrap().status(), ServingStatus::Serving);
    server.shutdown_token().cancel();
    assert_eq!(health.message().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    // The watch stays open: it holds the shutdown no longer than it may.
    timeout(LONGEST, server.stopped()).await.expect("the shutdown takes too long");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_that_has_not_started_is_ended_too() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let mut stream = RawStream::open(&server.url()).await;
    timeout(LONGEST, server.shutdown()).await.expect("the shutdown takes too long");
    assert_eq!(stream.end().await.unwrap_err().code(), Code::Unavailable);
}
