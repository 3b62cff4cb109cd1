//! The trace of a drive: the way it took, gathered frame by frame beside its mapper.
//!
//! A point is kept every [`SPACING_M`] metres, with the fix of its frame, if there is one, and what odometry claims for
//! the motion in between. Its size grows with the way and not with time: a vehicle that stands adds nothing.

use serde::{Deserialize, Serialize};

use super::contribution::{Contribution, DriveId, PlacedBy, TrajectoryPoint};
use crate::{
    frame::{Frame, TimestampNs},
    geometry::{Pose, pose::yaw_rad},
    lane_map::LaneMap,
    sensor::Sensor,
};

/// Way between two points, metres.
pub const SPACING_M: f64 = 4.0;

/// The way of a drive so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Trace {
    points: Vec<TrajectoryPoint>,
    started: Option<TimestampNs>,
    motion_variance_m2: f64,
    turn_variance_rad2: f64,
}

impl Trace {
    /// Takes a frame and the corrected pose of the vehicle at it.
    pub fn observe(&mut self, frame: &Frame, map_from_vehicle: &Pose) {
        self.started.get_or_insert(frame.time());
        if let Some(covariance) = &frame.odometry().motion_covariance {
            self.motion_variance_m2 += covariance[(0, 0)].max(covariance[(1, 1)]);
            self.turn_variance_rad2 += covariance[(5, 5)];
        }
        let position = map_from_vehicle.translation.vector.into();
        let travelled_m = match self.points.last() {
            Some(last) => nalgebra::distance(&last.position, &position),
            None => 0.0,
        };
        if !self.points.is_empty() && travelled_m < SPACING_M {
            return;
        }
        self.points.push(TrajectoryPoint {
            time: frame.time(),
            arc_m: self.points.last().map_or(0.0, |last| last.arc_m + travelled_m),
            position,
            yaw_rad: yaw_rad(map_from_vehicle),
            motion_variance_m2: std::mem::take(&mut self.motion_variance_m2),
            turn_variance_rad2: std::mem::take(&mut self.turn_variance_rad2),
            fix: frame.gnss().copied(),
            hidden: frame.occlusions().to_vec(),
        });
    }

    /// The points so far, in the order of travel.
    #[must_use]
    pub fn points(&self) -> &[TrajectoryPoint] {
        &self.points
    }

    /// What the drive says about the map; `None` before its first frame.
    #[must_use]
    pub fn contribution(&self, drive: DriveId, sensor: Sensor, map: &LaneMap) -> Option<Contribution> {
        let started = self.started?;
        let (trajectory, lanes) = (self.points.clone(), map.lanes.clone());
        Some(Contribution { drive, started, sensor, placed_by: PlacedBy::Receiver, trajectory, lanes })
    }
}
