//! What the store keeps of a session besides its frames.

use std::fmt;

use lanemap_core::{Preset, Sensor};
use serde::{Deserialize, Serialize};

use crate::{
    privacy::{DrivePseudonym, TripCut, VehiclePseudonym},
    session::SessionId,
};

/// The names under which a vehicle opens and resumes a drive. They go no further than the stream that brought them: the
/// store, the logs and the readers of maps know pseudonyms. `{:?}` does not show them.
#[derive(Clone, PartialEq, Eq)]
pub struct SessionKey {
    /// The fleet.
    pub fleet: String,
    /// The vehicle within the fleet.
    pub vehicle: String,
    /// The drive of the vehicle, chosen by the client.
    pub drive: String,
}

impl fmt::Debug for SessionKey {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("SessionKey(..)")
    }
}

/// How a drive is mapped; does not change within it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SessionSetup {
    /// Which mapper.
    pub preset: Preset,
    /// The camera.
    pub sensor: Sensor,
}

/// A session as the store knows it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SessionRecord {
    /// The server's name of the session.
    pub id: SessionId,
    /// The drive, by which it is found again.
    pub drive: DrivePseudonym,
    /// The vehicle, by which all of its drives are found when they are to be deleted.
    pub vehicle: VehiclePseudonym,
    /// How it is mapped.
    pub setup: SessionSetup,
    /// What is cut off its trips.
    pub cut: TripCut,
    /// Whether the drive is over.
    pub ended: bool,
}
