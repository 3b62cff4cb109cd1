//! A contribution made ready: its fixes in the shared frame, and its lanes, pass by pass, as samples that know from where
//! they were seen.
//!
//! A pass is a stretch of the way that does not come back to itself. A drive that does is several witnesses of the same road, as
//! different drives would be, with one correction: that is how its loops close.

use std::ops::Range;

use nalgebra::{Point3, Vector2, Vector3};

use super::{
    contribution::{Contribution, PlacedBy, TrajectoryPoint},
    correction::{Correction, knot_indices},
    georeferenced::by_gnss,
    params::FleetParams,
};
use crate::{
    geometry::georeference::{Anchor, Wgs84},
    lane_map::{ControlPoint, EndRule, MapLane},
    spline::curve::Curve,
};

/// What of a drive holds its correction: fixes, and odometry between knots.
#[derive(Clone, Debug)]
pub(super) struct Restraints {
    pub(super) fixes: Vec<SharedFix>,
    /// Whence the fixes come.
    pub(super) placed_by: PlacedBy,
    /// Standard deviations of what all fixes have in common, horizontally and in height, metres.
    pub(super) bias_sigma_m: [f64; 2],
    /// Standard deviation of where the fixes put the drive among others, metres.
    pub(super) place_sigma_m: f64,
    /// Mean of the standard deviations that the receiver states, horizontally, metres.
    pub(super) stated_sigma_m: f64,
    /// What odometry is off by all through the drive.
    pub(super) drift_sigma: DriftSigma,
    /// Odometry's variances between knot `i` and `i + 1` of the correction.
    pub(super) steps: Vec<OdometryStep>,
}

/// A contribution in the form that alignment reads.
#[derive(Debug)]
pub(super) struct PreparedDrive<'a> {
    pub(super) contribution: &'a Contribution,
    pub(super) restraints: Restraints,
    /// Where GNSS and odometry alone put it; `None` without fixes.
    pub(super) by_gnss: Option<Correction>,
    pub(super) passes: Vec<PreparedPass<'a>>,
}

/// A stretch of a drive that does not come back to itself.
#[derive(Debug)]
pub(super) struct PreparedPass<'a> {
    pub(super) way: &'a [TrajectoryPoint],
    pub(super) lanes: Vec<PreparedLane<'a>>,
    /// The same lanes with every [`COARSE_STRIDE`]th sample: enough to fit a drive, which has few degrees of freedom.
    pub(super) coarse_lanes: Vec<PreparedLane<'a>>,
}

/// Every how many samples of a lane one is used to fit its drive.
pub(super) const COARSE_STRIDE: usize = 2;

/// A GNSS fix in the shared frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct SharedFix {
    pub(super) arc_m: f64,
    /// Where the vehicle was, map frame of the drive.
    pub(super) map: Point3<f64>,
    /// Where the receiver put it.
    pub(super) shared: Point3<f64>,
    /// Standard deviations of what it has not in common with others, horizontally and in height, metres.
    pub(super) sigma_m: [f64; 2],
}

/// Standard deviations of what odometry is off by all through a drive.
#[derive(Clone, Copy, Debug)]
pub(super) struct DriftSigma {
    /// Of the way: 0.01 is 1 %.
    pub(super) scale: f64,
    /// Of the heading, radians per metre of way.
    pub(super) turn_rad_per_m: f64,
}

/// What odometry is off by between two knots, beside that.
#[derive(Clone, Copy, Debug)]
pub(super) struct OdometryStep {
    pub(super) position_m2: f64,
    pub(super) yaw_rad2: f64,
    pub(super) height_m2: f64,
}

/// A lane, or as much of it as one pass saw.
#[derive(Debug)]
pub(super) struct PreparedLane<'a> {
    pub(super) lane: &'a MapLane,
    pub(super) curve: Curve<'a, [ControlPoint]>,
    pub(super) samples: Vec<LaneSample>,
}

/// A point of a drive's lane.
#[derive(Clone, Copy, Debug)]
pub(super) struct LaneSample {
    /// Spline parameter of the lane.
    pub(super) parameter: f64,
    /// Map frame of the drive.
    pub(super) map: Point3<f64>,
    /// Direction of the lane there, of length 1.
    pub(super) tangent: Vector3<f64>,
    /// From where on its way the drive saw it.
    pub(super) arc_m: f64,
    pub(super) lateral_variance_m2: f64,
    pub(super) height_variance_m2: f64,
}

/// Standard deviation of what is not known, metres.
const UNKNOWN_M: f64 = 1e3;
/// Way after which coming near an earlier place is coming back, metres.
const LEAST_LOOP_M: f64 = 150.0;
/// Distance from an earlier place that is near, metres.
const NEAR_M: f64 = 30.0;

impl<'a> PreparedDrive<'a> {
    pub(super) fn new(contribution: &'a Contribution, anchor: &Anchor, params: &FleetParams) -> Self {
        let restraints = Restraints::new(contribution, anchor, params);
        let by_gnss = by_gnss(&contribution.trajectory, &restraints, params);
        Self::placed(contribution, restraints, by_gnss, params)
    }

    /// The same, where it is known already where GNSS and odometry alone put it.
    pub(super) fn of(
        contribution: &'a Contribution,
        by_gnss: Option<Correction>,
        anchor: &Anchor,
        params: &FleetParams,
    ) -> Self {
        Self::placed(contribution, Restraints::new(contribution, anchor, params), by_gnss, params)
    }

    fn placed(
        contribution: &'a Contribution,
        restraints: Restraints,
        by_gnss: Option<Correction>,
        params: &FleetParams,
    ) -> Self {
        let trajectory = &contribution.trajectory;
        let passes = passes(&way(trajectory, by_gnss.as_ref()));
        let passes: Vec<&[TrajectoryPoint]> = passes.into_iter().map(|range| &trajectory[range]).collect();
        let mut prepared: Vec<PreparedPass<'_>> =
            passes.iter().map(|way| PreparedPass { way, lanes: Vec::new(), coarse_lanes: Vec::new() }).collect();
        for lane in contribution.lanes.iter().filter(|lane| lane.existence >= params.least_existence) {
            let Some(lane) = PreparedLane::new(lane, trajectory, params) else { continue };
            for pass in &mut prepared {
                pass.lanes.extend(lane.seen_on(pass.way, params));
            }
        }
        for pass in &mut prepared {
            pass.coarse_lanes = pass.lanes.iter().map(PreparedLane::coarse).collect();
        }
        Self { contribution, restraints, by_gnss, passes: prepared }
    }
}

impl Restraints {
    pub(super) fn new(contribution: &Contribution, anchor: &Anchor, params: &FleetParams) -> Self {
        let (trajectory, placed_by) = (contribution.trajectory.as_slice(), contribution.placed_by);
        let mut fixes: Vec<SharedFix> = trajectory.iter().filter_map(|point| shared_fix(point, anchor)).collect();
        let mean = |axis: usize| fixes.iter().map(|fix| fix.sigma_m[axis]).sum::<f64>() / fixes.len().max(1) as f64;
        let stated_sigma_m = mean(0);
        let (bias_sigma_m, place_sigma_m) = match placed_by {
            PlacedBy::Receiver => {
                let sigma_m = [0, 1].map(|axis| mean(axis).max(params.gnss_bias_sigma_m));
                (sigma_m, sigma_m[0])
            }
            // They know where the drive lies on the map, and nothing of where the map lies.
            PlacedBy::Map => ([UNKNOWN_M; 2], mean(0).max(params.gate_m / params.search_sigmas)),
        };
        // Fixes near each other share what they are off by: so many witnesses there are of the shape of the way.
        let length_m = fixes.last().map_or(0.0, |last| last.arc_m - fixes[0].arc_m);
        let witnesses = length_m / params.gnss_correlation_m + 1.0;
        let deflation = (fixes.len() as f64 / witnesses).max(1.0).sqrt();
        for fix in &mut fixes {
            fix.sigma_m = fix.sigma_m.map(|sigma_m| params.gnss_shape_share * sigma_m * deflation);
        }
        let knots = knot_indices(trajectory, params.correction_knot_m);
        let steps = knots.windows(2).map(|pair| step(&trajectory[pair[0]..=pair[1]], params)).collect();
        let drift_sigma =
            DriftSigma { scale: params.odometry_scale_sigma, turn_rad_per_m: params.odometry_turn_sigma_rad_per_m };
        Self { fixes, placed_by, bias_sigma_m, place_sigma_m, stated_sigma_m, drift_sigma, steps }
    }

    /// Weighs what the fixes say of the shape of the way by another share of what the receiver states.
    pub(super) fn reweigh_shape(&mut self, share: f64, params: &FleetParams) {
        for fix in &mut self.fixes {
            fix.sigma_m[0] *= share / params.gnss_shape_share;
        }
    }
}

impl<'a> PreparedLane<'a> {
    fn new(lane: &'a MapLane, trajectory: &[TrajectoryPoint], params: &FleetParams) -> Option<Self> {
        let curve = Curve::new(lane.control_points.as_slice(), EndRule::Reflected)?;
        let (from, to) = (lane.drawn_from.max(0.0), lane.drawn_to.min(curve.last_parameter()));
        let chord_m = mean_chord_m(lane);
        if (to - from) * chord_m < params.shortest_lane_m {
            return None;
        }
        let seen_from = seen_from(lane, trajectory);
        let pieces = count_of(((to - from) * chord_m / params.sample_m).ceil()).max(1);
        let mut nearest = None;
        let samples = (0..=pieces).map(|piece| {
            let parameter = from + (to - from) * piece as f64 / pieces as f64;
            let map = curve.point(parameter);
            let tangent = curve.derivative(parameter).normalize();
            let index = walk_to_nearest(seen_from, &map, nearest);
            nearest = Some(index);
            let (lateral_m2, height_m2) = variances(lane, parameter, &tangent);
            LaneSample {
                parameter,
                map,
                tangent,
                arc_m: seen_from[index].arc_m,
                lateral_variance_m2: lateral_m2 + params.lane_sigma_m.powi(2),
                height_variance_m2: height_m2 + params.lane_sigma_height_m.powi(2),
            }
        });
        let samples: Vec<LaneSample> = samples.collect();
        samples.iter().all(|sample| sample.tangent.x.is_finite()).then_some(Self { lane, curve, samples })
    }

    fn coarse(&self) -> Self {
        let samples = self.samples.iter().step_by(COARSE_STRIDE).copied().collect();
        Self { lane: self.lane, curve: self.curve, samples }
    }

    /// The runs of samples that were seen from a stretch of the way, each as a lane.
    fn seen_on(&self, way: &[TrajectoryPoint], params: &FleetParams) -> Vec<Self> {
        let (from, to) = (way[0].arc_m, way[way.len() - 1].arc_m);
        let on_it = |sample: &LaneSample| sample.arc_m >= from && sample.arc_m <= to;
        let least = count_of(params.shortest_lane_m / params.sample_m).max(2);
        let runs = self.samples.chunk_by(|a, b| on_it(a) == on_it(b));
        let runs = runs.filter(|run| on_it(&run[0]) && run.len() >= least);
        runs.map(|run| Self { lane: self.lane, curve: self.curve, samples: run.to_vec() }).collect()
    }
}

/// A way as places with their arc length, in the shared frame where GNSS puts it there: by odometry alone a long way may
/// come back to itself far from where it began.
fn way(trajectory: &[TrajectoryPoint], by_gnss: Option<&Correction>) -> Vec<(f64, Point3<f64>)> {
    let place = |point: &TrajectoryPoint| match by_gnss {
        Some(correction) => correction.apply(&point.position, point.arc_m),
        None => point.position,
    };
    trajectory.iter().map(|point| (point.arc_m, place(point))).collect()
}

/// Cuts a way where it comes back to itself.
fn passes(way: &[(f64, Point3<f64>)]) -> Vec<Range<usize>> {
    const STRIDE: usize = 3;
    let mut passes = Vec::new();
    let mut start = 0;
    for (index, (arc_m, place)) in way.iter().enumerate() {
        let comes_back = way[start..index].iter().step_by(STRIDE).any(|(earlier_m, earlier)| {
            arc_m - earlier_m > LEAST_LOOP_M && (place - earlier).xy().norm_squared() < NEAR_M * NEAR_M
        });
        if comes_back {
            passes.push(start..index);
            start = index;
        }
    }
    passes.push(start..way.len());
    passes
}

fn shared_fix(point: &TrajectoryPoint, anchor: &Anchor) -> Option<SharedFix> {
    let fix = point.fix.as_ref()?;
    let place = Wgs84 { latitude_deg: fix.latitude_deg, longitude_deg: fix.longitude_deg, height_m: fix.height_m };
    Some(SharedFix {
        arc_m: point.arc_m,
        map: point.position,
        shared: anchor.enu_from_wgs84(&place),
        sigma_m: [fix.horizontal_sigma_m, fix.vertical_sigma_m],
    })
}

fn step(between: &[TrajectoryPoint], params: &FleetParams) -> OdometryStep {
    let way_m = between[between.len() - 1].arc_m - between[0].arc_m;
    let claimed = |variance: fn(&TrajectoryPoint) -> f64| between[1..].iter().map(variance).sum::<f64>();
    OdometryStep {
        position_m2: params.odometry_sigma_m.powi(2) * way_m + claimed(|point| point.motion_variance_m2),
        yaw_rad2: params.odometry_sigma_rad.powi(2) * way_m + claimed(|point| point.turn_variance_rad2),
        height_m2: params.odometry_sigma_height_m.powi(2) * way_m,
    }
}

/// The stretch of the way from which a lane was seen.
fn seen_from<'a>(lane: &MapLane, trajectory: &'a [TrajectoryPoint]) -> &'a [TrajectoryPoint] {
    let first = trajectory.partition_point(|point| point.time < lane.first_seen).saturating_sub(1);
    let last = trajectory.partition_point(|point| point.time <= lane.last_seen);
    &trajectory[first..(last + 1).min(trajectory.len()).max(first + 1)]
}

/// Index of the nearest point of the way: from the one before where there is one, else among all.
fn walk_to_nearest(way: &[TrajectoryPoint], place: &Point3<f64>, before: Option<usize>) -> usize {
    let distance = |index: usize| nalgebra::distance_squared(&way[index].position, place);
    let Some(mut index) = before else {
        return (0..way.len()).min_by(|a, b| distance(*a).total_cmp(&distance(*b))).unwrap_or(0);
    };
    loop {
        let here = distance(index);
        if index + 1 < way.len() && distance(index + 1) < here {
            index += 1;
        } else if index > 0 && distance(index - 1) < here {
            index -= 1;
        } else {
            return index;
        }
    }
}

fn mean_chord_m(lane: &MapLane) -> f64 {
    let chords = lane.control_points.windows(2).map(|pair| nalgebra::distance(&pair[0].position, &pair[1].position));
    chords.sum::<f64>() / (lane.control_points.len() - 1) as f64
}

/// Variances across the lane and of its height, between those of the two control points beside a parameter.
fn variances(lane: &MapLane, parameter: f64, tangent: &Vector3<f64>) -> (f64, f64) {
    let normal = normal_of(tangent);
    let normal = Vector3::new(normal.x, normal.y, 0.0);
    let before = count_of(parameter.floor()).min(lane.control_points.len() - 1);
    let after = (before + 1).min(lane.control_points.len() - 1);
    let share = (parameter - before as f64).clamp(0.0, 1.0);
    let at = |index: usize| {
        let covariance = &lane.control_points[index].covariance;
        ((covariance * normal).dot(&normal), covariance[(2, 2)])
    };
    let ((lateral_a, height_a), (lateral_b, height_b)) = (at(before), at(after));
    (lateral_a + (lateral_b - lateral_a) * share, height_a + (height_b - height_a) * share)
}

/// The horizontal normal of a direction, to its left, of length 1; zero where the direction is vertical.
pub(super) fn normal_of(tangent: &Vector3<f64>) -> Vector2<f64> {
    Vector2::new(-tangent.y, tangent.x).try_normalize(1e-9).unwrap_or_default()
}

/// A count from a number that is not negative, cut to whole.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the cast saturates, and NaN becomes 0")]
pub(super) fn count_of(value: f64) -> usize {
    value as usize
}
