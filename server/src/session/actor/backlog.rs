//! Acked frames that wait to be mapped, and the session's place in the line for it.
//!
//! Bounded by what may be in flight: each frame keeps its place there until it is mapped.

use std::collections::VecDeque;

use futures::{FutureExt, future::BoxFuture};

use super::Arrival;
use crate::session::mapping_turns::{MappingTurn, MappingTurns};

/// The frames of one session that wait.
pub(super) struct Backlog {
    frames: VecDeque<Arrival>,
    turns: MappingTurns,
    /// The place in the line, once it was asked for.
    in_line: Option<BoxFuture<'static, MappingTurn>>,
}

impl Backlog {
    /// Nothing waits.
    pub(super) fn new(turns: MappingTurns) -> Self {
        Self { frames: VecDeque::new(), turns, in_line: None }
    }

    /// Adds frames that were acked.
    pub(super) fn extend(&mut self, frames: Vec<Arrival>) {
        self.frames.extend(frames);
    }

    /// Whether all that was acked is mapped.
    pub(super) fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// The next frame to map.
    pub(super) fn pop(&mut self) -> Option<Arrival> {
        self.frames.pop_front()
    }

    /// Waits for a turn at mapping; for ever where no frame waits. Who is interrupted and asks again has kept the place in
    /// the line, and must ask again soon: nobody else has the turn meanwhile.
    pub(super) async fn turn(&mut self) -> MappingTurn {
        if self.frames.is_empty() {
            return std::future::pending().await;
        }
        let turns = &self.turns;
        let in_line = self.in_line.get_or_insert_with(|| {
            let turns = turns.clone();
            async move { turns.take().await }.boxed()
        });
        let turn = in_line.await;
        self.in_line = None;
        turn
    }
}
