//! What readers see of a session: whole versions of its map, swapped in at once.
//!
//! A session's actor publishes; HTTP and gRPC read. A reader holds an [`Arc`] of one version for as long as it likes and
//! never waits for a writer. How often an actor publishes is bounded by `publish_interval_ms`.

use std::{
    collections::BTreeMap,
    fmt,
    sync::{
        Arc, PoisonError, RwLock,
        atomic::{AtomicU64, Ordering},
    },
};

use arc_swap::ArcSwap;
use lanemap_core::{
    LaneMap, Preset, Sequence, TimestampNs,
    geometry::{Pose, georeference::Georeference},
};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use super::id::SessionId;

/// Version of a session's map: the number of frames in it. The same version of a session always has the same map.
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

/// One version of a session's map.
#[derive(Clone, Debug)]
pub struct PublishedMap {
    /// The session.
    pub session: SessionId,
    /// Number of frames in the map.
    pub version: MapVersion,
    /// Whether frames are coming. May change without a new version.
    pub state: SessionState,
    /// The mapper of the session.
    pub preset: Preset,
    /// The lanes, map frame, metres.
    pub map: Arc<LaneMap>,
    /// Corrected pose of the vehicle at the last frame.
    pub map_from_vehicle: Pose,
    /// Sequence of the last frame; `None` before the first.
    pub last_sequence: Option<Sequence>,
    /// Time of measurement of the last frame; the epoch before the first.
    pub last_time: TimestampNs,
    /// Where on the earth the map frame lies, once the drive's GNSS fixes tell.
    pub georeference: Option<Georeference>,
}

/// The published maps of all sessions. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct Sessions {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    maps: RwLock<BTreeMap<SessionId, Arc<ArcSwap<PublishedMap>>>>,
    publications: watch::Sender<u64>,
    removals: AtomicU64,
}

impl Sessions {
    /// The newest map of every session, in the order of their ids.
    #[must_use]
    pub fn list(&self) -> Vec<Arc<PublishedMap>> {
        let maps = self.shared.maps.read().unwrap_or_else(PoisonError::into_inner);
        maps.values().map(|slot| slot.load_full()).collect()
    }

    /// The newest map of one session.
    #[must_use]
    pub fn get(&self, session: &SessionId) -> Option<Arc<PublishedMap>> {
        let maps = self.shared.maps.read().unwrap_or_else(PoisonError::into_inner);
        maps.get(session).map(|slot| slot.load_full())
    }

    /// Makes `published` the newest map of its session: readers that ask from now on get it.
    pub fn publish(&self, published: PublishedMap) {
        let session = published.session;
        let published = Arc::new(published);
        let slot = {
            let maps = self.shared.maps.read().unwrap_or_else(PoisonError::into_inner);
            maps.get(&session).map(Arc::clone)
        };
        if let Some(slot) = slot {
            slot.store(published);
        } else {
            let mut maps = self.shared.maps.write().unwrap_or_else(PoisonError::into_inner);
            maps.insert(session, Arc::new(ArcSwap::new(published)));
        }
        self.shared.publications.send_modify(|count| *count += 1);
    }

    /// Takes a session's map away from readers; those that hold it keep it as long as they like.
    pub fn remove(&self, session: &SessionId) {
        let mut maps = self.shared.maps.write().unwrap_or_else(PoisonError::into_inner);
        if maps.remove(session).is_some() {
            self.shared.removals.fetch_add(1, Ordering::Relaxed);
        }
        drop(maps);
        self.shared.publications.send_modify(|count| *count += 1);
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
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(session: SessionId, version: u64) -> PublishedMap {
        PublishedMap {
            session,
            version: MapVersion(version),
            state: SessionState::Live,
            preset: Preset::Default,
            map: Arc::default(),
            map_from_vehicle: Pose::identity(),
            last_sequence: None,
            last_time: TimestampNs(0),
            georeference: None,
        }
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
}
