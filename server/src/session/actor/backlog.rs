//! Frames that wait to be mapped, and the session's place in the line for it.
//!
//! They are mapped in their order, which is that of three parts:
//!
//! 1. frames that the journal has and the map has not, after a crash: a vehicle that comes back is heard before them;
//! 2. frames that were acked since, a few, which keep their place among those in flight until they are mapped;
//! 3. frames that were acked while those few were still waiting. They leave memory, and are read from the journal when it
//!    is their turn: a machine that maps too slowly for a while goes on acking, and what waits costs it no memory.

mod journaled;

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
    },
    telemetry,
};
use journaled::Journaled;

/// The frames of one session that wait.
pub(super) struct Backlog {
    /// Left by a crash.
    left: Option<Journaled>,
    acked: VecDeque<Arrival>,
    /// Acked after those.
    put_off: Option<Journaled>,
    /// Frames of `put_off`.
    put_off_count: usize,
    /// Frames at the front, acked and put off, that came by a stream before the one that is open.
    unheard: usize,
    /// Acked frames that are kept in memory, at the most.
    most_in_memory: usize,
    journal: Journal,
    session: SessionId,
    turns: MappingTurns,
    /// The place in the line, once it was asked for.
    in_line: Option<BoxFuture<'static, MappingTurn>>,
}

/// The next frame to map.
pub(super) struct Waiting {
    pub(super) frame: Frame,
    pub(super) from: Origin,
    /// Its place among those in flight, where it has kept one; free again when dropped.
    _place: Option<FramePlace>,
}

/// Where a frame that waits comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// A crash left it.
    Crash,
    /// A stream that is over: nobody waits for its pose.
    StreamBefore,
    /// The stream that is open.
    Stream,
}

impl Backlog {
    /// Nothing waits but what is `unmapped` in the journal.
    pub(super) fn new(
        turns: MappingTurns,
        journal: &Journal,
        session: SessionId,
        unmapped: Option<Unmapped>,
        most_in_memory: usize,
    ) -> Self {
        Self {
            left: unmapped.map(Journaled::new),
            acked: VecDeque::new(),
            put_off: None,
            put_off_count: 0,
            unheard: 0,
            most_in_memory,
            journal: journal.clone(),
            session,
            turns,
            in_line: None,
        }
    }

    /// Adds frames that were acked: they are in the journal.
    pub(super) fn extend(&mut self, frames: Vec<Arrival>) {
        metrics::gauge!(telemetry::FRAMES_UNMAPPED).increment(frames.len() as f64);
        for arrival in frames {
            match &mut self.put_off {
                Some(put_off) => put_off.extend_to(arrival.frame.sequence()),
                None if self.acked.len() < self.most_in_memory => {
                    self.acked.push_back(arrival);
                    continue;
                }
                None => {
                    let after = self.acked.back().map(|last| last.frame.sequence());
                    self.put_off = Some(Journaled::new(Unmapped { after, through: arrival.frame.sequence() }));
                }
            }
            self.put_off_count += 1;
        }
    }

    /// Whether all frames are mapped.
    pub(super) fn is_empty(&self) -> bool {
        self.left.is_none() && self.acked() == 0
    }

    /// Frames that wait and were acked since the drive was read.
    pub(super) fn acked(&self) -> usize {
        self.acked.len() + self.put_off_count
    }

    /// Whether frames wait that a crash left.
    pub(super) fn is_catching_up(&self) -> bool {
        self.left.is_some()
    }

    /// Whether more waits than is kept in memory.
    pub(super) fn is_long(&self) -> bool {
        self.left.is_some() || self.put_off.is_some()
    }

    /// Another stream opens: nobody waits for the poses of what the one before brought.
    pub(super) fn begin_stream(&mut self) {
        self.unheard = self.acked();
    }

    /// The next frame to map, where it is read.
    pub(super) fn pop(&mut self) -> Option<Waiting> {
        if let Some(left) = &mut self.left {
            let frame = left.pop();
            self.left.take_if(|left| left.is_done());
            return frame.map(|frame| Waiting { frame, from: Origin::Crash, _place: None });
        }
        let (frame, place) = self.pop_acked()?;
        let from = if self.unheard > 0 { Origin::StreamBefore } else { Origin::Stream };
        self.unheard = self.unheard.saturating_sub(1);
        metrics::gauge!(telemetry::FRAMES_UNMAPPED).decrement(1.0);
        Some(Waiting { frame, from, _place: place })
    }

    fn pop_acked(&mut self) -> Option<(Frame, Option<FramePlace>)> {
        if let Some(Arrival { frame, place, .. }) = self.acked.pop_front() {
            return Some((frame, Some(place)));
        }
        let put_off = self.put_off.as_mut()?;
        let frame = put_off.pop();
        self.put_off_count = self.put_off_count.saturating_sub(usize::from(frame.is_some()));
        if put_off.is_done() {
            (self.put_off, self.put_off_count) = (None, 0);
        }
        Some((frame?, None))
    }

    /// Waits for a turn at mapping; for ever where no frame waits. Who is interrupted and asks again has kept the place in
    /// the line, and must ask again soon: nobody else has the turn meanwhile.
    ///
    /// # Errors
    /// The journal cannot be read.
    pub(super) async fn turn(&mut self) -> Result<MappingTurn, JournalError> {
        let next = match &mut self.left {
            Some(left) => Some(left),
            None => self.put_off.as_mut().filter(|_| self.acked.is_empty()),
        };
        if let Some(next) = next {
            next.read_some(&self.journal, self.session).await?;
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

impl Drop for Backlog {
    fn drop(&mut self) {
        metrics::gauge!(telemetry::FRAMES_UNMAPPED).decrement(self.acked() as f64);
    }
}
