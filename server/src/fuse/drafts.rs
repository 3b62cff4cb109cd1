//! Drafts: cells of many drives, shown with their live drives before all are solved together.
//!
//! Solving for all drives of a large cell takes longer than a live one takes to say something new. So what is settled of such a cell
//! stays in memory, and live drives are laid on it (`lanemap_core::fleet::settled`) until the cell is quiet or has been drafted for
//! long; then all are fused. A drive that is settled and says something new is taken out of what is settled, once.
//!
//! A draft is a version like any other to readers; the cell stays dirty, and its record bears the fingerprint of no set of
//! drives, so that a start after a crash fuses it.

use std::sync::Arc;

use lanemap_core::fleet::{CellId, FleetParams, Settled};
use quick_cache::{Weighter, sync::Cache};

use crate::{journal::cells::Facts, session::SessionId};

/// What a draft is fused from, in place of a fingerprint: no set of drives.
pub(super) const DRAFTED: u64 = 0;
/// Live drives of a cell beyond which it is fused as a whole.
const MOST_LIVE: usize = 8;
/// Cells of which it is kept what is settled, about, and the memory for it, bytes.
const CELLS: usize = 64;
const MOST_BYTES: u64 = 64 << 20;

/// What is settled of the cells that were fused last.
#[derive(Debug)]
pub(super) struct Drafts {
    known: Cache<CellId, Arc<Known>, ByBytes>,
    least_line_m: f64,
}

/// What is settled of a cell.
#[derive(Debug)]
pub(super) struct Known {
    pub(super) settled: Settled,
    /// What its drives said.
    members: Facts,
}

/// How a cell may be drafted.
#[derive(Debug)]
pub(super) enum Draft {
    /// Live drives are laid on this.
    Onto(Arc<Known>, Vec<SessionId>),
    /// The same, once these drives are settled without the others.
    Settling(Facts, Vec<SessionId>),
}

#[derive(Clone, Debug)]
struct ByBytes;

impl Weighter<CellId, Arc<Known>> for ByBytes {
    fn weight(&self, _: &CellId, known: &Arc<Known>) -> u64 {
        let members = known.members.len() * size_of_val(&known.members.first_key_value());
        (size_of::<Known>() + members + known.settled.bytes()) as u64
    }
}

impl Drafts {
    /// Cells are drafted from so many metres of lines on.
    pub(super) fn new(least_line_m: f64) -> Self {
        Self { known: Cache::with_weighter(CELLS, MOST_BYTES, ByBytes), least_line_m }
    }

    /// How a cell may be drafted from what its drives say now; `None` where it is to be fused as a whole.
    pub(super) fn of(&self, cell: CellId, facts: &Facts) -> Option<Draft> {
        let known = self.known.get(&cell)?;
        if !known.members.keys().all(|session| facts.contains_key(session)) {
            // A drive was taken out: nothing of it stays.
            self.known.remove(&cell);
            return None;
        }
        let live: Vec<SessionId> =
            facts.iter().filter(|(session, fact)| known.members.get(session) != Some(fact)).map(|it| *it.0).collect();
        if live.is_empty() || live.len() > MOST_LIVE {
            return None;
        }
        if live.iter().all(|session| !known.members.contains_key(session)) {
            return Some(Draft::Onto(known, live));
        }
        let others: Facts =
            facts.iter().filter(|it| !live.contains(it.0)).map(|(&session, &fact)| (session, fact)).collect();
        (!others.is_empty()).then_some(Draft::Settling(others, live))
    }

    /// Takes what is settled of a cell that has lines enough.
    pub(super) fn settle(&self, cell: CellId, members: Facts, settled: Settled) -> Option<Arc<Known>> {
        if settled.line_m(&FleetParams::default()) < self.least_line_m {
            self.known.remove(&cell);
            return None;
        }
        let known = Arc::new(Known { settled, members });
        self.known.insert(cell, Arc::clone(&known));
        Some(known)
    }
}

#[cfg(test)]
mod tests {
    use lanemap_core::{
        TimestampNs,
        fleet::{Base, DriveId, Keep, by_seniority, fuse_from},
    };

    use super::*;
    use crate::{
        fuse::bases::tests::{CELL, drive},
        journal::cells::ContributionFact,
    };

    fn session(number: u64) -> SessionId {
        SessionId::from_key(number.to_be_bytes())
    }

    fn facts(drives: impl IntoIterator<Item = (u64, u64)>) -> Facts {
        let fact = |(number, digest)| {
            (session(number), ContributionFact { started: TimestampNs(0), drive: DriveId(number), digest })
        };
        drives.into_iter().map(fact).collect()
    }

    fn cell() -> CellId {
        CellId::new(CELL.0, CELL.1).unwrap()
    }

    fn settled() -> Settled {
        let drives: Vec<_> = (0..3).map(drive).collect();
        let keep = Keep { beginning_before: None, settled: true };
        let params = FleetParams::default();
        fuse_from(None, &Base::default(), &by_seniority(&drives), &cell().anchor(), &params, keep).settled.unwrap()
    }

    #[test]
    fn a_cell_is_drafted_while_few_drives_are_live_and_settled_without_one_that_goes_on() {
        let drafts = Drafts::new(0.0);
        assert!(drafts.of(cell(), &facts([(1, 1)])).is_none(), "nothing is settled");
        drafts.settle(cell(), facts([(1, 1), (2, 1)]), settled());
        assert!(drafts.of(cell(), &facts([(1, 1), (2, 1)])).is_none(), "nothing is live");
        let now = facts([(1, 1), (2, 1), (3, 1)]);
        assert!(matches!(drafts.of(cell(), &now), Some(Draft::Onto(_, live)) if live == [session(3)]));
        let now = facts([(1, 1), (2, 7), (3, 1)]);
        let Some(Draft::Settling(others, live)) = drafts.of(cell(), &now) else { panic!("the second goes on") };
        assert_eq!((others, live), (facts([(1, 1)]), vec![session(2), session(3)]));
        let many = facts((1..=2 + MOST_LIVE as u64 + 1).map(|number| (number, 1)));
        assert!(drafts.of(cell(), &many).is_none(), "too many are live");
    }

    #[test]
    fn nothing_of_a_drive_that_was_taken_out_stays() {
        let drafts = Drafts::new(0.0);
        drafts.settle(cell(), facts([(1, 1), (2, 1)]), settled());
        assert!(drafts.of(cell(), &facts([(2, 1), (3, 1)])).is_none());
        assert!(drafts.known.get(&cell()).is_none());
    }

    #[test]
    fn a_cell_with_few_lines_is_never_drafted() {
        let drafts = Drafts::new(1e3);
        assert!(drafts.settle(cell(), facts([(1, 1)]), settled()).is_none());
        assert!(drafts.of(cell(), &facts([(1, 1), (2, 1)])).is_none());
    }
}
