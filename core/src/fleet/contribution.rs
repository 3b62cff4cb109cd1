//! What one drive says about the map: its lanes, the way it took, and its GNSS fixes, all in the drive's own frame.
//!
//! A contribution is a record of the drive so far; a later one of the same drive replaces it. It needs no other drive to
//! be made, and nothing of it changes when the shared map does.

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::{
    frame::{GnssFix, Occlusion, TimestampNs},
    lane_map::MapLane,
    sensor::Sensor,
};

/// A drive's name in the shared map. Says nothing of the vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct DriveId(pub u64);

/// Whence the fixes of a contribution come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum PlacedBy {
    /// From the vehicle's receiver: they say where the map lies on the earth.
    #[default]
    Receiver,
    /// From the map itself ([`localization`](super::localization)): they say where on it the drive lies, and nothing of
    /// where the map does.
    Map,
}

/// What one drive says about the map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Contribution {
    /// The drive.
    pub drive: DriveId,
    /// Time of its first frame. Drives are fused in this order, then by their names.
    pub started: TimestampNs,
    /// The camera that saw the lanes.
    pub sensor: Sensor,
    /// Whence its fixes come.
    pub placed_by: PlacedBy,
    /// The way that the vehicle took, in the order of travel.
    pub trajectory: Vec<TrajectoryPoint>,
    /// Its lanes, in the order of their numbers, map frame of the drive.
    pub lanes: Vec<MapLane>,
}

/// A place on the way of a drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryPoint {
    /// Time at which the vehicle was there.
    pub time: TimestampNs,
    /// Way from the start of the drive, metres.
    pub arc_m: f64,
    /// Position of the vehicle's origin, map frame of the drive, metres.
    pub position: Point3<f64>,
    /// Heading in the map frame, radians.
    pub yaw_rad: f64,
    /// Variance that odometry claims for the motion since the point before, horizontally, m^2.
    pub motion_variance_m2: f64,
    /// Variance that odometry claims for the turn since the point before, rad^2.
    pub turn_variance_rad2: f64,
    /// The GNSS fix taken there.
    pub fix: Option<GnssFix>,
    /// What other vehicles hid from the camera there.
    pub hidden: Vec<Occlusion>,
}

impl TrajectoryPoint {
    /// Whether something hid a place on the road from the camera, so many metres ahead and to the left of the vehicle.
    pub(super) fn hides(&self, ahead_m: f64, left_m: f64, sensor: &Sensor) -> bool {
        let place = Point3::new(ahead_m, left_m, 0.0);
        self.hidden.iter().any(|occlusion| occlusion.hides(&place, sensor))
    }
}

impl Contribution {
    /// The order in which drives are fused, which is also that of their claim to be a line's name.
    #[must_use]
    pub fn seniority(&self) -> (TimestampNs, DriveId) {
        (self.started, self.drive)
    }
}
