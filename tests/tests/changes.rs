//! Promise: who follows the map has it: every state of it has a number, and a reader that was away is told what it
//! missed, over restarts and kills too.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{collections::BTreeMap, sync::Arc};

use lanemap_core::fleet::CellId;
use lanemap_proto::{
    v1::{self, map_service_client::MapServiceClient, watch_changes_response::Told},
    zenoh_keys::{CELL_ENCODING, EVERY_CELL, cell_key},
};
use lanemap_server::{
    Server, ServerConfig,
    config::ZenohMode,
    fuse::{CellVersion, MapRevision, RevisionError, SharedMap, wire::apply},
};
use lanemap_tests::{
    endpoints::HeldEndpoint,
    events::{Event, Events},
    fleets::{PATIENCE, along_a_road, cell_bytes, cells_until, grow, settled},
    http, raw_zenoh,
    servers::{self, ServerProcess},
};
use prost::Message;
use reqwest::StatusCode;
use serde_json::{Value, json};
use tokio::time::timeout;
use tonic::{Code, transport::Endpoint};

/// The map as a reader has it that follows it.
#[derive(Clone, Debug, Default)]
struct Copy {
    cells: BTreeMap<String, v1::CellMap>,
}

impl Copy {
    /// What a server has now.
    async fn of(url: &str) -> Self {
        let cells = cell_bytes(url).await;
        let cells = cells.into_iter().map(|(cell, bytes)| (cell, v1::CellMap::decode(bytes.as_slice()).unwrap()));
        Self { cells: cells.collect() }
    }

    /// Takes what an event says changed.
    async fn follow(&mut self, url: &str, event: &Event) {
        let cell = event.data["cell"].as_str().unwrap();
        let had = self.cells.entry(cell.to_owned()).or_default().clone();
        assert_eq!(event.data["from_version"], had.version, "{event:?}");
        let changes = http::get(format!("{url}/cells/{cell}/changes.pb?since={}", had.version)).await.unwrap();
        let changes = changes.error_for_status().unwrap().bytes().await.unwrap();
        let changes = v1::CellChanges::decode(changes).unwrap();
        assert!(changes.to_version >= event.data["to_version"].as_u64().unwrap());
        self.take(&changes);
    }

    fn take(&mut self, changes: &v1::CellChanges) {
        let had = self.cells.entry(changes.cell.clone()).or_default();
        *had = apply(had, changes);
    }

    /// The bytes of every cell that ever had lines.
    fn bytes(&self) -> BTreeMap<String, Vec<u8>> {
        self.cells.iter().map(|(cell, map)| (cell.clone(), map.encode_to_vec())).collect()
    }
}

/// The bytes of every cell that ever had lines, by its name.
fn snapshot(map: &SharedMap) -> (MapRevision, BTreeMap<CellId, Vec<u8>>) {
    let (revision, cells) = map.list_with_revision();
    let cells = cells.into_iter().filter(|(_, record)| record.version.0 > 0);
    (revision, cells.map(|(cell, _)| (cell, map.get(cell).unwrap().unwrap().bytes.to_vec())).collect())
}

/// The same at a revision before.
fn snapshot_at(map: &SharedMap, revision: MapRevision) -> Result<BTreeMap<CellId, Vec<u8>>, RevisionError> {
    let bytes = |(cell, version)| (cell, map.version_of(cell, version).unwrap().expect("it is kept").bytes.to_vec());
    Ok(map.versions_at(revision)?.into_iter().map(bytes).collect())
}

#[tokio::test(flavor = "multi_thread")]
async fn every_revision_gives_the_map_as_it_was_also_after_a_restart() {
    let drives = along_a_road(21, 2, 200.0, true);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    assert_eq!(server.map().revision(), MapRevision(0));
    let mut seen = BTreeMap::new();
    for drive in &drives {
        for frames in [60, 120, drive.frames.len()] {
            drive.upload(&server.url(), frames, false).await;
            settled(&server).await;
            let (revision, cells) = snapshot(server.map());
            seen.insert(revision, cells);
        }
    }
    assert!(seen.len() >= 4 && seen.values().any(|cells| cells.len() == 2), "{:?}", seen.keys());
    let newest = server.map().revision();
    for (revision, cells) in &seen {
        assert_eq!(snapshot_at(server.map(), *revision).as_ref(), Ok(cells), "{revision}");
    }
    server.shutdown().await;

    let server = servers::start(folder.path()).await;
    settled(&server).await;
    assert_eq!(server.map().revision(), newest);
    for (revision, cells) in &seen {
        assert_eq!(snapshot_at(server.map(), *revision).as_ref(), Ok(cells), "{revision}");
        let changes = server.map().changed_since(*revision).unwrap();
        let mut versions = server.map().versions_at(*revision).unwrap();
        for change in changes.cells {
            let before = versions.insert(change.cell, change.to_version).unwrap_or_default();
            assert_eq!(before, change.from_version);
        }
        assert_eq!(Ok(versions), server.map().versions_at(newest));
    }
    let asked = MapRevision(newest.0 + 1);
    assert_eq!(server.map().changed_since(asked), Err(RevisionError::InTheFuture { asked, newest }));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn revisions_that_are_kept_no_longer_are_refused_and_the_newest_stays_known() {
    let drives = along_a_road(22, 2, 120.0, false);
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { cell_versions_kept_s: 0, ..servers::config(folder.path()) };
    let server = Server::start(config.clone()).await.unwrap();
    for drive in &drives {
        for frames in [60, drive.frames.len()] {
            drive.upload(&server.url(), frames, false).await;
            settled(&server).await;
        }
    }
    let newest = server.map().revision();
    assert!(newest >= MapRevision(3), "{newest}");
    let too_old = server.map().changed_since(MapRevision(0));
    assert!(matches!(too_old, Err(RevisionError::NotKept { .. })), "{too_old:?}");
    let cell = server.map().list()[0].0;
    assert!(server.map().version_of(cell, CellVersion(1)).unwrap().is_none());
    server.shutdown().await;
    let server = Server::start(config).await.unwrap();
    assert_eq!(server.map().revision(), newest);
    server.shutdown().await;
}

/// Reads changes until all up to `revision` is told; gives the events.
async fn cells_up_to(events: &mut Events, revision: MapRevision) -> Vec<Event> {
    let mut read = Vec::new();
    let reading = async {
        while events.last_id != revision.to_string() {
            read.push(events.expect("cell").await);
        }
    };
    timeout(PATIENCE, reading).await.expect("all is told");
    read
}

#[tokio::test(flavor = "multi_thread")]
async fn a_snapshot_and_the_changes_since_any_revision_give_the_bytes_of_the_next_snapshot() {
    let drives = along_a_road(23, 3, 200.0, true);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    let url = server.url();
    // A reader that begins with nothing, and others that begin at every revision that it saw.
    let mut from_nothing = Events::open(&format!("{url}/changes?since=0&content=lines"), "").await;
    assert_eq!(from_nothing.expect("start").await.data, json!({ "revision": 0 }));
    let growing = tokio::spawn({
        let (url, drives) = (url.clone(), drives.clone());
        async move { grow(&url, &drives).await }
    });
    let mut seen = vec![MapRevision(0)];
    while !growing.is_finished() {
        let event = timeout(PATIENCE, from_nothing.expect("cell")).await.unwrap();
        seen.push(MapRevision(event.data["revision"].as_u64().unwrap()));
    }
    growing.await.unwrap();
    settled(&server).await;
    cells_up_to(&mut from_nothing, server.map().revision()).await;
    assert!(seen.len() > 6, "only {} changes were seen", seen.len());

    let fresh = cell_bytes(&url).await;
    for since in seen {
        let mut copy = Copy::default();
        for (cell, version) in server.map().versions_at(since).unwrap() {
            let kept = server.map().version_of(cell, version).unwrap().unwrap();
            copy.cells.insert(cell.to_string(), v1::CellMap::clone(&kept.map));
        }
        let mut events = Events::open(&format!("{url}/changes?since={since}"), "").await;
        events.expect("start").await;
        for event in cells_up_to(&mut events, server.map().revision()).await {
            copy.follow(&url, &event).await;
        }
        assert_eq!(copy.bytes(), fresh, "since {since}");
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_that_is_cut_off_anywhere_goes_on_without_a_gap_also_over_a_kill() {
    let binary = env!("CARGO_BIN_EXE_killable-server");
    let drives = along_a_road(24, 2, 200.0, true);
    let folder = tempfile::tempdir().unwrap();
    let mut server = ServerProcess::start(binary, folder.path());
    let both = |cells: &[Value]| cells.len() == 2 && cells.iter().all(|cell| cell["version"] != 0);
    drives[0].upload_whole(&server.url).await;
    cells_until(&server.url, both).await;

    let mut copy = Copy::default();
    let mut events = Events::open(&format!("{}/changes?since=0", server.url), "").await;
    events.expect("start").await;
    let first = events.expect("cell").await;
    copy.follow(&server.url, &first).await;
    let last_id = events.last_id.clone();
    server.kill();
    // What was on its way comes yet; then the stream has an end.
    while events.next().await.is_some() {}

    let server = ServerProcess::start(binary, folder.path());
    drives[1].upload_whole(&server.url).await;
    cells_until(&server.url, |cells| both(cells) && cells.iter().all(|cell| cell["drives"] == 2)).await;
    let mut events = Events::open(&format!("{}/changes?since=0", server.url), &last_id).await;
    events.expect("start").await;
    let fresh = Copy::of(&server.url).await.bytes();
    while copy.bytes() != fresh {
        let event = timeout(PATIENCE, events.expect("cell")).await.expect("the copy becomes whole");
        let has = copy.cells.get(event.data["cell"].as_str().unwrap()).map_or(0, |cell| cell.version);
        // What a copy took before the kill may run ahead of what it was told.
        if event.data["to_version"].as_u64().unwrap() > has {
            let data = Event {
                data: json!({ "cell": event.data["cell"], "from_version": has,
                "to_version": event.data["to_version"] }),
                ..event
            };
            copy.follow(&server.url, &data).await;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn changes_come_with_the_lines_that_the_cell_says_changed() {
    let drives = along_a_road(25, 2, 150.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    let url = server.url();
    drives[0].upload_whole(&url).await;
    settled(&server).await;
    let since = server.map().revision();
    drives[1].upload_whole(&url).await;
    settled(&server).await;
    let mut events = Events::open(&format!("{url}/changes?since={since}&content=lines"), "").await;
    events.expect("start").await;
    let event = events.expect("cell").await;
    let cell = event.data["cell"].as_str().unwrap();
    let told = http::get(format!("{url}/cells/{cell}/changes?since={}", event.data["from_version"])).await.unwrap();
    let told: Value = told.json().await.unwrap();
    assert!(!told["upserted"].as_array().unwrap().is_empty());
    for name in ["cell", "from_version", "to_version", "upserted", "removed"] {
        assert_eq!(event.data[name], told[name], "{name}");
    }
    // Where they would be too large, the lines stay out and the rest is told.
    server.shutdown().await;
    let server = servers::lively(folder.path(), |config| config.max_change_event_bytes = 2_000).await;
    let mut events = Events::open(&format!("{}/changes?since={since}&content=lines", server.url()), "").await;
    events.expect("start").await;
    let event = events.expect("cell").await;
    assert!(event.data["upserted"].is_null() && event.data["lines_upserted"] != 0, "{event:?}");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_of_one_place_is_told_of_nothing_else() {
    let drives = along_a_road(26, 1, 200.0, true);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    drives[0].upload_whole(&server.url()).await;
    settled(&server).await;
    let (revision, cells) = server.map().list_with_revision();
    let [first, second] = [cells[0].0, cells[1].0];
    let bounds = second.bounds();
    // Half way into the cell, away from its neighbour.
    let (longitude, latitude) = (0.5 * (bounds.west + bounds.east), 0.5 * (bounds.south + bounds.north));
    for (query, cell) in
        [(format!("cell={first}"), first), (format!("bbox={longitude},{latitude},{longitude},{latitude}"), second)]
    {
        let mut events = Events::open(&format!("{}/changes?since=0&{query}", server.url()), "").await;
        events.expect("start").await;
        let told = cells_up_to(&mut events, revision).await;
        assert_eq!(told.len(), 1, "{told:?}");
        assert_eq!(told[0].data["cell"], cell.to_string());
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_revision_that_is_not_kept_is_a_reset_and_one_in_the_future_a_problem() {
    let drives = along_a_road(27, 2, 120.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |config| config.cell_versions_kept_s = 0).await;
    grow(&server.url(), &drives).await;
    settled(&server).await;
    let newest = server.map().revision();
    let mut events = Events::open(&format!("{}/changes?since=1", server.url()), "").await;
    events.expect("start").await;
    let reset = events.expect("reset").await;
    assert_eq!((&reset.data["revision"], reset.id), (&json!(newest), newest.to_string()));

    let answer = http::get(format!("{}/changes?since=1000000", server.url())).await.unwrap();
    assert_eq!(answer.status(), StatusCode::BAD_REQUEST);
    let problem: Value = answer.json().await.unwrap();
    assert_eq!((&problem["parameter"], &problem["status"]), (&json!("since"), &json!(400)));
    assert!(problem["detail"].as_str().unwrap().contains(&format!("it is at {newest}")), "{problem}");
    // A browser that comes again does so by itself, and is helped: another store may be served.
    let mut events = Events::open(&format!("{}/changes", server.url()), "1000000").await;
    events.expect("start").await;
    events.expect("reset").await;

    let mut client = MapServiceClient::connect(server.url()).await.unwrap();
    let request = v1::WatchChangesRequest { since_revision: Some(1_000_000), ..v1::WatchChangesRequest::default() };
    assert_eq!(client.watch_changes(request).await.unwrap_err().code(), Code::InvalidArgument);
    // Who has nothing is told all, whatever is kept.
    let mut events = Events::open(&format!("{}/changes?since=0", server.url()), "").await;
    events.expect("start").await;
    assert_eq!(events.expect("cell").await.data["from_version"], 0);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn more_readers_than_may_follow_are_told_to_come_again_and_one_that_vanishes_leaves_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |config| config.max_change_readers = 20).await;
    let url = format!("{}/changes", server.url());
    let mut readers = Vec::new();
    for _ in 0..20 {
        let mut events = Events::open(&url, "").await;
        events.expect("start").await;
        readers.push(events);
    }
    let client = Arc::new(http::client());
    let refused = futures::future::join_all((0..2_000).map(|_| {
        let (client, url) = (Arc::clone(&client), url.clone());
        async move { client.get(url).send().await.unwrap() }
    }));
    for answer in refused.await {
        assert_eq!(answer.status(), StatusCode::SERVICE_UNAVAILABLE);
        assert!(answer.headers()["retry-after"].to_str().unwrap().parse::<u32>().unwrap() > 0);
    }
    let mut grpc = MapServiceClient::connect(server.url()).await.unwrap();
    let refused = grpc.watch_changes(v1::WatchChangesRequest::default()).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted);

    readers.pop();
    // Its place is free once the server has seen the end of the connection.
    let coming_again = async {
        while client.get(&url).send().await.unwrap().status() != StatusCode::OK {
            tokio::task::yield_now().await;
        }
    };
    timeout(PATIENCE, coming_again).await.expect("the place is free again");
    for reader in &mut readers {
        assert_eq!(reader.headers()["cache-control"], "no-cache, no-transform");
        assert_eq!(reader.headers()["x-accel-buffering"], "no");
    }
    server.shutdown().await;
    for reader in &mut readers {
        assert!(reader.next().await.is_none(), "the stream has an end");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_of_a_quiet_map_hears_that_the_server_is_alive_and_how_far_the_map_is() {
    let drives = along_a_road(28, 1, 120.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |config| config.change_heartbeat_s = 1).await;
    let mut events = Events::open(&format!("{}/changes?cell=14-1-1", server.url()), "").await;
    events.expect("start").await;
    drives[0].upload_whole(&server.url()).await;
    settled(&server).await;
    let newest = server.map().revision().to_string();
    let hearing = async {
        while events.last_id != newest {
            events.comment().await;
        }
    };
    timeout(PATIENCE, hearing).await.expect("the sign of life names the newest revision");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_caller_that_reads_slowly_is_told_of_what_it_missed_at_once_and_holds_up_nobody() {
    let drives = along_a_road(29, 4, 200.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    let narrow = Endpoint::from_shared(server.url()).unwrap().initial_stream_window_size(1_000);
    let mut client = MapServiceClient::new(narrow.connect().await.unwrap());
    let request =
        v1::WatchChangesRequest { since_revision: Some(0), with_lines: true, ..v1::WatchChangesRequest::default() };
    let mut slow = client.watch_changes(request).await.unwrap().into_inner();
    // It reads nothing while the map grows: HTTP/2 lets 1,000 bytes pass, then the server waits.
    grow(&server.url(), &drives).await;
    settled(&server).await;
    let newest = server.map().revision();

    let fresh = cell_bytes(&server.url()).await;
    let mut copy = Copy::default();
    let mut told = 0;
    while copy.bytes() != fresh {
        let message = timeout(PATIENCE, slow.message()).await.unwrap().unwrap().expect("the stream goes on");
        let Some(Told::Cell(cell)) = message.told else { continue };
        let changes = cell.changes.expect("it fits");
        assert_eq!(changes.from_version, copy.cells.get(&cell.cell).map_or(0, |cell| cell.version));
        copy.take(&changes);
        told += 1;
    }
    assert!(told < newest.0, "{told} messages told of {newest} versions");
    server.shutdown().await;
    let end = timeout(PATIENCE, async { while let Ok(Some(_)) = slow.message().await {} }).await;
    assert!(end.is_ok(), "the stream has an end");
}

/// The cells that a query is answered with: their keys and bytes.
async fn queried(session: &zenoh::Session, key: &str) -> BTreeMap<String, Vec<u8>> {
    let replies = session.get(key).await.unwrap();
    let mut cells = BTreeMap::new();
    while let Ok(reply) = replies.recv_async().await {
        let sample = reply.into_result().unwrap();
        assert_eq!(sample.encoding().to_string(), CELL_ENCODING);
        cells.insert(sample.key_expr().to_string(), sample.payload().to_bytes().to_vec());
    }
    cells
}

#[tokio::test(flavor = "multi_thread")]
async fn over_zenoh_every_cell_is_put_as_it_changes_and_queried_as_it_is() {
    let drives = along_a_road(30, 2, 200.0, true);
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let server = servers::lively(folder.path(), |config| {
        config.zenoh_mode = ZenohMode::Router;
        config.zenoh_listen = endpoint.parse().unwrap();
    })
    .await;
    let session = raw_zenoh::connect(&endpoint).await;
    assert!(queried(&session, EVERY_CELL).await.is_empty());
    let heard = session.declare_subscriber(EVERY_CELL).await.unwrap();
    drives[0].upload_whole(&server.url()).await;
    // A subscriber that is declared just now may miss the first puts: it asks, and hears the rest.
    settled(&server).await;
    let mut copy = queried(&session, EVERY_CELL).await;
    assert_eq!(copy.len(), 2);
    drives[1].upload_whole(&server.url()).await;
    settled(&server).await;
    let fresh: BTreeMap<String, Vec<u8>> =
        cell_bytes(&server.url()).await.into_iter().map(|(cell, bytes)| (cell_key(&cell), bytes)).collect();
    let following = async {
        while copy != fresh {
            let sample = heard.recv_async().await.unwrap();
            assert_eq!(sample.encoding().to_string(), CELL_ENCODING);
            copy.insert(sample.key_expr().to_string(), sample.payload().to_bytes().to_vec());
        }
    };
    timeout(PATIENCE, following).await.expect("what is put is the map");
    assert_eq!(queried(&session, EVERY_CELL).await, fresh);
    let (key, bytes) = fresh.first_key_value().unwrap();
    assert_eq!(queried(&session, key).await, BTreeMap::from([(key.clone(), bytes.clone())]));
    assert!(queried(&session, "lanemap/v1/map/14-1-1").await.is_empty());
    server.shutdown().await;
}
