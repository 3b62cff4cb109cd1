//! What the store keeps of a session besides its frames.

use lanemap_core::{Preset, Sensor};
use serde::{Deserialize, Serialize};

use crate::session::SessionId;

/// The key under which a vehicle opens and resumes a drive. Never shown to map consumers.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SessionKey {
    /// The fleet.
    pub fleet: String,
    /// The vehicle within the fleet.
    pub vehicle: String,
    /// The drive of the vehicle, chosen by the client.
    pub drive: String,
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
    /// The vehicle's name of it.
    pub key: SessionKey,
    /// How it is mapped.
    pub setup: SessionSetup,
    /// Whether the drive is over.
    pub ended: bool,
}
