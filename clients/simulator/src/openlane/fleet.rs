//! Writes a fleet as `OpenLane` folders.
//!
//! As [`super`] has it, and besides: `network.geojson` is what is painted after the last drive, `network-before.geojson`
//! what was there at its first, `changes.geojson` what changed between. The index gives the anchor of the world on the
//! earth, and of each drive its start, its road and what is wrong with it. Annotations have every line in the camera's
//! view, also behind other vehicles; detections are not there. `OpenLane` has no room for occlusions and for odometry.

use std::{ops::Range, path::Path};

use lanemap_core::evaluation::GroundFrame;
use lanemap_openlane::{OpenLaneError, write_annotation, write_result};
use nalgebra::Point3;
use serde_json::{Value, json};

use super::{TRUTH_STEPS_PER_M, Written, annotation, detections_of, geojson_of, rounded, write_json};
use crate::{
    drive::motion::FRAME_RATE_HZ,
    fleet::{ChangeKind, Fleet, FleetDrive, FleetRoutes, FleetTruth, Poison, RoadChange},
    random::Purpose,
    truth_map::{TrueLine, TruthMap},
};

/// Simulates some drives of a fleet, by their numbers, and writes them below `root`, which is made where it is not there, frame
/// by frame.
///
/// # Errors
/// A folder or file that cannot be written.
pub fn write_fleet(root: &Path, fleet: &Fleet, drives: Range<u32>) -> Result<Written, OpenLaneError> {
    let mut written = Written::default();
    let mut index = Vec::new();
    for drive in drives.map(|number| fleet.drive(number)) {
        written.drives += 1;
        written.frames += drive.states().len();
        written.length_m += drive.length_m();
        index.push(write_drive(root, fleet, &drive)?);
    }
    let truth_at = |drive| lines_of(&fleet.truth_at(fleet.start_of(drive)));
    write_json(root, "network.geojson", &geojson_of("network", &truth_at(fleet.scenario().drives)))?;
    write_json(root, "network-before.geojson", &geojson_of("network-before", &truth_at(0)))?;
    write_json(root, "changes.geojson", &changes_of(fleet.changes()))?;
    let anchor = fleet.scenario().anchor;
    let index = json!({
        "set": "simulated fleet",
        "seed": fleet.seed().0,
        "hz": FRAME_RATE_HZ,
        "anchor": {
            "latitude_deg": anchor.latitude_deg,
            "longitude_deg": anchor.longitude_deg,
            "height_m": anchor.height_m,
        },
        "drives": index,
    });
    write_json(root, "index.json", &index)?;
    Ok(written)
}

/// Writes one drive and its true map; gives its entry of the index.
fn write_drive(root: &Path, fleet: &Fleet, drive: &FleetDrive<'_>) -> Result<Value, OpenLaneError> {
    let (seed, number) = (fleet.seed(), drive.number());
    let name = format!("segment-fleet-{}-{number:03}", seed.0);
    let (results, ground) = (root.join("results"), GroundFrame::below(&drive.sensor()));
    let rng = &mut seed.stream(Purpose::TrackIds, number);
    let mut map = TruthMap::default();
    for seen in drive.observed() {
        let camera = &fleet.scenario().camera;
        let annotation = annotation(&name, camera, &seen.truth, seen.gnss_world_from_vehicle, &seen.views);
        let time = seen.truth.time;
        write_annotation(root, &name, time, &annotation)?;
        let detections = detections_of(seen.frame.detections(), &ground, rng);
        write_result(&results, &name, time, &annotation, &detections)?;
        map.observe_views(&seen.views);
    }
    let lines = map.lines_by(|id| drive.line(id));
    write_json(&root.join("maps"), &format!("{name}.geojson"), &geojson_of(&name, &lines))?;
    let duration_s = (drive.states().len().max(2) - 1) as f64 / FRAME_RATE_HZ;
    let mut entry = json!({
        "name": name,
        "frames": drive.states().len(),
        "path_m": (drive.length_m() * 10.0).round() / 10.0,
        "lines": lines.len(),
        "mean_speed_mps": (drive.length_m() / duration_s * 100.0).round() / 100.0,
        "start_unix_ns": drive.start().0,
        "source": "simulated",
        "categories": "made",
        "detections": "simulated",
        "geometry": "made",
        "poses": "made",
    });
    if let FleetRoutes::Shared { .. } = fleet.scenario().routes {
        entry["road"] = json!(format!("fleet-{}", seed.0));
        entry["traversal"] = json!(number);
    }
    if let Some(poison) = drive.poison() {
        entry["poison"] = json!(match poison {
            Poison::GnssOffset { .. } => "GNSS offset",
            Poison::OdometryScale(_) => "odometry scale",
            Poison::MountYaw(_) => "mount yaw",
            Poison::LaneShift(_) => "lane shift",
        });
    }
    Ok(entry)
}

fn lines_of(truth: &FleetTruth) -> Vec<TrueLine> {
    let line = |line: &crate::fleet::FleetTrueLine| TrueLine {
        line: line.line,
        category: line.category,
        frames_seen: 0,
        points: line.points.clone(),
    };
    truth.lines.iter().map(line).collect()
}

/// A feature for each change: its course after it, or before it where nothing is there after it.
fn changes_of(changes: &[RoadChange]) -> Value {
    let places = |points: &[Point3<f64>]| -> Vec<[f64; 3]> {
        points.iter().map(|point| rounded(*point, TRUTH_STEPS_PER_M).into()).collect()
    };
    let features: Vec<Value> = changes
        .iter()
        .map(|change| {
            let mut properties = json!({
                "time_unix_ns": change.time.0,
                "track_id": change.line.0,
                "zone": change.zone,
            });
            match change.kind {
                ChangeKind::Vanished => properties["change"] = json!("vanished"),
                ChangeKind::Appeared => properties["change"] = json!("appeared"),
                ChangeKind::Moved { left_m } => {
                    properties["change"] = json!("moved");
                    properties["left_m"] = json!(left_m);
                }
                ChangeKind::Repainted { from, to } => {
                    properties["change"] = json!("repainted");
                    properties["from_category"] = json!(from.openlane_code());
                    properties["to_category"] = json!(to.openlane_code());
                }
            }
            let course = if change.after.is_empty() { &change.before } else { &change.after };
            json!({
                "type": "Feature",
                "properties": properties,
                "geometry": { "type": "LineString", "coordinates": places(course) },
            })
        })
        .collect();
    json!({
        "type": "FeatureCollection",
        "name": "changes",
        "coordinate_frame": "world of this simulation, metres, not longitude/latitude",
        "features": features,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Seed,
        fleet::{ChangePlan, FleetScenario, PoisonPlan},
    };
    use lanemap_openlane::Drives;

    #[test]
    fn a_fleet_that_is_written_is_read_back_as_its_vehicles_saw_it() {
        let scenario = FleetScenario {
            routes: FleetRoutes::Random { length_m: 120.0 },
            changes: ChangePlan::some(1, 1),
            poison: PoisonPlan { gross_share: 1.0, adversarial_share: 0.0 },
            ..FleetScenario::small_town(2)
        };
        let fleet = scenario.fleet(Seed(4));
        let folder = tempfile::tempdir().unwrap();
        let written = write_fleet(folder.path(), &fleet, 0..fleet.scenario().drives).unwrap();
        assert_eq!(written.drives, 2);
        let read = Drives::list(folder.path(), &[]).unwrap();
        for (read, drive) in read.iter().zip(fleet.drives()) {
            assert_eq!(read.len(), drive.states().len());
            for (read, seen) in read.frames().zip(drive.observed()) {
                let read = read.unwrap();
                assert_eq!(read.time, seen.frame.time());
                assert_eq!(read.truth_vehicle().len(), seen.views.len());
                assert_eq!(read.detections_vehicle().len(), seen.frame.detections().len());
            }
        }
        let text = |file: &str| std::fs::read_to_string(folder.path().join(file)).unwrap();
        assert_ne!(text("network.geojson"), text("network-before.geojson"));
        let changes: Value = serde_json::from_str(&text("changes.geojson")).unwrap();
        assert_eq!(changes["features"].as_array().unwrap().len(), fleet.changes().len());
        let index: Value = serde_json::from_str(&text("index.json")).unwrap();
        assert!(index["drives"][1]["poison"].is_string());
    }
}
