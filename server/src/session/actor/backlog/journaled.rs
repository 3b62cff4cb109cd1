//! Frames that wait in the journal, read a few at a time.

use std::collections::VecDeque;

use futures::{FutureExt, future::BoxFuture};
use lanemap_core::{Frame, Sequence};

use crate::{
    journal::{Journal, JournalError},
    session::{SessionId, drive::Unmapped, registry::blocking},
};

/// Frames read from the journal at a time.
const FRAMES_PER_READ: usize = 64;

/// Frames that the journal has and the map has not.
pub(super) struct Journaled {
    /// What is still to be read.
    rest: Unmapped,
    read: VecDeque<Frame>,
    reading: Option<BoxFuture<'static, Result<Piece, JournalError>>>,
}

/// What was read at a time.
struct Piece {
    frames: Vec<Frame>,
    /// Every frame up to this one is among them, or is not there.
    through: Sequence,
}

impl Journaled {
    pub(super) fn new(rest: Unmapped) -> Self {
        Self { rest, read: VecDeque::new(), reading: None }
    }

    /// One more frame, the last so far, is in the journal.
    pub(super) fn extend_to(&mut self, last: Sequence) {
        self.rest.through = last;
    }

    /// The next frame, where it is read.
    pub(super) fn pop(&mut self) -> Option<Frame> {
        self.read.pop_front()
    }

    /// Whether none is left.
    pub(super) fn is_done(&self) -> bool {
        self.read.is_empty() && self.rest.is_empty()
    }

    /// Has the next frames at hand.
    pub(super) async fn read_some(&mut self, journal: &Journal, session: SessionId) -> Result<(), JournalError> {
        if !self.read.is_empty() {
            return Ok(());
        }
        let reading = self.reading.get_or_insert_with(|| {
            let (journal, rest) = (journal.clone(), self.rest);
            blocking(move || read_piece(&journal, session, rest)).boxed()
        });
        let piece = reading.await;
        self.reading = None;
        let piece = piece?;
        self.rest.after = Some(piece.through);
        self.read.extend(piece.frames);
        Ok(())
    }
}

fn read_piece(journal: &Journal, session: SessionId, rest: Unmapped) -> Result<Piece, JournalError> {
    let frames = journal.frames_between(session, rest.after, rest.through)?.take(FRAMES_PER_READ);
    let frames = frames.collect::<Result<Vec<Frame>, _>>()?;
    let is_full = frames.len() == FRAMES_PER_READ;
    // What is not there now never was: frames are mapped after they are durable.
    let through = frames.last().filter(|_| is_full).map_or(rest.through, Frame::sequence);
    Ok(Piece { frames, through })
}
