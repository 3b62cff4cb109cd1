//! The part of the map that a frame can see: nearby lanes, as the stages of a step want them.

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector3, Vector6};

use crate::{
    association::LaneShape,
    geometry::{Pose, pose::perturb},
    landmark::{
        Landmark,
        existence::DETECTION,
        foot_walk::FootWalk,
        index::{LaneIndex, NearbyRun, STALE_M},
        information::Knot,
    },
    lane_map::LaneId,
    observation::LaneObservation,
    params::Params,
    sensor::Sensor,
    spline::sampling::sample,
    tracking::{Correspondence, MatchedLane, PoseEstimate},
};

/// Lanes within this radius of the middle of the view are looked at, metres.
const RADIUS_M: f64 = 55.0;
/// The middle of the view, metres ahead of the vehicle.
const MIDDLE_M: f64 = 28.0;
/// Lanes are looked at this much farther to the side than they are observed, metres: a detection may be off, and a curve
/// runs on between control points.
const PLAY_M: f64 = 3.0;
/// Middles of lanes that may be one lie nearer than this, metres.
const TOGETHER_M: f64 = 2.0;
/// Samples of a lane per chord, for association, which compares with the tangent at the nearest sample.
const PIECES_PER_CHORD: usize = 1;

/// Nearby lanes in the order of their ids.
pub(super) struct Scene {
    /// Where each lane is near.
    pub runs: Vec<NearbyRun>,
    /// The same lanes as polylines in the vehicle frame at the predicted pose.
    pub shapes: Vec<LaneShape>,
    /// How far to the right and to the left each shape goes, metres.
    sides_m: Vec<(f64, f64)>,
}

impl Scene {
    /// The lanes around a predicted pose.
    pub fn around(
        predicted: &PoseEstimate,
        lanes: &BTreeMap<LaneId, Landmark>,
        index: &LaneIndex,
        params: &Params,
    ) -> Self {
        let map_from_vehicle = &predicted.map_from_vehicle;
        let middle = map_from_vehicle * Point3::new(MIDDLE_M, 0.0, 0.0);
        let side_m = params.observation.side_m + play_m(predicted);
        let (mut runs, mut shapes, mut sides_m) = (Vec::new(), Vec::new(), Vec::new());
        for run in index.within(&middle, RADIUS_M + STALE_M) {
            let Some(lane) = lanes.get(&run.lane) else { continue };
            if let Some(shape) = shape_of(lane, &run, map_from_vehicle, side_m, params) {
                runs.push(run);
                sides_m.push(sides_of(&shape));
                shapes.push(shape);
            }
        }
        Self { runs, shapes, sides_m }
    }

    /// Whether the middles of two lanes lie near each other, which all duplicates' do.
    pub fn may_run_together(&self, a: usize, b: usize) -> bool {
        let ((right_a, left_a), (right_b, left_b)) = (self.sides_m[a], self.sides_m[b]);
        if right_a - left_b > TOGETHER_M || right_b - left_a > TOGETHER_M {
            return false;
        }
        let (a, b) = (&self.shapes[a], &self.shapes[b]);
        let (short, long) = if a.points.len() < b.points.len() { (a, b) } else { (b, a) };
        let middle = &short.points[short.points.len() / 2];
        (long.points[long.nearest(middle)] - middle).norm() < TOGETHER_M
    }

    /// Matched observations with the foot points of their samples, for the pose update.
    pub fn matched_lanes<'a>(
        &self,
        observations: &'a [LaneObservation],
        lane_of: &[Option<usize>],
        lanes: &'a BTreeMap<LaneId, Landmark>,
        params: &'a Params,
    ) -> Vec<MatchedLane<'a>> {
        let mut matched = Vec::new();
        for (observation, shape) in observations.iter().zip(lane_of) {
            let Some(lane) = shape.and_then(|shape| lanes.get(&self.runs[shape].lane)) else { continue };
            // A lane seen once agrees with the frame that began it, whatever the pose.
            if lane.observations < 2 {
                continue;
            }
            let step = (params.tracking.point_step_m / params.observation.sample_step_m).round().max(1.0);
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a small positive stride
            let points: Vec<Point3<f64>> = observation.samples.iter().step_by(step as usize).copied().collect();
            let run = shape.map(|shape| self.runs[shape]);
            let near = run.map_or_else(|| lane.knots(), |run| (run.first, run.last));
            let query = points.clone();
            let foot_points = Box::new(move |pose: &Pose| correspondences(lane, near, &query, pose, params));
            matched.push(MatchedLane { points_vehicle: points, foot_points });
        }
        matched
    }
}

fn correspondences(
    lane: &Landmark,
    near: (Knot, Knot),
    points: &[Point3<f64>],
    pose: &Pose,
    params: &Params,
) -> Vec<Option<Correspondence>> {
    let Some(curve) = lane.curve(params.landmark.ends) else { return vec![None; points.len()] };
    let mut walk = FootWalk::new(lane, &curve, near, &params.landmark);
    points
        .iter()
        .map(|point| {
            let foot = walk.foot_point(&(pose * point))?;
            let (foot_map, derivative, _) = curve.segment_at(foot.parameter).evaluate(foot.parameter);
            let tangent_map = derivative.try_normalize(1e-9)?;
            let head = lane.information().head() as f64;
            let map_variance = lane.extent.variance_at(head + foot.parameter).min(10.0);
            Some(Correspondence { foot_map, tangent_map, map_variance })
        })
        .collect()
}

fn sides_of(shape: &LaneShape) -> (f64, f64) {
    let widen = |(right, left): (f64, f64), point: &Point3<f64>| (right.min(point.y), left.max(point.y));
    shape.points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), widen)
}

/// How far to the side a line may lie from where it is seen, metres.
fn play_m(predicted: &PoseEstimate) -> f64 {
    let sigma = |axis: usize| predicted.covariance[(axis, axis)].max(0.0).sqrt();
    PLAY_M + 3.0 * (sigma(1) + RADIUS_M * sigma(5))
}

/// A nearby lane as a polyline in the vehicle frame; `None` where all of it lies farther to the side than can be seen.
fn shape_of(
    lane: &Landmark,
    run: &NearbyRun,
    map_from_vehicle: &Pose,
    side_m: f64,
    params: &Params,
) -> Option<LaneShape> {
    let (first, last) = (lane.index_of(run.first), lane.index_of(run.last));
    let vehicle_from_map = map_from_vehicle.inverse();
    let beside = |point: &Point3<f64>| (vehicle_from_map * point).y.abs() <= side_m;
    if !lane.positions().range(first..=last).any(beside) {
        return None;
    }
    let curve = lane.curve(params.landmark.ends)?;
    let (from, to) = (first as f64, last as f64);
    let points = sample(&curve, from, to, PIECES_PER_CHORD);
    if points.len() < 2 {
        return None;
    }
    Some(LaneShape {
        category: lane.category.best(),
        category_log_likelihood: lane.category.log_likelihood(params.association.category_confusion),
        points: points.iter().map(|point| vehicle_from_map * point).collect(),
    })
}

/// The pose with an estimated error `(x, y, yaw)`, vehicle frame, taken away.
pub(super) fn displaced(map_from_vehicle: &Pose, error: &Vector3<f64>) -> Pose {
    perturb(map_from_vehicle, &Vector6::new(-error.x, -error.y, 0.0, 0.0, 0.0, -error.z))
}

/// Knots of a lane between which an observation lies: those near the vehicle, and what the lane has just grown by.
pub(super) fn near_knots(lane: &Landmark, run: &NearbyRun) -> (Knot, Knot) {
    /// A crop box is shorter than this many chords.
    const GROWTH: Knot = 24;
    let (first, last) = lane.knots();
    ((run.first - GROWTH).max(first), (run.last + GROWTH).min(last))
}

/// How surely the detector would report a line that runs through a place (vehicle frame), in `[0, 1]`.
pub(super) fn visibility(point_vehicle: &Point3<f64>, sensor: &Sensor, params: &Params) -> f64 {
    let (sure_m, blind_m) = (params.landmark.sure_range_m, params.landmark.blind_range_m);
    let params = &params.observation;
    let offset = point_vehicle - Point3::from(sensor.ground_offset());
    let outside = offset.x < params.ahead_from_m || offset.y.abs() > params.side_m || !sensor.sees(point_vehicle);
    if outside { 0.0 } else { ((blind_m - offset.xy().norm()) / (blind_m - sure_m)).clamp(0.0, 1.0) }
}

/// Chance that a frame at this pose reports a lane that exists.
pub(super) fn detection_probability(
    lane: &Landmark,
    run: &NearbyRun,
    map_from_vehicle: &Pose,
    sensor: &Sensor,
    params: &Params,
) -> f64 {
    let Some((from, to)) = lane.drawn(&params.landmark) else { return 0.5 };
    let (mut length, mut side) = (0.0, 0.0);
    for index in lane.index_of(run.first)..=lane.index_of(run.last) {
        if (index as f64) < from || (index as f64) > to {
            continue;
        }
        let point = map_from_vehicle.inverse_transform_point(&lane.positions()[index]);
        let visible = visibility(&point, sensor, params);
        length += visible;
        side += visible * point.y.abs();
    }
    // Three control points well in view are enough to be reported; lines far to the side are often missed.
    let share = (length / 4.0).min(1.0);
    let side_m = if length > 0.0 { side / length } else { 0.0 };
    share * (DETECTION - 0.04 * (side_m - 2.0).clamp(0.0, 10.0))
}
