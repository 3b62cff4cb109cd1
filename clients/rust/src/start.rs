//! How a session starts.

use lanemap_core::{Preset, Sensor};
use lanemap_proto::{encode, v1};

use crate::{reconnect::Reconnect, spool::SpoolOptions};

/// Frames unacked where the owner says nothing.
pub(crate) const MAX_UNACKED: usize = 64;

/// Which drive to stream, and how it is mapped.
#[derive(Clone, Debug, PartialEq)]
pub struct SessionStart {
    /// The fleet, 1 to 128 characters.
    pub fleet: String,
    /// The vehicle within the fleet, 1 to 128 characters.
    pub vehicle: String,
    /// The drive of the vehicle, 1 to 128 characters: the same id resumes the same drive.
    pub drive: String,
    /// Which mapper.
    pub preset: Preset,
    /// The camera.
    pub sensor: Sensor,
    /// Whether [`Event::LocalMap`](crate::Event::LocalMap) is wanted after every frame.
    pub wants_local_map: bool,
    /// Most frames sent and not acked, at least 1; fewer where the service says so. Without a spool these are also the
    /// frames kept, in memory, to be sent again.
    pub max_unacked: usize,
    /// What to do when the connection breaks.
    pub reconnect: Reconnect,
    /// Where frames wait on disk until they are acked; `None`: in memory.
    pub spool: Option<SpoolOptions>,
}

impl SessionStart {
    /// A drive with the default mapper, a sensor at the vehicle's origin, and up to 64 frames unacked.
    #[must_use]
    pub fn new(fleet: impl Into<String>, vehicle: impl Into<String>, drive: impl Into<String>) -> Self {
        Self {
            fleet: fleet.into(),
            vehicle: vehicle.into(),
            drive: drive.into(),
            preset: Preset::Default,
            sensor: Sensor::default(),
            wants_local_map: false,
            max_unacked: MAX_UNACKED,
            reconnect: Reconnect::default(),
            spool: None,
        }
    }

    pub(crate) fn to_wire(&self) -> v1::SessionStart {
        v1::SessionStart {
            fleet_id: self.fleet.clone(),
            vehicle_id: self.vehicle.clone(),
            drive_id: self.drive.clone(),
            preset: encode::preset(self.preset).into(),
            sensor: Some(encode::sensor(&self.sensor)),
            wants_local_map: self.wants_local_map,
        }
    }
}
