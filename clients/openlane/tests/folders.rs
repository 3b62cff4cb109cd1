//! Promises of the reader and the writer, on a hand-made drive and on the real OpenLane frames where they are present.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::{
    fs,
    path::{Path, PathBuf},
};

use lanemap_core::{Category, Frame, FrameLimits, Sequence, TimestampNs, geometry::Pose};
use lanemap_openlane::{
    AnnotatedLane, Annotation, DetectedLane, DetectionFile, DriveFolder, Drives, Intrinsic, OpenLaneError,
    write_annotation, write_result,
};
use nalgebra::{Point3, Vector3};

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/drives")
}

/// Drives and frames that a clone of the repository does not have; the test says so and passes.
fn shared(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared").join(folder);
    // A worktree lies one folder deeper than the repository.
    let nested = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../../shared").join(folder);
    let found = [path, nested].into_iter().find(|path| path.is_dir());
    if found.is_none() {
        eprintln!("skipped: ../shared/{folder} is not here");
    }
    found
}

/// A copy of the hand-made annotation with one text replaced.
fn refusal_after(find: &str, replace: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(fixtures().join("segment-tiny/160000000000000000.json")).unwrap();
    assert!(text.contains(find), "the fixture has no {find}");
    let path = folder.path().join("160000000000000000.json");
    fs::write(&path, text.replacen(find, replace, 1)).unwrap();
    let message = Annotation::read(&path).unwrap_err().to_string();
    assert!(message.starts_with(&path.display().to_string()), "{message}");
    message[path.display().to_string().len()..].to_owned()
}

#[test]
fn a_drive_is_read_in_the_order_of_time_with_its_detections_beside_it() {
    let drive = DriveFolder::open(fixtures(), "segment-tiny").unwrap();
    let frames: Vec<_> = drive.frames().map(Result::unwrap).collect();
    assert_eq!(frames.len(), 2);
    assert_eq!(frames[0].time, TimestampNs(1_600_000_000_000_000_000));
    assert!((frames[1].time.seconds_since(frames[0].time) - 0.1).abs() < 1e-12);
    assert!(frames[0].detections.is_some(), "the first frame has a result file");
    assert!(frames[1].detections.is_none(), "the second frame has none");
    assert_eq!(frames[0].annotation.lanes[0].track_id, 4);
    assert!(frames[0].annotation.lanes[1].points_camera.is_empty());
}

#[test]
fn annotation_and_result_of_a_hand_made_frame_meet_in_the_vehicle_frame() {
    let drive = DriveFolder::open(fixtures(), "segment-tiny").unwrap();
    let frame = drive.frame(drive.times()[0]).unwrap();
    let truth = &frame.truth_vehicle()[0];
    let detected = &frame.detections_vehicle()[0].points_vehicle;
    assert_eq!(truth, &[6.5, 21.5, 36.5].map(|x| Point3::new(x, 1.75, -0.25)));
    assert_eq!(detected, truth);
    assert_eq!(frame.truth_ground()[0], frame.detections_ground()[0]);
}

#[test]
fn a_frame_of_a_drive_is_a_frame_of_the_mapper() {
    let drive = DriveFolder::open(fixtures(), "segment-tiny").unwrap();
    let frame = drive.frame(drive.times()[1]).unwrap();
    let parts = frame.frame_parts(Sequence(2), frame.annotation.pose().unwrap(), None);
    let frame = Frame::new(parts, &FrameLimits::default()).unwrap();
    assert_eq!(frame.odometry().odometry_from_vehicle, Pose::translation(1.0, 0.0, 0.0));
}

#[test]
fn the_image_border_is_twice_the_principal_point() {
    let drive = DriveFolder::open(fixtures(), "segment-tiny").unwrap();
    let sensor = drive.annotation(drive.times()[0]).unwrap().sensor();
    // The camera sits 0.25 m to the left; at 10 m its left border is at 9.6 m.
    assert!(sensor.sees(&Point3::new(11.5, 9.8, 2.0)));
    assert!(!sensor.sees(&Point3::new(11.5, 9.9, 2.0)));
}

#[test]
fn a_truncated_file_is_refused_by_name_with_the_place_where_it_stops() {
    let folder = tempfile::tempdir().unwrap();
    let text = fs::read(fixtures().join("segment-tiny/160000000000000000.json")).unwrap();
    let path = folder.path().join("160000000000000000.json");
    fs::write(&path, &text[..text.len() / 2]).unwrap();
    let error = Annotation::read(&path).unwrap_err();
    assert!(matches!(error, OpenLaneError::Json { .. }));
    let message = error.to_string();
    assert!(message.contains("160000000000000000.json: is not whole JSON: EOF while parsing"), "{message}");
}

#[test]
fn a_wrong_shape_is_refused_by_file_lane_and_field() {
    let two_rows = refusal_after("[\n     -2.25,\n     -2.25,\n     -2.25\n    ]", "[\n     -2.25\n    ]");
    assert_eq!(two_rows, ": lane_lines[0].xyz has rows of 3, 3 and 1 numbers, want equal lengths");
    assert_eq!(refusal_after("20.0", "\"x\""), ": lane_lines[0].xyz[0][1] is a text, not a number");
    assert_eq!(
        refusal_after("\"category\": 1", "\"category\": 99"),
        ": lane_lines[1].category is 99, want an OpenLane code: 0 to 12, 20 or 21"
    );
    assert_eq!(refusal_after("\"extrinsic\"", "\"mount\""), ": extrinsic is missing");
}

#[test]
fn a_pose_that_is_no_rotation_is_refused_by_field() {
    let text = refusal_after("\"pose\": [\n  [\n   1,", "\"pose\": [\n  [\n   2,");
    assert!(text.starts_with(": pose is not a rotation: "), "{text}");
}

#[test]
fn a_result_point_of_two_numbers_is_refused_by_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("1.json");
    fs::write(&path, r#"{"lane_lines": [{"category": 1, "xyz": [[1.0, 2.0, 3.0], [1.0, 2.0]]}]}"#).unwrap();
    let message = DetectionFile::read(&path).unwrap_err().to_string();
    assert!(message.ends_with("lane_lines[0].xyz[1] has 2 numbers, want 3 (x, y, z)"), "{message}");
}

#[test]
fn a_missing_pose_is_a_state_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("160000000000000000.json");
    let text = fs::read_to_string(fixtures().join("segment-tiny/160000000000000000.json")).unwrap();
    fs::write(&path, text.replacen("\"pose\"", "\"position\"", 1)).unwrap();
    let annotation = Annotation::read(&path).unwrap();
    assert_eq!(annotation.world_from_vehicle, None);
    assert!(matches!(annotation.pose(), Err(OpenLaneError::NoPose { .. })));
}

#[test]
fn a_file_that_is_not_named_by_a_timestamp_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("segment-x")).unwrap();
    fs::write(folder.path().join("segment-x/frame-1.json"), "{}").unwrap();
    let message = DriveFolder::open(folder.path(), "segment-x").unwrap_err().to_string();
    assert!(message.ends_with("frame-1.json: is not named by a timestamp of 18 digits"), "{message}");
}

#[test]
fn drives_are_chosen_by_a_part_of_their_name_and_an_unknown_one_is_refused() {
    let names = |only: &[&str]| {
        let only: Vec<String> = only.iter().map(|text| (*text).to_owned()).collect();
        Drives::list(fixtures(), &only).map(|drives| drives.len())
    };
    assert_eq!(names(&[]).unwrap(), 1);
    assert_eq!(names(&["tiny"]).unwrap(), 1);
    assert!(matches!(names(&["tiny", "absent"]), Err(OpenLaneError::NoSuchDrive { .. })));
}

#[test]
fn what_is_written_reads_back_to_the_last_digit() {
    let folder = tempfile::tempdir().unwrap();
    let (root, name, time) = (folder.path(), "segment-written", TimestampNs(1_600_000_000_123_456_780));
    let mount = Pose::new(Vector3::new(1.5, -0.02, 2.1), Vector3::new(0.01, -0.02, 0.03));
    let annotation = Annotation {
        path: root.join(name).join("160000000012345678.json"),
        intrinsic: Intrinsic { fx: 2059.047, fy: 2059.047, cx: 935.125, cy: 635.05 },
        vehicle_from_camera: mount,
        world_from_vehicle: Some(Pose::translation(1.0, 2.0, 3.0)),
        world_from_vehicle_gnss: None,
        image: "validation/a.jpg".to_owned(),
        lanes: vec![AnnotatedLane {
            category: Category::RightCurb,
            track_id: 3,
            attribute: 4,
            points_camera: vec![Point3::new(0.1 + 0.2, 1.0 / 3.0, -2.0e-7), Point3::new(7.0, 8.0, 9.0)],
        }],
    };
    let result = DetectionFile {
        lanes: vec![DetectedLane {
            category: Category::YellowSolid,
            track_id: 12,
            points_ground: vec![Point3::new(1.0 / 7.0, 2.0, 3.0)],
        }],
    };
    write_annotation(root, name, time, &annotation).unwrap();
    write_result(&root.join("results"), name, time, &annotation, &result).unwrap();

    let drive = DriveFolder::open(root, name).unwrap();
    let read = drive.frame(drive.times()[0]).unwrap();
    assert_eq!(read.time, time);
    assert_eq!(read.detections, Some(result));
    assert_eq!(read.annotation.lanes, annotation.lanes);
    assert_eq!(read.annotation.world_from_vehicle, annotation.world_from_vehicle);
    let moved = read.annotation.vehicle_from_camera.to_homogeneous() - mount.to_homogeneous();
    assert!(moved.amax() < 1e-12);
}

fn nearest(line: &[Point3<f64>], point: &Point3<f64>) -> Point3<f64> {
    let nearer = |a: &&Point3<f64>, b: &&Point3<f64>| (*a - point).norm().total_cmp(&(*b - point).norm());
    *line.iter().min_by(nearer).unwrap()
}

#[test]
fn the_real_openlane_frames_overlay_in_the_vehicle_frame() {
    let Some(root) = shared("openlane_example") else { return };
    let drives = Drives::list(root, &[]).unwrap();
    assert_eq!(drives.len(), 1);
    for frame in drives[0].frames() {
        let frame = frame.unwrap();
        assert!(matches!(frame.annotation.pose(), Err(OpenLaneError::NoPose { .. })));
        let truth: Vec<Point3<f64>> = frame.truth_vehicle().concat();
        // Truth begins where the paint comes into view, detections end with their model's rows: compare in between,
        // and across the lines only, as the truth has gaps along them.
        let errors: Vec<Vector3<f64>> = frame
            .detections_vehicle()
            .iter()
            .flat_map(|lane| &lane.points_vehicle)
            .filter(|point| (20.0..55.0).contains(&point.x))
            .map(|point| nearest(&truth, point) - point)
            .collect();
        let within = errors.iter().filter(|error| error.y.abs() < 0.5 && error.z.abs() < 0.3).count();
        assert!(errors.len() >= 15, "the detector saw {} points", errors.len());
        assert!(within * 10 >= errors.len() * 9, "{within} of {} points lie on the truth", errors.len());
    }
}

#[test]
fn the_written_camera_is_that_of_the_real_result_files() {
    let Some(root) = shared("openlane_example") else { return };
    let drive = Drives::list(&root, &[]).unwrap().remove(0);
    let frame = drive.frame(drive.times()[0]).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let detections = frame.detections.clone().unwrap();
    write_result(folder.path(), drive.name(), frame.time, &frame.annotation, &detections).unwrap();
    let file = format!("{}/152268801497018700.json", drive.name());
    let json = |path: PathBuf| -> serde_json::Value { serde_json::from_slice(&fs::read(path).unwrap()).unwrap() };
    let (written, real) = (json(folder.path().join(&file)), json(root.join("results").join(&file)));
    for row in 0..4 {
        for column in 0..4 {
            let entry = |value: &serde_json::Value| value["extrinsic"][row][column].as_f64().unwrap();
            assert!((entry(&written) - entry(&real)).abs() < 1e-9, "row {row}, column {column}");
        }
    }
    assert_eq!(written["lane_lines"][0]["xyz"], real["lane_lines"][0]["xyz"]);
}

#[test]
fn every_shared_drive_opens_and_its_first_frame_parses() {
    let Some(root) = shared("drives") else { return };
    let drives = Drives::list(root, &[]).unwrap();
    assert_eq!(drives.len(), 43);
    assert_eq!(drives.iter().map(DriveFolder::len).sum::<usize>(), 4663);
    for drive in &drives {
        let frame = drive.frames().next().unwrap().unwrap();
        assert!(frame.annotation.pose().is_ok() && frame.detections.is_some(), "{}", drive.name());
    }
}
