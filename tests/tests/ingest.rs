//! Promise: a drive that is streamed is acked, mapped and answered, and the map is the mapper's own, byte by byte.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use futures::StreamExt;
use lanemap_client::{Event, IngestClient, SessionStart};
use lanemap_core::{LocalWindow, Mapper, Params, Preset, Sequence};
use lanemap_proto::{
    encode,
    v1::{
        self, ingest_service_client::IngestServiceClient, map_service_client::MapServiceClient,
        stream_observations_request::Message, stream_observations_response::Message as Response,
    },
};
use lanemap_server::{Server, ServerConfig, session::SessionState};
use lanemap_tests::{
    drives::{self, Drive, assert_same_map},
    http,
    raw_stream::RawStream,
    servers::{self, map_bytes},
};
use tonic::Code;

/// Streams a whole drive; gives the session's id.
async fn stream(url: &str, drive: &Drive, start: SessionStart) -> String {
    let client = IngestClient::connect(url).await.unwrap();
    let (mut session, _events) = client.start_session(start).await.unwrap();
    for frame in &drive.frames {
        session.send(frame).await.unwrap();
    }
    let id = session.id().to_owned();
    let summary = session.finish().await.unwrap();
    assert_eq!((summary.acked, summary.refused), (drive.frames.last().map(lanemap_core::Frame::sequence), 0));
    id
}

#[tokio::test(flavor = "multi_thread")]
async fn a_streamed_drive_gives_the_bytes_of_a_local_mapper() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(5, 150);
    let id = stream(&server.url(), &drive, drive.start()).await;
    assert_same_map(&map_bytes(&server.url(), &id).await, &drive);
    let published = server.sessions().get(&id.parse().unwrap()).unwrap();
    assert_eq!((published.state, published.version.0), (SessionState::Closed, 150));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_map_of_a_paper_drive_is_cleaned_up_under_a_version_of_its_own_once_it_is_over() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(5, 150);
    let mapper = drive.mapped_by(Preset::Paper);
    let (under_way, finished) = (mapper.lane_map(), mapper.finished_lane_map());
    assert!(!finished.lanes.is_empty() && finished.lanes.len() < under_way.lanes.len(), "or this test shows nothing");

    let start = || SessionStart { preset: Preset::Paper, ..drive.start() };
    let client = IngestClient::connect(server.url()).await.unwrap();
    let (mut session, _events) = client.start_session(start()).await.unwrap();
    for frame in &drive.frames {
        session.send(frame).await.unwrap();
    }
    let id = session.id().parse().unwrap();
    let mut publications = server.sessions().publications();
    while server.sessions().get(&id).is_none_or(|told| told.version.0 < 150) {
        publications.changed().await.unwrap();
    }
    assert_eq!(*server.sessions().get(&id).unwrap().map, under_way);
    session.finish().await.unwrap();

    let is_finished = |server: &lanemap_server::RunningServer| {
        // The list first: what it tells must not depend on whether the map was read.
        let listed = server.sessions().list()[0].clone();
        let told = server.sessions().get(&id).unwrap();
        assert_eq!((listed.state, listed.version.0, listed.frames()), (SessionState::Closed, 151, 150));
        assert_eq!((told.version.0, told.lanes, listed.lanes), (151, finished.lanes.len(), finished.lanes.len()));
        assert_eq!(*told.map, finished);
    };
    is_finished(&server);
    server.shutdown().await;
    is_finished(&servers::start(folder.path()).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn http_serves_the_same_bytes_as_grpc() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(5, 60);
    let id = stream(&server.url(), &drive, drive.start()).await;
    let url = format!("{}/sessions/{id}/lanes.pb", server.url());
    let bytes = http::get(url).await.unwrap().error_for_status().unwrap().bytes().await.unwrap();
    assert_same_map(&bytes, &drive);
    let lanes = lanemap_client::MapClient::new(server.url()).lane_map(&id).await.unwrap();
    assert_eq!(lanes, drive.mapped().lane_map());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_vehicle_hears_the_poses_and_local_maps_of_a_local_mapper() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(6, 40);
    let client = IngestClient::connect(server.url()).await.unwrap();
    let start = SessionStart { wants_local_map: true, max_unacked: 1, ..drive.start() };
    let (mut session, mut events) = client.start_session(start).await.unwrap();
    let mut mapper = Mapper::new(Params::preset(Preset::Default), drive.sensor);
    for frame in &drive.frames {
        session.send(frame).await.unwrap();
        let report = mapper.step(frame);
        let (mut pose, mut map) = (None, None);
        while pose.is_none() || map.is_none() {
            match events.next().await.unwrap() {
                Event::Pose(heard) => pose = Some(heard),
                Event::LocalMap(heard) => map = Some(heard),
                _ => {}
            }
        }
        let (pose, map) = (pose.unwrap(), map.unwrap());
        assert_eq!((pose.sequence, pose.map_from_vehicle), (report.sequence, report.map_from_vehicle));
        assert_eq!(map.sequence, report.sequence);
        assert_eq!(map.lanes, mapper.local_map(&LocalWindow::default()));
        assert_eq!(map.born, report.born.iter().map(|born| born.lane).collect::<Vec<_>>());
    }
    session.finish().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_map_grows_while_the_drive_is_streamed() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(5, 100);
    let client = IngestClient::connect(server.url()).await.unwrap();
    let (mut session, _events) = client.start_session(drive.start()).await.unwrap();
    let id = session.id().parse().unwrap();
    let mut publications = server.sessions().publications();
    for frame in &drive.frames[..50] {
        session.send(frame).await.unwrap();
    }
    // Nothing more is sent: the last frames are published because the session went quiet.
    while server.sessions().get(&id).unwrap().version.0 < 50 {
        publications.changed().await.unwrap();
    }
    let half_way = server.sessions().get(&id).unwrap();
    assert_eq!(half_way.state, SessionState::Live);
    assert!(!half_way.map.lanes.is_empty());
    session.close().await.unwrap();
    assert_eq!(server.sessions().get(&id).unwrap().state, SessionState::Idle);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_stream_of_a_drive_takes_over_from_the_first() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(7, 5);
    let (mut first, accepted) = RawStream::started(&server.url(), drive.wire_start()).await;
    first.send_frame(encode::frame(&drive.frames[0])).await;
    first.acked(1).await;
    let (mut second, resumed) = RawStream::started(&server.url(), drive.wire_start()).await;
    assert_eq!((resumed.session_id, resumed.resume_after_sequence), (accepted.session_id, Some(1)));
    assert_eq!(first.end().await.unwrap_err().code(), Code::Aborted);
    second.send_frame(encode::frame(&drive.frames[1])).await;
    second.acked(2).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_that_is_over_takes_no_frame_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(7, 5);
    let (mut stream, _) = RawStream::started(&server.url(), drive.wire_start()).await;
    stream.send_frame(encode::frame(&drive.frames[0])).await;
    stream.send(Message::End(v1::SessionEnd {})).await;
    stream.end().await.unwrap();
    let (mut again, accepted) = RawStream::started(&server.url(), drive.wire_start()).await;
    assert!(accepted.ended);
    again.send_frame(encode::frame(&drive.frames[1])).await;
    assert_eq!(again.refusal().await.reason(), v1::RefusalReason::OutOfTurn);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_uploaded_in_pieces_gives_the_same_map() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(5, 150);
    let mut client = IngestServiceClient::connect(server.url()).await.unwrap();
    let mut session_id = String::new();
    for (index, piece) in drive.frames.chunks(40).enumerate() {
        let mut frames: Vec<_> = piece.iter().map(encode::frame).collect();
        let spoiled = v1::Frame { odometry: None, ..frames[3].clone() };
        frames.push(spoiled);
        let request = v1::UploadObservationsRequest { start: Some(drive.wire_start()), frames, end: index == 3 };
        let response = client.upload_observations(request).await.unwrap().into_inner();
        assert_eq!(response.acked_sequence_inclusive, piece.last().map(|frame| frame.sequence().0));
        assert_eq!(response.refusals.len(), 1, "{:?}", response.refusals);
        session_id = response.accepted.unwrap().session_id;
    }
    assert_same_map(&map_bytes(&server.url(), &session_id).await, &drive);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_that_never_reads_slows_no_neighbour_and_loses_no_frame() {
    const BAD: u64 = 3;
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { max_frames_in_flight: 8, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let (deaf_drive, drive) = (drives::simulated(8, 600), drives::simulated(9, 60));
    let mut deaf = RawStream::open_with_small_windows(&server.url()).await;
    deaf.start(deaf_drive.wire_start()).await;
    // Most of its frames are bad: refusals may not be dropped, so this stream must come to a halt.
    let halted = async {
        for frame in &deaf_drive.frames {
            deaf.send_frame(encode::frame(frame)).await;
            for _ in 0..BAD {
                deaf.send_frame(v1::Frame { odometry: None, ..encode::frame(frame) }).await;
            }
        }
        unreachable!("a stream whose refusals nobody reads takes frames without end");
    };
    let neighbour = async {
        let id = stream(&server.url(), &drive, drive.start()).await;
        assert_same_map(&map_bytes(&server.url(), &id).await, &drive);
    };
    tokio::select! {
        () = halted => {}
        () = neighbour => {}
    }
    // It reads again, and hears every ack and every refusal.
    deaf.close_sending();
    let (mut acked, mut refused) = (0, 0);
    while let Some(answer) = deaf.answer_or_end().await.unwrap() {
        match answer {
            Response::Ack(ack) => acked = ack.acked_sequence_inclusive,
            Response::Refusal(_) => refused += 1,
            _ => {}
        }
    }
    assert!(acked > 64 && (BAD * (acked - 1)..=BAD * acked).contains(&refused), "{acked} acked, {refused} refused");
}

#[tokio::test(flavor = "multi_thread")]
async fn vehicles_beyond_the_two_hundred_streams_of_http2_share_one_connection() {
    const VEHICLES: usize = 250;
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(5, 12);
    let client = IngestClient::connect(server.url()).await.unwrap();
    let vehicles = (0..VEHICLES).map(|number| {
        let (client, drive) = (&client, &drive);
        async move {
            let start = SessionStart { vehicle: format!("vehicle-{number}"), ..drive.start() };
            let (mut session, _events) = client.start_session(start).await.unwrap();
            for frame in &drive.frames {
                session.send(frame).await.unwrap();
            }
            session.finish().await.unwrap()
        }
    });
    let summaries = futures::future::join_all(vehicles).await;
    assert!(summaries.iter().all(|summary| summary.acked == Some(Sequence(12)) && summary.refused == 0));
    let sessions = server.sessions().list();
    assert_eq!(sessions.len(), VEHICLES);
    let expected = drive.mapped().lane_map();
    assert!(sessions.iter().all(|told| {
        *server.sessions().get(&told.session).unwrap().map == expected && told.state == SessionState::Closed
    }));
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_are_listed_page_by_page_and_name_no_vehicle() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    for seed in 0..5 {
        let drive = drives::simulated(seed, 5);
        stream(&server.url(), &drive, drive.start()).await;
    }
    let mut client = MapServiceClient::connect(server.url()).await.unwrap();
    let (mut listed, mut page_token) = (Vec::new(), String::new());
    loop {
        let page =
            client.list_sessions(v1::ListSessionsRequest { page_size: 2, page_token }).await.unwrap().into_inner();
        assert!(page.sessions.len() <= 2);
        assert!(!format!("{page:?}").contains("vehicle-under-test"));
        listed.extend(page.sessions.into_iter().map(|session| session.id));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    let ids: Vec<_> = server.sessions().list().iter().map(|map| map.session.to_string()).collect();
    assert_eq!(listed, ids);
    assert_eq!(ids.len(), 5);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_that_is_not_there_is_not_found() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let mut client = MapServiceClient::connect(server.url()).await.unwrap();
    for session_id in ["0000000000000001", "no id at all"] {
        let request = v1::GetLaneMapRequest { session_id: session_id.to_owned() };
        assert_eq!(client.get_lane_map(request).await.unwrap_err().code(), Code::NotFound);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn health_and_reflection_answer_on_the_same_port() {
    use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};
    use tonic_reflection::pb::v1::{
        ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
        server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
    };
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let channel = tonic::transport::Channel::from_shared(server.url()).unwrap().connect().await.unwrap();

    let service = "lanemap.v1.IngestService".to_owned();
    let health = HealthClient::new(channel.clone()).check(HealthCheckRequest { service }).await.unwrap();
    assert_eq!(health.into_inner().status(), ServingStatus::Serving);

    let list = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let requests = futures::stream::iter([list]);
    let answers = ServerReflectionClient::new(channel).server_reflection_info(requests).await.unwrap();
    let answer = answers.into_inner().next().await.unwrap().unwrap().message_response.unwrap();
    let MessageResponse::ListServicesResponse(services) = answer else { panic!("{answer:?}") };
    let names: Vec<_> = services.service.iter().map(|service| service.name.as_str()).collect();
    assert!(names.contains(&"lanemap.v1.IngestService") && names.contains(&"lanemap.v1.MapService"), "{names:?}");

    let missing = http::get(format!("{}/nothing/here", server.url())).await.unwrap();
    assert_eq!(missing.status(), 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_may_send_a_frame_again_before_its_ack() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(5, 60);
    let client = IngestClient::connect(server.url()).await.unwrap();
    let (mut session, _events) = client.start_session(drive.start()).await.unwrap();
    for frame in &drive.frames {
        session.send(frame).await.unwrap();
        session.send(frame).await.unwrap();
    }
    let id = session.id().to_owned();
    let summary = session.finish().await.unwrap();
    assert_eq!((summary.acked, summary.refused), (Some(Sequence(60)), 0));
    assert_same_map(&map_bytes(&server.url(), &id).await, &drive);
}
