//! How a session starts.

use std::time::Duration;

use lanemap_core::{Preset, Sensor};
use lanemap_proto::{encode, v1};

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
    /// Most frames unacked, at least 1: what is kept in memory to be sent again.
    pub max_unacked: usize,
    /// What to do when the connection breaks.
    pub reconnect: Reconnect,
}

/// How often, and for how long, a broken connection is tried again. The pause doubles from try to try.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reconnect {
    /// Tries without any answer before the session fails; 0: a broken connection ends the session.
    pub max_tries: u32,
    /// Pause before the first try.
    pub first_pause: Duration,
    /// Longest pause.
    pub longest_pause: Duration,
}

impl Default for Reconnect {
    /// Ten tries: about half a minute.
    fn default() -> Self {
        Self { max_tries: 10, first_pause: Duration::from_millis(100), longest_pause: Duration::from_secs(5) }
    }
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
            max_unacked: 64,
            reconnect: Reconnect::default(),
        }
    }

    pub(crate) fn to_wire(&self) -> v1::SessionStart {
        v1::SessionStart {
            fleet_id: self.fleet.clone(),
            vehicle_id: self.vehicle.clone(),
            drive_id: self.drive.clone(),
            preset: encode::preset(self.preset).into(),
            sensor: Some(v1::Sensor {
                vehicle_from_sensor: Some(encode::pose(&self.sensor.vehicle_from_sensor)),
                // A `Frame` of lanemap-core holds its points in the vehicle frame.
                axis_convention: v1::AxisConvention::Vehicle.into(),
                field_of_view: self.sensor.field_of_view.as_ref().map(encode::field_of_view),
            }),
            wants_local_map: self.wants_local_map,
        }
    }
}
