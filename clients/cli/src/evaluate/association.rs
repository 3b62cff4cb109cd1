//! Association: which lane of one frame is which lane of another, with a wrong pose between them.
//!
//! The pairs, and the error of each pose, are written out in `association_pairs.json` beside the drives. The true lanes of frame
//! b are the detections, those of frame a the map; lanes of the map come through the wrong pose into the vehicle frame of b,
//! as the mapper brings them. With `--heading` the map is turned to another compass heading before.

use std::{collections::BTreeMap, time::Duration};

use clap::Args;
use lanemap_core::{
    Pose, TimestampNs,
    association::{LaneShape, PoseUncertainty},
    evaluation::{AssociationMean, AssociationScore},
};
use lanemap_openlane::{Annotation, DriveFolder};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use serde_json::{Value, json};

use super::{
    CommonArgs,
    association_method::Method,
    association_pairs::{FramePair, read_pairs},
    drives::chosen,
    parallel,
    table::Table,
};

/// Pairs with at least this many lanes in frame a are counted a second time for themselves, as for the authors' code.
const MANY_LANES: usize = 5;
/// Error of the poses between the frames, as the paper draws it.
const POSE: PoseUncertainty =
    PoseUncertainty { yaw_rad: 2.0 * std::f64::consts::PI / 180.0, along_m: 3.0, across_m: 3.0 };

#[derive(Debug, Args)]
pub struct AssociationArgs {
    #[command(flatten)]
    common: CommonArgs,
    /// Compass headings to turn the map to, degrees
    #[arg(long, value_name = "DEG,..", value_delimiter = ',', allow_hyphen_values = true, default_values_t = [0.0])]
    heading: Vec<f64>,
}

/// The scores of one method.
#[derive(Clone, Copy, Debug, Default)]
struct MethodScore {
    all: AssociationMean,
    many: AssociationMean,
    time: Duration,
}

pub fn run(args: &AssociationArgs) -> anyhow::Result<()> {
    let pairs = read_pairs(&args.common.drives.join("association_pairs.json"))?;
    let scenes: Vec<Scene> = read_scenes(&chosen(&args.common)?, &pairs)?;
    anyhow::ensure!(!scenes.is_empty(), "no pair of association_pairs.json is in the chosen drives");
    let methods = Method::all(args.common.preset.presets());
    let headings: Vec<(f64, Vec<MethodScore>)> = args
        .heading
        .iter()
        .map(|heading| (*heading, methods.iter().map(|method| score(*method, &scenes, *heading)).collect()))
        .collect();
    if args.common.json {
        println!("{}", serde_json::to_string_pretty(&as_json(scenes.len(), &methods, &headings))?);
    } else {
        print!("{}", as_text(scenes.len(), &methods, &headings));
    }
    Ok(())
}

/// One pair of frames, read.
struct Scene {
    /// Lanes of frame b, vehicle frame of b.
    detections: Vec<TrackedLane>,
    /// Lanes of frame a, vehicle frame of a.
    map: Vec<TrackedLane>,
    /// The pose of b as it is believed.
    vehicle_a_from_b: Pose,
    in_both: Vec<i64>,
}

struct TrackedLane {
    track_id: i64,
    shape: LaneShape,
}

fn read_scenes(drives: &[DriveFolder], pairs: &[FramePair]) -> anyhow::Result<Vec<Scene>> {
    let mut of_drive: BTreeMap<&str, Vec<&FramePair>> = BTreeMap::new();
    for pair in pairs {
        of_drive.entry(&pair.drive).or_default().push(pair);
    }
    let scenes = parallel::for_each(drives, |drive| {
        let mut annotations: BTreeMap<TimestampNs, Annotation> = BTreeMap::new();
        let pairs = of_drive.get(drive.name()).map(Vec::as_slice).unwrap_or_default();
        for time in pairs.iter().flat_map(|pair| [pair.frame_a, pair.frame_b]) {
            if let std::collections::btree_map::Entry::Vacant(entry) = annotations.entry(time) {
                entry.insert(drive.annotation(time)?);
            }
        }
        Ok(pairs
            .iter()
            .map(|pair| Scene::new(pair, &annotations[&pair.frame_a], &annotations[&pair.frame_b]))
            .collect())
    })?;
    Ok(scenes.into_iter().flat_map(|scenes: Vec<Scene>| scenes).collect())
}

impl Scene {
    fn new(pair: &FramePair, a: &Annotation, b: &Annotation) -> Self {
        Self {
            detections: tracked_lanes(b),
            map: tracked_lanes(a),
            vehicle_a_from_b: a.vehicle_from_camera * pair.camera_a_from_b * b.vehicle_from_camera.inverse(),
            in_both: pair.in_both.clone(),
        }
    }

    /// Detections and lanes of the map in the vehicle frame of b as it is believed, out of a map that was turned.
    fn in_vehicle_frame(&self, heading_rad: f64) -> (Vec<LaneShape>, Vec<LaneShape>) {
        let turn =
            Pose::from_parts(Vector3::zeros().into(), UnitQuaternion::from_scaled_axis(Vector3::z() * heading_rad));
        let b_from_map = (turn * self.vehicle_a_from_b).inverse();
        let map = self.map.iter().map(|lane| moved(&moved(&lane.shape, &turn), &b_from_map)).collect();
        (self.detections.iter().map(|lane| lane.shape.clone()).collect(), map)
    }

    fn score(&self, lane_of: &[Option<usize>]) -> AssociationScore {
        let claimed: Vec<(i64, i64)> = self
            .detections
            .iter()
            .zip(lane_of)
            .filter_map(|(detection, lane)| Some((detection.track_id, self.map[(*lane)?].track_id)))
            .collect();
        AssociationScore::new(&claimed, &self.in_both)
    }

    fn has_many_lanes(&self) -> bool {
        self.map.len() >= MANY_LANES
    }
}

fn tracked_lanes(annotation: &Annotation) -> Vec<TrackedLane> {
    let tracked = |lane: &lanemap_openlane::AnnotatedLane| {
        let points: Vec<Point3<f64>> = lane.points_vehicle(&annotation.vehicle_from_camera);
        // An annotation is never wrong about its category; a detector is, now and then.
        let shape = LaneShape::seen_once(lane.category, points, 0.1);
        TrackedLane { track_id: lane.track_id, shape }
    };
    annotation.lanes.iter().filter(|lane| !lane.points_camera.is_empty()).map(tracked).collect()
}

fn moved(shape: &LaneShape, target_from_source: &Pose) -> LaneShape {
    LaneShape { points: shape.points.iter().map(|point| target_from_source * point).collect(), ..shape.clone() }
}

fn score(method: Method, scenes: &[Scene], heading_deg: f64) -> MethodScore {
    let mut total = MethodScore::default();
    for scene in scenes {
        let (detections, map) = scene.in_vehicle_frame(heading_deg.to_radians());
        let (lane_of, took) = method.associate_timed(&detections, &map, &POSE);
        let score = scene.score(&lane_of);
        total.time += took;
        total.all.add(&score);
        if scene.has_many_lanes() {
            total.many.add(&score);
        }
    }
    total
}

fn as_text(pairs: usize, methods: &[Method], headings: &[(f64, Vec<MethodScore>)]) -> String {
    let mut text = format!("Association, {pairs} pairs of frames; pose error 3 m in x and y, 2 degrees in yaw.\n");
    for (heading, scores) in headings {
        let many = scores.first().map_or(0, |score| score.many.pairs);
        text.push('\n');
        text.push_str(&heading_line(*heading, many));
        let mut table = Table::new(&["", "F1", "precision", "recall", "F1 >= 5 lanes", "mean us"]);
        for (method, score) in methods.iter().zip(scores) {
            let mut cells = vec![method.name().to_owned()];
            let numbers = [score.all.f1(), score.all.precision(), score.all.recall(), score.many.f1()];
            cells.extend(numbers.map(|number| format!("{number:.3}")));
            cells.push(format!("{:.1}", mean_us(score)));
            table.row(cells);
        }
        text.push_str(&table.render());
    }
    text
}

fn heading_line(heading_deg: f64, many: u64) -> String {
    format!("map turned by {heading_deg} degrees; {many} pairs with {MANY_LANES} lanes or more\n")
}

fn mean_us(score: &MethodScore) -> f64 {
    score.time.as_secs_f64() * 1e6 / score.all.pairs.max(1) as f64
}

fn as_json(pairs: usize, methods: &[Method], headings: &[(f64, Vec<MethodScore>)]) -> Value {
    let heading = |(heading, scores): &(f64, Vec<MethodScore>)| {
        let methods: serde_json::Map<String, Value> = methods
            .iter()
            .zip(scores)
            .map(|(method, score)| {
                let value = json!({
                    "f1": score.all.f1(),
                    "precision": score.all.precision(),
                    "recall": score.all.recall(),
                    "f1_5_lanes": score.many.f1(),
                    "pairs_5_lanes": score.many.pairs,
                    "mean_us": mean_us(score),
                });
                (method.name().to_owned(), value)
            })
            .collect();
        json!({ "heading_deg": heading, "methods": methods })
    };
    json!({ "measure": "association", "pairs": pairs, "headings": headings.iter().map(heading).collect::<Vec<_>>() })
}
