//! Walks through the drives: the state of all of them at which each began, so that its pages are of one state.
//!
//! A drive's map has no earlier versions in the store. What grows is held here: of each walk the list of drives and their
//! versions, and the maps of those that are awake, which are shared with the session for as long as that does not go on. Walks
//! of the same state are one. Memory is bounded: the walk that was asked for longest ago gives way. A walk whose state is
//! still that of now goes on in any case, also after a restart.

use std::{fmt, sync::Arc};

use quick_cache::{Weighter, sync::Cache};

use crate::{
    serve::{entity_tag::EntityTag, sessions::identity},
    session::{PublishedMap, SessionSummary, Sessions},
};

/// The walks that are held. Clones share them.
#[derive(Clone)]
pub(in crate::serve) struct DriveWalks {
    held: Arc<Cache<u64, Arc<DriveWalk>, Weight>>,
}

/// All drives in one state.
pub(in crate::serve) struct DriveWalk {
    /// Names the state.
    pub(in crate::serve) number: u64,
    /// In the order of their ids.
    drives: Vec<(Arc<SessionSummary>, Option<Arc<PublishedMap>>)>,
    sessions: Sessions,
}

#[derive(Clone)]
struct Weight;

impl Weighter<u64, Arc<DriveWalk>> for Weight {
    fn weight(&self, _: &u64, walk: &Arc<DriveWalk>) -> u64 {
        let maps = walk.drives.iter().filter_map(|(_, awake)| awake.as_ref());
        let held: usize = maps.map(|map| map.memory_bytes()).sum();
        (held + 32 * walk.drives.len() + 64) as u64
    }
}

impl fmt::Debug for DriveWalks {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("DriveWalks").finish_non_exhaustive()
    }
}

impl DriveWalks {
    /// None yet, and at most so many bytes.
    pub(in crate::serve) fn new(bytes: usize) -> Self {
        Self { held: Arc::new(Cache::with_weighter(16, bytes as u64, Weight)) }
    }

    /// A walk of the state of now.
    pub(in crate::serve) fn begin(&self, sessions: &Sessions) -> Arc<DriveWalk> {
        let walk = Arc::new(DriveWalk::of(sessions));
        if self.held.get(&walk.number).is_none() {
            self.held.insert(walk.number, Arc::clone(&walk));
        }
        walk
    }

    /// The walk of a state; `None` where that is neither held nor the one of now.
    pub(in crate::serve) fn go_on(&self, number: u64, sessions: &Sessions) -> Option<Arc<DriveWalk>> {
        self.held.get(&number).or_else(|| Some(self.begin(sessions)).filter(|walk| walk.number == number))
    }
}

impl DriveWalk {
    fn of(sessions: &Sessions) -> Self {
        let drives = sessions.list_with_awake();
        let identities: Vec<_> = drives.iter().map(|(summary, _)| identity(summary)).collect();
        Self { number: EntityTag::of(identities).number(), drives, sessions: sessions.clone() }
    }

    /// What is told of the drives.
    pub(in crate::serve) fn summaries(&self) -> impl Iterator<Item = (usize, &Arc<SessionSummary>)> {
        self.drives.iter().map(|(summary, _)| summary).enumerate()
    }

    /// The map of a drive as it was; `None` where it is gone: the drive was deleted, or went on after it had slept. Reads the
    /// store: not for a task of the runtime.
    pub(in crate::serve) fn map(&self, drive: usize) -> Option<Arc<PublishedMap>> {
        let (summary, awake) = &self.drives[drive];
        if !self.sessions.contains(&summary.session) {
            return None;
        }
        let map = awake.clone().or_else(|| self.sessions.get(&summary.session))?;
        (identity(&map) == identity(summary)).then_some(map)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::sample::published;

    #[test]
    fn a_walk_keeps_its_state_while_drives_go_on_and_loses_those_that_are_deleted() {
        let (sessions, walks) = (Sessions::default(), DriveWalks::new(1 << 24));
        sessions.publish(published(1, 3));
        sessions.publish(published(2, 3));
        let walk = walks.begin(&sessions);
        assert_eq!(walks.begin(&sessions).number, walk.number, "walks of one state are one");
        let mut grown = published(1, 5);
        grown.summary.version.0 += 1;
        sessions.publish(grown);
        let walk = walks.go_on(walk.number, &sessions).unwrap();
        assert_eq!(walk.map(0).unwrap().map.lanes.len(), 3);
        assert_ne!(walks.begin(&sessions).number, walk.number);
        sessions.remove(&walk.summaries().next().unwrap().1.session);
        assert!(walk.map(0).is_none() && walk.map(1).is_some());
    }

    #[test]
    fn a_walk_that_is_not_held_goes_on_where_its_state_is_that_of_now() {
        let sessions = Sessions::default();
        sessions.publish(published(1, 3));
        let number = DriveWalks::new(1 << 24).begin(&sessions).number;
        let walks = DriveWalks::new(1 << 24);
        assert!(walks.go_on(number, &sessions).is_some());
        assert!(walks.go_on(number + 1, &sessions).is_none());
    }

    #[test]
    fn walks_that_are_too_many_give_way() {
        let (sessions, walks) = (Sessions::default(), DriveWalks::new(20_000));
        let numbers: Vec<u64> = (1..=50)
            .map(|number| {
                sessions.publish(published(number, 2));
                walks.begin(&sessions).number
            })
            .collect();
        assert!(walks.go_on(numbers[0], &sessions).is_none());
    }
}
