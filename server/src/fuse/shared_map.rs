//! What readers see of the shared map: whole versions of its cells, swapped in at once.
//!
//! Of every cell what is told of it stays in memory; its lines are read from the store when somebody asks for them, and kept
//! in a cache of bounded size. A reader holds one version for as long as it likes and never waits for a fusion.

mod past;

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock},
};

use arc_swap::{ArcSwap, ArcSwapOption};
use bytes::Bytes;
use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use prost::Message;
use quick_cache::{Weighter, sync::Cache};
use thiserror::Error;
use tokio::sync::watch;

use super::{
    CellRecord, CellVersion,
    localizing::{Alignment, Sought},
    publications::{CellChange, MapChanges, MapRevision, Publication, Publications, RevisionError},
};
use crate::{
    journal::{JournalError, cells::CellStore},
    session::SessionId,
    telemetry,
};

/// Attempts to read a version before it gives way to the next.
const ATTEMPTS: usize = 8;

/// One version of a cell.
#[derive(Clone, Debug)]
pub struct PublishedCell {
    /// What is told of it.
    pub record: Arc<CellRecord>,
    /// Its lines.
    pub map: Arc<v1::CellMap>,
    /// The bytes of `map`: the same for the same version.
    pub bytes: Bytes,
}

/// A version of a cell that may have been replaced.
#[derive(Clone, Debug)]
pub struct KeptVersion {
    /// Its lines.
    pub map: Arc<v1::CellMap>,
    /// The bytes of `map`: the same for the same version.
    pub bytes: Bytes,
}

/// Why changes cannot be told.
#[derive(Clone, Debug, Error)]
pub enum ChangesError {
    /// No drive ever touched the cell.
    #[error("nothing is known of cell {cell}")]
    NoSuchCell {
        /// The cell.
        cell: CellId,
    },
    /// The version is not kept any more, or not there yet.
    #[error(
        "version {since} of cell {cell} is not kept: it is at {newest}, and the oldest that is kept is {oldest}; take the cell whole"
    )]
    NotKept {
        /// The cell.
        cell: CellId,
        /// The version that was asked for.
        since: u64,
        /// The oldest version that is kept.
        oldest: u64,
        /// The newest version.
        newest: u64,
    },
    /// The store cannot be read.
    #[error(transparent)]
    Store(#[from] JournalError),
}

/// The cells of the shared map. Clones share them.
#[derive(Clone)]
pub struct SharedMap {
    shared: Arc<Shared>,
}

struct Shared {
    cells: RwLock<Cells>,
    read: Cache<(CellId, CellVersion), Arc<PublishedCell>, MemoryWeight>,
    past: Cache<(CellId, CellVersion), Arc<KeptVersion>, MemoryWeight>,
    /// The last revision that was given, published or not.
    last_given: Mutex<MapRevision>,
    store: ArcSwapOption<CellStore>,
    waiting: ArcSwap<Waiting>,
    /// Where drives without GNSS stand that were sought.
    sought: RwLock<BTreeMap<SessionId, Sought>>,
    publications: watch::Sender<u64>,
}

/// What is told of all cells at one revision.
#[derive(Default)]
struct Cells {
    records: BTreeMap<CellId, Arc<CellRecord>>,
    publications: Publications,
}

/// The turn of the one thread that publishes: readers see revisions in their order.
pub(super) struct Turn<'a>(MutexGuard<'a, MapRevision>);

impl Turn<'_> {
    /// The next revision. It is given once, whatever becomes of what is written under it.
    pub(super) fn next(&mut self) -> MapRevision {
        self.0.0 += 1;
        *self.0
    }
}

/// What is not in the map yet.
#[derive(Clone, Debug, Default)]
struct Waiting {
    dirty: BTreeSet<CellId>,
    drives: usize,
}

/// Bytes that a cell takes in memory.
#[derive(Clone)]
struct MemoryWeight;

impl Weighter<(CellId, CellVersion), Arc<PublishedCell>> for MemoryWeight {
    fn weight(&self, _: &(CellId, CellVersion), cell: &Arc<PublishedCell>) -> u64 {
        memory_bytes(&cell.map, &cell.bytes)
    }
}

impl Weighter<(CellId, CellVersion), Arc<KeptVersion>> for MemoryWeight {
    fn weight(&self, _: &(CellId, CellVersion), kept: &Arc<KeptVersion>) -> u64 {
        memory_bytes(&kept.map, &kept.bytes)
    }
}

fn memory_bytes(map: &v1::CellMap, bytes: &Bytes) -> u64 {
    // Numbers that are one or two bytes on the wire are four in memory.
    (4 * bytes.len() + 256 * map.lanes.len() + 512) as u64
}

impl fmt::Debug for SharedMap {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("SharedMap").finish_non_exhaustive()
    }
}

impl SharedMap {
    /// A map without cells, whose lines take at most `cache_bytes`: three quarters for the newest versions, the rest for
    /// replaced ones.
    #[must_use]
    pub fn new(cache_bytes: usize) -> Self {
        let shared = Shared {
            cells: RwLock::default(),
            read: Cache::with_weighter(64, cache_bytes as u64 / 4 * 3, MemoryWeight),
            past: Cache::with_weighter(64, cache_bytes as u64 / 4, MemoryWeight),
            last_given: Mutex::default(),
            store: ArcSwapOption::empty(),
            waiting: ArcSwap::default(),
            sought: RwLock::default(),
            publications: watch::Sender::default(),
        };
        Self { shared: Arc::new(shared) }
    }

    /// Begins with what the store has.
    pub(super) fn begin(&self, records: BTreeMap<CellId, CellRecord>, publications: Publications, store: CellStore) {
        *self.shared.last_given.lock().unwrap_or_else(PoisonError::into_inner) = publications.newest();
        let records = records.into_iter().map(|(cell, record)| (cell, Arc::new(record))).collect();
        *self.shared.cells.write().unwrap_or_else(PoisonError::into_inner) = Cells { records, publications };
        self.shared.store.store(Some(Arc::new(store)));
        self.count();
    }

    /// Reads no more from the store, which is to be closed.
    pub(crate) fn let_go_of_store(&self) {
        self.shared.store.store(None);
    }

    /// What is told of every cell, in their order.
    #[must_use]
    pub fn list(&self) -> Vec<(CellId, Arc<CellRecord>)> {
        self.at_once(Cells::list)
    }

    /// The newest revision, and what is told of every cell at it.
    #[must_use]
    pub fn list_with_revision(&self) -> (MapRevision, Vec<(CellId, Arc<CellRecord>)>) {
        self.at_once(|cells| (cells.publications.newest(), cells.list()))
    }

    /// What is told of one cell.
    #[must_use]
    pub fn record(&self, cell: CellId) -> Option<Arc<CellRecord>> {
        self.at_once(|cells| cells.records.get(&cell).map(Arc::clone))
    }

    /// The newest revision; 0: nothing was ever published.
    #[must_use]
    pub fn revision(&self) -> MapRevision {
        self.at_once(|cells| cells.publications.newest())
    }

    /// The oldest revision of which [`SharedMap::changed_since`] and [`SharedMap::versions_at`] tell.
    #[must_use]
    pub fn oldest_revision(&self) -> MapRevision {
        self.at_once(|cells| cells.publications.oldest())
    }

    /// Which cells changed since a revision.
    ///
    /// # Errors
    /// A revision that is not kept any more, or not there yet.
    pub fn changed_since(&self, since: MapRevision) -> Result<MapChanges, RevisionError> {
        self.changed_between(since, None)
    }

    /// Which cells changed between two revisions, the newer of which may be the newest (`None`).
    ///
    /// # Errors
    /// A revision that is not kept any more, or not there yet.
    pub fn changed_between(&self, since: MapRevision, until: Option<MapRevision>) -> Result<MapChanges, RevisionError> {
        self.at_once(|cells| {
            let until = until.unwrap_or_else(|| cells.publications.newest());
            cells.publications.changed_between(since, until)
        })
    }

    /// Every cell that ever had lines, as a change for who has nothing, whatever publications are kept.
    #[must_use]
    pub fn all_cells(&self) -> MapChanges {
        self.at_once(|cells| {
            let to_revision = cells.publications.newest();
            let published = cells.records.iter().filter(|(_, record)| record.version.0 > 0);
            let changes = published.map(|(cell, record)| CellChange {
                cell: *cell,
                from_version: CellVersion(0),
                to_version: record.version,
                revision: to_revision,
                lines_upserted: record.lanes,
                lines_removed: 0,
            });
            MapChanges { to_revision, cells: changes.collect() }
        })
    }

    /// The version of every cell at a revision, cells without lines left out that had never had any. Read them with
    /// [`SharedMap::version_of`].
    ///
    /// # Errors
    /// A revision that is not kept any more, or not there yet.
    pub fn versions_at(&self, revision: MapRevision) -> Result<BTreeMap<CellId, CellVersion>, RevisionError> {
        self.at_once(|cells| {
            let mut versions = cells.records.iter().map(|(cell, record)| (*cell, record.version)).collect();
            cells.publications.go_back(&mut versions, revision)?;
            Ok(versions)
        })
    }

    /// The publications after a revision, the oldest first, at most so many.
    ///
    /// # Errors
    /// A revision that is not kept any more, or not there yet.
    pub fn publications_after(&self, since: MapRevision, most: usize) -> Result<Vec<Publication>, RevisionError> {
        self.at_once(|cells| Ok(cells.publications.after(since)?.take(most).copied().collect()))
    }

    /// Length of all lines, metres.
    #[must_use]
    pub fn line_m(&self) -> f64 {
        self.at_once(|cells| cells.records.values().map(|record| record.line_m).sum())
    }

    /// Where a drive without GNSS stands; as a drive of which nothing is known, if it was never sought.
    #[must_use]
    pub fn alignment(&self, session: &SessionId) -> Alignment {
        self.sought(*session).map(|sought| sought.alignment).unwrap_or_default()
    }

    pub(super) fn sought(&self, session: SessionId) -> Option<Sought> {
        self.shared.sought.read().unwrap_or_else(PoisonError::into_inner).get(&session).copied()
    }

    /// Every drive that was sought, in their order.
    pub(super) fn all_sought(&self) -> Vec<(SessionId, Sought)> {
        let sought = self.shared.sought.read().unwrap_or_else(PoisonError::into_inner);
        sought.iter().map(|(session, sought)| (*session, *sought)).collect()
    }

    /// Tells where a drive stands; nothing of one that has GNSS, or is gone.
    pub(super) fn tell_sought(&self, session: SessionId, told: Option<Sought>) {
        let mut sought = self.shared.sought.write().unwrap_or_else(PoisonError::into_inner);
        match told {
            Some(told) => sought.insert(session, told),
            None => sought.remove(&session),
        };
        drop(sought);
        self.count();
    }

    fn at_once<T>(&self, read: impl FnOnce(&Cells) -> T) -> T {
        read(&self.shared.cells.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Whether drives have said something of a cell that is not in its map yet.
    #[must_use]
    pub fn is_dirty(&self, cell: CellId) -> bool {
        self.shared.waiting.load().dirty.contains(&cell)
    }

    /// Whether all that drives have said up to now is in the map.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        let waiting = self.shared.waiting.load();
        waiting.dirty.is_empty() && waiting.drives == 0
    }

    /// The newest version of a cell, where drives have touched it. Reads the store where it is not in the cache, which
    /// takes milliseconds: not for a task of the runtime.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn get(&self, cell: CellId) -> Result<Option<Arc<PublishedCell>>, JournalError> {
        for _ in 0..ATTEMPTS {
            let Some(record) = self.record(cell) else { return Ok(None) };
            let read = || self.read(cell, &record)?.map(Arc::new).ok_or(ReadError::Outdated);
            match self.shared.read.get_or_insert_with(&(cell, record.version), read) {
                Ok(found) => return Ok(Some(found)),
                Err(ReadError::Store(error)) => return Err(error),
                // The next version has taken its place meanwhile.
                Err(ReadError::Outdated) => {}
            }
        }
        Err(JournalError::Store(format!("cell {cell} changes faster than it can be read")))
    }

    fn read(&self, cell: CellId, record: &Arc<CellRecord>) -> Result<Option<PublishedCell>, ReadError> {
        let Some(map) = self.version(cell, record.version.0)? else { return Ok(None) };
        let bytes = map.encode_to_vec().into();
        Ok(Some(PublishedCell { record: Arc::clone(record), map: Arc::new(map), bytes }))
    }

    /// The turn to publish; waits while another thread has it.
    pub(super) fn turn(&self) -> Turn<'_> {
        Turn(self.shared.last_given.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The revisions of publications that are not kept once another comes: published before `since_ms`, or too many.
    pub(super) fn outdated_publications(&self, since_ms: u64) -> Vec<MapRevision> {
        self.at_once(|cells| cells.publications.outdated(since_ms))
    }

    pub(super) fn drop_publications_until(&self, last: MapRevision) {
        let mut cells = self.shared.cells.write().unwrap_or_else(PoisonError::into_inner);
        cells.publications.drop_until(last);
    }

    /// Makes a version, which is on the disk, the newest of its cell.
    pub(super) fn publish(
        &self,
        cell: CellId,
        record: CellRecord,
        map: Option<(v1::CellMap, Bytes)>,
        publication: Option<Publication>,
    ) {
        let record = Arc::new(record);
        if let Some((map, bytes)) = map {
            let published = PublishedCell { record: Arc::clone(&record), map: Arc::new(map), bytes };
            self.shared.read.insert((cell, record.version), Arc::new(published));
        }
        let mut cells = self.shared.cells.write().unwrap_or_else(PoisonError::into_inner);
        let before = cells.records.insert(cell, Arc::clone(&record));
        if let Some(publication) = publication {
            cells.publications.push(publication);
        }
        metrics::gauge!(telemetry::CELLS).set(cells.records.len() as f64);
        drop(cells);
        if let Some(before) = before.filter(|before| before.version != record.version) {
            self.shared.read.remove(&(cell, before.version));
        }
        self.count();
    }

    pub(super) fn tell_waiting(&self, dirty: BTreeSet<CellId>, drives: usize) {
        metrics::gauge!(telemetry::CELLS_DIRTY).set(dirty.len() as f64);
        self.shared.waiting.store(Arc::new(Waiting { dirty, drives }));
        self.count();
    }

    /// Counts what readers may see: tells one that something is newer than when it looked.
    #[must_use]
    pub fn publications(&self) -> watch::Receiver<u64> {
        self.shared.publications.subscribe()
    }

    fn count(&self) {
        self.shared.publications.send_modify(|count| *count += 1);
    }
}

impl Cells {
    fn list(&self) -> Vec<(CellId, Arc<CellRecord>)> {
        self.records.iter().map(|(cell, record)| (*cell, Arc::clone(record))).collect()
    }
}

enum ReadError {
    Store(JournalError),
    Outdated,
}

impl From<JournalError> for ReadError {
    fn from(error: JournalError) -> Self {
        Self::Store(error)
    }
}
