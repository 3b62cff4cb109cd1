//! A contribution made ready: its fixes in the shared frame, its lanes as samples that know from where they were seen.

use nalgebra::{Point3, Vector2, Vector3};

use super::{
    contribution::{Contribution, TrajectoryPoint},
    correction::{Correction, CorrectionKnot},
    params::FleetParams,
};
use crate::{
    geometry::georeference::{Anchor, Wgs84},
    lane_map::{EndRule, MapLane},
    spline::curve::Curve,
};

/// A contribution in the form that alignment reads.
#[derive(Debug)]
pub(super) struct PreparedDrive<'a> {
    pub(super) contribution: &'a Contribution,
    pub(super) fixes: Vec<SharedFix>,
    pub(super) lanes: Vec<PreparedLane<'a>>,
    /// Odometry's variances between knot `i` and `i + 1` of the correction.
    pub(super) steps: Vec<OdometryStep>,
}

/// A GNSS fix in the shared frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct SharedFix {
    pub(super) arc_m: f64,
    /// Where the vehicle was, map frame of the drive.
    pub(super) map: Point3<f64>,
    /// Where the receiver put it.
    pub(super) shared: Point3<f64>,
    pub(super) horizontal_sigma_m: f64,
    pub(super) vertical_sigma_m: f64,
}

/// What odometry is off by between two knots.
#[derive(Clone, Copy, Debug)]
pub(super) struct OdometryStep {
    pub(super) position_m2: f64,
    pub(super) yaw_rad2: f64,
    pub(super) height_m2: f64,
}

#[derive(Debug)]
pub(super) struct PreparedLane<'a> {
    pub(super) lane: &'a MapLane,
    pub(super) curve: Curve<'a, [crate::lane_map::ControlPoint]>,
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

impl<'a> PreparedDrive<'a> {
    pub(super) fn new(contribution: &'a Contribution, anchor: &Anchor, params: &FleetParams) -> Self {
        let fixes = contribution.trajectory.iter().filter_map(|point| shared_fix(point, anchor)).collect();
        let usable = |lane: &&MapLane| lane.existence >= params.least_existence;
        let lanes = contribution.lanes.iter().filter(usable);
        let lanes = lanes.filter_map(|lane| PreparedLane::new(lane, &contribution.trajectory, params)).collect();
        let knots = knot_indices(&contribution.trajectory, params.correction_knot_m);
        let steps = knots.windows(2).map(|pair| step(&contribution.trajectory[pair[0]..=pair[1]], params)).collect();
        Self { contribution, fixes, lanes, steps }
    }

    /// The correction that puts the drive's frame into the shared one as a whole.
    pub(super) fn rigid_correction(
        &self,
        yaw_rad: f64,
        shared_from_map: impl Fn(&Point3<f64>) -> Point3<f64>,
        params: &FleetParams,
    ) -> Correction {
        let trajectory = &self.contribution.trajectory;
        let knots = knot_indices(trajectory, params.correction_knot_m).into_iter().map(|index| {
            let point = &trajectory[index];
            CorrectionKnot {
                arc_m: point.arc_m,
                map: point.position,
                shared: shared_from_map(&point.position),
                yaw_rad,
            }
        });
        Correction { knots: knots.collect() }
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
            let (lateral_variance_m2, height_variance_m2) = variances(lane, parameter, &tangent);
            LaneSample {
                parameter,
                map,
                tangent,
                arc_m: seen_from[index].arc_m,
                lateral_variance_m2,
                height_variance_m2,
            }
        });
        let samples: Vec<LaneSample> = samples.collect();
        samples.iter().all(|sample| sample.tangent.x.is_finite()).then_some(Self { lane, curve, samples })
    }
}

fn shared_fix(point: &TrajectoryPoint, anchor: &Anchor) -> Option<SharedFix> {
    let fix = point.fix.as_ref()?;
    let place = Wgs84 { latitude_deg: fix.latitude_deg, longitude_deg: fix.longitude_deg, height_m: fix.height_m };
    Some(SharedFix {
        arc_m: point.arc_m,
        map: point.position,
        shared: anchor.enu_from_wgs84(&place),
        horizontal_sigma_m: fix.horizontal_sigma_m,
        vertical_sigma_m: fix.vertical_sigma_m,
    })
}

/// Indices of the trajectory points at which a correction has knots: the first, the last, and one every `spacing_m`.
fn knot_indices(trajectory: &[TrajectoryPoint], spacing_m: f64) -> Vec<usize> {
    let mut knots = vec![0];
    for (index, point) in trajectory.iter().enumerate() {
        if point.arc_m - trajectory[knots[knots.len() - 1]].arc_m >= spacing_m {
            knots.push(index);
        }
    }
    knots
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
