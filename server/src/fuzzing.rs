//! A door for the fuzz targets of `tests/fuzz`, and for nobody else: the rules by which a session puts
//! frames in order and admits them.

use std::{ops::RangeInclusive, time::Duration};

use lanemap_core::{Frame, Preset, Sensor, Sequence};
use tokio::time::Instant;

use crate::{
    journal::frame_bytes,
    privacy::TripCut,
    session::{
        SessionSetup,
        drive::{Admission, Drive},
        reorder::{Offer, Passed, Reorder},
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

/// What passes a window of order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ordered {
    /// The next frame.
    Frame(u64),
    /// Numbers that did not come.
    Gap(RangeInclusive<u64>),
}

/// A window of order as a session's actor holds it; a frame is its number, time is milliseconds from its making.
#[derive(Debug)]
pub struct FuzzedOrder {
    reorder: Reorder<u64>,
    began: Instant,
}

impl FuzzedOrder {
    /// A window of `max_held` frames for `max_wait_ms`, after the frame `last`.
    #[must_use]
    pub fn new(max_held: usize, max_wait_ms: u64, last: Option<Sequence>) -> Self {
        let max_wait = Duration::from_millis(max_wait_ms);
        Self { reorder: Reorder::new(max_held, max_wait, last), began: Instant::now() }
    }

    /// Whether a number is of the past.
    #[must_use]
    pub fn has_passed(&self, sequence: Sequence) -> bool {
        self.reorder.has_passed(sequence)
    }

    /// Offers a frame whose number has not passed; `false`: it is held already.
    pub fn offer(&mut self, sequence: Sequence, at_ms: u64) -> bool {
        let arrived = self.at(at_ms);
        matches!(self.reorder.offer(sequence, sequence.0, arrived), Offer::Taken)
    }

    /// Takes note of a refused number.
    pub fn refused(&mut self, sequence: Sequence) {
        self.reorder.refused(sequence);
    }

    /// What passes next by then.
    pub fn pass(&mut self, at_ms: u64) -> Option<Ordered> {
        let now = self.at(at_ms);
        self.reorder.pass(now).map(ordered)
    }

    /// What passes next where nothing more comes.
    pub fn pass_last(&mut self) -> Option<Ordered> {
        self.reorder.pass_last().map(ordered)
    }

    /// A new stream begins after `last`.
    pub fn restart(&mut self, last: Option<Sequence>) {
        self.reorder.restart(last);
    }

    fn at(&self, ms: u64) -> Instant {
        self.began + Duration::from_millis(ms)
    }
}

fn ordered(passed: Passed<u64>) -> Ordered {
    match passed {
        Passed::Frame(number) => Ordered::Frame(number),
        Passed::Gap(numbers) => Ordered::Gap(numbers),
    }
}
