//! Where the drives of a full cell went, so that those are let go of that are missed least.
//!
//! Asked only where a cell has more drives than it keeps. Where a drive went is kept in memory, so that a drive that comes
//! to a full cell has none of the others read again.

use std::sync::Arc;

use lanemap_core::fleet::{CellId, Contribution, DriveId, FleetParams, Visits, missed_least};
use quick_cache::sync::Cache;

use crate::{
    journal::{JournalError, cells::Facts},
    session::SessionId,
};

/// Drives of which it is kept where they went, some kilobytes each.
const MOST_DRIVES: usize = 4096;

/// Where drives went within cells, those asked for last.
#[derive(Debug)]
pub(super) struct Footprints {
    /// By cell, drive, and the digest of what it said.
    known: Cache<(CellId, DriveId, u64), Arc<Visits>>,
}

impl Footprints {
    pub(super) fn new() -> Self {
        Self { known: Cache::new(MOST_DRIVES) }
    }

    /// The drives of a cell that are let go of so that `most` are left. Reads those of which it is not known where they went.
    pub(super) fn missed_least(
        &self,
        cell: CellId,
        facts: &Facts,
        most: usize,
        read: impl Fn(SessionId) -> Result<Option<Contribution>, JournalError>,
    ) -> Result<Vec<SessionId>, JournalError> {
        if facts.len() <= most {
            return Ok(Vec::new());
        }
        let (anchor, params) = (cell.anchor(), FleetParams::default());
        let mut visits = Vec::with_capacity(facts.len());
        for (session, fact) in facts {
            let key = (cell, fact.drive, fact.digest);
            let known = self.known.get_or_insert_with(&key, || {
                let contribution = read(*session)?.ok_or_else(|| missing(cell))?;
                Ok::<_, JournalError>(Arc::new(Visits::of(&contribution, &anchor, &params)))
            })?;
            visits.push(known);
        }
        let sessions: Vec<SessionId> = facts.keys().copied().collect();
        let gone = missed_least(visits.iter().map(Arc::as_ref), most, &params);
        Ok(gone.into_iter().map(|index| sessions[index]).collect())
    }
}

fn missing(cell: CellId) -> JournalError {
    JournalError::Decode { what: format!("a contribution to cell {cell}"), reason: "it is not there".to_owned() }
}
