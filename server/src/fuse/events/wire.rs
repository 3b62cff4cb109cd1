//! Events as messages.

use lanemap_core::fleet::CellId;
use lanemap_proto::v1;

use super::{CellEvent, EventKind};

impl CellEvent {
    /// The event as it goes over the wire.
    #[must_use]
    pub fn message(&self, cell: CellId) -> v1::MapEvent {
        v1::MapEvent {
            cell: cell.to_string(),
            number: self.number,
            kind: kind(self.kind).into(),
            withdrawn: self.withdrawn,
            revision: self.revision.0,
            version: self.version.0,
            told_unix_ns: i64::try_from(self.published_ms.saturating_mul(1_000_000)).unwrap_or(i64::MAX),
            lane: self.lane.clone(),
            into: self.into.clone(),
            category: self.category,
            probability_permille: self.probability_permille,
            noticed_unix_ns: self.noticed_unix_ns,
            drives: self.drives,
            moved_mm: match self.kind {
                EventKind::Moved { by_mm } => by_mm,
                _ => 0,
            },
            xyz_mm: self.xyz_mm.clone(),
            category_before: match self.kind {
                EventKind::Repainted { from } => from,
                _ => 0,
            },
        }
    }
}

fn kind(kind: EventKind) -> v1::MapEventKind {
    match kind {
        EventKind::Appeared => v1::MapEventKind::Appeared,
        EventKind::Vanished => v1::MapEventKind::Vanished,
        EventKind::Moved { .. } => v1::MapEventKind::Moved,
        EventKind::Renamed => v1::MapEventKind::Renamed,
        EventKind::Merged => v1::MapEventKind::Merged,
        EventKind::Split => v1::MapEventKind::Split,
        EventKind::Repainted { .. } => v1::MapEventKind::Repainted,
    }
}
