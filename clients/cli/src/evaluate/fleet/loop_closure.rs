//! How well a drive that comes back over its own road closes its loop.
//!
//! Where a drive truly passes within [`MEETING_M`] of where it was at least [`LEAST_LOOP_M`] of way before, its corrected
//! places are off by `e_1` the first time and by `e_2` the second. `e_2 - e_1`, across its way and in height, is what is left
//! open: a bias that both have in common is not in it.

use std::collections::BTreeMap;

use lanemap_core::{
    Pose, TimestampNs,
    evaluation::{fleet_score::Quantiles, quantile},
    fleet::{Contribution, DriveId, FusedMap},
};
use lanemap_simulator::fleet::Fleet;
use nalgebra::{Point3, Vector2, Vector3};

/// Distance at which two places of a way meet, metres.
const MEETING_M: f64 = 20.0;
/// Least way between them, metres.
const LEAST_LOOP_M: f64 = 500.0;

/// Where a drive truly went.
pub struct TrueWay {
    drive: DriveId,
    poses: BTreeMap<TimestampNs, Pose>,
    /// Where its map frame truly lies.
    world_from_map: Pose,
}

/// What is left open of a loop, metres.
#[derive(Clone, Copy, Debug)]
pub struct LoopClosure {
    /// Places that were passed twice.
    pub places: usize,
    pub lateral: Quantiles,
    pub height: Quantiles,
    /// What odometry and the mapper alone leave open, the median.
    pub by_odometry_m: f64,
}

/// A place of a way: its arc length, and by how much it is off as corrected and by odometry.
struct Passing {
    arc_m: f64,
    place: Point3<f64>,
    left: Vector2<f64>,
    corrected: Vector3<f64>,
    by_odometry: Vector3<f64>,
}

/// The true ways of a fleet.
pub fn true_ways(fleet: &Fleet) -> Vec<TrueWay> {
    let way = |number: u32| {
        let drive = fleet.drive(number);
        TrueWay {
            drive: DriveId(u64::from(number)),
            poses: drive.states().iter().map(|state| (state.time, state.world_from_vehicle)).collect(),
            world_from_map: drive.world_from_odometry(),
        }
    };
    (0..fleet.scenario().drives).map(way).collect()
}

impl TrueWay {
    /// What is left open of this drive in a map; `None` where it was kept apart or never came back.
    pub fn closure(&self, drives: &[Contribution], map: &FusedMap) -> Option<LoopClosure> {
        let contribution = drives.iter().find(|contribution| contribution.drive == self.drive)?;
        let correction = map.drives.iter().find(|drive| drive.drive == self.drive)?.correction.as_ref()?;
        let passings = contribution.trajectory.iter().filter_map(|point| {
            let truth = self.poses.get(&point.time)?;
            let place = Point3::from(truth.translation.vector);
            let ahead = (truth.rotation * Vector3::x()).xy().normalize();
            Some(Passing {
                arc_m: point.arc_m,
                place,
                left: Vector2::new(-ahead.y, ahead.x),
                corrected: correction.apply(&point.position, point.arc_m) - place,
                by_odometry: self.world_from_map * point.position - place,
            })
        });
        let passings: Vec<Passing> = passings.collect();
        let meetings = passings.iter().filter_map(|second| {
            let distance_m = |first: &Passing| (first.place - second.place).xy().norm();
            let before = passings.iter().filter(|first| second.arc_m - first.arc_m > LEAST_LOOP_M);
            let first = before.min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)))?;
            (distance_m(first) < MEETING_M).then_some((first, second))
        });
        let meetings: Vec<(&Passing, &Passing)> = meetings.collect();
        let each = |open: &dyn Fn(&Passing, &Passing) -> f64| -> Vec<f64> {
            meetings.iter().map(|(first, second)| open(first, second).abs()).collect()
        };
        let quantiles =
            |mut values: Vec<f64>| Quantiles { p50: quantile(&mut values, 0.5), p95: quantile(&mut values, 0.95) };
        (!meetings.is_empty()).then(|| LoopClosure {
            places: meetings.len(),
            lateral: quantiles(each(&|first, second| (second.corrected - first.corrected).xy().dot(&second.left))),
            height: quantiles(each(&|first, second| second.corrected.z - first.corrected.z)),
            by_odometry_m: quantiles(each(&|first, second| (second.by_odometry - first.by_odometry).xy().norm())).p50,
        })
    }
}
