//! Promise: what a live drive says is on the map of a large cell before all of its drives are solved together, and once it is
//! quiet the map is the one that they make, drafted or not.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::path::Path;

use lanemap_proto::v1::{self, admin_service_client::AdminServiceClient};
use lanemap_server::{Server, ServerConfig, fuse::SharedMap};
use lanemap_tests::{
    fleets::{FLEET, PATIENCE, WireDrive, along_a_road, cell_maps, settled, settled_where},
    http, servers,
};
use tokio::time::timeout;

/// A server that drafts every cell, and fuses it long enough afterwards for a test to look at the draft.
fn drafting(folder: &Path, key: &Path) -> ServerConfig {
    ServerConfig {
        privacy_key_file: key.join("privacy.key"),
        fuse_draft_km: 0.0,
        fuse_interval_ms: 2_000,
        ..servers::config(folder)
    }
}

/// The lines of the only cell that drives make on a server that drafts none.
async fn fused(key: &Path, drives: &[(&WireDrive, usize)]) -> Vec<v1::FusedLane> {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { privacy_key_file: key.join("privacy.key"), ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    for (drive, frames) in drives {
        drive.upload(&server.url(), *frames, *frames == drive.frames.len()).await;
    }
    settled(&server).await;
    let lanes = cell_maps(&server.url()).await.remove(0).lanes;
    server.shutdown().await;
    lanes
}

async fn drafts(url: &str) -> f64 {
    let metrics = http::get(format!("{url}/metrics")).await.unwrap().text().await.unwrap();
    let line = metrics.lines().find_map(|line| line.strip_prefix("lanemap_cells_drafted_total "));
    line.expect("the counter is there from the start").parse().unwrap()
}

/// Waits for the next version of the only cell.
async fn next_version(map: &SharedMap, version: u64) {
    let mut publications = map.publications();
    let coming = async {
        while map.list()[0].1.version.0 <= version {
            publications.changed().await.unwrap();
        }
    };
    timeout(PATIENCE, coming).await.expect("another version comes");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_live_drive_is_drafted_and_the_cell_is_fused_from_all_of_its_drives_once_it_is_quiet() {
    let drives = along_a_road(31, 5, 300.0, false);
    let (live, others) = drives.split_last().unwrap();
    let (key, folder) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let server = Server::start(drafting(folder.path(), key.path())).await.unwrap();
    for drive in others {
        drive.upload(&server.url(), drive.frames.len() / 2, true).await;
    }
    settled(&server).await;
    let before = server.map().list()[0].1.as_ref().clone();
    let most = live.frames.len() * 9 / 10;

    // More of the road than the others saw is on the map while the cell is still to be fused.
    let already = drafts(&server.url()).await;
    live.upload(&server.url(), most, false).await;
    next_version(server.map(), before.version.0).await;
    assert!(drafts(&server.url()).await > already);
    assert!(!server.map().is_settled());
    let draft = server.map().list()[0].1.as_ref().clone();
    assert!(draft.line_m > before.line_m + 50.0, "{} m of lines were {} m", draft.line_m, before.line_m);
    assert!(cell_maps(&server.url()).await[0].lanes.iter().any(|lane| lane.drives == 5));

    settled_where(server.map(), |map| map.list()[0].1.version.0 >= draft.version.0).await;
    let mut said: Vec<(&WireDrive, usize)> = Vec::new();
    let halves: Vec<WireDrive> = others
        .iter()
        .map(|drive| WireDrive { frames: drive.frames[..drive.frames.len() / 2].to_vec(), ..drive.clone() })
        .collect();
    said.extend(halves.iter().map(|drive| (drive, drive.frames.len())));
    said.push((live, most));
    assert_eq!(cell_maps(&server.url()).await.remove(0).lanes, fused(key.path(), &said).await);

    // It goes on, though it was fused with the others, and the service stops while there is but a draft.
    let version = server.map().list()[0].1.version.0;
    live.upload_whole(&server.url()).await;
    next_version(server.map(), version).await;
    assert!(!server.map().is_settled());
    server.shutdown().await;
    let server = Server::start(drafting(folder.path(), key.path())).await.unwrap();
    settled(&server).await;
    said.pop();
    said.push((live, live.frames.len()));
    assert_eq!(cell_maps(&server.url()).await.remove(0).lanes, fused(key.path(), &said).await);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_that_is_deleted_leaves_drafted_cells_too() {
    let drives = along_a_road(33, 4, 160.0, false);
    let (key, folder) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let server = Server::start(drafting(folder.path(), key.path())).await.unwrap();
    let url = server.url();
    drives[0].upload_whole(&url).await;
    drives[1].upload_whole(&url).await;
    settled(&server).await;
    // The deleted drive is in what the live one is laid on.
    let (already, version) = (drafts(&url).await, server.map().list()[0].1.version.0);
    drives[2].upload(&url, drives[2].frames.len() / 2, false).await;
    next_version(server.map(), version).await;
    assert!(drafts(&url).await > already);
    let mut admin = AdminServiceClient::connect(url.clone()).await.unwrap();
    let vehicle_id = drives[0].start.vehicle_id.clone();
    let request = v1::ForgetRequest { fleet_id: FLEET.to_owned(), vehicle_id, drive_id: None };
    assert_eq!(admin.forget(request).await.unwrap().into_inner().drives, 1);
    settled(&server).await;
    drives[3].upload_whole(&url).await;
    settled(&server).await;
    let said = [
        (&drives[1], drives[1].frames.len()),
        (&drives[2], drives[2].frames.len() / 2),
        (&drives[3], drives[3].frames.len()),
    ];
    assert_eq!(cell_maps(&url).await.remove(0).lanes, fused(key.path(), &said).await);
    server.shutdown().await;
}
