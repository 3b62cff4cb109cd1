//! What a session offers to the shared map, and what of it belongs to which cell.

use std::sync::Arc;

use lanemap_core::{
    LaneMap, Sensor,
    fleet::{Contribution, DriveId, Trace, cell, localization::LEAST_WAY_M},
    geometry::georeference::Georeference,
};
use xxhash_rust::xxh3::xxh3_64;

use crate::{
    journal::{
        JournalError,
        cells::{ContributionFact, StoredContribution, encoded},
    },
    session::{MapVersion, SessionId},
};

/// What a drive says now.
#[derive(Clone, Debug)]
pub(crate) struct Offer {
    pub(crate) session: SessionId,
    /// The drive's name in the shared map.
    pub(crate) drive: DriveId,
    pub(crate) version: MapVersion,
    /// Where its own GNSS puts it; without that it stays in its own frame, unless it is found on the map.
    pub(crate) georeference: Option<Georeference>,
    pub(crate) sensor: Sensor,
    pub(crate) trace: Arc<Trace>,
    pub(crate) map: Arc<LaneMap>,
}

impl Offer {
    /// All that the drive says, in its own frame; `None` before its first frame.
    pub(super) fn whole(&self) -> Option<Contribution> {
        self.trace.contribution(self.drive, self.sensor, &self.map)
    }

    /// Whether it may be said of the drive where it lies: by its own GNSS, or by a search for it.
    pub(super) fn may_be_placed(&self) -> bool {
        self.georeference.is_some() || self.trace.points().last().is_some_and(|last| last.arc_m >= LEAST_WAY_M)
    }

    /// What the drive says of each cell that it touches, in the order of the cells.
    pub(super) fn contributions(&self) -> Result<Vec<StoredContribution>, JournalError> {
        let Some(georeference) = &self.georeference else { return Ok(Vec::new()) };
        let Some(contribution) = self.whole() else { return Ok(Vec::new()) };
        let cells = cell::cut(&contribution, georeference).into_iter();
        cells.map(|(cell, part)| stored(cell, &part)).collect()
    }
}

/// A contribution to a cell as the store has it.
pub(super) fn stored(cell: cell::CellId, part: &Contribution) -> Result<StoredContribution, JournalError> {
    let bytes = encoded("a contribution", part)?;
    let fact = ContributionFact { started: part.started, drive: part.drive, digest: xxh3_64(&bytes) };
    Ok(StoredContribution { cell, fact, bytes })
}
