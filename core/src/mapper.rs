//! The mapper: one vehicle's frames in, one drive's lane map out.

use serde::{Deserialize, Serialize};

use crate::{
    error::SnapshotError,
    frame::{Frame, Sequence},
    geometry::{Pose, TangentCovariance},
    lane_map::{LaneId, LaneMap, LocalLane, LocalWindow},
    params::Params,
    sensor::Sensor,
};

/// A mapper of one drive. Deterministic: the same frames give the same bytes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Mapper {
    params: Params,
    sensor: Sensor,
    map_from_vehicle: Pose,
}

/// A detection that was taken for a lane of the map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AssociatedDetection {
    /// Index of the detection in its frame.
    pub detection: usize,
    /// The lane.
    pub lane: LaneId,
}

/// What one step changed.
#[derive(Clone, Debug, PartialEq)]
pub struct StepReport {
    /// The frame's number.
    pub sequence: Sequence,
    /// Detections taken for lanes that the map already had.
    pub associated: Vec<AssociatedDetection>,
    /// Detections that began a lane.
    pub born: Vec<AssociatedDetection>,
    /// Lanes that became longer.
    pub grown: Vec<LaneId>,
    /// Lanes that were given up, or joined to another.
    pub dropped: Vec<LaneId>,
    /// Corrected pose of the vehicle in the map frame.
    pub map_from_vehicle: Pose,
    /// Covariance of that pose relative to the map around it, in the vehicle's axes.
    pub covariance: TangentCovariance,
}

impl Mapper {
    /// A mapper that knows nothing yet. Its map frame is the odometry frame of the drive at the first frame.
    #[must_use]
    pub fn new(params: Params, sensor: Sensor) -> Self {
        Self { params, sensor, map_from_vehicle: Pose::identity() }
    }

    /// Takes one frame. Frames come in the order of their sequence; the caller sees to that.
    pub fn step(&mut self, frame: &Frame) -> StepReport {
        self.map_from_vehicle = frame.odometry().odometry_from_vehicle;
        StepReport {
            sequence: frame.sequence(),
            associated: Vec::new(),
            born: Vec::new(),
            grown: Vec::new(),
            dropped: Vec::new(),
            map_from_vehicle: self.map_from_vehicle,
            covariance: TangentCovariance::zeros(),
        }
    }

    /// Corrected pose of the vehicle at the last frame.
    #[must_use]
    pub fn map_from_vehicle(&self) -> Pose {
        self.map_from_vehicle
    }

    /// Parameters of this mapper.
    #[must_use]
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// Every lane of the drive that is worth showing.
    #[must_use]
    pub fn lane_map(&self) -> LaneMap {
        LaneMap::default()
    }

    /// The map around the vehicle at the last frame, in its own axes.
    #[must_use]
    pub fn local_map(&self, _window: &LocalWindow) -> Vec<LocalLane> {
        Vec::new()
    }

    /// The whole state as bytes; [`Mapper::restore`] goes on from there as if nothing had happened.
    #[must_use]
    pub fn snapshot(&self) -> Vec<u8> {
        postcard::to_stdvec(self).unwrap_or_default()
    }

    /// A mapper from the bytes of [`Mapper::snapshot`].
    ///
    /// # Errors
    /// Bytes of another format version, or that do not decode.
    pub fn restore(bytes: &[u8]) -> Result<Self, SnapshotError> {
        Ok(postcard::from_bytes(bytes)?)
    }
}
