//! Turns at mapping: as many sessions map at a time as the machine has cores, the others wait in line.
//!
//! Steps of mappers are most of the service's work. Were every session with frames to map ready to run, whatever reads,
//! journals and acks frames would wait behind all of them at each of its hops; so it waits behind those few whose turn it
//! is, and a frame's ack does not depend on how much is left to map.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::registry::cores;

/// The line. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct MappingTurns {
    places: Arc<Semaphore>,
}

/// A turn; it ends when this is dropped.
pub(crate) struct MappingTurn {
    _place: Option<OwnedSemaphorePermit>,
}

impl MappingTurns {
    /// One place for each core.
    pub(crate) fn new() -> Self {
        Self { places: Arc::new(Semaphore::new(cores())) }
    }

    /// Waits for a turn, first come, first served. Keep it for about a millisecond.
    pub(crate) async fn take(&self) -> MappingTurn {
        // The line is never closed.
        MappingTurn { _place: Arc::clone(&self.places).acquire_owned().await.ok() }
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;

    use super::*;

    #[test]
    fn a_turn_that_ends_is_the_next_ones() {
        let turns = MappingTurns::new();
        let mut taken: Vec<_> = (0..cores()).map(|_| turns.take().now_or_never().unwrap()).collect();
        let mut waiting = Box::pin(turns.take());
        assert!(waiting.as_mut().now_or_never().is_none());
        taken.pop();
        assert!(waiting.now_or_never().is_some());
    }
}
