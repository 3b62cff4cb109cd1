//! What readers see of a session: whole versions of its map, swapped in at once.
//!
//! A session's actor publishes; HTTP and gRPC read. A reader holds an [`Arc`] of one version for as long as it likes and
//! never waits for a writer. How often an actor publishes is bounded by `publish_interval_ms`.
//!
//! A store holds many drives and few that are awake. Of a session that sleeps only its [`SessionSummary`] stays in
//! memory; its map is read from the store when somebody asks for it, and kept in a cache of bounded size.

use std::{
    collections::BTreeMap,
    fmt,
    ops::Deref,
    sync::{
        Arc, PoisonError, RwLock,
        atomic::{AtomicU64, Ordering},
    },
};

use arc_swap::{ArcSwap, ArcSwapOption};
use lanemap_core::{
    ControlPoint, LaneMap, Params, Preset, Sequence, TimestampNs,
    geometry::{Pose, georeference::Georeference},
};
use nalgebra::Point3;
use quick_cache::{Weighter, sync::Cache};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use super::{
    id::SessionId,
    way::{Way, WayPoint},
};
use crate::journal::{JournalError, SessionRecord};

/// Version of a session's map: the number of frames in it, and one more once a drive is over whose map the mapper then
/// cleans up (`paper`). The same version of a session always has the same map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct MapVersion(pub u64);

impl fmt::Display for MapVersion {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(formatter)
    }
}

/// Whether frames are coming.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SessionState {
    /// A stream of the drive is open.
    Live,
    /// No stream of the drive is open; it may be resumed.
    Idle,
    /// The drive is over.
    Closed,
}

/// What is told of a session besides its lanes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SessionSummary {
    /// The session.
    pub session: SessionId,
    /// Version of the map.
    pub version: MapVersion,
    /// Whether frames are coming. May change without a new version.
    pub state: SessionState,
    /// The mapper of the session.
    pub preset: Preset,
    /// Number of lanes in the map.
    pub lanes: usize,
    /// Lowest and highest corner of the lanes' control points, metres: east-north-up at the anchor where the session has
    /// a place on the earth, else in its map frame. `None` without lanes.
    pub extent: Option<[Point3<f64>; 2]>,
    /// Corrected pose of the vehicle at the last frame.
    pub map_from_vehicle: Pose,
    /// Sequence of the last frame; `None` before the first.
    pub last_sequence: Option<Sequence>,
    /// Time of measurement of the last frame; the epoch before the first.
    pub last_time: TimestampNs,
    /// Where on the earth the map frame lies, once the drive's GNSS fixes tell.
    pub georeference: Option<Georeference>,
}

impl SessionSummary {
    /// The summary of a drive that has had no frame.
    #[must_use]
    pub fn empty(record: &SessionRecord) -> Self {
        Self {
            session: record.id,
            version: MapVersion(0),
            state: state_without_stream(record),
            preset: record.setup.preset,
            lanes: 0,
            extent: None,
            map_from_vehicle: Pose::identity(),
            last_sequence: None,
            last_time: TimestampNs(0),
            georeference: None,
        }
    }
}

impl SessionSummary {
    /// Number of frames in the map.
    #[must_use]
    pub fn frames(&self) -> u64 {
        self.version.0 - u64::from(is_cleaned_up(self.preset, self.state)).min(self.version.0)
    }
}

/// Whether the map of a drive in this state is the cleaned-up one, which has a version more than it has frames.
pub(super) fn is_cleaned_up(preset: Preset, state: SessionState) -> bool {
    state == SessionState::Closed && Params::preset(preset).landmark.clean_up.is_some()
}

/// The state of a drive to which no stream is open.
pub(super) fn state_without_stream(record: &SessionRecord) -> SessionState {
    if record.ended { SessionState::Closed } else { SessionState::Idle }
}

/// One version of a session's map; reads as its summary, too.
#[derive(Clone, Debug)]
pub struct PublishedMap {
    /// What is told of it.
    pub summary: SessionSummary,
    /// The lanes, map frame, metres.
    pub map: Arc<LaneMap>,
    /// Where the vehicle has been.
    pub way: Way,
}

impl PublishedMap {
    /// A map and its summary, whose number and extent of the lanes are filled in.
    #[must_use]
    pub fn new(mut summary: SessionSummary, map: Arc<LaneMap>, way: Way) -> Self {
        let points = map.lanes.iter().flat_map(|lane| lane.control_points.iter().map(|point| point.position));
        summary.extent = match &summary.georeference {
            Some(georeference) => extent(points.map(|point| georeference.enu_from_map * point)),
            None => extent(points),
        };
        summary.lanes = map.lanes.len();
        Self { summary, map, way }
    }

    /// Bytes that it takes in memory.
    #[must_use]
    pub fn memory_bytes(&self) -> usize {
        let points: usize = self.map.lanes.iter().map(|lane| lane.control_points.len()).sum();
        let lanes = 256 * self.map.lanes.len() + size_of::<ControlPoint>() * points;
        size_of::<Self>() + lanes + size_of::<WayPoint>() * self.way.len()
    }
}

impl Deref for PublishedMap {
    type Target = SessionSummary;

    fn deref(&self) -> &SessionSummary {
        &self.summary
    }
}

/// Lowest and highest corner of points; `None` without points.
#[must_use]
pub fn extent(mut points: impl Iterator<Item = Point3<f64>>) -> Option<[Point3<f64>; 2]> {
    let first = points.next()?;
    Some(points.fold([first, first], |[low, high], point| [low.inf(&point), high.sup(&point)]))
}

/// Reads the map of a session that sleeps.
type ReadMap = dyn Fn(SessionId) -> Result<Option<PublishedMap>, JournalError> + Send + Sync;

/// The published maps of all sessions. Clones share them.
#[derive(Clone)]
pub struct Sessions {
    shared: Arc<Shared>,
}

struct Shared {
    entries: RwLock<BTreeMap<SessionId, Arc<Entry>>>,
    /// Maps of sessions that sleep, the recently read ones.
    asleep: Cache<(SessionId, MapVersion), Arc<PublishedMap>, MemoryWeight>,
    read: ArcSwapOption<Box<ReadMap>>,
    publications: watch::Sender<u64>,
    removals: AtomicU64,
}

struct Entry {
    summary: ArcSwap<SessionSummary>,
    /// The map while the session is awake.
    awake: ArcSwapOption<PublishedMap>,
}

/// Bytes that a map takes in memory.
#[derive(Clone)]
struct MemoryWeight;

impl Weighter<(SessionId, MapVersion), Arc<PublishedMap>> for MemoryWeight {
    fn weight(&self, _: &(SessionId, MapVersion), published: &Arc<PublishedMap>) -> u64 {
        published.memory_bytes() as u64
    }
}

impl fmt::Debug for Sessions {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Sessions").finish_non_exhaustive()
    }
}

impl Default for Sessions {
    fn default() -> Self {
        Self::new(64 * 1024 * 1024)
    }
}

impl Sessions {
    /// No session yet; maps of sessions that sleep take at most `cache_bytes`.
    #[must_use]
    pub fn new(cache_bytes: usize) -> Self {
        // A guess of the number of maps; the cache grows where they are smaller.
        let estimated_maps = 256;
        let shared = Shared {
            entries: RwLock::default(),
            asleep: Cache::with_weighter(estimated_maps, cache_bytes as u64, MemoryWeight),
            read: ArcSwapOption::empty(),
            publications: watch::Sender::default(),
            removals: AtomicU64::new(0),
        };
        Self { shared: Arc::new(shared) }
    }

    /// What is told of every session, in the order of their ids.
    #[must_use]
    pub fn list(&self) -> Vec<Arc<SessionSummary>> {
        let entries = self.shared.entries.read().unwrap_or_else(PoisonError::into_inner);
        entries.values().map(|entry| entry.summary.load_full()).collect()
    }

    /// The same, each with its map where the session is awake.
    pub(crate) fn list_with_awake(&self) -> Vec<(Arc<SessionSummary>, Option<Arc<PublishedMap>>)> {
        let entries = self.shared.entries.read().unwrap_or_else(PoisonError::into_inner);
        let with_map = |entry: &Arc<Entry>| match entry.awake.load_full() {
            // Of one version with it.
            Some(awake) => (Arc::new(awake.summary.clone()), Some(awake)),
            None => (entry.summary.load_full(), None),
        };
        entries.values().map(with_map).collect()
    }

    /// Whether there is a session of this name.
    #[must_use]
    pub fn contains(&self, session: &SessionId) -> bool {
        self.entry(*session).is_some()
    }

    /// The newest map of one session. Reads the store where the session sleeps, which takes milliseconds: not for a task
    /// of the runtime.
    #[must_use]
    pub fn get(&self, session: &SessionId) -> Option<Arc<PublishedMap>> {
        let entry = self.entry(*session)?;
        if let Some(awake) = entry.awake.load_full() {
            return Some(awake);
        }
        let key = (*session, entry.summary.load().version);
        // Nothing more to say of an error: it was logged.
        let published = self.shared.asleep.get_or_insert_with(&key, || self.read(&entry, *session).ok_or(())).ok()?;
        if self.contains(session) {
            return Some(published);
        }
        // Removed while it was read.
        self.shared.asleep.remove(&key);
        None
    }

    /// Reads a map that sleeps; its summary is put right where the last frames came after it was written.
    fn read(&self, entry: &Entry, session: SessionId) -> Option<Arc<PublishedMap>> {
        let read = self.shared.read.load_full()?;
        let published = match read(session) {
            Ok(published) => published?,
            Err(error) => {
                tracing::error!(%session, %error, "the session's map cannot be read");
                return None;
            }
        };
        if entry.summary.load().version < published.version {
            entry.summary.store(Arc::new(published.summary.clone()));
            self.count_publication();
        }
        Some(Arc::new(published))
    }

    /// Makes `published` the newest map of its session, which is awake: readers that ask from now on get it.
    pub fn publish(&self, published: PublishedMap) {
        let published = Arc::new(published);
        let entry = self.entry_for(&published.summary);
        entry.summary.store(Arc::new(published.summary.clone()));
        entry.awake.store(Some(published));
        self.count_publication();
    }

    /// Adds a session that sleeps.
    pub(crate) fn add_asleep(&self, summary: &SessionSummary) {
        self.entry_for(summary);
    }

    /// Lets go of the map of a session that has fallen asleep, in this state.
    pub(crate) fn fall_asleep(&self, session: SessionId, state: SessionState) {
        let Some(entry) = self.entry(session) else { return };
        if let Some(awake) = entry.awake.swap(None) {
            let summary = SessionSummary { state, ..awake.summary.clone() };
            entry.summary.store(Arc::new(summary.clone()));
            let asleep = Arc::new(PublishedMap { summary, map: Arc::clone(&awake.map), way: awake.way.clone() });
            self.shared.asleep.insert((session, asleep.version), asleep);
        }
    }

    /// Tells how maps of sessions that sleep are read.
    pub(crate) fn read_with(
        &self,
        read: impl Fn(SessionId) -> Result<Option<PublishedMap>, JournalError> + Send + Sync + 'static,
    ) {
        self.shared.read.store(Some(Arc::new(Box::new(read))));
    }

    /// Reads no more from the store, which is to be closed.
    pub(crate) fn let_go_of_store(&self) {
        self.shared.read.store(None);
    }

    /// Takes a session's map away from readers; those that hold it keep it as long as they like.
    pub fn remove(&self, session: &SessionId) {
        let mut entries = self.shared.entries.write().unwrap_or_else(PoisonError::into_inner);
        if entries.remove(session).is_some() {
            self.shared.removals.fetch_add(1, Ordering::Relaxed);
        }
        drop(entries);
        self.shared.asleep.retain(|(cached, _), _| cached != session);
        self.count_publication();
    }

    /// Counts removals: tells who keeps something of each session that something is to be dropped.
    #[must_use]
    pub fn removals(&self) -> u64 {
        self.shared.removals.load(Ordering::Relaxed)
    }

    /// Counts publications of all sessions: tells a reader that something is newer than when it looked.
    #[must_use]
    pub fn publications(&self) -> watch::Receiver<u64> {
        self.shared.publications.subscribe()
    }

    fn count_publication(&self) {
        self.shared.publications.send_modify(|count| *count += 1);
    }

    fn entry(&self, session: SessionId) -> Option<Arc<Entry>> {
        let entries = self.shared.entries.read().unwrap_or_else(PoisonError::into_inner);
        entries.get(&session).map(Arc::clone)
    }

    fn entry_for(&self, summary: &SessionSummary) -> Arc<Entry> {
        self.entry(summary.session).unwrap_or_else(|| {
            let mut entries = self.shared.entries.write().unwrap_or_else(PoisonError::into_inner);
            let fresh = || {
                let summary = ArcSwap::from_pointee(summary.clone());
                Arc::new(Entry { summary, awake: ArcSwapOption::empty() })
            };
            Arc::clone(entries.entry(summary.session).or_insert_with(fresh))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::sample;

    fn map(session: SessionId, version: u64) -> PublishedMap {
        let published = sample::published(1, 2);
        let summary = SessionSummary { session, version: MapVersion(version), ..published.summary };
        PublishedMap::new(summary, published.map, published.way)
    }

    #[test]
    fn a_reader_keeps_its_version_while_a_newer_one_is_published() {
        let sessions = Sessions::default();
        let id = SessionId::next(None, 0, 1);
        sessions.publish(map(id, 1));
        let held = sessions.get(&id).unwrap();
        sessions.publish(map(id, 2));
        assert_eq!(held.version, MapVersion(1));
        assert_eq!(sessions.get(&id).unwrap().version, MapVersion(2));
    }

    #[test]
    fn sessions_are_listed_in_the_order_of_their_ids() {
        let sessions = Sessions::default();
        let first = SessionId::next(None, 0, 1);
        let second = SessionId::next(Some(first), 0, 1);
        sessions.publish(map(second, 1));
        sessions.publish(map(first, 1));
        let listed: Vec<_> = sessions.list().iter().map(|map| map.session).collect();
        assert_eq!(listed, [first, second]);
    }

    #[test]
    fn maps_of_sessions_that_sleep_are_read_again_when_their_cache_is_full() {
        let (count, reads) = (50, Arc::new(AtomicU64::new(0)));
        let ids: Vec<_> = (0..count).map(|number| SessionId::next(None, 0, number)).collect();
        // Room for a few of them.
        let one = MemoryWeight.weight(&(ids[0], MapVersion(1)), &Arc::new(map(ids[0], 1)));
        let sessions = Sessions::new(usize::try_from(5 * one).unwrap());
        let counted = Arc::clone(&reads);
        sessions.read_with(move |session| {
            counted.fetch_add(1, Ordering::Relaxed);
            Ok(Some(map(session, 1)))
        });
        for id in &ids {
            sessions.publish(map(*id, 1));
            sessions.fall_asleep(*id, SessionState::Idle);
        }
        assert!(sessions.shared.asleep.weight() <= 5 * one);
        for id in &ids {
            assert_eq!(sessions.get(id).unwrap().session, *id);
        }
        assert!(reads.load(Ordering::Relaxed) >= count - 5);
        assert!(sessions.shared.asleep.weight() <= 5 * one);
        assert_eq!(sessions.list().len(), ids.len());
    }

    #[test]
    fn frames_that_came_after_the_summary_was_written_are_in_it_once_the_map_was_read() {
        let sessions = Sessions::default();
        let id = SessionId::next(None, 0, 1);
        sessions.add_asleep(&map(id, 3).summary);
        sessions.read_with(move |session| Ok(Some(map(session, 7))));
        assert_eq!(sessions.list()[0].version, MapVersion(3));
        assert_eq!(sessions.get(&id).unwrap().version, MapVersion(7));
        assert_eq!(sessions.list()[0].version, MapVersion(7));
    }
}
