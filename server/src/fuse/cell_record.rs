//! What is told of a cell beside its lines.

use lanemap_core::{TimestampNs, fleet::FleetParams};
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::Xxh3;

use super::border::Crossing;
use crate::{journal::cells::ContributionFact, session::SessionId};

/// Raise it where the same contributions give another map: every cell is then fused again at the next start.
const ALGORITHM: u32 = 16;

/// Raise it where the bytes of contributions or of fused cells change: what an earlier build wrote is then written anew from
/// the drives' snapshots.
pub(super) const FORMAT: u16 = 4;

/// Version of a cell: grows by one with every change of its map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct CellVersion(pub u64);

/// What is told of a cell.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CellRecord {
    /// Version of its map.
    pub version: CellVersion,
    /// What it was fused from; `drafts::DRAFTED` where that is a draft.
    pub(crate) fingerprint: u64,
    /// When it was fused last, milliseconds since the Unix epoch.
    pub fused_at_ms: u64,
    /// Time that it took, milliseconds.
    pub fused_in_ms: u64,
    /// Drives that it was fused from, those kept apart among them.
    pub drives: u32,
    /// Drives that fit nowhere, or not in one place only.
    pub kept_apart: Vec<SessionId>,
    /// Pieces of lines in it.
    pub lanes: u32,
    /// Length of all of them, metres.
    pub line_m: f64,
    /// Median over all control points of the standard deviation across the line, metres; 0 without lines.
    pub median_lateral_sigma_m: f64,
    /// Where its lines cross its border.
    pub(crate) crossings: Vec<Crossing>,
    /// Changes of the road that were noticed no later than this are not told any more: their events have left.
    pub(crate) events_left: Option<TimestampNs>,
    /// Drives of it have been let go of.
    pub(crate) forgets: bool,
    /// The last version that told of an event.
    pub(crate) told_in: CellVersion,
    /// The number of the last event that was told of it.
    pub(crate) last_event: u64,
}

/// What tells a set of contributions, and the way in which they are fused, from all others.
pub(super) fn fingerprint<'a>(facts: impl IntoIterator<Item = &'a ContributionFact>) -> u64 {
    let mut facts: Vec<&ContributionFact> = facts.into_iter().collect();
    facts.sort_unstable();
    let mut hasher = Xxh3::new();
    hasher.update(&ALGORITHM.to_le_bytes());
    hasher.update(&FORMAT.to_le_bytes());
    hasher.update(format!("{:?}", FleetParams::default()).as_bytes());
    for fact in facts {
        hasher.update(&fact.started.0.to_le_bytes());
        hasher.update(&fact.drive.0.to_le_bytes());
        hasher.update(&fact.digest.to_le_bytes());
    }
    hasher.digest()
}

#[cfg(test)]
mod tests {
    use lanemap_core::fleet::DriveId;

    use super::*;

    fn fact(number: u64) -> ContributionFact {
        ContributionFact { started: TimestampNs(1), drive: DriveId(number), digest: number + 10 }
    }

    #[test]
    fn a_fingerprint_knows_no_order_and_every_change() {
        let of = |facts: &[ContributionFact]| fingerprint(facts);
        assert_eq!(of(&[fact(1), fact(2)]), of(&[fact(2), fact(1)]));
        assert_ne!(of(&[fact(1), fact(2)]), of(&[fact(1)]));
        assert_ne!(of(&[fact(1)]), of(&[ContributionFact { digest: 5, ..fact(1) }]));
        assert_ne!(of(&[]), of(&[fact(1)]));
    }
}
