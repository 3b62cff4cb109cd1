//! The beginnings of cells in which drives are live: what was made of their older drives, which need not be laid again while
//! only younger ones grow and arrive.
//!
//! Kept is the beginning before the oldest of the drives that changed last: where several are live, it stands before them all.

use std::{collections::VecDeque, sync::Arc};

use lanemap_core::{
    TimestampNs,
    fleet::{Base, Beginning, CellId, Contribution, DriveId, FleetParams, Fused, Keep, fuse_from},
};
use quick_cache::{Weighter, sync::Cache};

use crate::journal::cells::ContributionFact;

/// Memory that beginnings may take, bytes.
const MOST_BYTES: u64 = 64 << 20;
/// Cells whose beginnings are kept, about.
const CELLS: usize = 64;
/// Changes that tell which drives are live.
const RECENT: usize = 16;

/// The beginnings of the cells that were fused last.
#[derive(Debug)]
pub(super) struct Beginnings {
    known: Cache<CellId, Arc<Known>, ByBytes>,
}

/// A cell as it was fused last.
#[derive(Debug)]
struct Known {
    /// Fingerprint of what was folded.
    base: u64,
    /// What the drives that are kept apart said.
    facts: Vec<ContributionFact>,
    /// Made of the first of them.
    beginning: Option<Arc<Beginning>>,
    /// The first drive that was another than before, of the last few fusions.
    changed: VecDeque<(TimestampNs, DriveId)>,
}

#[derive(Clone, Debug)]
struct ByBytes;

impl Weighter<CellId, Arc<Known>> for ByBytes {
    fn weight(&self, _: &CellId, known: &Arc<Known>) -> u64 {
        let beginning = known.beginning.as_ref().map_or(0, |beginning| beginning.bytes());
        (size_of::<Known>() + size_of_val(known.facts.as_slice()) + beginning) as u64
    }
}

impl Beginnings {
    pub(super) fn new() -> Self {
        Self { known: Cache::with_weighter(CELLS, MOST_BYTES, ByBytes) }
    }

    /// Fuses drives onto a base as `lanemap_core::fleet::fuse_onto` does, and gives what is settled of them. `base_print` and `facts` tell the base and the
    /// drives from others.
    pub(super) fn fuse(
        &self,
        cell: CellId,
        (base_print, base): (u64, &Base),
        (facts, drives): (Vec<ContributionFact>, &[&Contribution]),
        params: &FleetParams,
    ) -> Fused {
        let before = self.known.get(&cell);
        let same_base = before.as_ref().filter(|known| known.base == base_print);
        // The youngest will grow, for all that is known.
        let unchanged = same_base.map_or(facts.len().saturating_sub(1), |known| known.in_common(&facts));
        let mut changed = before.as_ref().map(|known| known.changed.clone()).unwrap_or_default();
        changed.extend(facts.get(unchanged).map(|fact| (fact.started, fact.drive)));
        changed.drain(..changed.len().saturating_sub(RECENT));
        let beginning = same_base.and_then(|known| known.beginning.clone());
        let beginning = beginning.filter(|beginning| beginning.drives() <= unchanged);

        let oldest_live = changed.iter().min().copied();
        let live_from = facts.partition_point(|fact| Some((fact.started, fact.drive)) < oldest_live);
        let is_farther = live_from > beginning.as_ref().map_or(0, |beginning| beginning.drives());
        let keep = Keep { beginning_before: is_farther.then_some(live_from), settled: true };
        let mut fused = fuse_from(beginning.as_deref(), base, drives, &cell.anchor(), params, keep);
        let beginning = fused.beginning.take().map(Arc::new).or(beginning);
        self.known.insert(cell, Arc::new(Known { base: base_print, facts, beginning, changed }));
        fused
    }
}

impl Known {
    /// How many of the first drives say what they said.
    fn in_common(&self, facts: &[ContributionFact]) -> usize {
        self.facts.iter().zip(facts).take_while(|(before, now)| before == now).count()
    }
}

#[cfg(test)]
mod tests {
    use lanemap_core::fleet::{by_seniority, fuse_onto};

    use super::*;
    use crate::fuse::bases::tests::{CELL, drive};

    fn facts(drives: &[Contribution]) -> Vec<ContributionFact> {
        let fact = |drive: &Contribution| ContributionFact {
            started: drive.started,
            drive: drive.drive,
            digest: drive.trajectory.len() as u64,
        };
        drives.iter().map(fact).collect()
    }

    #[test]
    fn a_cell_with_live_drives_is_fused_as_from_nothing_and_keeps_the_beginning_before_the_oldest_of_them() {
        let (params, cell) = (FleetParams::default(), CellId::new(CELL.0, CELL.1).unwrap());
        let (beginnings, base) = (Beginnings::new(), Base::default());
        let whole: Vec<Contribution> = (0..8).map(drive).collect();
        let mut now = whole.clone();
        for live in &mut now[4..] {
            live.trajectory.truncate(12);
        }
        let kept = |beginnings: &Beginnings| {
            let known = beginnings.known.get(&cell).unwrap();
            known.beginning.as_ref().map(|beginning| beginning.drives())
        };
        // Two are live and grow by turns, then the older of them is done, then one comes.
        for (round, live) in [7, 5, 7, 5, 7].into_iter().chain([7; RECENT]).enumerate() {
            now[live].trajectory = whole[live].trajectory[..9 + round].to_vec();
            let drives = by_seniority(&now);
            let map = beginnings.fuse(cell, (7, &base), (facts(&now), &drives), &params).map;
            assert_eq!(map, fuse_onto(&base, &drives, &cell.anchor(), &params), "round {round}");
            let expected = if (1..RECENT + 3).contains(&round) { 5 } else { 7 };
            assert_eq!(kept(&beginnings), Some(expected), "round {round}");
        }
        now.push(drive(8));
        let drives = by_seniority(&now);
        let map = beginnings.fuse(cell, (7, &base), (facts(&now), &drives), &params).map;
        assert_eq!(map, fuse_onto(&base, &drives, &cell.anchor(), &params));
        // Another base: nothing that was kept is used.
        let drives = by_seniority(&now[1..]);
        let map = beginnings.fuse(cell, (8, &base), (facts(&now[1..]), &drives), &params).map;
        assert_eq!(map, fuse_onto(&base, &drives, &cell.anchor(), &params));
    }
}
