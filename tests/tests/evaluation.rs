//! `lanemap evaluate`: the figures are those of the scorers on the files that `lanemap replay` writes, and of nothing else.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test fails where it fails

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use lanemap_core::evaluation::{Counts, score_authors, score_strict};
use lanemap_openlane::Drives;
use lanemap_simulator::{Scenario, openlane::write_simulation};
use serde_json::{Value, json};
use tempfile::TempDir;

fn recorded(seed: u64, length_m: f64) -> TempDir {
    let scenario = Scenario::long_road(seed, length_m);
    let folder = tempfile::tempdir().unwrap();
    write_simulation(folder.path(), &scenario).unwrap();
    folder
}

fn lanemap(words: &[&str], drives: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lanemap-under-test")).args(words).arg("--drives").arg(drives).output().unwrap()
}

fn evaluate(words: &[&str], drives: &Path) -> Value {
    let output = lanemap(&[&["evaluate"], words, &["--json"]].concat(), drives);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn counts(row: &Value) -> Counts {
    let number = |key: &str| row[key].as_u64().unwrap();
    Counts { true_positives: number("tp"), truths: number("truth"), predictions: number("pred") }
}

/// The frames, and the numbers of `score_map.py`, are those of the scorers' own test in `clients/openlane`.
#[test]
fn raw_detections_are_scored_as_score_map_py_scores_them() {
    let fixture: PathBuf = [env!("CARGO_MANIFEST_DIR"), "../clients/openlane/tests/fixtures/scored"].iter().collect();
    let figures = evaluate(&["map"], &fixture);
    let row = &figures["overall"]["detections"];
    assert_eq!(counts(&row["authors"]), Counts { true_positives: 19, truths: 31, predictions: 34 });
    assert_eq!(counts(&row["strict"]), Counts { true_positives: 16, truths: 31, predictions: 28 });
    assert!((row["lateral_m"]["p95"].as_f64().unwrap() - 0.390_145_523_785_622).abs() < 1e-6);
}

#[test]
fn a_map_is_scored_by_what_replay_writes_of_it_with_noise_and_drops_of_the_same_seed() {
    let drives = recorded(3, 200.0);
    let results = tempfile::tempdir().unwrap();
    let disturbed = ["--pose-noise", "0.2,0.2", "--drop", "0.6", "--seed", "5"];
    let out = results.path().to_str().unwrap();
    for preset in ["paper", "default"] {
        let replayed = [&["replay", "--local", "--preset", preset, "--results-dir", out][..], &disturbed].concat();
        let output = lanemap(&replayed, drives.path());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let figures = evaluate(&[&["map", "--preset", preset][..], &disturbed].concat(), drives.path());

        let (mut authors, mut strict) = (Counts::default(), Counts::default());
        for frame in Drives::list(drives.path(), &[]).unwrap().remove(0).with_results(results.path()).frames() {
            let frame = frame.unwrap();
            let (truth, mapped) = (frame.truth_ground(), frame.detections_ground());
            authors += score_authors(&truth, &mapped);
            strict += score_strict(&truth, &mapped, &frame.annotation.sensor()).counts;
        }
        assert!(authors.true_positives > 40, "a map without lanes proves nothing: {authors:?}");
        assert_eq!(counts(&figures["overall"][preset]["authors"]), authors, "{preset}");
        assert_eq!(counts(&figures["overall"][preset]["strict"]), strict, "{preset}");
    }
}

#[test]
fn the_limit_of_the_pose_has_no_rotation_error_and_lies_below_odometry() {
    let drives = recorded(4, 200.0);
    let words = ["pose", "--noise", "0.3", "--draws", "2", "--preset", "default", "--seed", "8"];
    let figures = evaluate(&words, drives.path());
    let level = &figures["levels"][0];
    for length in ["10m", "30m", "50m"] {
        let metres = |method: &str| level[method][length]["translation_m"].as_f64().unwrap();
        assert!(level["limit"][length]["rotation_deg"].as_f64().unwrap() < 1e-5);
        assert!(level["odometry"][length]["rotation_deg"].as_f64().unwrap() > 0.3);
        assert!(metres("limit") > 0.1 && metres("limit") < metres("odometry"), "{length}: {level}");
    }
    assert_eq!(evaluate(&words, drives.path()), figures, "one seed gives one set of figures");
}

/// Pairs of frames ten apart, with the true pose between them turned and shifted by `error` metres to the left.
fn write_pairs(drives: &Path, error_m: f64) {
    let drive = Drives::list(drives, &[]).unwrap().remove(0);
    let frames: Vec<_> = drive.frames().map(Result::unwrap).collect();
    let stem = |index: usize| lanemap_openlane::timestamp_stem(frames[index].time);
    let pair = |a: usize| {
        let (from, to) = (&frames[a].annotation, &frames[a + 10].annotation);
        let camera = |of: &lanemap_openlane::Annotation| of.pose().unwrap() * of.vehicle_from_camera;
        let mut noisy = camera(from).inverse() * camera(to);
        noisy.translation.vector.y += error_m;
        let matrix = noisy.to_homogeneous();
        let rows: Vec<Vec<f64>> = (0..4).map(|row| (0..4).map(|column| matrix[(row, column)]).collect()).collect();
        let ids = |of: &lanemap_openlane::Annotation| of.lanes.iter().map(|lane| lane.track_id).collect::<Vec<_>>();
        let in_both: Vec<i64> = ids(from).into_iter().filter(|id| ids(to).contains(id)).collect();
        json!({
            "drive": drive.name(), "frame_a": stem(a), "frame_b": stem(a + 10), "T_ab_noisy": rows,
            "true_track_ids": in_both,
        })
    };
    let pairs: Vec<Value> = (0..frames.len() - 10).step_by(10).map(pair).collect();
    fs::write(drives.join("association_pairs.json"), json!({ "pairs": pairs }).to_string()).unwrap();
}

#[test]
fn association_finds_every_lane_with_a_small_pose_error_at_every_heading() {
    let drives = recorded(5, 250.0);
    write_pairs(drives.path(), 0.3);
    let figures = evaluate(&["association", "--heading", "0,123"], drives.path());
    let [north, turned] = [0, 1].map(|index| figures["headings"][index]["methods"].clone());
    for method in ["shell", "clipper", "cd_xyz", "cd_lmr", "ours_lmr", "ours", "default"] {
        assert!(north[method]["f1"].as_f64().is_some(), "{method} has no figure");
    }
    for method in ["ours", "default"] {
        assert!(north[method]["f1"].as_f64().unwrap() > 0.97, "{method}: {north}");
        assert_eq!(north[method]["f1"], turned[method]["f1"], "{method}");
    }
}

#[test]
fn an_annotation_that_is_cut_short_ends_the_evaluation_by_its_name() {
    let drives = recorded(6, 60.0);
    let drive = Drives::list(drives.path(), &[]).unwrap().remove(0);
    let name = format!("{}.json", lanemap_openlane::timestamp_stem(drive.times()[2]));
    let path = drives.path().join(drive.name()).join(&name);
    let text = fs::read(&path).unwrap();
    fs::write(&path, &text[..text.len() / 2]).unwrap();
    let output = lanemap(&["evaluate", "map"], drives.path());
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1));
    assert!(message.contains(&format!("{name}: is not whole JSON")), "{message}");
}

#[test]
fn a_drive_that_is_not_there_is_refused_by_its_name() {
    let drives = recorded(7, 60.0);
    let output = lanemap(&["evaluate", "map", "--only", "ps-001"], drives.path());
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("has no drive ps-001"));
}
