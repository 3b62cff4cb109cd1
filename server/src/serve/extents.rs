//! The border of each session's lanes on the earth, computed once per version of its map.
//!
//! A store holds many drives that are over and few that are live. A query for a box must not walk every control point of
//! all of them: it asks for their borders here, and walks only the drives that the box touches.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use super::bounds::Bounds;
use crate::session::{MapVersion, SessionId, SessionSummary, Sessions};

/// The borders that are known. Clones share them; there is one per session, and the registry bounds the sessions.
#[derive(Clone, Debug, Default)]
pub struct Extents {
    known: Arc<Mutex<BTreeMap<SessionId, Known>>>,
    /// [`Sessions::removals`] at the last [`Extents::drop_removed`].
    removals: Arc<AtomicU64>,
}

#[derive(Clone, Copy, Debug)]
struct Known {
    version: MapVersion,
    bounds: Option<Bounds>,
}

impl Extents {
    /// The border of a session's lanes; `None` without lanes, or without a place on the earth.
    #[must_use]
    pub fn of(&self, map: &SessionSummary) -> Option<Bounds> {
        let georeference = map.georeference.as_ref()?;
        let known = self.lock().get(&map.session).copied();
        if let Some(known) = known.filter(|known| known.version == map.version) {
            return known.bounds;
        }
        let bounds = map.extent.and_then(|corners| Bounds::around_extent(georeference, corners));
        self.lock().insert(map.session, Known { version: map.version, bounds });
        bounds
    }

    /// Drops the borders of sessions that are no longer there.
    pub fn drop_removed(&self, sessions: &Sessions) {
        let removals = sessions.removals();
        if self.removals.swap(removals, Ordering::Relaxed) != removals {
            self.lock().retain(|session, _| sessions.contains(session));
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, BTreeMap<SessionId, Known>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        serve::sample::{georeference, placed, published},
        session::PublishedMap,
    };
    use lanemap_core::LaneMap;

    #[test]
    fn a_border_is_that_of_the_newest_version_and_goes_with_the_place_on_the_earth() {
        let extents = Extents::default();
        assert_eq!(extents.of(&published(1, 3)), None);
        let map = placed(published(1, 3), georeference(11.58, 48.14));
        let three_lanes = extents.of(&map).unwrap();
        let summary = SessionSummary { version: MapVersion(map.version.0 + 1), ..map.summary };
        let map = PublishedMap::new(summary, Arc::new(LaneMap { lanes: map.map.lanes[..1].to_vec() }), map.way);
        let one_lane = extents.of(&map).unwrap();
        assert!(one_lane.west > three_lanes.west, "lanes lie side by side, to the west");
    }
}
