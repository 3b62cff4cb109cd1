//! Promise: what many drives say of a road is one map, whatever the order in which it comes, and readers see whole
//! versions of it, over restarts and kills too.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use lanemap_proto::v1::{self, admin_service_client::AdminServiceClient, map_service_client::MapServiceClient};
use lanemap_server::{
    Server, ServerConfig,
    fuse::{
        SharedMap,
        wire::{apply, parse_lane_id, positions},
    },
};
use lanemap_tests::{
    fleets::{FLEET, WireDrive, along_a_road, cell_bytes, cell_maps, cells_until, settled, settled_where},
    http,
    raw_stream::RawStream,
    servers::{self, ServerProcess},
};
use nalgebra::Point3;
use prost::Message;
use reqwest::StatusCode;
use serde_json::Value;
use tonic::Code;

async fn json(url: &str) -> Value {
    http::get(url).await.unwrap().error_for_status().unwrap().json().await.unwrap()
}

async fn forget(url: &str, drive: &WireDrive) {
    let mut client = AdminServiceClient::connect(url.to_owned()).await.unwrap();
    let vehicle_id = drive.start.vehicle_id.clone();
    let request = v1::ForgetRequest { fleet_id: FLEET.to_owned(), vehicle_id, drive_id: None };
    assert_eq!(client.forget(request).await.unwrap().into_inner().drives, 1);
}

/// A counter without labels.
async fn counter(url: &str, name: &str) -> u64 {
    let metrics = http::get(format!("{url}/metrics")).await.unwrap().text().await.unwrap();
    let line = metrics.lines().find(|line| line.starts_with(&format!("{name} "))).expect("the metric is there");
    line.rsplit(' ').next().unwrap().parse().unwrap()
}

/// Shortest distance between control points of two lanes, in plan, metres.
fn apart_m(a: &v1::FusedLane, b: &v1::FusedLane) -> f64 {
    let (a, b) = (positions(a), positions(b));
    let to = |point: &Point3<f64>| {
        let chords = b.windows(2).map(|pair| {
            let chord = (pair[1] - pair[0]).xy();
            let along = ((point - pair[0]).xy().dot(&chord) / chord.norm_squared()).clamp(0.0, 1.0);
            ((point - pair[0]).xy() - chord * along).norm()
        });
        chords.fold(f64::INFINITY, f64::min)
    };
    // The middle half: lines may begin and end beside each other.
    let middle = &a[a.len() / 4..(3 * a.len()).div_ceil(4)];
    middle.iter().map(to).fold(f64::INFINITY, f64::min)
}

#[tokio::test(flavor = "multi_thread")]
async fn two_drives_of_one_road_with_different_gnss_bias_give_one_set_of_lanes() {
    let drives = along_a_road(1, 2, 250.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    drives[0].upload_whole(&server.url()).await;
    settled(&server).await;
    let alone = cell_maps(&server.url()).await;
    drives[1].upload_whole(&server.url()).await;
    settled(&server).await;
    let both = cell_maps(&server.url()).await;

    let [alone, both] = [&alone, &both].map(|maps| {
        assert_eq!(maps.len(), 1, "the road lies in one cell");
        &maps[0]
    });
    assert!(both.version > alone.version);
    let seen_by_both = both.lanes.iter().filter(|lane| lane.drives == 2).count();
    assert!(seen_by_both >= 2, "only {seen_by_both} lines were seen by both drives");
    for (index, lane) in both.lanes.iter().enumerate() {
        for other in &both.lanes[index + 1..] {
            assert!(apart_m(lane, other) > 1.0, "{} runs beside {}", lane.id, other.id);
        }
    }
    // Lines keep their names: those of the older drive.
    let names = |map: &v1::CellMap| map.lanes.iter().map(|lane| lane.id.clone()).collect::<BTreeSet<_>>();
    assert!(names(alone).intersection(&names(both)).count() >= 3);

    let items = json(&format!("{}/collections/lanes/items", server.url())).await;
    let features = items["features"].as_array().unwrap();
    assert_eq!(features.len(), both.lanes.len());
    for name in ["lane", "cell", "version", "category", "drives", "existence", "lateral_sigma_m", "last_seen"] {
        assert!(!features[0]["properties"][name].is_null(), "{name}");
    }
    let cells = json(&format!("{}/cells", server.url())).await;
    assert_eq!(
        (&cells["total"], &cells["cells"][0]["drives"], &cells["cells"][0]["dirty"]),
        (&1.into(), &2.into(), &false.into())
    );
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn any_order_of_upload_and_any_duplication_gives_the_same_map() {
    let drives = along_a_road(2, 3, 150.0, false);
    // Names in the map are given under the store's key: both stores have the same one.
    let key = tempfile::tempdir().unwrap();
    let mut maps = Vec::new();
    for order in [vec![0, 1, 2], vec![2, 2, 0, 1, 0]] {
        let folder = tempfile::tempdir().unwrap();
        let config =
            ServerConfig { privacy_key_file: key.path().join("privacy.key"), ..servers::config(folder.path()) };
        let server = Server::start(config).await.unwrap();
        for index in order {
            let drive: &WireDrive = &drives[index];
            assert!(drive.frames.len() <= 256, "a server knows as many frames again");
            drive.upload(&server.url(), 120, false).await;
            drive.upload(&server.url(), drive.frames.len(), false).await;
        }
        settled(&server).await;
        let mut map = cell_maps(&server.url()).await;
        for cell in &mut map {
            cell.version = 0;
        }
        maps.push(map);
        server.shutdown().await;
    }
    assert!(!maps[0].is_empty() && maps[0].iter().all(|cell| cell.lanes.len() >= 3));
    assert_eq!(maps[0], maps[1]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_kill_loses_no_cell_and_a_clean_one_is_not_fused_again() {
    let binary = env!("CARGO_BIN_EXE_killable-server");
    let drives = along_a_road(3, 2, 200.0, true);
    let folder = tempfile::tempdir().unwrap();
    let mut server = ServerProcess::start(binary, folder.path());
    drives[0].upload_whole(&server.url).await;
    drives[1].upload(&server.url, 130, false).await;
    // Both drives have come to both cells.
    let seen = |cells: &[Value]| cells.len() == 2 && cells.iter().all(|cell| cell["drives"] == 2);
    cells_until(&server.url, seen).await;
    let before = cell_bytes(&server.url).await;
    assert!(counter(&server.url, "lanemap_cells_fused_total").await > 0);
    server.kill();

    let server = ServerProcess::start(binary, folder.path());
    // The drive that was not saved whole is mapped again from its frames, and says the same.
    let whole = |sessions: &Value| {
        let sessions = sessions["sessions"].as_array().unwrap();
        sessions.iter().any(|session| session["frames"] == 130)
    };
    while !whole(&json(&format!("{}/sessions", server.url)).await) {
        tokio::task::yield_now().await;
    }
    cells_until(&server.url, seen).await;
    assert_eq!(cell_bytes(&server.url).await, before);
    assert_eq!(counter(&server.url, "lanemap_cells_fused_total").await, 0);

    // Once there is more to say, the versions go on from where they were.
    drives[1].upload_whole(&server.url).await;
    cells_until(&server.url, seen).await;
    let versions = |cells: &BTreeMap<String, Vec<u8>>| -> Vec<u64> {
        cells.values().map(|bytes| v1::CellMap::decode(bytes.as_slice()).unwrap().version).collect()
    };
    let after = cell_bytes(&server.url).await;
    assert!(versions(&after).iter().zip(versions(&before)).any(|(after, before)| *after > before));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restart_in_order_fuses_nothing_again_and_reads_what_it_had() {
    let drives = along_a_road(4, 2, 150.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    for drive in &drives {
        drive.upload_whole(&server.url()).await;
    }
    settled(&server).await;
    let before = cell_bytes(&server.url()).await;
    let fused_at = json(&format!("{}/cells", server.url())).await["cells"][0]["fused_at"].clone();
    server.shutdown().await;
    let server = servers::start(folder.path()).await;
    settled(&server).await;
    assert_eq!(cell_bytes(&server.url()).await, before);
    assert_eq!(json(&format!("{}/cells", server.url())).await["cells"][0]["fused_at"], fused_at);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_live_drive_sees_is_readable_while_it_drives_on() {
    let drives = along_a_road(5, 1, 250.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let (mut stream, _) = RawStream::started(&server.url(), drives[0].start.clone()).await;
    let mut longest = 0.0;
    for frames in drives[0].frames.chunks(60) {
        for frame in frames {
            stream.send_frame(frame.clone()).await;
        }
        stream.acked(frames.last().unwrap().sequence).await;
        // The stream stays open, and nothing more comes on it until the map has grown.
        let length = |map: &SharedMap| map.list().iter().map(|(_, record)| record.line_m).sum::<f64>();
        if frames.len() == 60 {
            settled_where(server.map(), |map| length(map) > longest + 20.0).await;
        }
        longest = length(server.map());
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_forgotten_drive_is_gone_from_the_cells_and_from_their_past() {
    let drives = along_a_road(6, 2, 150.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    drives[1].upload_whole(&server.url()).await;
    settled(&server).await;
    let alone = cell_maps(&server.url()).await;
    drives[0].upload_whole(&server.url()).await;
    settled(&server).await;
    let (cell, with_both) = (alone[0].cell.clone(), cell_maps(&server.url()).await);
    assert_ne!(alone[0].lanes, with_both[0].lanes);

    forget(&server.url(), &drives[0]).await;
    let without = cell_maps(&server.url()).await;
    assert_eq!(without[0].lanes, alone[0].lanes);
    assert!(without[0].version > with_both[0].version);
    let since = format!("{}/cells/{cell}/changes?since={}", server.url(), with_both[0].version);
    let refused = http::get(&since).await.unwrap();
    assert_eq!(refused.status(), StatusCode::GONE);
    let problem: Value = refused.json().await.unwrap();
    assert_eq!(problem["alternate"], format!("{}/cells/{cell}/lanes.pb", server.url()));

    forget(&server.url(), &drives[1]).await;
    let nothing = cell_maps(&server.url()).await;
    assert!(nothing[0].lanes.is_empty() && nothing[0].version > without[0].version);
    let items = json(&format!("{}/collections/lanes/items", server.url())).await;
    assert_eq!(items["features"], Value::Array(vec![]));
    server.shutdown().await;
}

/// Reads a cell again and again until told to stop; every version that it saw.
async fn watch(url: String, stop: Arc<AtomicBool>) -> BTreeMap<u64, Vec<u8>> {
    let mut seen: BTreeMap<u64, Vec<u8>> = BTreeMap::new();
    let mut last = 0;
    while !stop.load(Ordering::Relaxed) {
        for (_, bytes) in cell_bytes(&url).await {
            let map = v1::CellMap::decode(bytes.as_slice()).unwrap();
            assert!(map.version >= last, "version {} came after {last}", map.version);
            assert_eq!(map.encode_to_vec(), bytes, "the bytes are whole");
            last = map.version;
            let same = seen.insert(map.version, bytes.clone()).is_none_or(|before| before == bytes);
            assert!(same, "version {last} has two contents");
        }
    }
    seen
}

#[tokio::test(flavor = "multi_thread")]
async fn readers_see_whole_versions_while_drives_write_and_changes_lead_from_each_to_the_last() {
    let drives = along_a_road(7, 3, 150.0, false);
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { fuse_interval_ms: 20, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let reader = tokio::spawn(watch(server.url(), Arc::clone(&stop)));
    for drive in &drives {
        for frames in [40, 80, 120, drive.frames.len()] {
            drive.upload(&server.url(), frames, false).await;
        }
    }
    settled(&server).await;
    stop.store(true, Ordering::Relaxed);
    let seen = reader.await.unwrap();
    assert!(seen.len() >= 3, "only {} versions were seen", seen.len());

    let newest = cell_maps(&server.url()).await.remove(0);
    let mut client = MapServiceClient::connect(server.url()).await.unwrap();
    for bytes in
        seen.values().chain([&v1::CellMap { cell: newest.cell.clone(), ..v1::CellMap::default() }.encode_to_vec()])
    {
        let snapshot = v1::CellMap::decode(bytes.as_slice()).unwrap();
        let since = format!("{}/cells/{}/changes.pb?since={}", server.url(), newest.cell, snapshot.version);
        let changes = http::get(since).await.unwrap().error_for_status().unwrap().bytes().await.unwrap();
        let changes = v1::CellChanges::decode(changes).unwrap();
        assert_eq!(apply(&snapshot, &changes).encode_to_vec(), newest.encode_to_vec());
        let request = v1::GetChangesRequest { cell: newest.cell.clone(), since_version: snapshot.version };
        assert_eq!(client.get_changes(request).await.unwrap().into_inner().changes, Some(changes));
    }
    let request = v1::GetCellRequest { cell: newest.cell.clone() };
    assert_eq!(client.get_cell(request).await.unwrap().into_inner().map, Some(newest));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_line_over_a_border_goes_on_in_the_next_cell_from_the_same_place() {
    let drives = along_a_road(8, 2, 250.0, true);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    for drive in &drives {
        drive.upload_whole(&server.url()).await;
    }
    settled(&server).await;
    let cells = cell_maps(&server.url()).await;
    assert_eq!(cells.len(), 2);
    let named: BTreeMap<(String, String, u32), &v1::FusedLane> = cells
        .iter()
        .flat_map(|cell| cell.lanes.iter().map(|lane| ((cell.cell.clone(), lane.id.clone(), lane.part), lane)))
        .collect();
    let (mut joined, mut same_name) = (0, 0);
    for ((cell, id, part), lane) in &named {
        let Some(border) = &lane.ends_at else { continue };
        let Some(next) = &border.continues_in else { continue };
        let beyond = named[&(next.cell.clone(), next.id.clone(), next.part)];
        let back = [&beyond.begins_at, &beyond.ends_at].into_iter().flatten().find(|back| back.place == border.place);
        let back = back.expect("the next piece has the same border point").continues_in.as_ref().unwrap();
        assert_eq!((&back.cell, &back.id, back.part), (cell, id, *part));
        joined += 1;
        same_name += usize::from(next.id == *id);
    }
    assert!(joined >= 3, "only {joined} lines go over the border");
    assert_eq!(same_name, joined, "both drives are the witnesses on both sides");

    let tile = http::get(format!("{}/splines/13/{}", server.url(), tile_around(&cells[0].cell))).await.unwrap();
    let tile = v1::SplineTile::decode(tile.error_for_status().unwrap().bytes().await.unwrap()).unwrap();
    let whole = tile.cells.iter().find(|cell| cell.cell == cells[0].cell).unwrap();
    assert_eq!((whole.version, whole.count as usize), (cells[0].version, cells[0].lanes.len()));
    server.shutdown().await;
}

/// Column and row of the tile of zoom 13 that holds a cell.
fn tile_around(cell: &str) -> String {
    let numbers: Vec<u32> = cell.split('-').map(|number| number.parse().unwrap()).collect();
    format!("{}/{}", numbers[1] / 2, numbers[2] / 2)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_without_gnss_stays_in_its_own_frame_and_says_so() {
    let mut drives = along_a_road(9, 2, 100.0, false);
    drives[1].frames.iter_mut().for_each(|frame| frame.gnss = None);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let placed = drives[0].upload_whole(&server.url()).await;
    let apart = drives[1].upload_whole(&server.url()).await;
    settled(&server).await;
    let sessions = json(&format!("{}/sessions", server.url())).await;
    let placement = |id: &str| {
        let sessions = sessions["sessions"].as_array().unwrap();
        sessions.iter().find(|session| session["id"] == id).unwrap()["placement"].as_str().unwrap().to_owned()
    };
    assert_eq!((placement(&placed).as_str(), placement(&apart).as_str()), ("shared map", "own frame"));
    assert_eq!(json(&format!("{}/cells", server.url())).await["cells"][0]["drives"], 1);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_ends_of_a_trip_that_are_cut_off_tell_the_shared_map_neither_place_nor_time() {
    let drives = along_a_road(11, 1, 300.0, false);
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { trip_cut_m: 60.0, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    drives[0].upload_whole(&server.url()).await;
    settled_where(server.map(), |map| map.list().iter().any(|(_, record)| record.lanes > 0)).await;
    let frames = &drives[0].frames;
    let travelled = |frame: &v1::Frame| {
        let position = frame.odometry.as_ref().unwrap().odometry_from_vehicle.unwrap().position.unwrap();
        position.x.hypot(position.y)
    };
    let whole_m = travelled(frames.last().unwrap());
    let mapped = |frame: &&v1::Frame| travelled(frame) > 58.0 && travelled(frame) < whole_m - 58.0;
    let first = frames.iter().find(mapped).unwrap().time_unix_ns;
    let last = frames.iter().rev().find(mapped).unwrap().time_unix_ns;
    for lane in &cell_maps(&server.url()).await[0].lanes {
        let started = parse_lane_id(&lane.id).unwrap().started.0;
        assert!(started >= first && lane.first_seen_unix_ns >= first && lane.last_seen_unix_ns <= last, "{lane:?}");
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cell_or_version_or_tile_that_is_not_there_is_refused_with_what_would_be() {
    let drives = along_a_road(10, 1, 100.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    drives[0].upload_whole(&server.url()).await;
    settled(&server).await;
    let cell = cell_maps(&server.url()).await[0].cell.clone();
    for (path, status, kind) in [
        ("/cells/14-0-0".to_owned(), 404, "no-such-cell"),
        ("/cells/somewhere/lanes.pb".to_owned(), 404, "no-such-cell"),
        (format!("/cells/{cell}/changes?since=99999"), 410, "version-not-kept"),
        (format!("/cells/{cell}/changes?since=-1"), 400, "bad-parameter"),
        (format!("/cells/{cell}?f=json"), 400, "unknown-parameter"),
        ("/splines/14/16384/0".to_owned(), 404, "no-such-tile"),
    ] {
        let answer = http::get(format!("{}{path}", server.url())).await.unwrap();
        assert_eq!(answer.status().as_u16(), status, "{path}");
        let problem: Value = answer.json().await.unwrap();
        assert_eq!(problem["type"], format!("urn:lanemap:problem:{kind}"), "{path}");
    }
    let mut client = MapServiceClient::connect(server.url()).await.unwrap();
    let code = |outcome: Result<_, tonic::Status>| outcome.err().map(|status| status.code());
    let ask = |cell: &str| v1::GetCellRequest { cell: cell.to_owned() };
    assert_eq!(code(client.get_cell(ask("14-0-0")).await.map(drop)), Some(Code::NotFound));
    assert_eq!(code(client.get_cell(ask("x")).await.map(drop)), Some(Code::InvalidArgument));
    let changes = v1::GetChangesRequest { cell, since_version: 99_999 };
    assert_eq!(code(client.get_changes(changes).await.map(drop)), Some(Code::OutOfRange));
    server.shutdown().await;
}
