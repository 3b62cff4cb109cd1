//! Promise: everything is bounded, and one slow, hostile or dead client does not slow another.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{io::Write, path::Path, time::Duration};

use bytes::Bytes;
use h2::client::SendRequest;
use lanemap_proto::{
    encode,
    v1::{self, stream_observations_request::Message as Request},
};
use lanemap_server::{Server, ServerConfig};
use lanemap_tests::{
    drives::{self, Drive},
    raw_stream::RawStream,
    servers::{self, ServerProcess},
};
use prost::Message;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    time::timeout,
};
use tonic::{Code, transport::Channel};
use tonic_types::StatusExt;

/// Longest wait before a test fails.
const PATIENCE: Duration = Duration::from_secs(30);

/// Streams a drive and waits for every ack: it is not slowed to a halt by whoever else is there.
async fn streams_well(url: &str, drive: &Drive) {
    let (mut stream, _) = RawStream::started(url, drive.wire_start()).await;
    for frame in &drive.frames {
        stream.send_frame(encode::frame(frame)).await;
        stream.acked(frame.sequence().0).await;
    }
}

fn wire_start(drive: &Drive, vehicle: &str) -> v1::SessionStart {
    v1::SessionStart { vehicle_id: vehicle.to_owned(), ..drive.wire_start() }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_never_reads_its_answers_slows_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let (drive, other) = (drives::simulated(1, 200), drives::simulated(2, 40));
    let mut deaf = RawStream::open_with_small_windows(&server.url()).await;
    deaf.start(v1::SessionStart { wants_local_map: true, ..drive.wire_start() }).await;
    let sending = tokio::spawn(async move {
        for frame in &drive.frames {
            deaf.send_frame(encode::frame(frame)).await;
        }
        deaf
    });
    streams_well(&server.url(), &other).await;
    // All of it is taken, though nothing of the answers was read: what they bring is dropped, and the acks are merged.
    let mut deaf = sending.await.unwrap();
    deaf.acked(200).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_floods_with_huge_frames_waits_for_its_own_and_slows_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { max_bytes_in_flight: 16 << 20, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let (drive, other) = (drives::simulated(1, 5), drives::simulated(2, 40));
    let (flood, _) = RawStream::started(&server.url(), drive.wire_start()).await;
    let mut huge = encode::frame(&drive.frames[4]);
    let line = v1::Detection { xyz: [10.0, 1.0, 0.0].repeat(4096), ..huge.detections[0].clone() };
    huge.detections = vec![line; 32];
    let flooding = tokio::spawn(async move {
        for number in 1.. {
            let time_unix_ns = huge.time_unix_ns + i64::try_from(number).unwrap() * 1_000_000;
            flood.send_frame(v1::Frame { sequence: number, time_unix_ns, ..huge.clone() }).await;
        }
    });
    streams_well(&server.url(), &other).await;
    assert!(!flooding.is_finished(), "the flood went on all the time");
    flooding.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_stalls_in_the_middle_of_a_message_slows_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(2, 40);
    let mut client = http2(&server.url()).await;
    let (_answer, mut body) = client.send_request(grpc("StreamObservations", "identity"), false).unwrap();
    let start = v1::StreamObservationsRequest { message: Some(Request::Start(wire_start(&drive, "stalled"))) };
    body.send_data(length_prefixed(0, &start.encode_to_vec()), false).unwrap();
    // The first half of a message of 100 bytes.
    let mut half = length_prefixed(0, &[0; 100]).to_vec();
    half.truncate(50);
    body.send_data(half.into(), false).unwrap();
    streams_well(&server.url(), &drive).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_peer_that_answers_no_ping_is_cut_off() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { keep_alive_s: 1, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let mut dead = TcpStream::connect(server.address()).await.unwrap();
    // The preface of HTTP/2 and empty settings; from then on the peer is silent.
    dead.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").await.unwrap();
    let mut heard = Vec::new();
    let closed = timeout(PATIENCE, dead.read_to_end(&mut heard)).await;
    assert!(closed.is_ok(), "the connection is still open");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_that_names_no_drive_is_ended() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { start_wait_s: 1, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let status = RawStream::open(&server.url()).await.end().await.unwrap_err();
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn one_stream_too_many_is_told_when_to_come_back_and_finds_a_place_later() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { max_live_sessions: 1, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let drive = drives::simulated(1, 3);
    let (mut first, _) = RawStream::started(&server.url(), wire_start(&drive, "first")).await;
    let status = RawStream::open(&server.url()).await.end().await.unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    assert!(status.get_details_retry_info().unwrap().retry_delay.is_some());
    first.send_frame(encode::frame(&drive.frames[0])).await;
    first.acked(1).await;
    first.close_sending();
    first.end().await.unwrap();
    // The place is free a moment after its vehicle has heard of the end; who is told when to come back does.
    let second = async {
        while let Err(status) = RawStream::open(&server.url()).await.try_start(wire_start(&drive, "second")).await {
            assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
            tokio::time::sleep(status.get_details_retry_info().unwrap().retry_delay.unwrap()).await;
        }
    };
    timeout(PATIENCE, second).await.expect("no place is ever free");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_connection_with_as_many_streams_as_it_may_have_waits_and_others_do_not() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { max_streams_per_connection: 1, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let drive = drives::simulated(1, 3);
    let channel = Channel::from_shared(server.url()).unwrap().connect().await.unwrap();
    let mut first = RawStream::open_on(channel.clone()).await;
    first.start(wire_start(&drive, "first")).await;
    let mut second = tokio::spawn(async move {
        let mut second = RawStream::open_on(channel).await;
        second.start(wire_start(&drives::simulated(1, 3), "second")).await
    });
    RawStream::started(&server.url(), wire_start(&drive, "on a connection of its own")).await;
    assert!(!second.is_finished());
    first.close_sending();
    first.end().await.unwrap();
    timeout(PATIENCE, &mut second).await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn no_more_frames_than_the_window_allows_are_taken_before_those_before_them_are_done() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_frames_in_flight: 4,
        reorder_window_frames: 64,
        reorder_wait_ms: 60_000,
        ..servers::config(folder.path())
    };
    let server = Server::start(config).await.unwrap();
    let drive = drives::simulated(1, 8);
    let (mut stream, accepted) = RawStream::started(&server.url(), drive.wire_start()).await;
    assert_eq!(accepted.limits.unwrap().max_frames_in_flight, 4);
    // Frame 1 is missing: with a window of 4 three others may wait for it, and the fourth gives it up.
    for frame in &drive.frames[2..6] {
        stream.send_frame(encode::frame(frame)).await;
    }
    stream.acked(6).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bomb_of_32_kilobytes_costs_less_than_the_largest_message() {
    // Of zstd not even the first byte is unpacked: it is not taken.
    let limit = ServerConfig::default().max_message_bytes as u64;
    for (encoding, bomb) in [("zstd", zstd_bomb()), ("gzip", gzip_bomb())] {
        let folder = tempfile::tempdir().unwrap();
        let server = ServerProcess::start(env!("CARGO_BIN_EXE_killable-server"), folder.path());
        streams_well(&server.url, &drives::simulated(2, 5)).await;
        assert!(bomb.len() <= 33 * 1024, "{encoding}: {} bytes", bomb.len());
        let before = peak_memory_bytes(server.id());
        let mut client = http2(&server.url).await;
        let (answer, mut body) = client.send_request(grpc("UploadObservations", encoding), false).unwrap();
        // An error where it was refused before it was sent: the answer tells.
        let _ = body.send_data(length_prefixed(1, &bomb), true);
        let answer = timeout(PATIENCE, answer).await.unwrap().unwrap();
        let mut trailers = answer.headers().clone();
        let mut rest = answer.into_body();
        if let Some(late) = rest.trailers().await.unwrap() {
            trailers = late;
        }
        let code = Code::from_bytes(trailers["grpc-status"].as_bytes());
        assert_ne!(code, Code::Ok, "{encoding}");
        let cost = peak_memory_bytes(server.id()).saturating_sub(before);
        assert!(cost < limit, "{encoding}: {cost} bytes, limit {limit}; {trailers:?}");
        streams_well(&server.url, &drives::simulated(3, 5)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_of_exactly_the_limit_is_taken_and_a_packed_one_of_half_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let limit = 100_000;
    let config = ServerConfig { max_message_bytes: limit, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    for (packed, bytes, taken) in
        [(0, limit, true), (0, limit + 1, false), (1, limit / 2, true), (1, limit / 2 + 1, false)]
    {
        let message = upload_of(bytes);
        let mut client = http2(&server.url()).await;
        let encoding = if packed == 1 { "gzip" } else { "identity" };
        let (answer, mut body) = client.send_request(grpc("UploadObservations", encoding), false).unwrap();
        let message = if packed == 1 { gzip(&message) } else { message };
        body.send_data(length_prefixed(packed, &message), true).unwrap();
        let answer = timeout(PATIENCE, answer).await.unwrap().unwrap();
        let mut trailers = answer.headers().clone();
        let mut rest = answer.into_body();
        while let Some(bytes) = rest.data().await {
            rest.flow_control().release_capacity(bytes.unwrap().len()).unwrap();
        }
        if let Some(late) = rest.trailers().await.unwrap() {
            trailers = late;
        }
        let code = Code::from_bytes(trailers["grpc-status"].as_bytes());
        assert_eq!(code == Code::Ok, taken, "{encoding}, {bytes} bytes: {trailers:?}");
    }
}

/// An upload that is encoded in `bytes` bytes: fields that the server does not know fill it up.
fn upload_of(bytes: usize) -> Vec<u8> {
    let drive = drives::simulated(1, 5);
    let frames = drive.frames.iter().map(encode::frame).collect();
    let mut message =
        v1::UploadObservationsRequest { start: Some(drive.wire_start()), frames, end: false }.encode_to_vec();
    // Field 1,000, a varint, in three bytes.
    while message.len() + 3 <= bytes {
        message.extend([0xc0, 0x3e, 0]);
    }
    while message.len() < bytes {
        // The last varint in more bytes than it needs.
        *message.last_mut().unwrap() = 0x80;
        message.push(0);
    }
    message
}

fn gzip(message: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(message).unwrap();
    encoder.finish().unwrap()
}

/// 32 KiB of zstd that unfold to hundreds of megabytes.
fn zstd_bomb() -> Vec<u8> {
    let mut encoder = zstd::Encoder::new(Vec::new(), 19).unwrap();
    zeros(512 << 20, &mut encoder);
    encoder.finish().unwrap()
}

/// 32 KiB of gzip that unfold a thousandfold: its format allows no more.
fn gzip_bomb() -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    zeros(33 << 20, &mut encoder);
    encoder.finish().unwrap()
}

fn zeros(count: usize, into: &mut impl Write) {
    let block = vec![0; 1 << 20];
    for _ in 0..count >> 20 {
        into.write_all(&block).unwrap();
    }
}

/// The most memory that a process has held so far.
fn peak_memory_bytes(process: u32) -> u64 {
    let status = std::fs::read_to_string(Path::new("/proc").join(process.to_string()).join("status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() * 1024
}

/// A bare HTTP/2 connection: what is sent on it is up to the test.
async fn http2(url: &str) -> SendRequest<Bytes> {
    let socket = TcpStream::connect(url.strip_prefix("http://").unwrap()).await.unwrap();
    let (client, connection) = h2::client::handshake(socket).await.unwrap();
    tokio::spawn(connection);
    client.ready().await.unwrap()
}

fn grpc(method: &str, encoding: &str) -> tonic::codegen::http::Request<()> {
    tonic::codegen::http::Request::post(format!("http://lanemap/lanemap.v1.IngestService/{method}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .header("grpc-encoding", encoding)
        .body(())
        .unwrap()
}

/// A message as gRPC frames it.
fn length_prefixed(compressed: u8, message: &[u8]) -> Bytes {
    let length = u32::try_from(message.len()).unwrap().to_be_bytes();
    [&[compressed], &length[..], message].concat().into()
}
