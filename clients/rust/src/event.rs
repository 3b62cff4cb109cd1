//! What a session hears from the service.

use std::time::Duration;

use lanemap_core::{
    LaneId, LocalLane, Sequence,
    geometry::{Pose, TangentCovariance},
};
use lanemap_proto::{
    decode::{self, DecodeError},
    v1,
};
use tokio::sync::broadcast;

/// Something that the service said.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The stream is open; frames after this one are sent, or sent again.
    Opened {
        /// Last durable frame, inclusive; `None` where the drive is new.
        resume_after: Option<Sequence>,
    },
    /// Every frame up to this one, inclusive, that was not refused is durable.
    Acked(Sequence),
    /// A frame was refused.
    Refused(v1::Refusal),
    /// Frames did not come, and the service goes on without them: from here on it refuses them. Frames that are numbered
    /// without holes, and sent in their order, are never missing.
    Gap {
        /// The first number that did not come.
        first: Sequence,
        /// The last of them, inclusive.
        last: Sequence,
    },
    /// Where the vehicle is.
    Pose(Box<VehiclePose>),
    /// The map around the vehicle.
    LocalMap(LocalMap),
    /// The connection broke, or could not be made; the client tries again.
    Disconnected {
        /// Why.
        reason: String,
        /// After which pause.
        retry_in: Duration,
    },
    /// Events were lost because they were not read in time.
    Missed(u64),
}

/// Where the vehicle is in its map.
#[derive(Clone, Debug, PartialEq)]
pub struct VehiclePose {
    /// The frame to which the pose belongs.
    pub sequence: Sequence,
    /// Corrected pose, map frame, metres.
    pub map_from_vehicle: Pose,
    /// Its covariance, vehicle axes.
    pub covariance: TangentCovariance,
}

/// The map around the vehicle at one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct LocalMap {
    /// The frame.
    pub sequence: Sequence,
    /// Lanes in sight, vehicle frame, metres.
    pub lanes: Vec<LocalLane>,
    /// Lanes that this frame began.
    pub born: Vec<LaneId>,
    /// Lanes that this frame made longer.
    pub grown: Vec<LaneId>,
    /// Lanes given up at this frame, or joined to another.
    pub dropped: Vec<LaneId>,
}

/// The events of a session. The newest 4,096 are kept for a slow reader; [`Event::Missed`] tells what it lost.
#[derive(Debug)]
pub struct Events {
    receiver: broadcast::Receiver<Event>,
}

impl Events {
    pub(crate) fn new(receiver: broadcast::Receiver<Event>) -> Self {
        Self { receiver }
    }

    /// The next event; `None` once the session is over.
    pub async fn next(&mut self) -> Option<Event> {
        match self.receiver.recv().await {
            Ok(event) => Some(event),
            Err(broadcast::error::RecvError::Lagged(count)) => Some(Event::Missed(count)),
            Err(broadcast::error::RecvError::Closed) => None,
        }
    }
}

pub(crate) fn pose(message: &v1::PoseUpdate) -> Result<VehiclePose, DecodeError> {
    let covariance = decode::required(message.covariance.as_ref(), || "pose.covariance".to_owned())?;
    Ok(VehiclePose {
        sequence: Sequence(message.sequence),
        map_from_vehicle: decode::pose(message.map_from_vehicle.as_ref(), "pose.map_from_vehicle")?,
        covariance: decode::tangent_covariance(covariance, "pose.covariance")?,
    })
}

pub(crate) fn local_map(message: &v1::LocalMapUpdate) -> Result<LocalMap, DecodeError> {
    let ids = |ids: &[u64]| ids.iter().copied().map(LaneId).collect();
    Ok(LocalMap {
        sequence: Sequence(message.sequence),
        lanes: message.lanes.iter().map(decode::local_lane).collect::<Result<_, _>>()?,
        born: ids(&message.born),
        grown: ids(&message.grown),
        dropped: ids(&message.dropped),
    })
}
