//! Promise: of more drives than a cell keeps, those are let go of that are missed least, in whatever order they came.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::path::Path;

use lanemap_server::{Server, ServerConfig};
use lanemap_tests::{
    fleets::{WireDrive, along_a_road, cell_maps, settled, settled_where},
    servers,
};

/// A server that keeps so many drives of a cell, with the names that a key gives.
fn keeping(drives: usize, folder: &Path, key: &Path) -> ServerConfig {
    ServerConfig {
        privacy_key_file: key.join("privacy.key"),
        max_contributions_per_cell: drives,
        ..servers::config(folder)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn of_more_drives_than_a_cell_keeps_the_youngest_count_in_any_order_of_upload() {
    let drives = along_a_road(12, 3, 120.0, false);
    let key = tempfile::tempdir().unwrap();
    let mut maps = Vec::new();
    for order in [vec![0, 1, 2], vec![2, 1, 0], vec![1, 2]] {
        let folder = tempfile::tempdir().unwrap();
        let server = Server::start(keeping(2, folder.path(), key.path())).await.unwrap();
        for index in order {
            drives[index].upload_whole(&server.url()).await;
        }
        settled(&server).await;
        assert_eq!(server.map().list().remove(0).1.drives, 2);
        maps.push(cell_maps(&server.url()).await.remove(0).lanes);
        server.shutdown().await;
    }
    assert!(!maps[0].is_empty());
    assert_eq!(maps[0], maps[2]);
    assert_eq!(maps[1], maps[2]);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_road_that_only_the_oldest_drive_went_stays_when_a_full_cell_lets_go_of_drives() {
    let drives = along_a_road(21, 9, 400.0, false);
    let key = tempfile::tempdir().unwrap();
    let mut maps = Vec::new();
    for last_first in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let server = Server::start(keeping(4, folder.path(), key.path())).await.unwrap();
        let record = || server.map().list().remove(0).1;
        if !last_first {
            drives[0].upload_whole(&server.url()).await;
            settled(&server).await;
        }
        let mut younger: Vec<&WireDrive> = drives[1..].iter().collect();
        if last_first {
            younger.reverse();
        }
        for drive in younger {
            drive.upload(&server.url(), drive.frames.len() * 2 / 5, true).await;
            settled(&server).await;
        }
        if last_first {
            let without_m = record().line_m;
            drives[0].upload_whole(&server.url()).await;
            settled_where(server.map(), |map| map.list()[0].1.line_m > 1.5 * without_m).await;
        }
        assert_eq!(record().drives, 4);
        let mut cell = cell_maps(&server.url()).await.remove(0);
        assert!(cell.lanes.iter().any(|lane| lane.drives == 4), "the oldest drive and the youngest saw one road");
        // The same after a restart.
        server.shutdown().await;
        let server = Server::start(keeping(4, folder.path(), key.path())).await.unwrap();
        settled(&server).await;
        assert_eq!(cell_maps(&server.url()).await, [cell.clone()]);
        cell.version = 0;
        maps.push((cell, server.map().list().remove(0).1.line_m));
        server.shutdown().await;
    }
    assert_eq!(maps[0].0, maps[1].0, "whichever comes first");

    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    drives[0].upload_whole(&server.url()).await;
    settled(&server).await;
    let alone_m = server.map().list()[0].1.line_m;
    assert!(maps[0].1 > 0.9 * alone_m, "{} m of lines are left of {alone_m} m", maps[0].1);
    server.shutdown().await;
}
