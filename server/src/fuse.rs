//! The shared map in the service: drives contribute to cells, and cells are fused in the background.
//!
//! 1. A session's actor [`offers`](Fuser::offer) what its drive says each time it publishes; the newest offer counts.
//! 2. A worker cuts the offer into [contributions](offer) per cell and puts those that changed into the store.
//! 3. A cell whose contributions are not those that it was fused from is dirty: a worker fuses it (`lanemap_core::fleet::fuse`),
//!    [cuts](border) its lines at the tile's border, and joins them with those of its neighbours. While drives are live in a large
//!    one, it is [drafted](drafts), and fused once it is quiet.
//! 4. Where its [bytes](wire) differ, a new version is made durable, which gives the map its next [revision](publications),
//!    and [swapped in](shared_map) for readers.
//!
//! Workers are threads of their own, never the runtime's; they take tasks in the order in which these became due
//! ([`queue`]), and rest in between, so that they take no more than a share of a core, and stand back (Linux) where frames
//! wait to be taken. What a cell is fused from is its
//! fingerprint: it is kept, and a start fuses nothing again that has not changed.

mod bases;
mod beginnings;
pub(crate) mod border;
mod cell_record;
mod drafts;
pub mod events;
pub mod follow;
mod footprints;
mod lineage;
pub mod localizing;
pub(crate) mod offer;
pub mod publications;
mod queue;
mod retention;
pub mod shared_map;
pub mod wire;
mod worker;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use lanemap_core::fleet::CellId;
use tokio::sync::watch;

pub use cell_record::{CellRecord, CellVersion};
pub(crate) use offer::Offer;
pub use publications::{MapRevision, Publication, RevisionError};
pub use shared_map::{ChangesError, KeptVersion, PublishedCell, SharedMap};

use crate::{
    config::ServerConfig,
    journal::{
        JournalError,
        cells::{CellStore, Contributed},
    },
    session::{MapVersion, SessionId},
};
use bases::Bases;
use cell_record::{FORMAT, fingerprint};
use drafts::Drafts;
use footprints::Footprints;
use localizing::{SearchedMap, Sought};
use publications::Publications;
use queue::Queue;
use worker::Worker;

/// Settings of the fuser.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FuseSettings {
    pub(crate) threads: usize,
    pub(crate) interval: Duration,
    pub(crate) cpu_share: f64,
    /// Length of its lines from which on a cell is drafted, metres.
    pub(crate) draft_from_m: f64,
    pub(crate) max_contributions: usize,
    pub(crate) versions_kept: Duration,
    pub(crate) most_events: usize,
    pub(crate) events_kept: Duration,
    /// Length of the map's lines up to which drives without GNSS are sought on it, metres.
    pub(crate) most_searched_m: f64,
}

impl FuseSettings {
    pub(crate) fn of(config: &ServerConfig) -> Self {
        Self {
            threads: config.fuse_threads,
            interval: Duration::from_millis(config.fuse_interval_ms),
            cpu_share: config.fuse_cpu_share,
            draft_from_m: 1e3 * config.fuse_draft_km,
            max_contributions: config.max_contributions_per_cell,
            versions_kept: Duration::from_secs(config.cell_versions_kept_s),
            most_events: config.max_events_per_cell,
            events_kept: Duration::from_secs(config.cell_events_kept_s),
            most_searched_m: 1e3 * config.max_localization_km,
        }
    }
}

/// Takes what drives say and keeps the cells fused. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Fuser {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    settings: FuseSettings,
    map: SharedMap,
    queue: Mutex<Queue>,
    bases: Bases,
    drafts: Drafts,
    footprints: Footprints,
    /// The map as drives without GNSS are sought on it.
    searched: Mutex<SearchedMap>,
    /// Told when there is more in the queue, or nothing more will come.
    woken: Condvar,
    /// Drives that a crash interrupted have been asked what they say.
    recovered: AtomicBool,
    stopping: AtomicBool,
    /// Counts tasks that were done.
    done: watch::Sender<u64>,
}

/// The threads that fuse.
#[derive(Debug)]
pub(crate) struct FuseThreads {
    fuser: Fuser,
    threads: Vec<JoinHandle<()>>,
}

impl Fuser {
    /// Reads what is told of every cell, finds out which are dirty, and starts the threads. Reads the disk.
    pub(crate) fn start(
        settings: FuseSettings,
        store: &CellStore,
        map: SharedMap,
    ) -> Result<FuseThreads, JournalError> {
        store.adopt_format(FORMAT)?;
        let told = store.told::<CellRecord>()?.into_iter();
        let records: BTreeMap<CellId, CellRecord> = told
            .map(|(cell, (version, told))| {
                (cell, CellRecord { version: CellVersion(version), ..told.unwrap_or_default() })
            })
            .collect();
        let facts = store.facts()?;
        let purges: BTreeSet<CellId> = store.purges()?.into_iter().collect();
        let now = Instant::now();
        let mut queue = Queue::new(settings.interval);
        let dirty = |cell: &CellId| {
            let fused_from = records.get(cell).map(|record| record.fingerprint);
            let now = facts.get(cell).map(|facts| fingerprint(facts.values()));
            fused_from != now.or(fused_from.map(|_| fingerprint([]))) || purges.contains(cell)
        };
        let cells: BTreeSet<CellId> = records.keys().chain(facts.keys()).chain(&purges).copied().collect();
        for cell in cells.into_iter().filter(dirty) {
            queue.touch_cell(cell, now);
        }
        for (session, contributed) in store.contributed()? {
            queue.has_contributed(session, contributed);
        }
        let publications = Publications::open(store, &records)?;
        map.begin(records, publications, store.clone());
        for (session, sought) in store.sought::<Sought>()? {
            if sought.is_none() {
                queue.locate(session, now);
            }
            map.tell_sought(session, Some(sought.unwrap_or_default()));
        }
        let shared = Shared {
            settings,
            map,
            queue: Mutex::new(queue),
            bases: Bases::new(),
            drafts: Drafts::new(settings.draft_from_m),
            footprints: Footprints::new(),
            searched: Mutex::default(),
            woken: Condvar::new(),
            recovered: AtomicBool::new(false),
            stopping: AtomicBool::new(false),
            done: watch::Sender::default(),
        };
        let fuser = Self { shared: Arc::new(shared) };
        fuser.tell_dirty(&fuser.queue());
        let threads = (0..settings.threads).map(|number| {
            let worker = Worker::new(fuser.clone(), store.clone());
            let builder = thread::Builder::new().name(format!("lanemap-fuse-{number}"));
            let spawned = builder.spawn(move || worker.run());
            spawned.map_err(|error| JournalError::Store(format!("a fusing thread does not start: {error}")))
        });
        Ok(FuseThreads { threads: threads.collect::<Result<_, _>>()?, fuser })
    }

    /// Begins to fuse cells: drives that a crash interrupted have said what they have to say, so that no cell is fused
    /// without them.
    pub(crate) fn begin(&self) {
        let mut queue = self.queue();
        self.shared.recovered.store(true, Ordering::Relaxed);
        self.seek_where_map_grew(&mut queue);
        drop(queue);
        self.shared.woken.notify_all();
    }

    /// Takes what a drive says now, in the place of what it said before. Does not wait.
    pub(crate) fn offer(&self, offer: Offer) {
        let mut queue = self.queue();
        if queue.offer(offer, Instant::now()) {
            self.tell_dirty(&queue);
            self.shared.woken.notify_all();
        }
    }

    /// Whether the cells do not have all of a session's map of this version, as far as they are told.
    pub(crate) fn is_behind(&self, session: SessionId, version: MapVersion) -> bool {
        self.queue().contributed(session).is_none_or(|contributed| contributed.version != version)
    }

    /// Drops what sessions have offered, which are being deleted; waits where some of it is in work. They offer nothing
    /// more.
    pub(crate) async fn drop_offers(&self, sessions: &[SessionId]) {
        self.wait_until(|queue| sessions.iter().all(|session| queue.drop_offer(*session))).await;
    }

    /// Fuses the cells to which deleted sessions contributed, now that the store has nothing of them.
    pub(crate) async fn fuse_without(&self, sessions: &[SessionId]) {
        let map = &self.shared.map;
        let mut withdrawn = Vec::new();
        let cells: Vec<CellId> = {
            let mut queue = self.queue();
            let mut cells: BTreeSet<CellId> =
                sessions.iter().filter_map(|session| queue.forget(*session)).flat_map(|left| left.cells).collect();
            for session in sessions {
                map.tell_sought(*session, None);
            }
            // The store has taken those off the map that were found on these cells.
            for (session, _) in map.all_sought().into_iter().filter(|(_, sought)| sought.is_aligned()) {
                let lies_on_them = |left: &Contributed| left.cells.iter().any(|cell| cells.contains(cell));
                if queue.contributed(session).is_some_and(lies_on_them) {
                    withdrawn.push((session, queue.forget(session).unwrap_or_default().cells));
                    map.tell_sought(session, Some(Sought::default()));
                }
            }
            cells.extend(withdrawn.iter().flat_map(|(_, left)| left.iter().copied()));
            for cell in &cells {
                queue.touch_cell(*cell, Instant::now());
            }
            self.tell_dirty(&queue);
            cells.into_iter().collect()
        };
        self.shared.woken.notify_all();
        self.wait_until(|queue| cells.iter().all(|cell| !queue.is_dirty(*cell))).await;
        let mut queue = self.queue();
        for (session, _) in withdrawn {
            queue.locate(session, Instant::now());
        }
        self.tell_dirty(&queue);
        drop(queue);
        self.shared.woken.notify_all();
    }

    /// Has the drives sought again that were not found on a smaller map.
    fn seek_where_map_grew(&self, queue: &mut Queue) {
        let map_m = self.shared.map.line_m();
        for (session, sought) in self.shared.map.all_sought() {
            if sought.map_grew(map_m) {
                queue.locate(session, Instant::now());
            }
        }
    }

    /// Waits until the queue is as it should be, or nothing is done any more.
    async fn wait_until(&self, holds: impl Fn(&mut Queue) -> bool) {
        let mut done = self.shared.done.subscribe();
        while !holds(&mut self.queue()) && !self.is_stopping() {
            if done.changed().await.is_err() {
                return;
            }
        }
    }

    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.shared.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_stopping(&self) -> bool {
        self.shared.stopping.load(Ordering::Relaxed)
    }

    /// Tells readers which cells are dirty, and how many drives wait.
    fn tell_dirty(&self, queue: &Queue) {
        self.shared.map.tell_waiting(queue.dirty_cells(), queue.waiting_offers());
    }
}

impl FuseThreads {
    pub(crate) fn fuser(&self) -> Fuser {
        self.fuser.clone()
    }

    /// Ends the threads once what drives have offered is in the store; dirty cells are fused after the next start.
    pub(crate) async fn stop(self) {
        self.fuser.shared.stopping.store(true, Ordering::Relaxed);
        self.fuser.shared.woken.notify_all();
        let join = move || self.threads.into_iter().map(JoinHandle::join).filter(Result::is_err).count();
        if !matches!(tokio::task::spawn_blocking(join).await, Ok(0)) {
            tracing::error!("a fusing thread has failed");
        }
    }
}

/// Milliseconds since the Unix epoch.
fn now_ms() -> u64 {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since_epoch.as_millis()).unwrap_or(u64::MAX)
}
