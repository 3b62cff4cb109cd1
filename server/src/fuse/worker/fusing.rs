//! Fusing a cell: all of its drives together, or a draft of it while drives are live.

use std::time::{Duration, Instant};

use lanemap_core::fleet::{CellId, Contribution, FleetParams, FusedMap, by_seniority, draft};

use super::Worker;
use crate::{
    fuse::{
        bases::missing,
        border::{self, Crossing, Piece},
        drafts::{Draft, Known},
    },
    journal::{JournalError, cells::Facts},
    session::SessionId,
    telemetry,
};

/// A cell as it was fused.
pub(super) struct Fused {
    pub(super) pieces: Vec<Piece>,
    pub(super) crossings: Vec<Crossing>,
    pub(super) map: FusedMap,
    pub(super) took: Duration,
    /// Live drives were laid on what is settled: all of them are still to be fused.
    pub(super) is_draft: bool,
}

impl Worker {
    /// Drafts a cell where that may be done.
    pub(super) fn draft_or_fuse(&self, cell: CellId, facts: &Facts) -> Result<Fused, JournalError> {
        match self.fuser.shared.drafts.of(cell, facts) {
            None => self.fuse_whole(cell, facts),
            Some(Draft::Onto(known, live)) => self.draft(cell, &known, &live),
            Some(Draft::Settling(others, live)) => {
                let settled = self.fuse_all(cell, &others)?.settled;
                let known = settled.and_then(|settled| self.fuser.shared.drafts.settle(cell, others, settled));
                match known {
                    Some(known) => self.draft(cell, &known, &live),
                    None => self.fuse_whole(cell, facts),
                }
            }
        }
    }

    /// Solves for all drives of a cell together.
    pub(super) fn fuse_whole(&self, cell: CellId, facts: &Facts) -> Result<Fused, JournalError> {
        let started = Instant::now();
        let fused = self.fuse_all(cell, facts)?;
        if let Some(settled) = fused.settled {
            self.fuser.shared.drafts.settle(cell, facts.clone(), settled);
        }
        let fused = Fused::of(cell, fused.map, started, false);
        metrics::histogram!(telemetry::FUSE_SECONDS).record(fused.took.as_secs_f64());
        metrics::counter!(telemetry::CELLS_FUSED).increment(1);
        Ok(fused)
    }

    fn fuse_all(&self, cell: CellId, facts: &Facts) -> Result<lanemap_core::fleet::Fused, JournalError> {
        let read = |session| self.store.contribution(cell, session);
        self.fuser.shared.bases.fuse(cell, facts, &FleetParams::default(), read)
    }

    fn draft(&self, cell: CellId, known: &Known, live: &[SessionId]) -> Result<Fused, JournalError> {
        let started = Instant::now();
        let read = live.iter().map(|session| self.store.contribution(cell, *session)?.ok_or_else(|| missing(cell)));
        let live = read.collect::<Result<Vec<Contribution>, JournalError>>()?;
        let map = draft(&known.settled, &by_seniority(&live), &cell.anchor(), &FleetParams::default());
        metrics::counter!(telemetry::CELLS_DRAFTED).increment(1);
        Ok(Fused::of(cell, map, started, true))
    }
}

impl Fused {
    fn of(cell: CellId, map: FusedMap, started: Instant, is_draft: bool) -> Self {
        let (pieces, crossings) = border::cut(cell, &map.lanes);
        Self { pieces, crossings, map, took: started.elapsed(), is_draft }
    }
}
