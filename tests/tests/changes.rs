//! Promise: who follows the map has it: every state of it has a number, and a reader that was away is told what it
//! missed, over restarts and kills too.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::collections::BTreeMap;

use lanemap_core::fleet::CellId;
use lanemap_server::{
    Server, ServerConfig,
    fuse::{CellVersion, MapRevision, RevisionError, SharedMap},
};
use lanemap_tests::{
    fleets::{along_a_road, settled},
    servers,
};

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
