//! Writes a simulation as `OpenLane` folders, laid out as real sets are.
//!
//! ```text
//! segment-sim-SEED-NN/TIMESTAMP.json           annotation: true pose, GNSS pose, true lines in sight
//! results/segment-sim-SEED-NN/TIMESTAMP.json   what the detector reported
//! maps/segment-sim-SEED-NN.geojson             true map of the drive: lines seen in three frames or more
//! network.geojson                              every painted line of the network
//! index.json                                   list of drives
//! ```
//!
//! Poses are true: odometry noise is for the reader to add (`lanemap replay --pose-noise`). Points are rounded to a
//! tenth of a millimetre, those of detections to a millimetre. The same simulation gives the same bytes.

use std::{fs, path::Path};

use lanemap_core::evaluation::GroundFrame;
use lanemap_openlane::{
    AnnotatedLane, Annotation, DetectedLane, DetectionFile, OpenLaneError, write_annotation, write_result,
};
use nalgebra::Point3;
use rand::Rng;
use serde_json::{Value, json};

use crate::{
    drive::motion::FRAME_RATE_HZ,
    random::{Purpose, SimRng},
    simulation::{Scenario, SimulatedDrive, SimulatedFrame, Simulation},
    truth_map::{TrueLine, truth_map},
    view::LineView,
};

/// Points of annotations and maps keep tenths of a millimetre.
const TRUTH_STEPS_PER_M: f64 = 1e4;
/// Points of detections keep millimetres.
const DETECTION_STEPS_PER_M: f64 = 1e3;
/// Detections get numbers below this; they carry no information.
const TRACK_ID_BOUND: i64 = 1_000_000;

/// Name of the folder of one drive.
#[must_use]
pub fn drive_name(scenario: &Scenario, number: u32) -> String {
    format!("segment-sim-{}-{number:02}", scenario.seed.0)
}

/// Writes a simulation of `scenario` below `root`, which is made where it is not there.
///
/// # Errors
/// A folder or file that cannot be written.
pub fn write_simulation(root: &Path, scenario: &Scenario, simulation: &Simulation) -> Result<(), OpenLaneError> {
    let mut index = Vec::new();
    for drive in &simulation.drives {
        let name = drive_name(scenario, drive.number);
        let rng = &mut scenario.seed.stream(Purpose::TrackIds, drive.number);
        for frame in &drive.frames {
            let annotation = annotation_of(&name, drive, frame);
            let time = frame.truth.time;
            write_annotation(root, &name, time, &annotation)?;
            write_result(&root.join("results"), &name, time, &annotation, &detections_of(drive, frame, rng))?;
        }
        let map = truth_map(drive, &simulation.network);
        write_json(&root.join("maps"), &format!("{name}.geojson"), &geojson_of(&name, &map))?;
        index.push(index_entry(&name, scenario, drive, map.len()));
    }
    let roads: Vec<TrueLine> = simulation.network.lines().iter().map(TrueLine::whole).collect();
    write_json(root, "network.geojson", &geojson_of("network", &roads))?;
    let index = json!({ "set": "simulated", "seed": scenario.seed.0, "hz": FRAME_RATE_HZ, "drives": index });
    write_json(root, "index.json", &index)
}

/// The annotation of one frame: what is truly there.
#[must_use]
pub fn annotation_of(name: &str, drive: &SimulatedDrive, frame: &SimulatedFrame) -> Annotation {
    let stem = lanemap_openlane::timestamp_stem(frame.truth.time);
    Annotation {
        path: std::path::PathBuf::new(),
        intrinsic: drive.camera.intrinsic,
        vehicle_from_camera: drive.camera.vehicle_from_camera,
        world_from_vehicle: Some(frame.truth.world_from_vehicle),
        world_from_vehicle_gnss: Some(frame.gnss_world_from_vehicle),
        image: format!("simulated/{name}/{stem}.jpg"),
        lanes: frame.views.iter().map(|view| annotated(view, &frame.views, drive)).collect(),
    }
}

fn annotated(view: &LineView, all: &[LineView], drive: &SimulatedDrive) -> AnnotatedLane {
    let mount = &drive.camera.vehicle_from_camera;
    AnnotatedLane {
        category: view.category,
        track_id: i64::from(view.line.0),
        attribute: attribute(view, all),
        points_camera: view
            .visible_points()
            .iter()
            .map(|point| rounded(mount.inverse_transform_point(point), TRUTH_STEPS_PER_M))
            .collect(),
    }
}

/// OpenLane's rank beside the vehicle: 1 left-left, 2 left, 3 right, 4 right-right, 0 other.
fn attribute(view: &LineView, all: &[LineView]) -> i64 {
    let nearer = |other: &&LineView| {
        other.side_m().is_sign_positive() == view.side_m().is_sign_positive()
            && other.side_m().abs() < view.side_m().abs()
    };
    match (view.side_m() >= 0.0, all.iter().filter(nearer).count()) {
        (true, 1) => 1,
        (true, 0) => 2,
        (false, 0) => 3,
        (false, 1) => 4,
        _ => 0,
    }
}

fn detections_of(drive: &SimulatedDrive, frame: &SimulatedFrame, rng: &mut SimRng) -> DetectionFile {
    let ground = GroundFrame::below(&drive.camera.sensor());
    let lanes = frame
        .detections
        .iter()
        .map(|detection| DetectedLane {
            category: detection.category,
            track_id: rng.random_range(0..TRACK_ID_BOUND),
            points_ground: detection
                .points_vehicle
                .iter()
                .map(|point| rounded(ground.ground_from_vehicle(point), DETECTION_STEPS_PER_M))
                .collect(),
        })
        .collect();
    DetectionFile { lanes }
}

fn rounded(point: Point3<f64>, steps_per_m: f64) -> Point3<f64> {
    point.map(|value| (value * steps_per_m).round() / steps_per_m)
}

fn geojson_of(name: &str, lines: &[TrueLine]) -> Value {
    let features: Vec<Value> = lines
        .iter()
        .map(|line| {
            let points: Vec<[f64; 3]> =
                line.points.iter().map(|point| rounded(*point, TRUTH_STEPS_PER_M).into()).collect();
            json!({
                "type": "Feature",
                "properties": {
                    "track_id": line.line.0,
                    "category": line.category.openlane_code(),
                    "frames_seen": line.frames_seen,
                },
                "geometry": { "type": "LineString", "coordinates": points },
            })
        })
        .collect();
    json!({
        "type": "FeatureCollection",
        "name": name,
        "coordinate_frame": "world of this simulation, metres, not longitude/latitude",
        "features": features,
    })
}

fn index_entry(name: &str, scenario: &Scenario, drive: &SimulatedDrive, lines: usize) -> Value {
    let mut entry = json!({
        "name": name,
        "frames": drive.frames.len(),
        "path_m": (drive.length_m() * 10.0).round() / 10.0,
        "lines": lines,
        "mean_speed_mps": (drive.length_m() / drive.duration_s().max(1e-9) * 100.0).round() / 100.0,
        "source": "simulated",
        "categories": "made",
        "detections": "simulated",
        "geometry": "made",
        "poses": "made",
    });
    if scenario.shared_route {
        entry["road"] = json!(format!("sim-{}", scenario.seed.0));
        entry["traversal"] = json!(drive.number);
    }
    entry
}

fn write_json(folder: &Path, file: &str, value: &Value) -> Result<(), OpenLaneError> {
    fs::create_dir_all(folder).map_err(|source| OpenLaneError::Io { path: folder.to_owned(), source })?;
    let path = folder.join(file);
    fs::write(&path, format!("{value}\n")).map_err(|source| OpenLaneError::Io { path, source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use lanemap_openlane::Drives;

    #[test]
    fn what_is_written_is_read_back_as_the_vehicle_saw_it() {
        let scenario = Scenario { drives: 1, length_m: 250.0, ..Scenario::town(5) };
        let simulation = Simulation::run(&scenario);
        let folder = tempfile::tempdir().unwrap();
        write_simulation(folder.path(), &scenario, &simulation).unwrap();

        let drives = Drives::list(folder.path(), &[]).unwrap();
        assert_eq!(drives[0].len(), simulation.drives[0].frames.len());
        let mut lines = 0;
        for (read, simulated) in drives[0].frames().zip(&simulation.drives[0].frames) {
            let read = read.unwrap();
            assert_eq!(read.time, simulated.truth.time);
            let pose = read.annotation.pose().unwrap();
            assert!((pose.inverse() * simulated.truth.world_from_vehicle).translation.vector.norm() < 1e-6);
            for (a, b) in read.truth_vehicle().iter().zip(&simulated.views) {
                assert!((a[0] - b.visible_points()[0]).norm() < 1e-3);
                lines += 1;
            }
            let detections = read.detections_vehicle();
            assert_eq!(detections.len(), simulated.detections.len());
            for (a, b) in detections.iter().zip(&simulated.detections) {
                assert_eq!(a.category, b.category);
                assert!((a.points_vehicle[0] - b.points_vehicle[0]).norm() < 2e-3);
            }
        }
        assert!(lines > 300);
    }
}
