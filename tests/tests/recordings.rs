//! Recordings: a drive is the same drive as an OpenLane folder, as MCAP and as a ROS 1 bag, and a file that is not whole
//! says what is missing of it.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test fails where it fails

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use lanemap_client::MapClient;
use lanemap_core::{Frame, FrameLimits, LaneMap, Mapper, Params, Preset};
use lanemap_openlane::{DriveFolder, Drives};
use lanemap_recording::{BagOptions, ReadOptions, RecordedDrive, RecordingError, open};
use lanemap_simulator::{Scenario, openlane::write_simulation};
use lanemap_tests::{
    bags::{BagWriter, LANE_LIST, POSE_STAMPED, bag_of, lanes_message, pose_message, write_bag},
    folders::files,
    http, servers,
};
use serde_json::Value;
use tempfile::TempDir;

/// A folder with `drives` simulated drives of `length_m` along one road.
fn simulated(seed: u64, drives: u32, length_m: f64) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_simulation(folder.path(), &Scenario { drives, ..Scenario::long_road(seed, length_m) }).unwrap();
    folder
}

fn only_drive(folder: &Path) -> DriveFolder {
    Drives::list(folder, &[]).unwrap().remove(0)
}

fn lanemap(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lanemap-under-test")).args(arguments).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn report(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&output.stderr)))
}

#[track_caller]
fn succeeded(output: Output) -> Output {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

fn record(drives: &Path, output: &Path) -> Output {
    succeeded(lanemap(&["record", "--json", "--drives", text(drives), "--output", text(output)]))
}

/// What the mapper of `replay --local` makes of drives: the local map of every frame, by file.
fn local_maps(drives: &Path, options: &[&str]) -> std::collections::BTreeMap<PathBuf, Vec<u8>> {
    let results = tempfile::tempdir().unwrap();
    let mut arguments = vec!["replay", "--local", "--json", "--drives", text(drives)];
    arguments.extend(["--results-dir", text(results.path())]);
    arguments.extend(options);
    succeeded(lanemap(&arguments));
    files(results.path())
}

fn mapped(drive: &mut RecordedDrive) -> LaneMap {
    let mut mapper: Option<Mapper> = None;
    for recorded in drive.frames() {
        let recorded = recorded.unwrap_or_else(|fault| panic!("{}: {}", fault.frame, fault.error));
        let sensor = recorded.camera.sensor;
        let frame = Frame::new(recorded.parts, &FrameLimits::default()).unwrap();
        mapper.get_or_insert_with(|| Mapper::new(Params::preset(Preset::Default), sensor)).step(&frame);
    }
    mapper.unwrap().lane_map()
}

fn open_one(path: &Path, options: &ReadOptions) -> RecordedDrive {
    open(path, options).unwrap().remove(0)
}

/// A small recording as bytes, and its drive.
fn small_mcap() -> (TempDir, Vec<u8>) {
    let folder = simulated(21, 1, 120.0);
    let path = folder.path().join("drive.mcap");
    record(folder.path(), &path);
    let bytes = fs::read(path).unwrap();
    (folder, bytes)
}

fn mcap_error(bytes: &[u8]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.mcap");
    fs::write(&path, bytes).unwrap();
    open(&path, &ReadOptions::default()).unwrap_err().to_string()
}

/// The first fault of a bag, in opening it or in reading its frames.
fn bag_error(bytes: &[u8]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.bag");
    fs::write(&path, bytes).unwrap();
    match open(&path, &ReadOptions::default()) {
        Err(error) => error.to_string(),
        Ok(mut drives) => drives[0].frames().find_map(Result::err).expect("a fault of this bag").error.to_string(),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_gives_the_same_map_byte_for_byte_from_its_folder_and_from_its_mcap_recording() {
    let (folder, recordings) = (simulated(1, 1, 400.0), tempfile::tempdir().unwrap());
    let path = recordings.path().join("drive.mcap");
    let recorded = report(&record(folder.path(), &path));
    let drive = only_drive(folder.path());
    assert_eq!(recorded["drives"][0]["name"], drive.name());
    assert_eq!(recorded["frames"], drive.len());

    let store = tempfile::tempdir().unwrap();
    let server = servers::start(store.path()).await;
    let mut maps = Vec::new();
    for drives in [folder.path(), &path] {
        let output = succeeded(lanemap(&["replay", "--json", "--server", &server.url(), "--drives", text(drives)]));
        let session = report(&output)["drives"][0]["session"].clone();
        assert_eq!(session["same_as_local"], true, "{session}");
        let id = session["id"].as_str().unwrap();
        assert!(MapClient::new(server.url()).lane_map(id).await.unwrap().lanes.len() >= 3, "no lanes prove nothing");
        let answer = http::get(format!("{}/sessions/{id}/lanes.pb", server.url())).await.unwrap();
        maps.push(answer.error_for_status().unwrap().bytes().await.unwrap());
    }
    assert_eq!(maps[0], maps[1]);
    server.shutdown().await;
}

#[test]
fn noise_and_drops_of_a_replay_are_the_same_for_a_folder_and_for_its_recording() {
    let folder = simulated(2, 1, 300.0);
    let recordings = tempfile::tempdir().unwrap();
    record(folder.path(), recordings.path());
    let options = ["--pose-noise", "0.3,0.3", "--drop", "0.4", "--seed", "5"];
    let (from_folder, from_mcap) = (local_maps(folder.path(), &options), local_maps(recordings.path(), &options));
    assert_eq!(from_folder.keys().collect::<Vec<_>>(), from_mcap.keys().collect::<Vec<_>>());
    let lanes = |bytes: &Vec<u8>| serde_json::from_slice::<Value>(bytes).unwrap()["lane_lines"].clone();
    for (path, bytes) in &from_folder {
        assert_eq!(lanes(bytes), lanes(&from_mcap[path]), "{}", path.display());
    }
}

#[test]
fn what_a_replay_streams_is_what_it_records() {
    let folder = simulated(3, 1, 300.0);
    let taken = tempfile::tempdir().unwrap();
    let path = taken.path().join("noisy.mcap");
    let noisy = ["--pose-noise", "0.2,0.2", "--drop", "0.3", "--seed", "9"];
    let mut options = noisy.to_vec();
    options.extend(["--record", text(&path), "--origin", "45.06,7.67"]);
    let streamed = local_maps(folder.path(), &options);
    let replayed = local_maps(&path, &[]);
    let lanes = |bytes: &Vec<u8>| serde_json::from_slice::<Value>(bytes).unwrap()["lane_lines"].clone();
    assert!(!replayed.is_empty());
    for (name, bytes) in &streamed {
        assert_eq!(lanes(bytes), lanes(&replayed[name]), "{}", name.display());
    }
    let fixes =
        open_one(&path, &ReadOptions::default()).frames().filter(|f| f.as_ref().unwrap().parts.gnss.is_some()).count();
    assert!(fixes >= 1);
}

#[test]
fn several_drives_become_several_files_and_are_replayed_as_a_folder() {
    let folder = simulated(4, 2, 150.0);
    let recordings = tempfile::tempdir().unwrap();
    let one_file = text(&recordings.path().join("one.mcap")).to_owned();
    let refused = lanemap(&["record", "--drives", text(folder.path()), "--output", &one_file]);
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && said.contains("2 drives") && said.contains("--output"), "{said}");

    record(folder.path(), recordings.path());
    let again = lanemap(&["record", "--drives", text(folder.path()), "--output", text(recordings.path())]);
    assert!(String::from_utf8_lossy(&again.stderr).contains("is there already"));
    let output = succeeded(lanemap(&["replay", "--local", "--json", "--drives", text(recordings.path())]));
    let names: Vec<_> = Drives::list(folder.path(), &[]).unwrap().iter().map(|drive| drive.name().to_owned()).collect();
    let replayed = report(&output);
    let replayed: Vec<_> =
        replayed["drives"].as_array().unwrap().iter().map(|drive| drive["name"].as_str().unwrap()).collect();
    assert_eq!(replayed, names);
}

#[test]
fn a_bag_gives_the_map_of_its_folder_within_the_rounding_of_its_floats() {
    let folder = simulated(5, 1, 400.0);
    let drive = only_drive(folder.path());
    let bags = tempfile::tempdir().unwrap();
    let path = bags.path().join(format!("{}.bag", drive.name()));
    write_bag(&drive, &path);
    let bag = BagOptions { camera: Some(folder.path().to_owned()), ..BagOptions::default() };
    let mut from_bag = open_one(&path, &ReadOptions { bag, ..ReadOptions::default() });
    assert_eq!((from_bag.name(), from_bag.len()), (drive.name(), drive.len()));
    assert!(from_bag.notes().is_empty());

    let from_bag = mapped(&mut from_bag);
    let from_folder = mapped(&mut RecordedDrive::OpenLane(drive));
    assert!(from_folder.lanes.len() >= 3, "a map without lanes proves nothing");
    assert_eq!(from_bag.lanes.len(), from_folder.lanes.len());
    for (a, b) in from_bag.lanes.iter().zip(&from_folder.lanes) {
        assert_eq!((a.id, a.category, a.control_points.len()), (b.id, b.category, b.control_points.len()));
        for (p, q) in a.control_points.iter().zip(&b.control_points) {
            assert!((p.position - q.position).norm() < 1e-3, "{} {}", p.position, q.position);
        }
    }
}

#[test]
fn a_bag_without_a_camera_is_mapped_from_the_camera_and_says_so() {
    let folder = simulated(6, 1, 200.0);
    let bags = tempfile::tempdir().unwrap();
    let path = bags.path().join("alone.bag");
    write_bag(&only_drive(folder.path()), &path);
    let output = succeeded(lanemap(&["replay", "--local", "--json", "--drives", text(&path)]));
    assert!(String::from_utf8_lossy(&output.stderr).contains("does not say how the camera is mounted"));
    assert!(report(&output)["drives"][0]["lanes"].as_u64().unwrap() >= 2);
}

#[test]
fn a_bag_is_read_by_the_names_of_its_own_definitions() {
    const LINES: &str = "int8 version\nstd_msgs/Header head\nLine[] lines\n===\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\n\
        string frame_id\n===\nMSG: other_pkg/Line\nuint8 category\nstring[] remarks\nPoint[] points\n===\n\
        MSG: other_pkg/Point\nfloat64 z\nfloat64 y\nfloat64 x\n";
    let mut bag = BagWriter::default();
    bag.connection(4, "/gt_pose_wc", "geometry_msgs/PoseStamped", POSE_STAMPED);
    bag.connection(9, "/lanes_predict", "other_pkg/Lines", LINES);
    bag.message(4, 1_000, &pose_message(1_000, &lanemap_core::Pose::translation(5.0, 6.0, 7.0)));
    let mut message = vec![3];
    message.extend([0; 4]);
    message.extend([0_u32, 1_000].map(u32::to_le_bytes).concat());
    message.extend([0; 4]);
    message.extend(1_u32.to_le_bytes());
    message.push(20);
    message.extend(1_u32.to_le_bytes());
    message.extend(2_u32.to_le_bytes());
    message.extend(b"hi");
    message.extend(2_u32.to_le_bytes());
    for value in [0.5_f64, -1.5, 10.0, 0.25, -1.75, 20.0] {
        message.extend(value.to_le_bytes());
    }
    bag.message(9, 1_000, &message);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("other.bag");
    fs::write(&path, bag.into_bytes()).unwrap();
    let frame = open_one(&path, &ReadOptions::default()).frames().next().unwrap().unwrap();
    assert_eq!(frame.parts.time.0, 1_000);
    let line = &frame.parts.detections[0];
    assert_eq!(line.category, lanemap_core::Category::LeftCurb);
    assert_eq!(line.points_vehicle[1], [20.0, -1.75, 0.25].into());
}

#[test]
fn a_bag_says_what_it_misses() {
    let only_poses = {
        let mut bag = BagWriter::default();
        bag.connection(0, "/gt_pose_wc", "geometry_msgs/PoseStamped", POSE_STAMPED);
        bag.connection(1, "/scan", "sensor_msgs/LaserScan", "float32 range\n");
        bag.into_bytes()
    };
    let error = bag_error(&only_poses);
    assert!(
        error.contains("has no topic /lanes_predict; it has /gt_pose_wc (geometry_msgs/PoseStamped), /scan"),
        "{error}"
    );

    let with_lanes = |definition: &str| {
        let mut bag = BagWriter::default();
        bag.connection(1, "/lanes_predict", "openlane_bag/LaneList", definition);
        bag_error(&bag.into_bytes())
    };
    let without_z = with_lanes(&LANE_LIST.replace("float32 z\n", ""));
    assert!(without_z.contains("topic /lanes_predict (openlane_bag/LaneList): it has no list of lanes"), "{without_z}");
    let text_category = with_lanes(&LANE_LIST.replace("int32 category", "string category"));
    assert!(text_category.contains("lane_list[].category is string, want a whole number"), "{text_category}");
    let no_header = with_lanes(&LANE_LIST.replace("Header header\n", ""));
    assert!(no_header.contains("no header with a stamp"), "{no_header}");
    let no_point = with_lanes(&LANE_LIST.replace("MSG: openlane_bag/LanePoint", "MSG: openlane_bag/Elsewhere"));
    assert!(no_point.contains("\"LanePoint\" is not defined in the bag"), "{no_point}");
}

#[test]
fn lanes_without_a_pose_and_bad_numbers_are_left_out_by_stamp() {
    let mut bag = BagWriter::default();
    bag.connection(0, "/gt_pose_wc", "geometry_msgs/PoseStamped", POSE_STAMPED);
    bag.connection(1, "/lanes_predict", "openlane_bag/LaneList", LANE_LIST);
    let line = |y| vec![(2, vec![[5.0, y, -2.0], [10.0, 1.0, -2.0]])];
    for (time, y, posed) in [(100, 1.0, true), (200, 1.0, false), (300, f32::NAN, true), (400, 1.0, true)] {
        if posed {
            bag.message(0, time, &pose_message(time, &lanemap_core::Pose::identity()));
        }
        bag.message(1, time, &lanes_message(time, &line(y)));
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gaps.bag");
    fs::write(&path, bag.into_bytes()).unwrap();
    let mut drive = open_one(&path, &ReadOptions::default());
    let (frames, faults): (Vec<_>, Vec<_>) = drive.frames().partition(Result::is_ok);
    assert_eq!(frames.len(), 2);
    let said: Vec<_> =
        faults.into_iter().map(|fault| fault.err().unwrap()).map(|f| format!("{}: {}", f.frame, f.error)).collect();
    assert!(said[0].starts_with("stamp 0.000000300") && said[0].contains("lane_list[0].lane[0].y is NaN"), "{said:?}");
    assert!(said[1].starts_with("stamp 0.000000200") && said[1].contains("no pose of the same stamp"), "{said:?}");
}

#[test]
fn a_recording_cut_anywhere_is_read_up_to_there_and_says_so() {
    let (folder, whole) = small_mcap();
    let frames = only_drive(folder.path()).len();
    let path = folder.path().join("cut.mcap");
    let mut most = 0;
    for cut in (1..20).map(|part| whole.len() * part / 20) {
        fs::write(&path, &whole[..cut]).unwrap();
        match open(&path, &ReadOptions::default()) {
            Ok(mut drives) => {
                let (read, faults): (Vec<_>, Vec<_>) = drives[0].frames().partition(Result::is_ok);
                most = most.max(read.len());
                let last = faults.last().map(|fault| fault.as_ref().unwrap_err().error.to_string());
                if read.len() < frames {
                    assert!(last.as_ref().is_some_and(|error| error.contains("cut short")), "{cut}: {last:?}");
                }
            }
            // Even the start was cut off.
            Err(error) => assert!(error.to_string().contains("cut short"), "{cut}: {error}"),
        }
    }
    assert!(most >= frames / 2, "{most} of {frames} frames");
}

#[test]
fn a_chunk_that_is_damaged_is_named_and_the_chunks_after_it_are_read() {
    let folder = simulated(22, 1, 600.0);
    let path = folder.path().join("drive.mcap");
    record(folder.path(), &path);
    let mut bytes = fs::read(&path).unwrap();
    let middle = bytes.len() * 2 / 5;
    bytes[middle] ^= 0x55;
    fs::write(&path, bytes).unwrap();
    let (read, faults): (Vec<_>, Vec<_>) = open_one(&path, &ReadOptions::default()).frames().partition(Result::is_ok);
    assert_eq!(faults.len(), 1);
    let said = faults[0].as_ref().unwrap_err().error.to_string();
    assert!(said.contains("a chunk") && said.contains("at byte"), "{said}");
    let last = read.last().unwrap().as_ref().unwrap().parts.sequence.0;
    assert_eq!(last, only_drive(folder.path()).len() as u64, "the last chunk is read");
    assert!((read.len() as u64) < last);
}

#[test]
fn bad_mcap_files_are_refused_by_place_value_and_limit() {
    let (_folder, whole) = small_mcap();
    assert!(mcap_error(&[]).contains("is empty"));
    assert!(mcap_error(b"hello, I am no recording").contains("begins with"));
    assert!(mcap_error(b"SQLite format 3\0 and so on").contains("ROS 2 bag"));
    assert!(mcap_error(&whole[..8]).contains("has no channel of lanemap.v1.SessionStart"));

    // Behind the magic: a chunk that says 2^60 bytes, then one of 100 MiB of which it has none.
    for (length, problem) in [(1_u64 << 60, "limit 67108864"), (100 << 20, "limit 67108864"), (1 << 20, "cut short")] {
        let mut absurd = whole[..8].to_vec();
        absurd.push(6);
        absurd.extend(length.to_le_bytes());
        let error = mcap_error(&absurd);
        assert!(error.contains(problem) && error.contains(&length.to_string()), "{error}");
    }
}

#[test]
fn bad_bags_are_refused_by_place_value_and_limit() {
    let folder = simulated(23, 1, 100.0);
    let whole = bag_of(&only_drive(folder.path()));
    assert!(bag_error(b"#ROSBAG V1.2\nand so on").contains("version 1"));
    assert!(bag_error(&whole[..40]).contains("cut short"));
    assert!(bag_error(&whole[..whole.len() - 10]).contains("cut short: a chunk wants"));
    let mut absurd = whole[..13].to_vec();
    absurd.extend(u32::MAX.to_le_bytes());
    assert!(bag_error(&absurd).contains("header says that it has 4294967295 bytes, limit 1048576"));
}

#[test]
fn a_file_of_the_wrong_name_is_what_its_bytes_say() {
    let (folder, bytes) = small_mcap();
    let path = folder.path().join("drive.bin");
    fs::write(&path, bytes).unwrap();
    assert!(matches!(open_one(&path, &ReadOptions::default()), RecordedDrive::Mcap(_)));
    let empty = tempfile::tempdir().unwrap();
    assert!(matches!(open(empty.path(), &ReadOptions::default()), Err(RecordingError::Empty { .. })));
}
