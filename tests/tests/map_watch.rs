//! Promise: a Rust client that follows the map has it, byte for byte, whatever happens to its connection and to the server.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{collections::BTreeMap, net::SocketAddr, time::Duration};

use lanemap_client::{Area, MapCopy, MapNews, MapWatch, Reconnect, WatchOptions};
use lanemap_proto::v1::{self, MapEventKind};
use lanemap_server::RunningServer;
use lanemap_simulator::fleet::ChangePlan;
use lanemap_tests::{
    fleets::{PATIENCE, along_a_changing_road, along_a_road, cell_bytes, grow, settled},
    proxy::{Fault, Proxy},
    servers,
};
use prost::Message;
use tokio::time::timeout;

/// Tries again soon.
fn quick(area: Area) -> WatchOptions {
    let reconnect = Reconnect { longest_pause: Duration::from_millis(200), ..Reconnect::forever() };
    WatchOptions { area, reconnect, ..WatchOptions::default() }
}

fn bytes_of(copy: &MapCopy) -> BTreeMap<String, Vec<u8>> {
    copy.cells().iter().map(|(cell, map)| (cell.clone(), map.encode_to_vec())).collect()
}

/// Has it follow until it has all.
async fn catch_up(watch: &mut MapWatch, server: &RunningServer) {
    settled(server).await;
    timeout(PATIENCE, watch.until(server.map().revision().0)).await.expect("it catches up").unwrap();
    assert_eq!(bytes_of(watch.copy()), cell_bytes(&server.url()).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_copy_of_the_map_is_the_map_though_the_connection_is_cut_again_and_again() {
    let drives = along_a_road(41, 3, 200.0, true);
    let folder = tempfile::tempdir().unwrap();
    // No change comes with its lines: each is fetched, and what is asked for wears the connection out.
    let server = servers::lively(folder.path(), |config| config.max_change_event_bytes = 0).await;
    let url = server.url();
    let address: SocketAddr = url.strip_prefix("http://").unwrap().parse().unwrap();
    let proxy = Proxy::start(address, 350, &[Fault::Cut; 8]).await;
    let mut watch = MapWatch::new(&format!("http://{}", proxy.address()), quick(Area::All)).await.unwrap();
    let growing = tokio::spawn({
        let (url, drives) = (url.clone(), drives.clone());
        async move { grow(&url, &drives).await }
    });
    let (mut breaks, mut versions) = (0, 0);
    while !(growing.is_finished() && breaks >= 3) {
        // A quiet map says nothing but that it lives.
        let Ok(news) = timeout(Duration::from_secs(2), watch.next()).await else { break };
        match news.unwrap() {
            MapNews::Disconnected { .. } => breaks += 1,
            MapNews::Cell { cell, from_version, to_version } => {
                assert!(from_version < to_version);
                assert_eq!(watch.copy().cell(&cell).unwrap().version, to_version);
                versions += 1;
            }
            MapNews::Event(_) => {}
            MapNews::Reset => panic!("all is kept"),
        }
    }
    growing.await.unwrap();
    catch_up(&mut watch, &server).await;
    // Versions that came while it was away are told as one.
    assert!(breaks >= 3 && versions >= 2, "{breaks} breaks, {versions} versions");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_copy_goes_on_after_a_restart_of_the_server_and_in_another_process_with_a_part_of_the_map_too() {
    let drives = along_a_road(42, 3, 200.0, true);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    let url = server.url();
    let mut watch = MapWatch::new(&url, quick(Area::All)).await.unwrap();
    drives[0].upload_whole(&url).await;
    catch_up(&mut watch, &server).await;
    let address: SocketAddr = url.strip_prefix("http://").unwrap().parse().unwrap();
    server.shutdown().await;

    let server = servers::lively(folder.path(), |config| config.listen = address).await;
    drives[1].upload_whole(&url).await;
    catch_up(&mut watch, &server).await;

    let copy = watch.into_copy();
    let revision = copy.revision().expect("it is the map at a revision");
    drives[2].upload_whole(&url).await;
    let mut watch = MapWatch::resume(&url, quick(Area::All), copy).await.unwrap();
    assert_eq!(watch.copy().revision(), Some(revision));
    catch_up(&mut watch, &server).await;

    let (cell, fresh) = cell_bytes(&url).await.pop_last().unwrap();
    let mut part = MapWatch::new(&url, quick(Area::Cells(vec![cell.clone()]))).await.unwrap();
    timeout(PATIENCE, part.until(server.map().revision().0)).await.expect("it catches up").unwrap();
    assert_eq!(bytes_of(part.copy()), BTreeMap::from([(cell, fresh)]));
    let wrong = MapWatch::new(&url, quick(Area::Cells(vec!["14-1".to_owned()]))).await.unwrap().next().await;
    assert!(wrong.unwrap_err().to_string().contains("14-1"), "what cannot be mended is told");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_copy_that_was_away_for_too_long_begins_anew_and_is_the_map_again() {
    let drives = along_a_road(43, 2, 120.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |config| config.cell_versions_kept_s = 0).await;
    let url = server.url();
    let mut watch = MapWatch::new(&url, quick(Area::All)).await.unwrap();
    drives[0].upload(&url, 60, false).await;
    catch_up(&mut watch, &server).await;
    let copy = watch.into_copy();
    grow(&url, &drives).await;
    settled(&server).await;
    let mut watch = MapWatch::resume(&url, quick(Area::All), copy).await.unwrap();
    assert_eq!(timeout(PATIENCE, watch.next()).await.unwrap().unwrap(), MapNews::Reset);
    assert_eq!(watch.copy(), &MapCopy::default());
    catch_up(&mut watch, &server).await;
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_happens_to_the_road_is_told_before_the_cell_in_which_it_did() {
    let plan = ChangePlan { vanished: 1, first_drive: 4, last_drive: 4, max_length_m: 100.0, ..ChangePlan::none() };
    let road = along_a_changing_road(44, 10, plan);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    let url = server.url();
    let mut watch = MapWatch::new(&url, quick(Area::All)).await.unwrap();
    for drive in &road.drives {
        drive.upload_whole(&url).await;
    }
    settled(&server).await;
    let hearing = async {
        loop {
            let MapNews::Event(event) = watch.next().await.unwrap() else { continue };
            if event.kind() == MapEventKind::Vanished {
                return event;
            }
        }
    };
    let event = timeout(PATIENCE, hearing).await.expect("it is told");
    assert!(event.probability_permille > 500 && event.noticed_unix_ns.is_some() && event.xyz_mm.len() > 9, "{event:?}");
    assert!(watch.copy().cell(&event.cell).is_none_or(|cell| cell.version < event.version), "the cell follows");
    catch_up(&mut watch, &server).await;
    assert!(watch.copy().cells()[&event.cell].version >= event.version);
    let v1::MapEvent { moved_mm, into, .. } = *event;
    assert_eq!((moved_mm, into), (0, Vec::new()));
    server.shutdown().await;
}
