//! A door for the fuzz targets of `tests/fuzz`, and for nobody else: the rules by which a session admits frames.

use lanemap_core::{Frame, Preset, Sensor, Sequence};

use crate::{
    journal::frame_bytes,
    privacy::TripCut,
    session::{
        SessionSetup,
        drive::{Admission, Drive},
    },
};

/// What becomes of a frame that is offered to a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offered {
    /// It is the next one, and is mapped.
    New,
    /// It came before.
    Repeated,
    /// It does not follow.
    Refused,
}

/// A drive as a session's actor holds it, without network and disk.
#[derive(Debug)]
pub struct FuzzedDrive(Drive);

impl FuzzedDrive {
    /// A drive that has had no frame.
    #[must_use]
    pub fn new(preset: Preset, sensor: Sensor) -> Self {
        Self(Drive::new(&SessionSetup { preset, sensor }, TripCut::default()))
    }

    /// Offers a frame as a stream does.
    pub fn offer(&mut self, frame: &Frame) -> Offered {
        match self.0.admit(frame, &bytes_of(frame)) {
            Admission::New => {
                self.0.map(frame);
                Offered::New
            }
            // Nothing is cut here.
            Admission::Cut | Admission::Repeated => Offered::Repeated,
            Admission::Refused(_) => Offered::Refused,
        }
    }

    /// Offers a frame as the journal does after a crash.
    ///
    /// # Errors
    /// The refusal in words.
    pub fn replay(&mut self, frame: &Frame) -> Result<(), String> {
        if self.0.replay(frame).map_err(|refusal| refusal.to_string())? {
            self.0.map(frame);
        }
        Ok(())
    }

    /// The state as bytes.
    ///
    /// # Errors
    /// It does not encode.
    pub fn snapshot(&self) -> Result<Vec<u8>, String> {
        self.0.snapshot().map_err(|error| error.to_string())
    }

    /// The drive of a snapshot.
    ///
    /// # Errors
    /// It does not decode.
    pub fn restore(bytes: &[u8]) -> Result<Self, String> {
        Drive::restore(bytes, TripCut::default()).map(Self).map_err(|error| error.to_string())
    }

    /// The last frame admitted.
    #[must_use]
    pub fn last_sequence(&self) -> Option<Sequence> {
        self.0.last_sequence()
    }
}

/// A frame as the journal keeps it.
#[must_use]
pub fn bytes_of(frame: &Frame) -> Vec<u8> {
    frame_bytes(frame).unwrap_or_default()
}
