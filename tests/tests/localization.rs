//! Promise: a drive without GNSS is found on the shared map where its lanes fit it in one place only, and nowhere else.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::collections::BTreeMap;

use lanemap_core::{
    Mapper, Params, Preset,
    fleet::{
        CellId, Contribution, DriveId, FleetParams, FusedMap, Trace, fuse,
        localization::{AtlasLine, LineAtlas, Localization, localize},
    },
    geometry::georeference::{Anchor, Wgs84},
};
use lanemap_proto::v1::{self, admin_service_client::AdminServiceClient};
use lanemap_server::{RunningServer, Server, ServerConfig, fuse::wire::positions};
use lanemap_simulator::{
    Fleet, FleetScenario, Seed,
    fleet::{FleetRoads, FleetRoutes, ReceiverModel},
    road::{Course, SingleRoad},
};
use lanemap_tests::{
    fleets::{FLEET, WireDrive, along_a_bending_road, along_a_road, cell_maps, settled},
    http, servers,
};
use nalgebra::{Point3, Vector3};
use serde_json::Value;

/// What drive `number` of a fleet says of the map.
fn mapped(fleet: &Fleet, number: u32) -> Contribution {
    let drive = fleet.drive(number);
    let mut mapper = Mapper::new(Params::preset(Preset::Default), drive.sensor());
    let mut trace = Trace::default();
    for frame in drive.frames() {
        let report = mapper.step(&frame);
        trace.observe(&frame, &report.map_from_vehicle);
    }
    trace.contribution(DriveId(u64::from(number)), drive.sensor(), &mapper.lane_map()).unwrap()
}

/// Lines of a map, cut where they leave a cell.
fn atlas(map: &FusedMap, anchor: &Anchor) -> LineAtlas {
    let mut cells: BTreeMap<CellId, Vec<AtlasLine>> = BTreeMap::new();
    for lane in &map.lanes {
        let places = lane.points.iter().map(|point| {
            let place = anchor.wgs84_from_enu(&point.position);
            let cell = CellId::containing(&place).unwrap();
            (cell, cell.anchor().enu_from_wgs84(&place))
        });
        let places: Vec<(CellId, Point3<f64>)> = places.collect();
        for run in places.chunk_by(|a, b| a.0 == b.0) {
            let points = run.iter().map(|(_, point)| *point).collect();
            let line = AtlasLine { points, category_posterior: lane.category_posterior.clone() };
            cells.entry(run[0].0).or_default().push(line);
        }
    }
    let mut atlas = LineAtlas::default();
    for (cell, lines) in cells {
        atlas.put(cell, lines);
    }
    atlas
}

/// Median and largest distance of the fixes that the map gave from where the vehicle truly was, metres, horizontally.
fn error_m(fleet: &Fleet, number: u32, placed: &Contribution) -> (f64, f64) {
    let drive = fleet.drive(number);
    let states = drive.states();
    let anchor = fleet.georeference().anchor;
    let mut errors: Vec<f64> = placed
        .trajectory
        .iter()
        .map(|point| {
            let fix = point.fix.unwrap();
            let state = states.iter().min_by_key(|state| (state.time.0 - point.time.0).abs()).unwrap();
            let place =
                Wgs84 { latitude_deg: fix.latitude_deg, longitude_deg: fix.longitude_deg, height_m: fix.height_m };
            (anchor.enu_from_wgs84(&place) - Point3::from(state.world_from_vehicle.translation.vector)).xy().norm()
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    (errors[errors.len() / 2], *errors.last().unwrap())
}

/// A world whose map was made by some drives, and others that are sought in it.
struct World {
    fleet: Fleet,
    atlas: LineAtlas,
    sought: Vec<(u32, Contribution)>,
}

fn world(scenario: &FleetScenario, seed: u64, mapping: u32, sought: u32) -> World {
    let receiver = ReceiverModel { bias_sigma_m: 0.05, ..ReceiverModel::default() };
    let fleet = FleetScenario { receiver, ..*scenario }.fleet(Seed(seed));
    let drives: Vec<_> = (0..mapping).map(|number| mapped(&fleet, number)).collect();
    let anchor = fleet.georeference().anchor;
    let atlas = atlas(&fuse(&drives, &anchor, &FleetParams::default()), &anchor);
    let sought = (mapping..mapping + sought).map(|number| (number, mapped(&fleet, number))).collect();
    World { fleet, atlas, sought }
}

/// What came of seeking all drives in all worlds.
#[derive(Debug, Default)]
struct Tally {
    /// Drives that were found in their own world, and the median distance of each from where it was, metres.
    found_m: Vec<f64>,
    /// Drives that were found in another.
    elsewhere: usize,
    refused: BTreeMap<String, usize>,
}

fn seek_all(worlds: &[World]) -> Tally {
    let mut tally = Tally::default();
    for (home, World { fleet, sought, .. }) in worlds.iter().enumerate() {
        for (number, drive) in sought {
            for (searched, World { atlas, .. }) in worlds.iter().enumerate() {
                match localize(drive, atlas, &FleetParams::default()) {
                    Localization::Aligned(place) if searched == home => {
                        let (median, worst) = error_m(fleet, *number, &place.contribution);
                        println!("{home}/{number}: {median:.2} / {worst:.2} m, sigma {:.2} m", place.sigma_m());
                        tally.found_m.push(median);
                    }
                    Localization::Aligned(_) => tally.elsewhere += 1,
                    refused if searched == home => *tally.refused.entry(format!("{refused:?}")).or_default() += 1,
                    _ => {}
                }
            }
        }
    }
    tally
}

#[test]
fn drives_are_found_on_their_own_bending_road_and_on_no_other() {
    let scenario = FleetScenario {
        roads: FleetRoads::Single(SingleRoad::new(Course::Loop, 2_500.0)),
        routes: FleetRoutes::Shared { length_m: 700.0, both_directions: false },
        ..FleetScenario::winding_road()
    };
    let worlds: Vec<World> = (1..4_u64).map(|seed| world(&scenario, seed, 3, 3)).collect();
    let tally = seek_all(&worlds);
    // One of the worlds bends as evenly as a circle for most of the way.
    assert!(tally.found_m.len() >= 6 && tally.elsewhere == 0, "{tally:?}");
    // A lane is 3.5 m wide; the map of three drives is itself bent by a metre along the road.
    assert!(tally.found_m.iter().all(|error_m| *error_m < 2.0), "{tally:?}");
}

/// `cargo nextest run --workspace -E 'binary(localization)' --run-ignored only --no-capture`
#[test]
#[ignore = "minutes: how many drives are found in towns, and how many where they are not"]
fn drives_through_towns() {
    for length_m in [600.0, 1_000.0] {
        let scenario = FleetScenario { routes: FleetRoutes::Random { length_m }, ..FleetScenario::small_town(80) };
        let worlds: Vec<World> = (1..5_u64).map(|seed| world(&scenario, seed, 30, 12)).collect();
        println!("{length_m} m: {:?}", seek_all(&worlds));
    }
}

async fn json(url: &str) -> Value {
    http::get(url).await.unwrap().error_for_status().unwrap().json().await.unwrap()
}

/// What a server tells of a session.
async fn told(server: &RunningServer, id: &str) -> Value {
    let list = json(&format!("{}/sessions", server.url())).await;
    let sessions = list["sessions"].as_array().unwrap();
    sessions.iter().find(|session| session["id"] == id).unwrap().clone()
}

async fn upload(server: &RunningServer, drives: &[WireDrive]) {
    for drive in drives {
        drive.upload_whole(&server.url()).await;
    }
    settled(server).await;
}

async fn forget(server: &RunningServer, drive: &WireDrive) {
    let mut client = AdminServiceClient::connect(server.url()).await.unwrap();
    let vehicle_id = drive.start.vehicle_id.clone();
    let request = v1::ForgetRequest { fleet_id: FLEET.to_owned(), vehicle_id, drive_id: None };
    assert_eq!(client.forget(request).await.unwrap().into_inner().drives, 1);
    settled(server).await;
}

/// Drives in the cells, each counted once in every cell that it touches.
async fn drives_in_cells(server: &RunningServer) -> u64 {
    let list = json(&format!("{}/cells", server.url())).await;
    list["cells"].as_array().unwrap().iter().map(|cell| cell["drives"].as_u64().unwrap()).sum()
}

/// Lanes of all cells, without versions.
async fn lanes(server: &RunningServer) -> Vec<v1::FusedLane> {
    cell_maps(&server.url()).await.into_iter().flat_map(|cell| cell.lanes).collect()
}

/// Mean move of the control points of lanes that have as many in both maps, metres.
fn mean_move(before: &[v1::FusedLane], after: &[v1::FusedLane]) -> Vector3<f64> {
    let same = before.iter().filter_map(|lane| {
        let other = after.iter().find(|other| (&other.id, other.part) == (&lane.id, lane.part))?;
        let (lane, other) = (positions(lane), positions(other));
        (lane.len() == other.len()).then(|| lane.into_iter().zip(other).map(|(from, to)| to - from).collect::<Vec<_>>())
    });
    let moves: Vec<Vector3<f64>> = same.flatten().collect();
    assert!(moves.len() > 100, "{} control points to compare", moves.len());
    moves.iter().sum::<Vector3<f64>>() / moves.len() as f64
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_without_gnss_becomes_part_of_the_map_where_its_lanes_fit_it_in_one_place_and_stays_over_a_restart() {
    let drives = along_a_bending_road(3, 4, 700.0);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    upload(&server, &drives[..3]).await;
    let (before, three) = (lanes(&server).await, drives_in_cells(&server).await);
    let last = drives[3].clone().without_gnss();
    let id = last.upload_whole(&server.url()).await;
    settled(&server).await;
    let session = told(&server, &id).await;
    assert_eq!((&session["placement"], &session["aligned_to_map"]["state"]), (&"shared map".into(), &"aligned".into()));
    assert!(session["aligned_to_map"]["sigma_m"].as_f64().unwrap() < 0.8, "{session}");
    assert_eq!(session["georeferenced"], false, "its own frame has no place of its own");
    let after = lanes(&server).await;
    assert!(drives_in_cells(&server).await > three);
    assert_eq!(after.iter().map(|lane| lane.drives).max(), Some(4));
    // It says what the road looks like, and nothing of where the map lies on the earth.
    let moved = mean_move(&before, &after);
    assert!(moved.xy().norm() < 0.1, "{moved}");
    server.shutdown().await;

    let server = servers::start(folder.path()).await;
    settled(&server).await;
    assert_eq!(lanes(&server).await, after);
    assert_eq!(told(&server, &id).await["aligned_to_map"], session["aligned_to_map"]);
    forget(&server, &last).await;
    assert_eq!(lanes(&server).await, before, "nothing of it is left");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_without_gnss_that_came_before_the_map_is_found_once_there_is_one_and_lost_when_those_it_lies_on_are_deleted()
 {
    let drives = along_a_bending_road(3, 4, 700.0);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let id = drives[3].clone().without_gnss().upload_whole(&server.url()).await;
    settled(&server).await;
    assert_eq!(told(&server, &id).await["aligned_to_map"]["state"], "no_fit");
    upload(&server, &drives[..3]).await;
    let session = told(&server, &id).await;
    assert_eq!(session["aligned_to_map"]["state"], "aligned", "{session}");

    forget(&server, &drives[0]).await;
    assert_eq!(told(&server, &id).await["aligned_to_map"]["state"], "aligned", "others are still there");
    forget(&server, &drives[1]).await;
    forget(&server, &drives[2]).await;
    let session = told(&server, &id).await;
    assert_eq!((&session["placement"], &session["aligned_to_map"]["state"]), (&"own frame".into(), &"no_fit".into()));
    assert_eq!(lanes(&server).await, []);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_without_gnss_along_a_straight_road_is_kept_apart_and_told_why() {
    let drives = along_a_road(9, 2, 600.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    upload(&server, &drives[..1]).await;
    let before = lanes(&server).await;
    let id = drives[1].clone().without_gnss().upload_whole(&server.url()).await;
    settled(&server).await;
    let session = told(&server, &id).await;
    assert_eq!(
        (&session["placement"], &session["aligned_to_map"]["state"]),
        (&"own frame".into(), &"not_unique".into())
    );
    assert!(session["aligned_to_map"]["why"].as_str().unwrap().contains("does not bend"), "{session}");
    assert_eq!(lanes(&server).await, before);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_map_larger_than_what_may_be_searched_is_not_searched_in_part() {
    let drives = along_a_bending_road(3, 2, 600.0);
    let folder = tempfile::tempdir().unwrap();
    let server =
        Server::start(ServerConfig { max_localization_km: 0.5, ..servers::config(folder.path()) }).await.unwrap();
    upload(&server, &drives[..1]).await;
    let id = drives[1].clone().without_gnss().upload_whole(&server.url()).await;
    settled(&server).await;
    let session = told(&server, &id).await;
    assert_eq!(session["aligned_to_map"]["state"], "own_frame");
    assert!(session["aligned_to_map"]["why"].as_str().unwrap().contains("max_localization_km"), "{session}");
    server.shutdown().await;
}
