//! Readers that follow the map: each is told which cells changed since it was told last, as fast as it reads.
//!
//! Nothing is queued for a reader: it holds a revision, and what changed since is looked up among the
//! [publications](super::publications) when it can take more. So a slow reader is told of a cell once, from the version that
//! it has to the newest, and what lies in between is skipped. It costs the memory of the changes that it is being told.
//!
//! What is looked up at a time is a *stretch*, from one revision to another, with one change for each cell. The
//! [`Position`] after each change names the stretch and how far the reader came in it, so that one that was cut off is told
//! the rest of the same stretch, of the same versions, and no change that it has seen.

use std::{
    collections::{BTreeSet, VecDeque},
    fmt,
    str::FromStr,
    sync::Arc,
};

use lanemap_core::fleet::CellId;
use thiserror::Error;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::{
    MapRevision, SharedMap,
    publications::{CellChange, RevisionError},
};
use crate::telemetry;

/// How far a reader came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Position {
    /// It was told all up to a revision.
    At(MapRevision),
    /// It is being told what changed between two revisions.
    Within {
        /// The older one.
        since: MapRevision,
        /// The newer one.
        until: MapRevision,
        /// The last change that it was told, by the revision of its last publication.
        told: MapRevision,
    },
}

impl fmt::Display for Position {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::At(revision) => revision.fmt(formatter),
            Self::Within { since, until, told } => write!(formatter, "{since}-{until}-{told}"),
        }
    }
}

impl FromStr for Position {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let numbers: Option<Vec<MapRevision>> = text.split('-').map(|number| number.parse().ok()).collect();
        match numbers.as_deref() {
            Some([at]) => Ok(Self::At(*at)),
            Some([since, until, told]) if since <= told && told <= until => {
                Ok(Self::Within { since: *since, until: *until, told: *told })
            }
            _ => Err("it must be a revision of the map, a whole number, or the id of an event".to_owned()),
        }
    }
}

/// Which cells a reader follows.
#[derive(Clone, Debug, Default)]
pub enum Followed {
    /// All of them, also those that are yet to come.
    #[default]
    All,
    /// These.
    Cells(BTreeSet<CellId>),
    /// Those within four borders, degrees: west, south, east, north; west above east runs over the antimeridian.
    Within([f64; 4]),
}

impl Followed {
    fn has(&self, cell: CellId) -> bool {
        match self {
            Self::All => true,
            Self::Cells(cells) => cells.contains(&cell),
            Self::Within([west, south, east, north]) => {
                let bounds = cell.bounds();
                let across = |low: f64, high: f64| bounds.west <= high && bounds.east >= low;
                let beside =
                    if west <= east { across(*west, *east) } else { across(*west, 180.0) || across(-180.0, *east) };
                beside && bounds.south <= *north && bounds.north >= *south
            }
        }
    }
}

/// What a reader is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Told {
    /// A cell changed.
    Cell {
        /// From which version to which.
        change: CellChange,
        /// Where the reader is once it has this.
        position: Position,
    },
    /// What changed since its revision is not known: it must take the map whole, and goes on from the newest revision.
    Reset {
        /// The newest revision.
        newest: MapRevision,
        /// The oldest since which changes are known.
        oldest: MapRevision,
    },
}

/// Why nobody is told anything.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum FollowError {
    /// Too many readers follow already.
    #[error("{most} readers follow the map already, which is the most (max_change_readers); come again later")]
    TooMany {
        /// The most.
        most: usize,
    },
    /// The revision is not there yet.
    #[error("there is no revision {asked} of the map yet: it is at {newest}")]
    InTheFuture {
        /// The revision that was asked for.
        asked: MapRevision,
        /// The newest.
        newest: MapRevision,
    },
}

/// Lets readers follow the map, so many at a time. Clones share the places.
#[derive(Clone, Debug)]
pub struct Followers {
    map: SharedMap,
    places: Arc<Semaphore>,
    most: usize,
}

impl Followers {
    /// At most `most` followers of `map` at a time.
    #[must_use]
    pub fn new(map: SharedMap, most: usize) -> Self {
        Self { map, places: Arc::new(Semaphore::new(most)), most }
    }

    /// A reader that goes on from where it was; `None`: from now.
    ///
    /// # Errors
    /// No place is free, or the position lies in the future.
    pub fn follow(&self, from: Option<Position>, followed: Followed) -> Result<Follower, FollowError> {
        let place = Arc::clone(&self.places).try_acquire_owned();
        let place = place.map_err(|_| FollowError::TooMany { most: self.most })?;
        let publications = self.map.publications();
        let newest = self.map.revision();
        let position = from.unwrap_or(Position::At(newest));
        let (Position::At(asked) | Position::Within { until: asked, .. }) = position;
        if asked > newest {
            return Err(FollowError::InTheFuture { asked, newest });
        }
        metrics::gauge!(telemetry::CHANGE_READERS).increment(1.0);
        let (map, stretch) = (self.map.clone(), None);
        Ok(Follower { map, publications, followed, position, stretch, _place: place })
    }

    /// The map that they follow.
    #[must_use]
    pub fn map(&self) -> &SharedMap {
        &self.map
    }
}

/// One reader that follows the map.
#[derive(Debug)]
pub struct Follower {
    map: SharedMap,
    publications: watch::Receiver<u64>,
    followed: Followed,
    position: Position,
    stretch: Option<Stretch>,
    _place: OwnedSemaphorePermit,
}

impl Drop for Follower {
    fn drop(&mut self) {
        metrics::gauge!(telemetry::CHANGE_READERS).decrement(1.0);
    }
}

/// What changed between two revisions, as far as it is still to be told.
#[derive(Debug)]
struct Stretch {
    since: MapRevision,
    until: MapRevision,
    /// Whether the publications between the two are known, so that one can go on within.
    is_known: bool,
    changes: VecDeque<CellChange>,
}

impl Follower {
    /// How far the reader came.
    #[must_use]
    pub fn position(&self) -> Position {
        self.position
    }

    /// What it is told next; waits until there is something. Nothing is lost where the wait is given up.
    pub async fn next(&mut self) -> Told {
        loop {
            if let Some(told) = self.told() {
                return told;
            }
            if self.publications.changed().await.is_err() {
                // Nothing is published any more.
                std::future::pending::<()>().await;
            }
        }
    }

    /// What it is told now.
    fn told(&mut self) -> Option<Told> {
        if let Some(change) = self.stretch.as_mut().and_then(|stretch| stretch.changes.pop_front()) {
            return Some(self.tell(change));
        }
        self.stretch = None;
        loop {
            let stretch = match self.look_up() {
                Ok(stretch) => stretch,
                Err(RevisionError::NotKept { oldest, newest, .. }) => {
                    self.position = Position::At(newest);
                    return Some(Told::Reset { newest, oldest });
                }
                // A map falls back only where another store was put in the place of its own.
                Err(RevisionError::InTheFuture { newest, .. }) => {
                    self.position = Position::At(newest);
                    return Some(Told::Reset { newest, oldest: newest });
                }
            };
            let (until, has_more) = (stretch.until, stretch.until < self.map.revision());
            let change = self.stretch.insert(stretch).changes.pop_front();
            match change {
                Some(change) => return Some(self.tell(change)),
                None => self.position = Position::At(until),
            }
            if !has_more {
                return None;
            }
        }
    }

    fn tell(&mut self, change: CellChange) -> Told {
        if let Some(Stretch { since, until, is_known, changes }) = &self.stretch {
            self.position = match (changes.is_empty(), is_known) {
                (true, _) => Position::At(*until),
                (false, true) => Position::Within { since: *since, until: *until, told: change.revision },
                // It is told all of it again.
                (false, false) => Position::At(*since),
            };
        }
        Told::Cell { change, position: self.position }
    }

    fn look_up(&self) -> Result<Stretch, RevisionError> {
        let found = match self.position {
            Position::At(since) => self.map.changed_between(since, None).map(|changes| (since, since, changes)),
            Position::Within { since, until, told } => {
                self.map.changed_between(since, Some(until)).map(|changes| (since, told, changes))
            }
        };
        let (since, told, changes, is_known) = match found {
            Ok((since, told, changes)) => (since, told, changes, true),
            // Who has nothing needs no past: every cell comes whole.
            Err(RevisionError::NotKept { .. }) if self.has_nothing() => {
                (MapRevision(0), MapRevision(0), self.map.all_cells(), false)
            }
            Err(error) => return Err(error),
        };
        let wanted = |change: &CellChange| change.revision > told && self.followed.has(change.cell);
        let until = changes.to_revision;
        Ok(Stretch { since, until, is_known, changes: changes.cells.into_iter().filter(wanted).collect() })
    }

    fn has_nothing(&self) -> bool {
        matches!(self.position, Position::At(MapRevision(0)) | Position::Within { since: MapRevision(0), .. })
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use futures::FutureExt;
    use lanemap_proto::v1;

    use super::*;
    use crate::fuse::{CellRecord, CellVersion, publications::Publication};

    fn cell(number: u32) -> CellId {
        CellId::new(number, 5).unwrap()
    }

    fn publish(map: &SharedMap, number: u32) {
        let from_version = map.record(cell(number)).map(|record| record.version).unwrap_or_default();
        let to_version = CellVersion(from_version.0 + 1);
        let mut turn = map.turn();
        let publication = Publication {
            revision: turn.next(),
            cell: cell(number),
            from_version,
            to_version,
            published_ms: 0,
            lines_upserted: 1,
            lines_removed: 0,
        };
        let record = CellRecord { version: to_version, ..CellRecord::default() };
        map.publish(cell(number), record, Some((v1::CellMap::default(), Bytes::new())), Some(publication));
    }

    fn followers() -> Followers {
        Followers::new(SharedMap::new(0), 2)
    }

    /// All that a reader is told now: cell, from and to version, position.
    fn told(follower: &mut Follower) -> Vec<(u32, u64, u64, String)> {
        std::iter::from_fn(|| follower.next().now_or_never())
            .map(|told| match told {
                Told::Cell { change, position } => {
                    (change.cell.x(), change.from_version.0, change.to_version.0, position.to_string())
                }
                Told::Reset { newest, .. } => (0, 0, 0, format!("reset {newest}")),
            })
            .collect()
    }

    fn event(number: u32, from: u64, to: u64, position: &str) -> (u32, u64, u64, String) {
        (number, from, to, position.to_owned())
    }

    #[test]
    fn a_reader_that_keeps_up_is_told_every_version() {
        let followers = followers();
        let mut reader = followers.follow(None, Followed::All).unwrap();
        for (revision, version) in [("1", 1), ("2", 2)] {
            publish(followers.map(), 7);
            assert_eq!(told(&mut reader), [event(7, version - 1, version, revision)]);
        }
    }

    #[test]
    fn a_reader_that_is_slow_is_told_of_each_cell_once_from_what_it_has_to_the_newest() {
        let followers = followers();
        publish(followers.map(), 7);
        let mut reader = followers.follow(None, Followed::All).unwrap();
        for number in [7, 8, 7, 7, 9] {
            publish(followers.map(), number);
        }
        assert_eq!(told(&mut reader), [event(8, 0, 1, "1-6-3"), event(7, 1, 4, "1-6-5"), event(9, 0, 1, "6")]);
    }

    #[test]
    fn a_reader_that_is_cut_off_goes_on_within_the_same_stretch_however_the_map_went_on() {
        let followers = followers();
        for number in [7, 8, 7] {
            publish(followers.map(), number);
        }
        let mut reader = followers.follow(Some(Position::At(MapRevision(0))), Followed::All).unwrap();
        assert_eq!(told(&mut reader), [event(8, 0, 1, "0-3-2"), event(7, 0, 2, "3")]);
        publish(followers.map(), 8);
        publish(followers.map(), 7);
        let position = Some("0-3-2".parse().unwrap());
        let mut reader = followers.follow(position, Followed::All).unwrap();
        assert_eq!(
            told(&mut reader),
            [event(7, 0, 2, "3"), event(8, 1, 2, "3-5-4"), event(7, 2, 3, "5")],
            "the version of the stretch, then what came after"
        );
    }

    #[test]
    fn a_reader_of_some_cells_is_told_of_no_other_and_comes_as_far_as_all() {
        let followers = followers();
        let mut reader = followers.follow(None, Followed::Cells([cell(8)].into())).unwrap();
        for number in [7, 8, 7] {
            publish(followers.map(), number);
        }
        assert_eq!(told(&mut reader), [event(8, 0, 1, "3")]);
        publish(followers.map(), 7);
        assert_eq!((told(&mut reader), reader.position()), (vec![], Position::At(MapRevision(4))));
    }

    #[test]
    fn a_reader_whose_revision_is_not_kept_starts_anew_and_one_that_has_nothing_is_told_all() {
        let followers = followers();
        for number in [7, 8, 7] {
            publish(followers.map(), number);
        }
        followers.map().drop_publications_until(MapRevision(2));
        let mut behind = followers.follow(Some(Position::At(MapRevision(1))), Followed::All).unwrap();
        assert_eq!(told(&mut behind), [event(0, 0, 0, "reset 3")]);
        let mut new = followers.follow(Some(Position::At(MapRevision(0))), Followed::All).unwrap();
        assert_eq!(told(&mut new), [event(7, 0, 2, "0"), event(8, 0, 1, "3")]);
        drop(new);
        publish(followers.map(), 9);
        assert_eq!(told(&mut behind), [event(9, 0, 1, "4")]);
    }

    #[test]
    fn no_more_follow_than_there_are_places_and_a_place_comes_back() {
        let followers = followers();
        let readers = [(); 2].map(|()| followers.follow(None, Followed::All).unwrap());
        assert_eq!(followers.follow(None, Followed::All).unwrap_err(), FollowError::TooMany { most: 2 });
        drop(readers);
        assert!(followers.follow(None, Followed::All).is_ok());
        let future = followers.follow(Some(Position::At(MapRevision(9))), Followed::All).unwrap_err();
        assert_eq!(future.to_string(), "there is no revision 9 of the map yet: it is at 0");
        assert_eq!(followers.places.available_permits(), 2);
    }

    #[test]
    fn cells_within_borders_are_found_over_the_antimeridian_too() {
        let (last, first) = (CellId::new(16_383, 8_000).unwrap(), CellId::new(0, 8_000).unwrap());
        let over = Followed::Within([179.99, 0.0, -179.99, 10.0]);
        assert!(over.has(last) && over.has(first) && !over.has(CellId::new(8_000, 8_000).unwrap()));
        assert!(!Followed::Within([179.99, -10.0, -179.99, -5.0]).has(first));
    }

    #[test]
    fn a_position_survives_its_text_and_one_that_is_none_is_refused() {
        for text in ["0", "18", "3-9-5"] {
            assert_eq!(text.parse::<Position>().unwrap().to_string(), text);
        }
        for text in ["", "x", "-1", "1-2", "9-3-5", "3-9-2", "1-2-3-4"] {
            assert!(text.parse::<Position>().is_err(), "{text}");
        }
    }
}
