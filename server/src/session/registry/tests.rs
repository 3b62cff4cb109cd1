use std::path::Path;

use futures::StreamExt;
use lanemap_core::{FrameLimits, FrameParts, Odometry, Preset, Sensor, Sequence, TimestampNs, geometry::Pose};
use lanemap_proto::v1::{self, stream_observations_response::Message};

use super::*;
use crate::{
    config::ServerConfig,
    fuse::{FuseSettings, Fuser, SharedMap},
    ingest::{OutboxStream, decode::PointFrame},
    journal::JournalOptions,
    session::{SessionSetup, Sessions, in_flight::InFlightBudget},
};

/// No session yet, and a store in `folder`.
async fn registry(folder: &Path, config: ServerConfig) -> SessionRegistry {
    let (journal, _) = Journal::open(&JournalOptions::new(folder)).unwrap();
    let map = SharedMap::new(1 << 20);
    let surroundings = Surroundings {
        fuser: Fuser::start(FuseSettings::of(&config), &journal.cells(), map).unwrap().fuser(),
        journal,
        pseudonyms: Pseudonyms::open(&folder.join("key"), None).unwrap(),
        sessions: Sessions::new(1 << 20),
        in_flight: InFlightBudget::new(&config),
        shutdown: CancellationToken::new(),
        config: Arc::new(config),
    };
    SessionRegistry::recover(surroundings).await.unwrap()
}

fn start() -> Start {
    let key = SessionKey { fleet: "fleet".to_owned(), vehicle: "vehicle".to_owned(), drive: "drive".to_owned() };
    let setup = SessionSetup { preset: Preset::Default, sensor: Sensor::default() };
    Start { key, setup, point_frame: PointFrame::Vehicle, wants_local_map: false }
}

fn frame(number: u64) -> Frame {
    let odometry = Odometry { odometry_from_vehicle: Pose::identity(), motion_covariance: None };
    let time = TimestampNs(i64::try_from(number).unwrap() * 100_000_000);
    let parts =
        FrameParts { sequence: Sequence(number), time, odometry, gnss: None, detections: vec![], occlusions: vec![] };
    Frame::new(parts, &FrameLimits::default()).unwrap()
}

async fn next(answers: &mut OutboxStream) -> Message {
    answers.next().await.unwrap().unwrap().message.unwrap()
}

#[tokio::test]
async fn an_ack_does_not_wait_for_mapping_until_as_many_frames_wait_for_it_as_may() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { max_frames_in_flight: 12, max_unmapped_frames: 100, ..ServerConfig::default() };
    let registry = registry(folder.path(), config).await;
    let (outbox, mut answers) = Outbox::new();
    let attachment = registry.open(&start(), &outbox).await.unwrap();
    // Others map, and go on mapping.
    let mut others = Vec::new();
    for _ in 0..cores() {
        others.push(registry.shared.mapping_turns.take().await);
    }
    for number in 1..=100 {
        attachment.send_frame(frame(number), Instant::now()).await.unwrap();
        assert_eq!(next(&mut answers).await, Message::Ack(v1::Ack { acked_sequence_inclusive: number }));
    }
    // Three of those that are acked are in flight still: with nine more the window is full, and the next one is not taken.
    for number in 101..=109 {
        attachment.send_frame(frame(number), Instant::now()).await.unwrap();
    }
    let mut one_more = Box::pin(attachment.send_frame(frame(110), Instant::now()));
    assert!(futures::poll!(one_more.as_mut()).is_pending());
    drop(others);
    one_more.await.unwrap();
    let mut poses = Vec::new();
    let mut acked = 100;
    while poses.len() < 110 {
        match next(&mut answers).await {
            Message::Pose(pose) => poses.push(pose.sequence),
            Message::Ack(ack) => acked = ack.acked_sequence_inclusive,
            other => panic!("{other:?}"),
        }
    }
    assert_eq!((poses, acked), ((1..=110).collect(), 110));
}

#[tokio::test]
async fn a_vehicle_that_comes_back_hears_of_the_frames_that_it_sends_then_and_its_map_has_all() {
    let folder = tempfile::tempdir().unwrap();
    let registry = registry(folder.path(), ServerConfig::default()).await;
    let mut others = Vec::new();
    for _ in 0..cores() {
        others.push(registry.shared.mapping_turns.take().await);
    }
    for (first, last) in [(1, 40), (41, 80)] {
        let (outbox, mut answers) = Outbox::new();
        let attachment = registry.open(&start(), &outbox).await.unwrap();
        assert_eq!(attachment.at.last, Some(Sequence(first - 1)).filter(|_| first > 1));
        for number in first..=last {
            attachment.send_frame(frame(number), Instant::now()).await.unwrap();
            assert_eq!(next(&mut answers).await, Message::Ack(v1::Ack { acked_sequence_inclusive: number }));
        }
        if last < 80 {
            // Its connection breaks; nothing is mapped yet.
            continue;
        }
        others.clear();
        for number in first..=last {
            let Message::Pose(pose) = next(&mut answers).await else { panic!("no pose") };
            assert_eq!(pose.sequence, number);
        }
        attachment.send(|stream| Command::Detach { stream, with: Ok(()) }).await.unwrap();
        outbox.finished().await;
        let sessions = &registry.shared.surroundings.sessions;
        assert_eq!(sessions.get(&attachment.session).unwrap().version.0, 80);
    }
}

#[tokio::test]
async fn a_vehicle_that_comes_back_after_a_crash_is_heard_before_its_frames_are_mapped_again() {
    let folder = tempfile::tempdir().unwrap();
    let copy = tempfile::tempdir().unwrap();
    let session = {
        let registry = registry(folder.path(), ServerConfig::default()).await;
        let (outbox, mut answers) = Outbox::new();
        let attachment = registry.open(&start(), &outbox).await.unwrap();
        for number in 1..=300 {
            attachment.send_frame(frame(number), Instant::now()).await.unwrap();
            while next(&mut answers).await != (Message::Ack(v1::Ack { acked_sequence_inclusive: number })) {}
        }
        // What a crash would leave: no snapshot, and every frame in the journal.
        copy_folder(folder.path(), copy.path());
        attachment.session
    };
    let registry = registry(copy.path(), ServerConfig::default()).await;
    let mut others = Vec::new();
    for _ in 0..cores() {
        others.push(registry.shared.mapping_turns.take().await);
    }
    let (outbox, mut answers) = Outbox::new();
    let attachment = registry.open(&start(), &outbox).await.unwrap();
    assert_eq!((attachment.session, attachment.at.last), (session, Some(Sequence(300))));
    for (number, acked) in [(300, 300), (301, 301)] {
        attachment.send_frame(frame(number), Instant::now()).await.unwrap();
        assert_eq!(next(&mut answers).await, Message::Ack(v1::Ack { acked_sequence_inclusive: acked }));
    }
    let sessions = registry.shared.surroundings.sessions.clone();
    assert!(sessions.list().iter().all(|told| told.version.0 == 0), "a part of the map is shown");
    drop(others);
    // Only the frame that came just now has a pose; by then all before it are mapped.
    let Message::Pose(pose) = next(&mut answers).await else { panic!("no pose") };
    assert_eq!(pose.sequence, 301);
    attachment.send(|stream| Command::Detach { stream, with: Ok(()) }).await.unwrap();
    outbox.finished().await;
    assert_eq!(sessions.get(&session).unwrap().version.0, 301);
}

#[tokio::test]
async fn nothing_of_an_actor_is_kept_once_its_drive_is_over() {
    let folder = tempfile::tempdir().unwrap();
    let registry = registry(folder.path(), ServerConfig::default()).await;
    let (outbox, mut answers) = Outbox::new();
    let attachment = registry.open(&start(), &outbox).await.unwrap();
    attachment.send_frame(frame(1), Instant::now()).await.unwrap();
    assert_eq!(next(&mut answers).await, Message::Ack(v1::Ack { acked_sequence_inclusive: 1 }));
    attachment.send(|stream| Command::End { stream }).await.unwrap();
    registry.stopped().await;
    let slot = locked(&registry.shared.slots).values().map(|place| Arc::clone(&place.slot)).next().unwrap();
    let slot = slot.lock().await;
    assert!(slot.actor.is_none() && slot.record.is_some());
}

fn copy_folder(from: &Path, to: &Path) {
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            std::fs::create_dir_all(&target).unwrap();
            copy_folder(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}
