//! The ways that drives took: which lane of a road belongs to which direction.
//!
//! Two lines and the one between them look the same a lane further over, but vehicles do not: those that meet use different
//! lanes. So the places where drives went are kept with their direction. Of drives that went the same way within
//! [`SAME_WAY_M`] one place is kept, so that their number does not grow with that of the drives.
//!
//! Not guaranteed: that nobody drives on the wrong side; [`placement`](super::placement) asks many places before it believes it.

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector2};
use serde::{Deserialize, Serialize};

use super::{contribution::TrajectoryPoint, correction::Correction, prepared::count_of};

/// Way between two places of a drive that are kept, metres.
pub(super) const WAY_STEP_M: f64 = 12.0;
/// Distance within which another place of the same direction says nothing new, metres.
const SAME_WAY_M: f64 = 2.0;
/// Least cosine of the angle between two drives that went the same way.
const LEAST_COSINE: f64 = 0.95;
/// Side of a square of the index, metres.
const SQUARE_M: f64 = 32.0;

/// A place where a drive went.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct WayPoint {
    /// Shared frame, metres.
    pub(super) place: Point3<f64>,
    /// Of travel, of length 1.
    pub(super) direction: Vector2<f64>,
}

/// Places where drives went.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Ways {
    squares: BTreeMap<(i64, i64), Vec<WayPoint>>,
}

impl WayPoint {
    /// The places of a stretch of way, every [`WAY_STEP_M`], with how far along they lie.
    pub(super) fn along<'a>(
        way: &'a [TrajectoryPoint],
        correction: &'a Correction,
    ) -> impl Iterator<Item = (f64, Self)> + 'a {
        let step = |point: &TrajectoryPoint| count_of(point.arc_m / WAY_STEP_M);
        way.chunk_by(move |a, b| step(a) == step(b)).map(|stretch| {
            let point = &stretch[0];
            let (sin, cos) = (point.yaw_rad + correction.yaw_rad(point.arc_m)).sin_cos();
            let place = correction.apply(&point.position, point.arc_m);
            (point.arc_m, Self { place, direction: Vector2::new(cos, sin) })
        })
    }

    /// To the left of travel.
    pub(super) fn normal(&self) -> Vector2<f64> {
        Vector2::new(-self.direction.y, self.direction.x)
    }
}

impl Ways {
    /// Adds where a drive went.
    pub(super) fn add(&mut self, way: &[TrajectoryPoint], correction: &Correction) {
        for (_, point) in WayPoint::along(way, correction) {
            let known = self.near(&point.place, SAME_WAY_M).any(|other| {
                (other.place - point.place).norm() < SAME_WAY_M && other.direction.dot(&point.direction) > LEAST_COSINE
            });
            if !known {
                self.squares.entry(square_of(&point.place)).or_default().push(point);
            }
        }
    }

    /// About how much memory they take, bytes.
    pub(super) fn bytes(&self) -> usize {
        self.squares.values().map(|points| size_of_val(points.as_slice())).sum()
    }

    /// Places within a distance horizontally, and some that are a little farther.
    pub(super) fn near(&self, place: &Point3<f64>, reach_m: f64) -> impl Iterator<Item = &WayPoint> {
        let corner = |sign: f64| square_of(&Point3::new(place.x + sign * reach_m, place.y + sign * reach_m, place.z));
        let ((west, south), (east, north)) = (corner(-1.0), corner(1.0));
        let columns = (west..=east).flat_map(move |x| self.squares.range((x, south)..=(x, north)));
        columns.flat_map(|(_, points)| points)
    }
}

#[expect(clippy::cast_possible_truncation, reason = "the cast saturates")]
fn square_of(place: &Point3<f64>) -> (i64, i64) {
    ((place.x / SQUARE_M).floor() as i64, (place.y / SQUARE_M).floor() as i64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{fleet::params::FleetParams, frame::TimestampNs};

    fn eastwards(y: f64) -> Vec<TrajectoryPoint> {
        let points = (0..100_u32).map(|index| TrajectoryPoint {
            time: TimestampNs(0),
            arc_m: f64::from(index),
            position: Point3::new(f64::from(index), y, 0.0),
            yaw_rad: 0.0,
            motion_variance_m2: 0.0,
            turn_variance_rad2: 0.0,
            fix: None,
            hidden: vec![],
        });
        points.collect()
    }

    fn ways(drives: &[(f64, f64)]) -> Ways {
        let mut ways = Ways::default();
        for (y, yaw_rad) in drives {
            let way = eastwards(*y);
            let turned = nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::z_axis(), *yaw_rad);
            let correction = Correction::rigid(&way, *yaw_rad, |point| turned * point, &FleetParams::default());
            ways.add(&way, &correction);
        }
        ways
    }

    fn count(ways: &Ways) -> usize {
        ways.squares.values().map(Vec::len).sum()
    }

    #[test]
    fn drives_of_one_lane_are_kept_once_and_those_that_meet_them_apart() {
        let one = ways(&[(0.0, 0.0)]);
        assert_eq!(count(&one), 9);
        assert_eq!(ways(&[(0.0, 0.0), (0.5, 0.0), (-0.7, 0.0)]), one);
        assert_eq!(count(&ways(&[(0.0, 0.0), (3.5, 0.0)])), 18);
        assert_eq!(count(&ways(&[(0.0, 0.0), (0.0, std::f64::consts::PI)])), 18);
    }

    #[test]
    fn what_is_near_is_found_across_squares() {
        let ways = ways(&[(0.1, 0.0), (-0.1, std::f64::consts::FRAC_PI_2)]);
        let near: Vec<&WayPoint> = ways.near(&Point3::new(1.0, -1.0, 0.0), 5.0).collect();
        assert!(near.iter().any(|point| point.direction.x > 0.99));
        assert!(near.iter().any(|point| point.direction.y > 0.99));
        assert_eq!(ways.near(&Point3::new(1_000.0, 0.0, 0.0), 5.0).count(), 0);
    }
}
