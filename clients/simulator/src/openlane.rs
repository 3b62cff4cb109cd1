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

mod fleet;

use std::{fs, path::Path};

use lanemap_core::{Detection, Pose, evaluation::GroundFrame};
use lanemap_openlane::{
    AnnotatedLane, Annotation, DetectedLane, DetectionFile, OpenLaneError, write_annotation, write_result,
};
use nalgebra::Point3;
use rand::Rng;
use serde_json::{Value, json};

use crate::{
    camera::Camera,
    drive::{TrueState, motion::FRAME_RATE_HZ},
    random::{Purpose, SimRng},
    road::RoadNetwork,
    scenario::Scenario,
    simulation::{DriveSimulation, SimulatedFrame},
    truth_map::{TrueLine, TruthMap},
    view::LineView,
};

pub use fleet::write_fleet;

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

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Written {
    /// Drives.
    pub drives: u32,
    /// Frames of all drives.
    pub frames: usize,
    /// Distance driven, metres.
    pub length_m: f64,
}

/// Simulates a scenario and writes it below `root`, which is made where it is not there, frame by frame.
///
/// # Errors
/// A folder or file that cannot be written.
pub fn write_simulation(root: &Path, scenario: &Scenario) -> Result<Written, OpenLaneError> {
    let network = RoadNetwork::build(&scenario.network, scenario.max_grade, scenario.seed);
    let mut written = Written::default();
    let mut index = Vec::new();
    for number in 0..scenario.drives {
        let drive = DriveSimulation::start(scenario, &network, number);
        written.drives += 1;
        written.frames += drive.states().len();
        written.length_m += drive.length_m();
        index.push(write_drive(root, scenario, &network, number, drive)?);
    }
    let roads: Vec<TrueLine> = network.lines().iter().map(TrueLine::whole).collect();
    write_json(root, "network.geojson", &geojson_of("network", &roads))?;
    let index = json!({ "set": "simulated", "seed": scenario.seed.0, "hz": FRAME_RATE_HZ, "drives": index });
    write_json(root, "index.json", &index)?;
    Ok(written)
}

/// Writes one drive and its true map; gives its entry of the index.
fn write_drive(
    root: &Path,
    scenario: &Scenario,
    network: &RoadNetwork,
    number: u32,
    drive: DriveSimulation<'_>,
) -> Result<Value, OpenLaneError> {
    let name = drive_name(scenario, number);
    let (frames, length_m, duration_s) = (drive.states().len(), drive.length_m(), drive.duration_s());
    let (results, ground) = (root.join("results"), GroundFrame::below(&scenario.camera.sensor()));
    let rng = &mut scenario.seed.stream(Purpose::TrackIds, number);
    let mut map = TruthMap::default();
    for frame in drive {
        let annotation = annotation_of(&name, &scenario.camera, &frame);
        let time = frame.truth.time;
        write_annotation(root, &name, time, &annotation)?;
        write_result(&results, &name, time, &annotation, &detections_of(&frame.detections, &ground, rng))?;
        map.observe(&frame);
    }
    let lines = map.lines(network);
    write_json(&root.join("maps"), &format!("{name}.geojson"), &geojson_of(&name, &lines))?;
    let mut entry = json!({
        "name": name,
        "frames": frames,
        "path_m": (length_m * 10.0).round() / 10.0,
        "lines": lines.len(),
        "mean_speed_mps": (length_m / duration_s.max(1e-9) * 100.0).round() / 100.0,
        "source": "simulated",
        "categories": "made",
        "detections": "simulated",
        "geometry": "made",
        "poses": "made",
    });
    if scenario.shared_route {
        entry["road"] = json!(format!("sim-{}", scenario.seed.0));
        entry["traversal"] = json!(number);
    }
    Ok(entry)
}

/// The annotation of one frame: what is truly there.
#[must_use]
pub fn annotation_of(name: &str, camera: &Camera, frame: &SimulatedFrame) -> Annotation {
    annotation(name, camera, &frame.truth, frame.gnss_world_from_vehicle, &frame.views)
}

fn annotation(name: &str, camera: &Camera, truth: &TrueState, gnss: Pose, views: &[LineView]) -> Annotation {
    let stem = lanemap_openlane::timestamp_stem(truth.time);
    Annotation {
        path: std::path::PathBuf::new(),
        intrinsic: camera.intrinsic,
        vehicle_from_camera: camera.vehicle_from_camera,
        world_from_vehicle: Some(truth.world_from_vehicle),
        world_from_vehicle_gnss: Some(gnss),
        image: format!("simulated/{name}/{stem}.jpg"),
        lanes: views.iter().map(|view| annotated(view, views, &camera.vehicle_from_camera)).collect(),
    }
}

fn annotated(view: &LineView, all: &[LineView], vehicle_from_camera: &Pose) -> AnnotatedLane {
    AnnotatedLane {
        category: view.category,
        track_id: i64::from(view.line.0),
        attribute: attribute(view, all),
        points_camera: view
            .visible_points()
            .iter()
            .map(|point| rounded(vehicle_from_camera.inverse_transform_point(point), TRUTH_STEPS_PER_M))
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

fn detections_of(detections: &[Detection], ground: &GroundFrame, rng: &mut SimRng) -> DetectionFile {
    let lanes = detections
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

fn write_json(folder: &Path, file: &str, value: &Value) -> Result<(), OpenLaneError> {
    fs::create_dir_all(folder).map_err(|source| OpenLaneError::Io { path: folder.to_owned(), source })?;
    let path = folder.join(file);
    fs::write(&path, format!("{value}\n")).map_err(|source| OpenLaneError::Io { path, source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Simulation;
    use lanemap_openlane::Drives;

    #[test]
    fn what_is_written_is_read_back_as_the_vehicle_saw_it() {
        let scenario = Scenario { drives: 1, length_m: 250.0, ..Scenario::town(5) };
        let simulation = Simulation::run(&scenario);
        let folder = tempfile::tempdir().unwrap();
        let written = write_simulation(folder.path(), &scenario).unwrap();
        assert_eq!(written.frames, simulation.drives[0].frames.len());

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
