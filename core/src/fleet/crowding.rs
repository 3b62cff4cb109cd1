//! Crowding: when so many drives went over the same places that the oldest are folded.
//!
//! The land is cut into squares, and `n_s` drives came to square `s`. By how many drives is a place passed that a drive
//! chosen by chance passes? By
//!
//! `crowd = sum_s n_s^2 / sum_s n_s`.
//!
//! Drives in the order of their seniority are a crowd as soon as this reaches a limit: on one road as many drives as
//! the limit, in a town many more. Whether the first so many are a crowd is said by them alone, so that crowds stay the same
//! while younger drives arrive.

use std::collections::{BTreeMap, BTreeSet};

use super::contribution::Contribution;
use crate::geometry::georeference::{Anchor, Wgs84};

/// Side of a square, metres.
const SQUARE_M: f64 = 50.0;
/// A drive came to the squares within so many metres of its way to each side: as many at the border of two as elsewhere.
const BESIDE_M: f64 = 15.0;

/// Number of drives that are a crowd: the shortest of their beginnings that is one; `None` where not all together are.
pub(super) fn first_crowd(ordered: &[&Contribution], anchor: &Anchor, limit: usize) -> Option<usize> {
    let mut visits: BTreeMap<(i64, i64), usize> = BTreeMap::new();
    let (mut sum, mut sum_of_squares) = (0_usize, 0_usize);
    let crowded = ordered.iter().position(|contribution| {
        for square in squares(contribution, anchor) {
            let visits = visits.entry(square).or_insert(0);
            sum += 1;
            sum_of_squares += 2 * *visits + 1;
            *visits += 1;
        }
        sum > 0 && sum_of_squares >= limit * sum
    });
    crowded.map(|last| last + 1)
}

/// The squares that a drive came to, by its fixes.
fn squares(contribution: &Contribution, anchor: &Anchor) -> BTreeSet<(i64, i64)> {
    let fixes = contribution.trajectory.iter().filter_map(|point| point.fix.as_ref());
    let places = fixes.map(|fix| {
        anchor.enu_from_wgs84(&Wgs84 {
            latitude_deg: fix.latitude_deg,
            longitude_deg: fix.longitude_deg,
            height_m: fix.height_m,
        })
    });
    let corners = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)];
    places
        .flat_map(|place| {
            corners.map(|(east, north)| (square_of(place.x + east * BESIDE_M), square_of(place.y + north * BESIDE_M)))
        })
        .collect()
}

#[expect(clippy::cast_possible_truncation, reason = "the cast saturates")]
fn square_of(coordinate_m: f64) -> i64 {
    (coordinate_m / SQUARE_M).floor() as i64
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::{
        fleet::{DriveId, PlacedBy, TrajectoryPoint},
        frame::{GnssFix, TimestampNs},
        sensor::Sensor,
    };

    fn anchor() -> Anchor {
        Anchor::new(Wgs84 { latitude_deg: 48.0, longitude_deg: 11.0, height_m: 500.0 })
    }

    /// Drives of 1 km to the east, each so far north.
    fn drives(norths: impl IntoIterator<Item = f64>) -> Vec<Contribution> {
        let drive = |(number, north): (usize, f64)| {
            let trajectory = (0..250).map(|step| {
                let arc_m = 4.0 * f64::from(step);
                let place = anchor().wgs84_from_enu(&Point3::new(arc_m, north, 0.0));
                TrajectoryPoint {
                    time: TimestampNs(0),
                    arc_m,
                    position: Point3::new(arc_m, 0.0, 0.0),
                    yaw_rad: 0.0,
                    motion_variance_m2: 0.0,
                    turn_variance_rad2: 0.0,
                    fix: Some(GnssFix {
                        latitude_deg: place.latitude_deg,
                        longitude_deg: place.longitude_deg,
                        height_m: place.height_m,
                        horizontal_sigma_m: 1.5,
                        vertical_sigma_m: 2.0,
                        yaw_enu_rad: None,
                    }),
                    hidden: vec![],
                }
            });
            Contribution {
                drive: DriveId(number as u64),
                started: TimestampNs(0),
                sensor: Sensor::default(),
                placed_by: PlacedBy::Receiver,
                trajectory: trajectory.collect(),
                lanes: vec![],
            }
        };
        norths.into_iter().enumerate().map(drive).collect()
    }

    fn crowd_of(drives: &[Contribution], limit: usize) -> Option<usize> {
        first_crowd(&drives.iter().collect::<Vec<_>>(), &anchor(), limit)
    }

    #[test]
    fn on_one_road_a_crowd_has_as_many_drives_as_the_limit() {
        // Its fixes scatter about the border of two squares.
        let drives = drives((0..20).map(|number| f64::from(number % 5) - 2.0));
        assert_eq!(crowd_of(&drives, 16), Some(16));
        assert_eq!(crowd_of(&drives[..15], 16), None);
    }

    #[test]
    fn on_many_roads_it_has_more() {
        let drives = drives((0..64).map(|number| 500.0 * f64::from(number % 4)));
        assert_eq!(crowd_of(&drives, 8), Some(4 * 8));
        assert_eq!(crowd_of(&[], 8), None);
    }
}
