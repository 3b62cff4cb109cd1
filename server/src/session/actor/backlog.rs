//! Frames that wait to be mapped, and the session's place in the line for it.
//!
//! First those that the journal has and the map has not, after a crash: they are read as they are mapped, so that a vehicle
//! that comes back is heard at once. Then those that were acked since, bounded by what may be in flight: each keeps its
//! place there until it is mapped.

use std::collections::VecDeque;

use futures::{FutureExt, future::BoxFuture};
use lanemap_core::Frame;

use super::Arrival;
use crate::{
    journal::{Journal, JournalError},
    session::{
        SessionId,
        drive::Unmapped,
        in_flight::FramePlace,
        mapping_turns::{MappingTurn, MappingTurns},
        registry::blocking,
    },
};

/// Frames read from the journal at a time.
const FRAMES_PER_READ: usize = 64;

/// The frames of one session that wait.
pub(super) struct Backlog {
    journaled: Option<Journaled>,
    acked: VecDeque<Arrival>,
    turns: MappingTurns,
    /// The place in the line, once it was asked for.
    in_line: Option<BoxFuture<'static, MappingTurn>>,
}

/// What the journal has and the map has not.
struct Journaled {
    journal: Journal,
    session: SessionId,
    /// What is still to be read.
    rest: Unmapped,
    read: VecDeque<Frame>,
    reading: Option<BoxFuture<'static, Result<Vec<Frame>, JournalError>>>,
}

/// The next frame to map.
pub(super) enum Waiting {
    /// One from the journal, of which its vehicle heard before, or hears no more.
    Journaled(Frame),
    /// One that was acked just now, and its place among those in flight.
    Acked(Frame, FramePlace),
}

impl Backlog {
    /// Nothing waits but what is `unmapped` in the journal.
    pub(super) fn new(turns: MappingTurns, journal: &Journal, session: SessionId, unmapped: Option<Unmapped>) -> Self {
        let journaled = unmapped.map(|rest| Journaled {
            journal: journal.clone(),
            session,
            rest,
            read: VecDeque::new(),
            reading: None,
        });
        Self { journaled, acked: VecDeque::new(), turns, in_line: None }
    }

    /// Adds frames that were acked.
    pub(super) fn extend(&mut self, frames: Vec<Arrival>) {
        self.acked.extend(frames);
    }

    /// Whether all frames are mapped.
    pub(super) fn is_empty(&self) -> bool {
        self.journaled.is_none() && self.acked.is_empty()
    }

    /// Frames that wait and were acked just now.
    pub(super) fn acked(&self) -> usize {
        self.acked.len()
    }

    /// Whether frames of the journal wait.
    pub(super) fn is_catching_up(&self) -> bool {
        self.journaled.is_some()
    }

    /// The next frame to map, where it is read.
    pub(super) fn pop(&mut self) -> Option<Waiting> {
        let Some(journaled) = &mut self.journaled else {
            return self.acked.pop_front().map(|Arrival { frame, place, .. }| Waiting::Acked(frame, place));
        };
        let frame = journaled.read.pop_front();
        if journaled.read.is_empty() && journaled.rest.is_empty() {
            self.journaled = None;
        }
        frame.map(Waiting::Journaled)
    }

    /// Waits for a turn at mapping; for ever where no frame waits. Who is interrupted and asks again has kept the place in
    /// the line, and must ask again soon: nobody else has the turn meanwhile.
    ///
    /// # Errors
    /// The journal cannot be read.
    pub(super) async fn turn(&mut self) -> Result<MappingTurn, JournalError> {
        if let Some(journaled) = &mut self.journaled {
            journaled.read_some().await?;
        }
        if self.is_empty() {
            return std::future::pending().await;
        }
        let turns = &self.turns;
        let in_line = self.in_line.get_or_insert_with(|| {
            let turns = turns.clone();
            async move { turns.take().await }.boxed()
        });
        let turn = in_line.await;
        self.in_line = None;
        Ok(turn)
    }
}

impl Journaled {
    /// Has the next frames at hand.
    async fn read_some(&mut self) -> Result<(), JournalError> {
        if !self.read.is_empty() {
            return Ok(());
        }
        let reading = self.reading.get_or_insert_with(|| {
            let (journal, session, rest) = (self.journal.clone(), self.session, self.rest);
            blocking(move || journal.frames_between(session, rest.after, rest.through)?.take(FRAMES_PER_READ).collect())
                .boxed()
        });
        let read = reading.await;
        self.reading = None;
        self.read.extend(read?);
        // The last one was there when the drive was read; without it nothing can be left.
        self.rest.after = Some(self.read.back().map_or(self.rest.through, Frame::sequence));
        Ok(())
    }
}
