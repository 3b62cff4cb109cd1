//! `lanemap replay`: a recorded drive becomes the same map in this process and through a server, and nothing of it is
//! lost silently.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test fails where it fails

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use lanemap_client::MapClient;
use lanemap_core::{Frame, FrameLimits, LaneMap, Mapper, Params, Preset, Sequence};
use lanemap_openlane::Drives;
use lanemap_server::{Server, ServerConfig, config::ZenohMode};
use lanemap_simulator::{OdometryNoise, Scenario, openlane::write_simulation};
use lanemap_tests::{
    endpoints::HeldEndpoint,
    folders::files,
    http,
    proxy::{Fault, Proxy},
    servers,
};
use serde_json::Value;
use tempfile::TempDir;

/// A folder with `drives` simulated drives of `length_m` along one road.
fn recorded(seed: u64, drives: u32, length_m: f64) -> TempDir {
    let scenario = Scenario { drives, ..Scenario::long_road(seed, length_m) };
    let folder = tempfile::tempdir().unwrap();
    write_simulation(folder.path(), &scenario).unwrap();
    folder
}

fn replay(drives: &Path, options: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
        .args(["replay", "--json", "--drives"])
        .arg(drives)
        .args(options)
        .output()
        .unwrap()
}

fn report(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| {
        panic!("{error}: stdout {:?}, stderr {}", output.stdout, String::from_utf8_lossy(&output.stderr))
    })
}

fn assert_success(output: &Output) {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// What a mapper makes of the only drive of a folder, read without the command.
fn mapped(folder: &Path) -> LaneMap {
    let drives = Drives::list(folder, &[]).unwrap();
    let covariance = OdometryNoise::default().motion_covariance();
    let mut mapper: Option<Mapper> = None;
    for (index, recorded) in drives[0].frames().enumerate() {
        let recorded = recorded.unwrap();
        let pose = recorded.annotation.pose().unwrap();
        let parts = recorded.frame_parts(Sequence(index as u64 + 1), pose, Some(covariance));
        let frame = Frame::new(parts, &FrameLimits::default()).unwrap();
        let sensor = recorded.annotation.sensor();
        mapper.get_or_insert_with(|| Mapper::new(Params::preset(Preset::Default), sensor)).step(&frame);
    }
    mapper.unwrap().lane_map()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_replayed_over_grpc_gives_the_lanes_and_the_local_maps_of_a_local_replay() {
    let drives = recorded(1, 1, 400.0);
    let store = tempfile::tempdir().unwrap();
    let server = servers::start(store.path()).await;
    let (here, there) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());

    let local = replay(drives.path(), &["--local", "--results-dir", here.path().to_str().unwrap()]);
    assert_success(&local);
    let url = server.url();
    let streamed = replay(drives.path(), &["--server", &url, "--results-dir", there.path().to_str().unwrap()]);
    assert_success(&streamed);

    let session = &report(&streamed)["drives"][0]["session"];
    assert_eq!(session["same_as_local"], true, "{session}");
    let served = MapClient::new(url).lane_map(session["id"].as_str().unwrap()).await.unwrap();
    assert!(served.lanes.len() >= 3, "a map without lanes proves nothing");
    assert_eq!(served, mapped(drives.path()));
    assert_eq!(report(&local)["drives"][0]["lanes"], served.lanes.len());
    assert_eq!(files(here.path()), files(there.path()));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_replayed_over_zenoh_gives_the_map_of_a_local_replay() {
    let drives = recorded(11, 1, 300.0);
    let store = tempfile::tempdir().unwrap();
    let zenoh = HeldEndpoint::tcp();
    let config = ServerConfig {
        zenoh_mode: ZenohMode::Router,
        zenoh_listen: zenoh.parse().unwrap(),
        ..servers::config(store.path())
    };
    let server = Server::start(config).await.unwrap();
    let output = replay(drives.path(), &["--server", &server.url(), "--transport", "zenoh", "--zenoh", &zenoh]);
    assert_success(&output);
    assert_eq!(report(&output)["drives"][0]["session"]["same_as_local"], true);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_connection_that_breaks_in_the_middle_of_a_drive_is_made_anew_and_the_replay_goes_on() {
    let drives = recorded(12, 2, 300.0);
    let store = tempfile::tempdir().unwrap();
    let server = servers::start(store.path()).await;
    let proxy = Proxy::start(server.address(), 20_000, &[Fault::Cut; 4]).await;
    let url = format!("http://{}", proxy.address());
    let folder = drives.path().to_owned();
    let output = tokio::task::spawn_blocking(move || replay(&folder, &["--server", &url])).await.unwrap();
    assert_success(&output);
    let drives = report(&output)["drives"].clone();
    let sessions: Vec<_> = drives.as_array().unwrap().iter().map(|drive| &drive["session"]).collect();
    assert!(sessions.iter().all(|session| session["same_as_local"] == true), "{drives}");
    let reconnections: u64 = sessions.iter().filter_map(|session| session["reconnections"].as_u64()).sum();
    assert!(reconnections >= 2, "{drives}");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn noisy_odometry_and_dropped_lanes_reach_the_server_bit_by_bit() {
    let drives = recorded(2, 1, 400.0);
    let store = tempfile::tempdir().unwrap();
    let server = servers::start(store.path()).await;
    for preset in ["default", "paper"] {
        let options =
            ["--server", &server.url(), "--pose-noise", "0.3,0.3", "--drop", "0.4", "--seed", "5", "--preset", preset];
        let output = replay(drives.path(), &options);
        assert_success(&output);
        assert_eq!(report(&output)["drives"][0]["session"]["same_as_local"], true, "{preset}");
    }
    server.shutdown().await;
}

#[test]
fn the_json_report_has_frames_step_times_and_every_drive() {
    let drives = recorded(3, 2, 1_300.0);
    let output = replay(drives.path(), &["--local"]);
    assert_success(&output);
    let report = report(&output);
    for figure in ["mean", "p50", "p99", "max"] {
        assert!(report["step_us"][figure].as_f64().unwrap() > 0.0, "{figure}");
    }
    let listed = report["drives"].as_array().unwrap();
    assert_eq!(listed.len(), 2);
    assert_eq!(report["frames"], listed.iter().map(|drive| drive["frames"].as_u64().unwrap()).sum::<u64>());
    for drive in listed {
        assert!(drive["name"].as_str().unwrap().starts_with("segment-sim-3-"));
        assert!(drive["lanes"].as_u64().unwrap() >= 3);
        assert!((drive["length_m"].as_f64().unwrap() - 1_300.0).abs() < 5.0);
        assert_eq!(drive["step_us_per_km"].as_array().unwrap().len(), 2);
        assert_eq!(drive["left_out"].as_array().unwrap().len(), 0);
    }
}

#[test]
fn results_have_the_folder_and_file_names_of_the_frames_that_they_belong_to() {
    let drives = recorded(4, 1, 300.0);
    let results = tempfile::tempdir().unwrap();
    assert_success(&replay(drives.path(), &["--local", "--results-dir", results.path().to_str().unwrap()]));
    let detections = files(&drives.path().join("results"));
    let written = files(results.path());
    assert_eq!(written.keys().collect::<Vec<_>>(), detections.keys().collect::<Vec<_>>());

    let drive = Drives::list(drives.path(), &[]).unwrap().remove(0).with_results(results.path());
    let mut lines = 0;
    for frame in drive.frames() {
        for lane in &frame.unwrap().detections.unwrap().lanes {
            lines += 1;
            for point in &lane.points_ground {
                assert!((3.0 - 1e-6..=50.0 + 1e-6).contains(&point.y) && point.x.abs() <= 10.0 + 1e-6, "{point}");
            }
        }
    }
    assert!(lines > 200, "{lines}");
}

#[test]
fn a_truncated_frame_is_named_and_left_out_and_the_rest_is_replayed() {
    let drives = recorded(5, 2, 300.0);
    let drive = Drives::list(drives.path(), &[]).unwrap().remove(0);
    let broken = drives.path().join(drive.name()).join(lanemap_openlane::timestamp_stem(drive.times()[20]));
    let broken = broken.with_extension("json");
    let whole = fs::read(&broken).unwrap();
    fs::write(&broken, &whole[..whole.len() / 2]).unwrap();

    let output = replay(drives.path(), &["--local"]);
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains(broken.to_str().unwrap()), "{said}");
    let report = report(&output);
    assert_eq!(report["drives"][0]["frames"], drive.len() - 1);
    assert!(report["drives"][0]["lanes"].as_u64().unwrap() >= 2);
    let left_out = report["drives"][0]["left_out"].as_array().unwrap();
    assert_eq!(left_out.len(), 1);
    assert!(left_out[0]["error"].as_str().unwrap().contains("is not whole JSON"), "{}", left_out[0]);
    assert_eq!(report["drives"][1]["left_out"].as_array().unwrap().len(), 0);
}

#[test]
fn a_number_out_of_range_leaves_out_that_frame_and_names_the_field() {
    let drives = recorded(6, 1, 300.0);
    let drive = Drives::list(drives.path(), &[]).unwrap().remove(0);
    let stem = lanemap_openlane::timestamp_stem(drive.times()[20]);
    let path = drives.path().join("results").join(drive.name()).join(&stem).with_extension("json");
    let mut file: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    file["lane_lines"][0]["xyz"][0][0] = serde_json::json!(1e300);
    fs::write(&path, file.to_string()).unwrap();

    let output = replay(drives.path(), &["--local"]);
    assert_eq!(output.status.code(), Some(1));
    let left_out = report(&output)["drives"][0]["left_out"].clone();
    assert_eq!(left_out[0]["frame"], *stem);
    let error = left_out[0]["error"].as_str().unwrap();
    assert!(error.contains("detections[0].points[0].y") && error.contains("500"), "{error}");
}

#[test]
fn one_seed_repeats_and_another_differs() {
    let drives = recorded(7, 1, 300.0);
    let run = |seed: &str| {
        let results = tempfile::tempdir().unwrap();
        let folder = results.path().to_str().unwrap();
        let options = ["--local", "--pose-noise", "0.3,0.3", "--drop", "0.6", "--seed", seed, "--results-dir", folder];
        assert_success(&replay(drives.path(), &options));
        files(results.path())
    };
    assert_eq!(run("1"), run("1"));
    assert_ne!(run("1"), run("2"));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_origin_puts_the_map_on_the_earth() {
    let drives = recorded(8, 1, 300.0);
    let store = tempfile::tempdir().unwrap();
    let server = servers::start(store.path()).await;
    let output = replay(drives.path(), &["--server", &server.url(), "--origin", "-33.8688,151.2093"]);
    assert_success(&output);
    let url = report(&output)["drives"][0]["session"]["lanes_url"].as_str().unwrap().to_owned();
    let lanes: Value = http::get(url).await.unwrap().error_for_status().unwrap().json().await.unwrap();
    let place = &lanes["features"][0]["geometry"]["coordinates"][0];
    assert!((place[0].as_f64().unwrap() - 151.2093).abs() < 0.02, "{place}");
    assert!((place[1].as_f64().unwrap() + 33.8688).abs() < 0.02, "{place}");
    server.shutdown().await;
}

#[test]
fn a_server_that_is_not_there_is_an_error_that_says_what_to_do() {
    let drives = recorded(9, 1, 100.0);
    let output = replay(drives.path(), &["--server", "http://127.0.0.1:1"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(output.stdout.is_empty());
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("http://127.0.0.1:1") && said.contains("lanemap serve"), "{said}");
}

#[test]
fn a_drive_that_is_not_there_is_an_error_that_names_it() {
    let drives = recorded(10, 1, 100.0);
    let output = replay(drives.path(), &["--local", "--only", "segment-nowhere"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("segment-nowhere"));
}
