//! What waits to be done: drives to be cut into contributions, and cells to be fused.
//!
//! Tasks come out in the order in which they became due, so that no drive and no cell waits for ever behind a busy one. A
//! task is due at once, and again no sooner than an interval after it was begun last: a change after a time of quiet is
//! seen at once, and a stream of changes costs no more than one fusion in each interval, however long that takes.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    time::{Duration, Instant},
};

use lanemap_core::fleet::CellId;

use super::Offer;
use crate::{journal::cells::Contributed, session::SessionId};

/// What is to be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) enum Task {
    /// A drive has something to say.
    Contribute(SessionId),
    /// A drive without GNSS is to be sought on the map, which has grown.
    Locate(SessionId),
    /// A cell is dirty.
    Fuse(CellId),
    /// A cell was drafted, and is to be fused from all of its drives.
    Settle(CellId),
}

/// Which tasks are to be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    /// Those that are due.
    All,
    /// Drives that are due.
    Drives,
    /// Drives, whether they are due or not.
    DrivesAtOnce,
}

/// A task that was taken.
#[derive(Debug)]
pub(super) enum Taken {
    Contribute(Box<Offer>),
    Locate(SessionId),
    Fuse(CellId),
    Settle(CellId),
}

#[derive(Debug)]
pub(super) struct Queue {
    interval: Duration,
    due: BTreeSet<(Instant, Task)>,
    /// When each task in `due` is due.
    waiting: BTreeMap<Task, Instant>,
    offers: HashMap<SessionId, Offer>,
    /// When each task in work was begun.
    in_work: BTreeMap<Task, Instant>,
    /// When tasks that are done were begun last, those of the last interval.
    done: HashMap<Task, Instant>,
    /// When the cells that are to be settled were drafted first.
    drafted: HashMap<CellId, Instant>,
    /// How much of each session has been contributed; as many as the registry lets there be.
    contributed: HashMap<SessionId, Contributed>,
}

/// Entries of `done` after which outdated ones are dropped.
const MOST_DONE: usize = 1024;
/// Time for which a cell may be drafted without being settled.
const LONGEST_DRAFTED: Duration = Duration::from_mins(2);

impl Task {
    /// What is never done at the same time: the task itself, and what else writes of the same drive or cell.
    fn exclusive(self) -> [Self; 2] {
        match self {
            Self::Contribute(session) | Self::Locate(session) => [Self::Contribute(session), Self::Locate(session)],
            Self::Fuse(cell) | Self::Settle(cell) => [Self::Fuse(cell), Self::Settle(cell)],
        }
    }

    /// Drives come round twice as often as cells, so that they add half an interval to the wait at most.
    fn interval(self, of_cells: Duration) -> Duration {
        match self {
            Self::Contribute(_) => of_cells / 2,
            Self::Locate(_) | Self::Fuse(_) | Self::Settle(_) => of_cells,
        }
    }
}

impl Queue {
    pub(super) fn new(interval: Duration) -> Self {
        Self {
            interval,
            due: BTreeSet::new(),
            waiting: BTreeMap::new(),
            offers: HashMap::new(),
            in_work: BTreeMap::new(),
            done: HashMap::new(),
            drafted: HashMap::new(),
            contributed: HashMap::new(),
        }
    }

    /// Takes an offer in the place of the one before; whether there is anything new in it.
    pub(super) fn offer(&mut self, offer: Offer, now: Instant) -> bool {
        let session = offer.session;
        let said = match (self.offers.get(&session), self.contributed.get(&session)) {
            (Some(before), _) => Some(before.version),
            (None, Some(contributed)) => Some(contributed.version),
            // Nothing to say, and nothing to take back.
            (None, None) if !offer.may_be_placed() => Some(offer.version),
            (None, None) => None,
        };
        if said == Some(offer.version) {
            return false;
        }
        self.offers.insert(session, offer);
        self.add(Task::Contribute(session), now);
        true
    }

    /// A cell has to be fused, or joined with its neighbours, again.
    pub(super) fn touch_cell(&mut self, cell: CellId, now: Instant) {
        self.add(Task::Fuse(cell), now);
    }

    /// A cell whose draft was begun then is to be settled: once it was quiet for an interval, but not too late.
    pub(super) fn settle_later(&mut self, cell: CellId, begun: Instant) {
        let first = *self.drafted.entry(cell).or_insert(begun);
        // While more comes, the next draft begins within the first of these intervals.
        let at = (begun + 2 * self.interval).min(first + LONGEST_DRAFTED);
        self.remove(Task::Settle(cell));
        self.insert(Task::Settle(cell), at);
    }

    /// A cell was fused from all of its drives.
    pub(super) fn has_settled(&mut self, cell: CellId) {
        self.drafted.remove(&cell);
        self.remove(Task::Settle(cell));
    }

    /// A drive without GNSS is to be sought again.
    pub(super) fn locate(&mut self, session: SessionId, now: Instant) {
        self.add(Task::Locate(session), now);
    }

    fn add(&mut self, task: Task, now: Instant) {
        if self.waiting.contains_key(&task) {
            return;
        }
        let again = self.done.get(&task).map(|begun| *begun + task.interval(self.interval));
        let at = again.map_or(now, |again| again.max(now));
        self.insert(task, at);
    }

    fn insert(&mut self, task: Task, at: Instant) {
        self.waiting.insert(task, at);
        self.due.insert((at, task));
    }

    /// The task that became due first; or when the next one will be, `None` where there is none.
    pub(super) fn take(&mut self, now: Instant, wanted: Wanted) -> Result<Taken, Option<Instant>> {
        let is_free = |task: &Task| task.exclusive().iter().all(|task| !self.in_work.contains_key(task));
        let is_wanted = |task: &Task| wanted == Wanted::All || matches!(task, Task::Contribute(_));
        let first = self.due.iter().find(|(_, task)| is_free(task) && is_wanted(task)).copied();
        let Some((at, task)) = first else { return Err(None) };
        if at > now && wanted != Wanted::DrivesAtOnce {
            return Err(Some(at));
        }
        self.remove(task);
        let taken = match task {
            Task::Contribute(session) => self.offers.remove(&session).map(|offer| Taken::Contribute(Box::new(offer))),
            Task::Locate(session) => Some(Taken::Locate(session)),
            Task::Fuse(cell) => Some(Taken::Fuse(cell)),
            Task::Settle(cell) => Some(Taken::Settle(cell)),
        };
        let Some(taken) = taken else { return self.take(now, wanted) };
        self.in_work.insert(task, now);
        Ok(taken)
    }

    fn remove(&mut self, task: Task) {
        if let Some(at) = self.waiting.remove(&task) {
            self.due.remove(&(at, task));
        }
    }

    /// A task that was taken has been done.
    pub(super) fn finish(&mut self, task: Task, now: Instant) {
        let begun = self.in_work.remove(&task).unwrap_or(now);
        if self.done.len() >= MOST_DONE {
            let interval = self.interval;
            self.done.retain(|task, begun| *begun + task.interval(interval) > now);
        }
        self.done.insert(task, begun);
    }

    /// A task that was taken could not be done: it comes again after a pause.
    pub(super) fn retry(&mut self, taken: Taken, now: Instant, pause: Duration) {
        let task = match taken {
            Taken::Contribute(offer) => {
                let session = offer.session;
                self.offers.entry(session).or_insert(*offer);
                Task::Contribute(session)
            }
            Taken::Locate(session) => Task::Locate(session),
            Taken::Fuse(cell) => Task::Fuse(cell),
            Taken::Settle(cell) => Task::Settle(cell),
        };
        self.in_work.remove(&task);
        self.remove(task);
        self.insert(task, now + pause);
    }

    /// What a session had contributed before.
    pub(super) fn contributed(&self, session: SessionId) -> Option<&Contributed> {
        self.contributed.get(&session)
    }

    pub(super) fn has_contributed(&mut self, session: SessionId, contributed: Contributed) {
        self.contributed.insert(session, contributed);
    }

    /// Drops a session's offer, and the search for it; whether none of it is in work.
    pub(super) fn drop_offer(&mut self, session: SessionId) -> bool {
        self.offers.remove(&session);
        let tasks = [Task::Contribute(session), Task::Locate(session)];
        for task in tasks {
            self.remove(task);
        }
        tasks.iter().all(|task| !self.in_work.contains_key(task))
    }

    /// Forgets a session; gives what it had contributed.
    pub(super) fn forget(&mut self, session: SessionId) -> Option<Contributed> {
        self.contributed.remove(&session)
    }

    pub(super) fn is_dirty(&self, cell: CellId) -> bool {
        let tasks = [Task::Fuse(cell), Task::Settle(cell)];
        tasks.iter().any(|task| self.waiting.contains_key(task) || self.in_work.contains_key(task))
    }

    pub(super) fn dirty_cells(&self) -> BTreeSet<CellId> {
        let tasks = self.waiting.keys().chain(self.in_work.keys());
        let cell_of = |task: &Task| if let Task::Fuse(cell) | Task::Settle(cell) = task { Some(*cell) } else { None };
        tasks.filter_map(cell_of).collect()
    }

    /// Drives whose offers are not in the store yet, or that are sought.
    pub(super) fn waiting_offers(&self) -> usize {
        let in_work = self.in_work.keys().filter(|task| !matches!(task, Task::Fuse(_) | Task::Settle(_))).count();
        let sought = self.waiting.keys().filter(|task| matches!(task, Task::Locate(_))).count();
        self.offers.len() + sought + in_work
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use lanemap_core::{LaneMap, Sensor, fleet::DriveId, geometry::georeference::Georeference};

    use super::*;
    use crate::{serve::sample::georeference, session::MapVersion};

    const INTERVAL: Duration = Duration::from_millis(500);

    fn cell(x: u32) -> CellId {
        CellId::new(x, 5).unwrap()
    }

    fn offer(number: u64, version: u64, georeference: Option<Georeference>) -> Offer {
        Offer {
            session: SessionId::next(None, 0, number),
            drive: DriveId(number),
            version: MapVersion(version),
            georeference,
            sensor: Sensor::default(),
            trace: Arc::default(),
            map: Arc::new(LaneMap::default()),
        }
    }

    fn taken_cell(queue: &mut Queue, now: Instant) -> Option<CellId> {
        match queue.take(now, Wanted::All) {
            Ok(Taken::Fuse(cell)) => Some(cell),
            _ => None,
        }
    }

    #[test]
    fn a_cell_that_was_quiet_is_due_at_once_and_a_busy_one_once_in_an_interval() {
        let (mut queue, now) = (Queue::new(INTERVAL), Instant::now());
        queue.touch_cell(cell(1), now);
        assert_eq!(taken_cell(&mut queue, now), Some(cell(1)));
        // Touched again while it is in work: nobody else takes it, and it is still dirty afterwards.
        queue.touch_cell(cell(1), now);
        assert_eq!(taken_cell(&mut queue, now), None);
        queue.finish(Task::Fuse(cell(1)), now);
        assert!(queue.is_dirty(cell(1)));
        queue.touch_cell(cell(1), now);
        assert_eq!(taken_cell(&mut queue, now), Some(cell(1)));
        queue.finish(Task::Fuse(cell(1)), now);
        queue.touch_cell(cell(1), now);
        assert!(matches!(queue.take(now, Wanted::All), Err(Some(at)) if at == now + INTERVAL));
        assert_eq!(taken_cell(&mut queue, now + INTERVAL), Some(cell(1)));
        // What it takes is part of the interval.
        queue.finish(Task::Fuse(cell(1)), now + INTERVAL.mul_f64(1.8));
        queue.touch_cell(cell(1), now + INTERVAL.mul_f64(1.8));
        assert!(
            matches!(queue.take(now + INTERVAL.mul_f64(1.9), Wanted::All), Err(Some(at)) if at == now + 2 * INTERVAL)
        );
    }

    #[test]
    fn a_cell_that_was_drafted_is_settled_once_it_is_quiet_and_in_time_if_it_never_is() {
        let settle_at = |queue: &mut Queue, now: Instant| match queue.take(now, Wanted::All) {
            Err(Some(at)) => at,
            other => panic!("{other:?}"),
        };
        let (mut queue, start) = (Queue::new(INTERVAL), Instant::now());
        let mut now = start;
        while now + INTERVAL < start + LONGEST_DRAFTED {
            queue.touch_cell(cell(1), now);
            assert_eq!(taken_cell(&mut queue, now), Some(cell(1)), "a draft comes before");
            queue.finish(Task::Fuse(cell(1)), now);
            queue.settle_later(cell(1), now);
            assert!(queue.is_dirty(cell(1)));
            let expected = (now + 2 * INTERVAL).min(start + LONGEST_DRAFTED);
            assert_eq!(settle_at(&mut queue, now), expected);
            now += INTERVAL;
        }
        let now = start + LONGEST_DRAFTED;
        assert!(matches!(queue.take(now, Wanted::All), Ok(Taken::Settle(taken)) if taken == cell(1)));
        queue.touch_cell(cell(1), now);
        assert_eq!(taken_cell(&mut queue, now), None, "it is being settled");
        queue.finish(Task::Settle(cell(1)), now);
        queue.has_settled(cell(1));
        assert_eq!(taken_cell(&mut queue, now + INTERVAL), Some(cell(1)));
        queue.finish(Task::Fuse(cell(1)), now + INTERVAL);
        assert!(!queue.is_dirty(cell(1)));
    }

    #[test]
    fn the_cell_that_is_due_longest_comes_first() {
        let (mut queue, now) = (Queue::new(INTERVAL), Instant::now());
        queue.touch_cell(cell(9), now);
        queue.touch_cell(cell(1), now + INTERVAL);
        queue.touch_cell(cell(9), now + INTERVAL);
        assert_eq!(taken_cell(&mut queue, now + INTERVAL), Some(cell(9)));
        assert_eq!(taken_cell(&mut queue, now + INTERVAL), Some(cell(1)));
    }

    #[test]
    fn of_a_drives_offers_the_newest_counts_and_one_that_says_nothing_new_is_passed_over() {
        let (mut queue, now) = (Queue::new(INTERVAL), Instant::now());
        let place = Some(georeference(11.58, 48.14));
        assert!(queue.offer(offer(1, 1, place), now) && queue.offer(offer(1, 2, place), now));
        let Ok(Taken::Contribute(taken)) = queue.take(now, Wanted::All) else { panic!("an offer") };
        assert_eq!(taken.version, MapVersion(2));
        queue.finish(Task::Contribute(taken.session), now);
        queue.has_contributed(taken.session, Contributed { version: MapVersion(2), cells: vec![] });
        assert!(!queue.offer(offer(1, 2, place), now));
        assert!(!queue.offer(offer(2, 7, None), now), "it has no place on the earth");
        assert!(queue.offer(offer(1, 3, place), now));
        assert!(
            matches!(queue.take(now, Wanted::DrivesAtOnce), Ok(Taken::Contribute(_))),
            "at once where the service ends"
        );
    }

    #[test]
    fn what_could_not_be_done_comes_again_unless_something_newer_has_come() {
        let (mut queue, now) = (Queue::new(INTERVAL), Instant::now());
        let place = Some(georeference(11.58, 48.14));
        queue.offer(offer(1, 1, place), now);
        let taken = queue.take(now, Wanted::All).unwrap();
        queue.offer(offer(1, 2, place), now);
        queue.retry(taken, now, INTERVAL);
        assert!(matches!(queue.take(now, Wanted::All), Err(Some(at)) if at == now + INTERVAL));
        let Ok(Taken::Contribute(taken)) = queue.take(now + INTERVAL, Wanted::All) else { panic!("an offer") };
        assert_eq!(taken.version, MapVersion(2));
    }
}
