//! Promise: what was acked outlives restarts and kills, and a drive that was interrupted gives the map of one that was
//! not, byte by byte.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::time::Duration;

use lanemap_client::{ClientError, IngestClient, Reconnect, SessionStart};
use lanemap_core::Sequence;
use lanemap_server::{Server, ServerConfig};
use lanemap_tests::{
    drives::{self, Drive, assert_same_map},
    servers::{self, ServerProcess, map_bytes},
};

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
    // More of them by `TEST_KILLS=200`.
    let kills: u64 = std::env::var("TEST_KILLS").map_or(10, |kills| kills.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let frames = usize::try_from(kills * 29 + 40).unwrap();
    let drives: Vec<_> = (0..VEHICLES).map(|seed| drives::simulated(10 + seed, frames)).collect();
    let mut acked = vec![None; drives.len()];

    for kill in 1..=kills {
        let mut server = ServerProcess::start(env!("CARGO_BIN_EXE_killable-server"), folder.path());
        // Far into the drive, at another place of it for every kill and every vehicle's stream.
        let until = Sequence(kill * 29 + 1);
        let streams = drives.iter().zip(&acked).map(|(drive, acked)| stream_until(&server.url, drive, *acked, until));
        let mut streams: Vec<_> = futures::future::join_all(streams).await;
        server.kill();
        for (acked, stream) in acked.iter_mut().zip(&mut streams) {
            *acked = stream.last_heard().await;
            assert!(*acked >= Some(until));
        }
    }

    let server = ServerProcess::start(env!("CARGO_BIN_EXE_killable-server"), folder.path());
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

#[tokio::test]
async fn a_second_server_on_the_same_store_is_refused_and_the_first_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let first = servers::start(folder.path()).await;
    let error = Server::start(servers::config(folder.path())).await.unwrap_err().to_string();
    assert!(error.contains(&folder.path().display().to_string()) && error.contains("Locked"), "{error}");
    IngestClient::connect(first.url()).await.unwrap();
}

/// A vehicle that goes on sending, whatever happens to the server.
struct Streaming {
    sending: tokio::task::JoinHandle<Option<Sequence>>,
}

impl Streaming {
    /// The last ack that the vehicle heard before its stream broke.
    async fn last_heard(&mut self) -> Option<Sequence> {
        (&mut self.sending).await.unwrap()
    }
}

/// Streams a drive from where the server says, and returns, still sending, once `until` is acked.
async fn stream_until(url: &str, drive: &Drive, acked: Option<Sequence>, until: Sequence) -> Streaming {
    let client = IngestClient::connect(url).await.unwrap();
    let reconnect = Reconnect { max_tries: 0, ..Reconnect::default() };
    let start = SessionStart { reconnect, ..drive.start() };
    let (mut session, _events) = client.start_session(start).await.unwrap();
    assert!(session.resume_after() >= acked, "acked {acked:?}, kept {:?}", session.resume_after());
    let frames: Vec<_> = rest(drive, session.resume_after()).to_vec();
    let (reached, reaches) = tokio::sync::oneshot::channel();
    let sending = tokio::spawn(async move {
        let mut reached = Some(reached);
        for frame in &frames {
            let sent = session.send(frame).await;
            if session.acked() >= Some(until) {
                reached.take().map(|reached| reached.send(()));
            }
            match sent {
                Ok(()) => {}
                Err(ClientError::Status(_) | ClientError::Unreachable(_)) => return session.acked(),
                Err(error) => panic!("{error}"),
            }
        }
        // All is sent: only the kill ends the stream now.
        session.wait_acked(until).await.unwrap();
        reached.take().map(|reached| reached.send(()));
        session.wait_acked(Sequence(u64::MAX)).await.unwrap_err();
        session.acked()
    });
    tokio::time::timeout(Duration::from_mins(1), reaches).await.unwrap().unwrap();
    Streaming { sending }
}

/// The frames after `after`.
fn rest(drive: &Drive, after: Option<Sequence>) -> &[lanemap_core::Frame] {
    let had = drive.frames.partition_point(|frame| Some(frame.sequence()) <= after);
    &drive.frames[had..]
}
