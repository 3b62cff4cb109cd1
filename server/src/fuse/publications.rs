//! The revision of the shared map, and which publication gave which.
//!
//! Every version of a cell that is published gets the next **revision**: one number over the whole map, which grows and
//! never falls, also over a crash, since it is written with the version in one commit. Revision 0 is the map without
//! lines. A revision names a state of the whole map: every cell in the newest version that was published up to it.
//! Numbers may be left out where a write failed; then nothing was published under them.
//!
//! The newest publications are kept, in memory and in the store, for as long as replaced versions of cells
//! (`cell_versions_kept_s`), and never more than [`MOST_KEPT`]. For as long,
//!
//! - [`SharedMap::changed_since`](super::SharedMap::changed_since) tells which cells changed since a revision, and from
//!   which version to which: what a reader needs that follows the map;
//! - [`SharedMap::versions_at`](super::SharedMap::versions_at) tells the version of every cell at a revision: what a
//!   reader needs that pins one state of the map, or goes back in time. [`SharedMap::version_of`](super::SharedMap::version_of)
//!   then reads the cells; a cell that changed often since, or of which a drive was deleted, may not be kept that long.
//!
//! A publication knows no line, only which cell had which version when.

use std::{
    collections::{BTreeMap, VecDeque},
    fmt,
    str::FromStr,
};

use lanemap_core::fleet::CellId;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{CellRecord, CellVersion, now_ms};
use crate::journal::{
    JournalError,
    cells::{CellStore, encoded},
};

/// Most publications that are kept, however young: about 10 MB.
pub const MOST_KEPT: usize = 1 << 17;

/// A revision of the shared map: grows with every version of any cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct MapRevision(pub u64);

impl fmt::Display for MapRevision {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(formatter)
    }
}

impl FromStr for MapRevision {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        text.parse().map(Self).map_err(|_| "it must be a revision of the map, a whole number".to_owned())
    }
}

/// A version of a cell that was published.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Publication {
    /// The revision that it gave the map.
    pub revision: MapRevision,
    /// The cell.
    pub cell: CellId,
    /// The version that it had before; 0: none.
    pub from_version: CellVersion,
    /// Its version since.
    pub to_version: CellVersion,
    /// When, milliseconds since the Unix epoch.
    pub published_ms: u64,
    /// Lines of it that are new or differ from those before.
    pub lines_upserted: u32,
    /// Lines that are no longer there.
    pub lines_removed: u32,
}

/// How a cell changed over several publications.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CellChange {
    /// The cell.
    pub cell: CellId,
    /// The version that a reader has who is at the older revision; 0: none.
    pub from_version: CellVersion,
    /// The version that it has at the newer one.
    pub to_version: CellVersion,
    /// The revision of its last publication.
    pub revision: MapRevision,
    /// Lines that were new or differed, in all publications together.
    pub lines_upserted: u32,
    /// Lines that went, in all publications together.
    pub lines_removed: u32,
}

impl CellChange {
    /// No change yet, at the version before a publication.
    fn before(publication: &Publication) -> Self {
        Self {
            cell: publication.cell,
            from_version: publication.from_version,
            to_version: publication.from_version,
            revision: publication.revision,
            lines_upserted: 0,
            lines_removed: 0,
        }
    }
}

/// What changed between two revisions.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MapChanges {
    /// The newer revision: where the next question goes on.
    pub to_revision: MapRevision,
    /// Every cell that changed, once, in the order of their last publications.
    pub cells: Vec<CellChange>,
}

/// Why nothing is told of a revision.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum RevisionError {
    /// It lies too far back.
    #[error("revision {asked} of the map is not kept: it is at {newest}, and the oldest that is kept is {oldest}")]
    NotKept {
        /// The revision that was asked for.
        asked: MapRevision,
        /// The oldest that is kept.
        oldest: MapRevision,
        /// The newest.
        newest: MapRevision,
    },
    /// It is not there yet.
    #[error("there is no revision {asked} of the map yet: it is at {newest}")]
    InTheFuture {
        /// The revision that was asked for.
        asked: MapRevision,
        /// The newest.
        newest: MapRevision,
    },
}

/// The newest publications, in the order of their revisions.
#[derive(Clone, Debug, Default)]
pub(super) struct Publications {
    /// The revision before the first that is kept.
    oldest: MapRevision,
    kept: VecDeque<Publication>,
}

impl Publications {
    /// Those that are kept, in the order of their revisions.
    fn new(kept: Vec<Publication>) -> Self {
        // Numbers that were left out before the first do no harm: what is known begins no earlier than it is sure.
        let oldest = kept.first().map_or(MapRevision(0), |first| MapRevision(first.revision.0 - 1));
        Self { oldest, kept: kept.into() }
    }

    /// Those of a store whose cells these are. One of before there were revisions gets them.
    pub(super) fn open(store: &CellStore, records: &BTreeMap<CellId, CellRecord>) -> Result<Self, JournalError> {
        let kept: Vec<Publication> = store.publications()?;
        if !kept.is_empty() {
            return Ok(Self::new(kept));
        }
        let made = of_a_store_without(records, now_ms());
        let told = made.iter().map(|publication| Ok((publication.revision.0, encoded("a publication", publication)?)));
        store.put_publications(told.collect::<Result<_, JournalError>>()?)?;
        Ok(Self::new(made))
    }

    pub(super) fn newest(&self) -> MapRevision {
        self.kept.back().map_or(self.oldest, |last| last.revision)
    }

    /// The oldest revision of which [`Publications::changed_between`] tells.
    pub(super) fn oldest(&self) -> MapRevision {
        self.oldest
    }

    /// Those after `since`, in the order of their revisions.
    pub(super) fn after(
        &self,
        since: MapRevision,
    ) -> Result<impl DoubleEndedIterator<Item = &Publication>, RevisionError> {
        let (oldest, newest) = (self.oldest, self.newest());
        if since < oldest {
            return Err(RevisionError::NotKept { asked: since, oldest, newest });
        }
        if since > newest {
            return Err(RevisionError::InTheFuture { asked: since, newest });
        }
        let first = self.kept.partition_point(|publication| publication.revision <= since);
        Ok(self.kept.range(first..))
    }

    pub(super) fn changed_between(&self, since: MapRevision, until: MapRevision) -> Result<MapChanges, RevisionError> {
        if until > self.newest() {
            return Err(RevisionError::InTheFuture { asked: until, newest: self.newest() });
        }
        let mut cells: BTreeMap<CellId, CellChange> = BTreeMap::new();
        for publication in self.after(since)?.take_while(|publication| publication.revision <= until) {
            let change = cells.entry(publication.cell).or_insert_with(|| CellChange::before(publication));
            change.to_version = publication.to_version;
            change.revision = publication.revision;
            change.lines_upserted = change.lines_upserted.saturating_add(publication.lines_upserted);
            change.lines_removed = change.lines_removed.saturating_add(publication.lines_removed);
        }
        let mut cells: Vec<CellChange> = cells.into_values().collect();
        cells.sort_unstable_by_key(|change| change.revision);
        Ok(MapChanges { to_revision: until, cells })
    }

    /// Makes of the newest versions of all cells those at `revision`; cells that had none then are left out.
    pub(super) fn go_back(
        &self,
        versions: &mut BTreeMap<CellId, CellVersion>,
        revision: MapRevision,
    ) -> Result<(), RevisionError> {
        for publication in self.after(revision)?.rev() {
            versions.insert(publication.cell, publication.from_version);
        }
        versions.retain(|_, version| version.0 > 0);
        Ok(())
    }

    pub(super) fn push(&mut self, publication: Publication) {
        self.kept.push_back(publication);
    }

    /// The revisions of those that are kept no longer once another comes: published before `since_ms`, or beyond the most.
    pub(super) fn outdated(&self, since_ms: u64) -> Vec<MapRevision> {
        let excess = (self.kept.len() + 1).saturating_sub(MOST_KEPT);
        let old = self.kept.iter().take_while(|publication| publication.published_ms < since_ms).count();
        self.kept.iter().take(excess.max(old)).map(|publication| publication.revision).collect()
    }

    /// Keeps those up to `last` no longer.
    pub(super) fn drop_until(&mut self, last: MapRevision) {
        while self.kept.front().is_some_and(|first| first.revision <= last) {
            self.kept.pop_front();
        }
        self.oldest = self.oldest.max(last);
    }
}

/// Publications for a store that was written before there were revisions: one for each cell, in their order.
fn of_a_store_without(records: &BTreeMap<CellId, CellRecord>, published_ms: u64) -> Vec<Publication> {
    let published = records.iter().filter(|(_, record)| record.version.0 > 0);
    let numbered = published.zip(1..).map(|((cell, record), revision)| Publication {
        revision: MapRevision(revision),
        cell: *cell,
        from_version: CellVersion(0),
        to_version: record.version,
        published_ms,
        lines_upserted: record.lanes,
        lines_removed: 0,
    });
    numbered.collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::journal::{Journal, JournalOptions};

    fn cell(number: u32) -> CellId {
        CellId::new(number, 5).unwrap()
    }

    /// Publications of cells one after the other, 10 ms apart, each with the state of the map after it.
    fn published(cells: &[u32]) -> (Publications, Vec<BTreeMap<CellId, CellVersion>>) {
        let mut publications = Publications::default();
        let mut states = vec![BTreeMap::new()];
        for (number, at) in cells.iter().zip(1..) {
            let mut state = states.last().cloned().unwrap();
            let version = state.entry(cell(*number)).or_insert(CellVersion(0));
            let from_version = *version;
            version.0 += 1;
            publications.push(Publication {
                revision: MapRevision(at),
                cell: cell(*number),
                from_version,
                to_version: *version,
                published_ms: 10 * at,
                lines_upserted: 1,
                lines_removed: 0,
            });
            states.push(state);
        }
        (publications, states)
    }

    proptest! {
        #[test]
        fn every_revision_that_is_kept_gives_its_state_and_the_way_to_the_newest(
            cells in prop::collection::vec(0_u32..5, 0..40), dropped in 0_u64..20,
        ) {
            let (mut publications, states) = published(&cells);
            let dropped = dropped.min(cells.len() as u64);
            publications.drop_until(MapRevision(dropped));
            let newest = states.last().unwrap();
            for (revision, state) in (0..).zip(&states) {
                let mut versions = newest.clone();
                let gone_back = publications.go_back(&mut versions, MapRevision(revision));
                prop_assert_eq!(gone_back.is_ok(), revision >= dropped);
                if gone_back.is_err() {
                    continue;
                }
                prop_assert_eq!(&versions, state);
                let changes = publications.changed_between(MapRevision(revision), publications.newest()).unwrap();
                prop_assert_eq!(changes.to_revision, MapRevision(cells.len() as u64));
                for change in changes.cells {
                    let before = versions.insert(change.cell, change.to_version).unwrap_or_default();
                    prop_assert_eq!(before, change.from_version);
                }
                prop_assert_eq!(&versions, newest);
            }
        }
    }

    #[test]
    fn a_revision_that_is_not_there_yet_is_told_from_one_that_is_kept_no_longer() {
        let (mut publications, _) = published(&[1, 2, 1]);
        publications.drop_until(MapRevision(2));
        let (oldest, newest) = (MapRevision(2), MapRevision(3));
        let not_kept = RevisionError::NotKept { asked: MapRevision(1), oldest, newest };
        let since = |revision| publications.changed_between(revision, newest);
        assert_eq!(since(MapRevision(1)), Err(not_kept));
        let in_the_future = RevisionError::InTheFuture { asked: MapRevision(4), newest };
        assert_eq!(since(MapRevision(4)), Err(in_the_future));
        assert_eq!(since(newest).unwrap().cells, []);
        assert_eq!(publications.changed_between(newest, MapRevision(4)), Err(in_the_future));
    }

    #[test]
    fn what_is_old_is_dropped_and_the_newest_revision_stays_known() {
        let (mut publications, _) = published(&[1, 1, 1]);
        assert_eq!(publications.outdated(20), [MapRevision(1)]);
        for last in publications.outdated(1_000) {
            publications.drop_until(last);
        }
        assert_eq!((publications.oldest(), publications.newest()), (MapRevision(3), MapRevision(3)));
    }

    #[test]
    fn a_store_from_before_there_were_revisions_gets_one_for_each_cell() {
        let folder = tempfile::tempdir().unwrap();
        let options = JournalOptions {
            folder: folder.path().to_owned(),
            max_frames_per_commit: 1,
            max_waiting_commits: 1,
            min_free_disk_bytes: 0,
        };
        let (journal, _committer) = Journal::open(&options).unwrap();
        let versions = [(cell(1), CellVersion(7)), (cell(2), CellVersion(0)), (cell(3), CellVersion(2))];
        let records = versions.map(|(cell, version)| (cell, CellRecord { version, ..CellRecord::default() }));
        let publications = Publications::open(&journal.cells(), &records.into()).unwrap();
        assert_eq!((publications.oldest(), publications.newest()), (MapRevision(0), MapRevision(2)));
        let mut at_first = BTreeMap::from(versions);
        publications.go_back(&mut at_first, MapRevision(1)).unwrap();
        assert_eq!(at_first, BTreeMap::from([(cell(1), CellVersion(7))]));
        // They are given once.
        let again = Publications::open(&journal.cells(), &BTreeMap::new()).unwrap();
        assert_eq!(again.kept, publications.kept);
    }
}
