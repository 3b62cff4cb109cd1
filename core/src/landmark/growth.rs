//! Growing a lane: new control points, one chord apart, on the line that a frame observed.
//!
//! Paper: "Lane Initialization", Algorithm 1, with its misprints corrected. The next control point is the
//! intersection of the sphere of one chord around the end with the observed cubic, by fixed-point iteration between the
//! two. Only what lies beyond the end's normal plane counts.
//!
//! * `paper`: as long as *any* sample lies beyond the plane, so the last control point is extrapolated by up to a chord.
//! * `default`: only while the next control point itself was observed: no road that nobody saw. The cubic is also moved to
//!   run through the lane's end, so that an observation that lies beside the lane bends it nowhere: the data terms, not
//!   the initial value, say where the line is.

use nalgebra::{Point3, Vector3};

use crate::{geometry::Pose, observation::LaneObservation};

/// How a lane may grow.
#[derive(Clone, Copy, Debug)]
pub struct GrowthRule {
    /// Distance of two control points, metres.
    pub chord_m: f64,
    /// Whether the last control point may lie beyond what was observed (`paper`).
    pub extrapolate: bool,
    /// Whether the cubic is moved to run through the lane's end (`default`).
    pub join: bool,
}

const ITERATIONS: usize = 10;
const SETTLED_M: f64 = 0.01;
/// Bound on one frame's growth: no crop box is longer.
const MOST_NEW_POINTS: usize = 64;

/// Control points of a lane that this observation begins, in the direction of travel; map frame.
#[must_use]
pub fn begin(observation: &LaneObservation, map_from_vehicle: &Pose, rule: &GrowthRule) -> Vec<Point3<f64>> {
    let first = local(observation, observation.reported.0);
    let mut points = vec![first];
    points.extend(extend(observation, &first, 1.0, rule));
    points.iter().map(|point| to_map(observation, map_from_vehicle, point)).collect()
}

/// Control points beyond the end of a lane, from the end outwards; map frame.
///
/// `end` is the lane's last (or first) control point, `inner` its neighbour.
#[must_use]
pub fn grow(
    observation: &LaneObservation,
    map_from_vehicle: &Pose,
    inner: &Point3<f64>,
    end: &Point3<f64>,
    rule: &GrowthRule,
) -> Vec<Point3<f64>> {
    let to_local = |point: &Point3<f64>| {
        observation.local_frame.local_from_vehicle(&map_from_vehicle.inverse_transform_point(point))
    };
    let (inner, end) = (to_local(inner), to_local(end));
    let outwards = end - inner;
    if outwards.xy().norm() < 1e-9 {
        return Vec::new();
    }
    // A line that leaves the lane at a steep angle is not its continuation.
    if outwards.x.abs() < 0.5 * outwards.xy().norm() {
        return Vec::new();
    }
    let new_points = extend(observation, &end, outwards.x.signum(), rule);
    new_points.iter().map(|point| to_map(observation, map_from_vehicle, point)).collect()
}

fn local(observation: &LaneObservation, x: f64) -> Point3<f64> {
    Point3::new(x, observation.lateral.at(x), observation.vertical.at(x))
}

fn to_map(observation: &LaneObservation, map_from_vehicle: &Pose, point: &Point3<f64>) -> Point3<f64> {
    map_from_vehicle * observation.local_frame.vehicle_from_local(point)
}

/// Steps of one chord along the observed line from `end`, towards growing or falling x; local frame.
fn extend(observation: &LaneObservation, end: &Point3<f64>, sign: f64, rule: &GrowthRule) -> Vec<Point3<f64>> {
    let offset = if rule.join { *end - local(observation, end.x) } else { Vector3::zeros() };
    let on_line = |x: f64| local(observation, x) + offset;
    let border = if sign > 0.0 { observation.reported.1 } else { observation.reported.0 };
    // Beyond this the line would be continued over a gap that this frame did not see.
    let near_border = if sign > 0.0 { observation.reported.0 } else { observation.reported.1 };
    if (near_border - end.x) * sign > rule.chord_m {
        return Vec::new();
    }
    let mut points: Vec<Point3<f64>> = Vec::new();
    let mut last = *end;
    while (border - last.x) * sign > 0.0 && points.len() < MOST_NEW_POINTS {
        let next = step_of_one_chord(&last, sign, rule.chord_m, &on_line);
        if (!rule.extrapolate && (border - next.x) * sign < 0.0) || (next.x - last.x) * sign < 0.2 * rule.chord_m {
            break;
        }
        points.push(next);
        last = next;
    }
    points
}

/// `Expand` of Algorithm 1: between 'on the sphere' and 'on the curve' until the point settles.
fn step_of_one_chord(end: &Point3<f64>, sign: f64, chord_m: f64, on_line: &impl Fn(f64) -> Point3<f64>) -> Point3<f64> {
    let mut point = end + Vector3::new(3.0 * sign * chord_m, 0.0, 0.0);
    for _ in 0..ITERATIONS {
        let direction = on_line(point.x) - end;
        let projected = end + direction * (chord_m / direction.norm());
        let moved_m = (projected - point).norm();
        point = projected;
        if moved_m < SETTLED_M {
            break;
        }
    }
    point
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        category::Category,
        frame::Detection,
        observation::observe,
        params::{Params, Preset},
        sensor::Sensor,
    };

    fn seen(from: f64, to: f64, y: impl Fn(f64) -> f64) -> LaneObservation {
        let count = 30;
        let points_vehicle = (0..=count)
            .map(|k| {
                let x = from + (to - from) * f64::from(k) / f64::from(count);
                Point3::new(x, y(x), 0.0)
            })
            .collect();
        let detection = Detection { category: Category::WhiteSolid, points_vehicle };
        observe(&detection, 0, &Sensor::default(), &Params::preset(Preset::Default).observation).unwrap()
    }

    const OURS: GrowthRule = GrowthRule { chord_m: 3.0, extrapolate: false, join: true };
    const PAPER: GrowthRule = GrowthRule { chord_m: 3.0, extrapolate: true, join: false };

    #[test]
    fn new_control_points_lie_one_chord_apart_on_the_observed_line() {
        let observation = seen(5.0, 45.0, |x| 2.0 + 0.002 * x * x);
        let points = begin(&observation, &Pose::identity(), &OURS);
        assert_eq!(points.len(), 14);
        for pair in points.windows(2) {
            assert!(((pair[1] - pair[0]).norm() - 3.0).abs() < 1e-9);
            assert!(pair[1].x > pair[0].x);
        }
        assert!(points.iter().all(|p| (p.y - (2.0 + 0.002 * p.x * p.x)).abs() < 0.02));
    }

    #[test]
    fn ours_ends_within_the_observation_and_the_papers_one_chord_beyond_at_the_most() {
        let observation = seen(5.0, 40.0, |_| 1.0);
        let (ours, paper) =
            (begin(&observation, &Pose::identity(), &OURS), begin(&observation, &Pose::identity(), &PAPER));
        assert!(ours.last().unwrap().x <= 40.0);
        assert!((40.0..43.0).contains(&paper.last().unwrap().x));
    }

    #[test]
    fn a_lane_grows_at_its_head_when_nearer_road_is_seen() {
        let observation = seen(5.0, 40.0, |_| 1.0);
        let (end, inner) = (Point3::new(15.0, 1.0, 0.0), Point3::new(18.0, 1.0, 0.0));
        let grown = grow(&observation, &Pose::identity(), &inner, &end, &OURS);
        assert_eq!(grown.len(), 3);
        assert!((grown[0].x - 12.0).abs() < 0.02 && (grown[2].x - 6.0).abs() < 0.05);
    }

    #[test]
    fn a_lane_does_not_jump_over_a_gap() {
        let observation = seen(20.0, 50.0, |_| 1.0);
        let grown =
            grow(&observation, &Pose::identity(), &Point3::new(2.0, 1.0, 0.0), &Point3::new(5.0, 1.0, 0.0), &OURS);
        assert!(grown.is_empty());
    }
}
