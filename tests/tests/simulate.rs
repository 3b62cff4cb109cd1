//! `lanemap simulate`: one seed, the same files to the byte, in a layout that the reader of real drives reads.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test fails where it fails

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use lanemap_openlane::Drives;
use lanemap_tests::folders::files;
use serde_json::Value;

fn simulate(out: &Path, options: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
        .args(["simulate", "--out"])
        .arg(out)
        .args(options)
        .output()
        .unwrap()
}

fn simulated(options: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let output = simulate(folder.path(), &[options, &["--length-km", "0.3"]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    folder
}

#[test]
fn one_seed_gives_the_same_bytes_and_another_does_not() {
    let options = ["--drives", "2", "--seed", "7"];
    let first = files(simulated(&options).path());
    assert!(first.len() > 400, "{} files", first.len());
    assert_eq!(first, files(simulated(&options).path()));
    assert_ne!(first, files(simulated(&["--drives", "2", "--seed", "8"]).path()));
}

#[test]
fn the_index_names_every_drive_and_each_has_its_true_map() {
    let folder = simulated(&["--drives", "3", "--seed", "1", "--shared-route"]);
    let index: Value = serde_json::from_slice(&fs::read(folder.path().join("index.json")).unwrap()).unwrap();
    let drives = Drives::list(folder.path(), &[]).unwrap();
    assert_eq!(drives.len(), 3);
    for (entry, drive) in index["drives"].as_array().unwrap().iter().zip(&drives) {
        assert_eq!(entry["name"], drive.name());
        assert_eq!(entry["frames"], drive.len());
        assert_eq!(entry["road"], "sim-1");
        let map = fs::read_to_string(folder.path().join("maps").join(format!("{}.geojson", drive.name()))).unwrap();
        let map: geojson::FeatureCollection = map.parse().unwrap();
        assert_eq!(entry["lines"], map.features.len());
        assert!(map.features.len() >= 3);
    }
}

#[test]
fn gnss_poses_are_off_by_the_bias_of_their_drive() {
    let folder = simulated(&["--drives", "3", "--seed", "2"]);
    for drive in Drives::list(folder.path(), &[]).unwrap() {
        let errors: Vec<f64> = drive
            .frames()
            .map(|frame| {
                let annotation = frame.unwrap().annotation;
                let (truth, gnss) = (annotation.pose().unwrap(), annotation.world_from_vehicle_gnss.unwrap());
                (gnss.translation.vector - truth.translation.vector).xy().norm()
            })
            .collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        assert!((0.2..1.9).contains(&mean), "{mean}");
    }
}

#[test]
fn a_fleets_city_is_written_with_its_truth_before_and_after_and_what_changed() {
    let options = ["--roads", "city", "--drives", "3", "--seed", "2", "--changes", "2", "--zones", "1"];
    let folder = simulated(&options);
    assert_eq!(files(folder.path()), files(simulated(&options).path()));
    let json = |file: &str| -> Value { serde_json::from_slice(&fs::read(folder.path().join(file)).unwrap()).unwrap() };
    let (index, changes) = (json("index.json"), json("changes.geojson"));
    let drives = Drives::list(folder.path(), &[]).unwrap();
    for (entry, drive) in index["drives"].as_array().unwrap().iter().zip(&drives) {
        assert_eq!((&entry["name"], &entry["frames"]), (&Value::from(drive.name()), &Value::from(drive.len())));
        assert!(drive.frames().all(|frame| frame.unwrap().annotation.world_from_vehicle_gnss.is_some()));
    }
    assert!(index["anchor"]["latitude_deg"].is_f64());
    let kinds: std::collections::BTreeSet<_> = changes["features"]
        .as_array()
        .unwrap()
        .iter()
        .map(|change| change["properties"]["change"].to_string())
        .collect();
    assert_eq!(kinds.len(), 4, "{kinds:?}");
    assert_ne!(json("network.geojson"), json("network-before.geojson"));
}

#[test]
fn options_of_fleets_are_refused_where_there_is_no_fleet() {
    let folder = tempfile::tempdir().unwrap();
    let output = simulate(folder.path(), &["--roads", "town", "--traffic-per-km", "5"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("need --roads city"));
    let output = simulate(folder.path(), &["--roads", "city", "--both-directions"]);
    assert!(String::from_utf8_lossy(&output.stderr).contains("needs --shared-route"));
    assert!(files(folder.path()).is_empty());
}

#[test]
fn a_simulation_too_large_for_a_disk_is_refused_with_the_limit() {
    let folder = tempfile::tempdir().unwrap();
    let output = simulate(folder.path(), &["--drives", "1000", "--length-km", "50"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("more than 1000"));
    assert!(files(folder.path()).is_empty());
}
