//! Routers that are not the server itself, and endpoints that are not free.

use std::path::Path;

use lanemap_server::{
    Server, ServerConfig,
    config::ZenohMode,
    session::{SessionId, SessionState},
};
use lanemap_tests::{
    drives::{self, assert_same_map},
    endpoints::HeldEndpoint,
    raw_zenoh::{self, RawZenohStream},
    servers::{self, map_bytes},
};

use super::{IN_FLIGHT, config, start_of};

/// Settings of a server that is a client of a router.
fn client_of(endpoint: &str, folder: &Path) -> ServerConfig {
    ServerConfig { zenoh_mode: ZenohMode::Client, zenoh_connect: endpoint.parse().unwrap(), ..servers::config(folder) }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_is_a_client_of_a_router_serves_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let router = zenoh::open(raw_zenoh::configuration("router", &[&endpoint], &[])).await.unwrap();
    let server = Server::start(client_of(&endpoint, folder.path())).await.unwrap();
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
async fn a_router_that_is_started_anew_is_found_again_by_the_server() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let start_router = || zenoh::open(raw_zenoh::configuration("router", &[&endpoint], &[]));
    let router = start_router().await.unwrap();
    let server = Server::start(client_of(&endpoint, folder.path())).await.unwrap();
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
    let endpoint = HeldEndpoint::tcp();
    let settings = client_of(&endpoint, folder.path());
    let (server, router) = tokio::join!(
        Server::start(settings.clone()),
        zenoh::open(raw_zenoh::configuration("router", &[&endpoint], &[]))
    );
    server.unwrap().shutdown().await;
    router.unwrap().close().await.unwrap();
    let error = Server::start(settings).await.unwrap_err().to_string();
    assert!(error.contains(&*endpoint), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_endpoint_that_is_taken_is_named() {
    let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let endpoint = HeldEndpoint::tcp();
    let _server = Server::start(config(folder.path(), &endpoint)).await.unwrap();
    let error = Server::start(config(other.path(), &endpoint)).await.unwrap_err().to_string();
    assert!(error.contains(&*endpoint), "{error}");
}
