//! Redundancy: which drives of a cell are missed least, where there are more than it keeps.
//!
//! The way of a drive is cut into steps, each at a place: a square of the land and a direction of travel. Let `n_p` be the
//! number of younger drives that passed place `p`, and `k` the number that makes a crowd. What would be missed without
//! drive `d` is
//!
//! `m_d = steps of d with n_p < k / steps of d`.
//!
//! Let go of is the oldest drive with `m_d = 0`; where there is none, the one with the least `m_d`, of several the oldest;
//! and so on, until as many are left as are kept. Example: of ten drives that went along a main road, the oldest also went
//! through a side street. Kept are four, a crowd is two: the second is let go of, then the third, until the first and the
//! three youngest are left. So a place that was ever passed keeps as many of its youngest drives as make a crowd, as long
//! as there is room for them all.
//!
//! Drives are placed by GNSS and odometry alone. Not guaranteed: that roads beside each other within the error of the
//! receivers are told apart; and where the rule has been used before, what is left depends on what was there then, beyond
//! the youngest crowd of each place.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    contribution::{Contribution, DriveId},
    georeferenced::by_gnss,
    params::FleetParams,
    prepared::Restraints,
    ways::WayPoint,
};
use crate::{frame::TimestampNs, geometry::georeference::Anchor};

/// Side of a square, metres.
const SQUARE_M: f64 = 20.0;
/// A drive passed the squares within so many metres of its way to each side: what receivers are off by.
const BESIDE_M: f64 = 10.0;
/// Least cosine of the angle between a way and each direction, of four, that it counts to: to two of them at most.
const LEAST_COS: f64 = 0.38;

/// East, north, and which of four directions.
type Place = (i64, i64, u8);

/// Where a drive went.
#[derive(Clone, Debug, PartialEq)]
pub struct Visits {
    seniority: (TimestampNs, DriveId),
    /// The places that it passed, in their order, with how many of its steps lie in each: 0 where it passed beside.
    places: Vec<(Place, u32)>,
    steps: u32,
}

impl Visits {
    /// Where a drive went, by its own fixes and odometry: nowhere, if it has no fix.
    #[must_use]
    pub fn of(contribution: &Contribution, anchor: &Anchor, params: &FleetParams) -> Self {
        let trajectory = &contribution.trajectory;
        let correction = by_gnss(trajectory, &Restraints::new(contribution, anchor, params), params);
        let mut places: BTreeMap<Place, u32> = BTreeMap::new();
        let mut steps = 0;
        let way = correction.iter().flat_map(|correction| WayPoint::along(trajectory, correction));
        for (_, point) in way {
            let (east, north) = (point.place.x, point.place.y);
            let corners = [(0.0, 0.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)];
            for direction in directions(&point) {
                for (index, (right, up)) in corners.into_iter().enumerate() {
                    let place = (square_of(east + right * BESIDE_M), square_of(north + up * BESIDE_M), direction);
                    let own = places.entry(place).or_insert(0);
                    *own += u32::from(index == 0);
                    steps += u32::from(index == 0);
                }
            }
        }
        Self { seniority: contribution.seniority(), places: places.into_iter().collect(), steps }
    }
}

/// The directions, of four, that a way counts to.
fn directions(point: &WayPoint) -> impl Iterator<Item = u8> {
    let direction = point.direction;
    let cosines = [direction.x, direction.y, -direction.x, -direction.y];
    (0_u8..).zip(cosines).filter(|(_, cosine)| *cosine >= LEAST_COS).map(|(index, _)| index)
}

#[expect(clippy::cast_possible_truncation, reason = "the cast saturates")]
fn square_of(coordinate_m: f64) -> i64 {
    (coordinate_m / SQUARE_M).floor() as i64
}

/// The drives that are let go of so that at most `most` are left: indices of `drives`, in the order in which they go.
///
/// The same drives go whatever their order in the slice. Where few are kept, half of them are a crowd.
#[must_use]
pub fn missed_least<'a>(drives: impl IntoIterator<Item = &'a Visits>, most: usize, params: &FleetParams) -> Vec<usize> {
    let drives: Vec<&Visits> = drives.into_iter().collect();
    let crowd = params.drives_apart.min(most / 2).max(1);
    let mut left: BTreeSet<usize> = (0..drives.len()).collect();
    let mut by_age: Vec<usize> = (0..drives.len()).collect();
    by_age.sort_by_key(|drive| drives[*drive].seniority);
    let mut cover = Cover::new(&drives, &by_age, crowd);
    let mut gone = Vec::new();
    while left.len() > most {
        let in_turn = || by_age.iter().copied().filter(|drive| left.contains(drive));
        let share = |drive: usize| (u64::from(cover.missed[drive]), u64::from(drives[drive].steps.max(1)));
        // The first of equals is the oldest.
        let least = in_turn().min_by(|one, other| {
            let ((missed, steps), (missed_too, steps_too)) = (share(*one), share(*other));
            (missed * steps_too).cmp(&(missed_too * steps))
        });
        let Some(least) = least else { break };
        cover.remove(drives[least], least);
        left.remove(&least);
        gone.push(least);
    }
    gone
}

/// Who passed each place.
struct Cover {
    crowd: usize,
    /// Rank of each drive: 0 is the oldest.
    rank: Vec<usize>,
    /// Those that passed a place, the youngest first, with how many of their steps lie in it.
    passed: BTreeMap<Place, Vec<(usize, u32)>>,
    /// Steps of each drive at places that no crowd of younger ones passed.
    missed: Vec<u32>,
}

impl Cover {
    fn new(drives: &[&Visits], by_age: &[usize], crowd: usize) -> Self {
        let mut rank = vec![0; drives.len()];
        for (age, drive) in by_age.iter().enumerate() {
            rank[*drive] = age;
        }
        let (mut passed, mut missed) = (BTreeMap::<Place, Vec<_>>::new(), vec![0; drives.len()]);
        for drive in by_age.iter().rev() {
            for (place, own) in &drives[*drive].places {
                let passed = passed.entry(*place).or_default();
                if passed.len() < crowd {
                    missed[*drive] += own;
                }
                passed.push((*drive, *own));
            }
        }
        Self { crowd, rank, passed, missed }
    }

    /// Without a drive the next older one may be among the youngest crowd of a place.
    fn remove(&mut self, visits: &Visits, drive: usize) {
        for (place, _) in &visits.places {
            let Some(passed) = self.passed.get_mut(place) else { continue };
            let at = passed.partition_point(|(other, _)| self.rank[*other] > self.rank[drive]);
            passed.remove(at);
            if at < self.crowd
                && let Some((next, own)) = passed.get(self.crowd - 1)
            {
                self.missed[*next] += own;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use proptest::prelude::*;

    use super::*;
    use crate::{
        fleet::{PlacedBy, TrajectoryPoint},
        frame::GnssFix,
        geometry::georeference::Wgs84,
        sensor::Sensor,
    };

    fn anchor() -> Anchor {
        Anchor::new(Wgs84 { latitude_deg: 48.0, longitude_deg: 11.0, height_m: 500.0 })
    }

    /// A drive along corners of its way, in metres to the east and the north, with a receiver that is off to the north.
    fn drive(number: u64, corners: &[(f64, f64)], off_m: f64) -> Contribution {
        let mut trajectory: Vec<TrajectoryPoint> = Vec::new();
        for pair in corners.windows(2) {
            let (east_m, north_m) = (pair[1].0 - pair[0].0, pair[1].1 - pair[0].1);
            let length_m = east_m.hypot(north_m);
            let mut on_m = 0.0;
            while on_m < length_m {
                let share = on_m / length_m;
                let position = Point3::new(pair[0].0 + share * east_m, pair[0].1 + share * north_m, 0.0);
                let place = anchor().wgs84_from_enu(&(position + nalgebra::Vector3::y() * off_m));
                trajectory.push(TrajectoryPoint {
                    time: TimestampNs(0),
                    arc_m: 4.0 * trajectory.len() as f64,
                    position,
                    yaw_rad: north_m.atan2(east_m),
                    motion_variance_m2: 1e-4,
                    turn_variance_rad2: 1e-6,
                    fix: Some(GnssFix {
                        latitude_deg: place.latitude_deg,
                        longitude_deg: place.longitude_deg,
                        height_m: place.height_m,
                        horizontal_sigma_m: 1.5,
                        vertical_sigma_m: 2.0,
                        yaw_enu_rad: None,
                    }),
                    hidden: vec![],
                });
                on_m += 4.0;
            }
        }
        Contribution {
            drive: DriveId(number),
            started: TimestampNs(i64::try_from(number).unwrap()),
            sensor: Sensor::default(),
            placed_by: PlacedBy::Receiver,
            trajectory,
            lanes: vec![],
        }
    }

    const MAIN: [(f64, f64); 2] = [(0.0, 0.0), (800.0, 0.0)];
    /// Along the main road, and 120 m into a side street.
    const SIDE: [(f64, f64); 3] = [(0.0, 0.0), (400.0, 0.0), (400.0, 120.0)];
    const BACK: [(f64, f64); 2] = [(800.0, 0.0), (0.0, 0.0)];

    fn visits(drives: &[Contribution]) -> Vec<Visits> {
        drives.iter().map(|drive| Visits::of(drive, &anchor(), &FleetParams::default())).collect()
    }

    fn gone(drives: &[Contribution], most: usize) -> Vec<usize> {
        missed_least(&visits(drives), most, &FleetParams::default())
    }

    /// Drives along the main road whose receivers scatter by metres.
    fn along_the_main_road(numbers: std::ops::Range<u64>) -> Vec<Contribution> {
        numbers.map(|number| drive(number, &MAIN, (number * 5 % 9) as f64 - 4.0)).collect()
    }

    #[test]
    fn the_only_drive_through_a_side_street_stays_and_the_oldest_of_the_others_go() {
        let mut drives = vec![drive(0, &SIDE, 2.0)];
        drives.extend(along_the_main_road(1..10));
        assert_eq!(gone(&drives, 4), [1, 2, 3, 4, 5, 6]);
        drives.extend(along_the_main_road(10..40));
        assert_eq!(gone(&drives, 38), [1, 2], "and where a crowd is as large as elsewhere");
    }

    #[test]
    fn on_one_road_the_oldest_go() {
        assert_eq!(gone(&along_the_main_road(0..40), 36), [0, 1, 2, 3]);
        assert_eq!(gone(&along_the_main_road(0..3), 2), [0]);
        assert_eq!(gone(&along_the_main_road(0..3), 3), [0; 0]);
    }

    #[test]
    fn whoever_went_the_other_way_is_not_replaced_by_those_that_he_met() {
        let mut drives = vec![drive(0, &BACK, 0.0)];
        drives.extend(along_the_main_road(1..6));
        assert_eq!(gone(&drives, 4), [1, 2]);
    }

    #[test]
    fn where_all_are_missed_the_one_goes_of_whose_way_the_most_is_covered() {
        // Nobody else was in the side street of each; the third went along the main road for longest.
        let aside = |number: u64, east: f64| drive(number, &[(0.0, 0.0), (east, 0.0), (east, 100.0)], 0.0);
        let mut drives = vec![aside(0, 200.0), aside(1, 400.0), aside(2, 700.0)];
        drives.extend(along_the_main_road(3..5));
        assert_eq!(gone(&drives, 4), [2]);
    }

    #[test]
    fn nobody_misses_a_drive_without_a_fix() {
        let mut drives = vec![drive(0, &SIDE, 0.0), drive(1, &MAIN, 0.0), drive(2, &MAIN, 0.0)];
        assert_eq!(gone(&drives, 2), [1]);
        for point in &mut drives[2].trajectory {
            point.fix = None;
        }
        assert_eq!(gone(&drives, 2), [2], "nor does it pass where the others went");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn as_many_are_left_as_are_kept_whatever_the_order_and_every_place_keeps_its_youngest_crowd_that_fits(
            streets in prop::collection::vec((0_u8..6, -5.0..5.0), 1..40),
            most in 1_usize..40,
            turn in 0_usize..40,
        ) {
            let drives: Vec<Contribution> = (0_u64..)
                .zip(&streets)
                .map(|(number, (street, off_m))| {
                    let north = 60.0 * f64::from(*street);
                    drive(number, &[(0.0, 0.0), (0.0, north + 1.0), (200.0, north + 1.0)], *off_m)
                })
                .collect();
            let params = FleetParams::default();
            let visits = visits(&drives);
            let gone = missed_least(&visits, most, &params);
            prop_assert_eq!(gone.len(), drives.len().saturating_sub(most));

            let count = drives.len();
            let turned: Vec<usize> = (0..count).map(|index| (index + turn) % count).collect();
            let in_other_order: Vec<Visits> = turned.iter().map(|index| visits[*index].clone()).collect();
            let named = missed_least(&in_other_order, most, &params).into_iter().map(|index| turned[index]);
            prop_assert_eq!(named.collect::<Vec<_>>(), gone.clone());

            let crowd = params.drives_apart.min(most / 2).max(1);
            let needed = |drive: usize, all: &[usize]| {
                visits[drive].places.iter().any(|(place, own)| {
                    let passed = |other: &&usize| {
                        **other > drive && visits[**other].places.iter().any(|(passed, _)| passed == place)
                    };
                    *own > 0 && all.iter().filter(passed).count() < crowd
                })
            };
            let all: Vec<usize> = (0..count).collect();
            let those_needed = all.iter().filter(|drive| needed(**drive, &all)).count();
            let kept: Vec<usize> = all.iter().copied().filter(|drive| !gone.contains(drive)).collect();
            if kept.iter().all(|drive| needed(*drive, &kept)) || those_needed > most {
                return Ok(());
            }
            prop_assert!(gone.iter().all(|drive| !needed(*drive, &all)), "{gone:?}");
        }
    }
}
