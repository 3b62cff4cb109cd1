//! Puts frames that come out of order back in order, within a bounded window and a bounded time.
//!
//! A frame whose number is next passes at once. One that comes too early is held until the numbers before it have come;
//! once as many are held as may, or the first of them has waited long enough, the numbers that are missing are given up
//! as a gap, and what is held passes. What passes, passes in the order of its numbers, and only that is journaled,
//! mapped and acked: no ack runs ahead of a hole that may still be filled.

use std::{collections::BTreeMap, ops::RangeInclusive, time::Duration};

use lanemap_core::Sequence;
use tokio::time::Instant;

/// The highest number with which a drive begins without a wait: some count from 0, some from 1.
const FIRST: u64 = 1;

/// What came under a number.
#[derive(Debug)]
enum Arrival<T> {
    /// A frame.
    Frame { frame: T, arrived: Instant },
    /// Something that was refused before it got here: its number needs no waiting for.
    Refused,
}

/// What passes.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Passed<T> {
    /// The next frame.
    Frame(T),
    /// Numbers that did not come, inclusive; never sent, or lost.
    Gap(RangeInclusive<u64>),
}

/// What becomes of a frame that is offered.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Offer<'a, T> {
    /// It was taken; see [`Reorder::pass`].
    Taken,
    /// A frame of its number is held already; the frame is given back.
    Held { before: &'a T, again: T },
}

/// Frames that came too early.
#[derive(Debug)]
pub(crate) struct Reorder<T> {
    max_held: usize,
    max_wait: Duration,
    /// Every number up to this one, inclusive, has passed; `None` before the first of a drive.
    passed: Option<u64>,
    held: BTreeMap<u64, Arrival<T>>,
}

impl<T> Reorder<T> {
    /// A window of `max_held` frames for at most `max_wait`, after the frame `last`.
    pub(crate) fn new(max_held: usize, max_wait: Duration, last: Option<Sequence>) -> Self {
        Self { max_held, max_wait, passed: last.map(|last| last.0), held: BTreeMap::new() }
    }

    /// Whether a number is of the past: it has passed, or was given up.
    pub(crate) fn has_passed(&self, sequence: Sequence) -> bool {
        self.passed.is_some_and(|passed| sequence.0 <= passed)
    }

    /// Takes a frame whose number has not passed yet.
    pub(crate) fn offer(&mut self, sequence: Sequence, frame: T, arrived: Instant) -> Offer<'_, T> {
        use std::collections::btree_map::Entry;
        match self.held.entry(sequence.0) {
            Entry::Vacant(entry) => {
                entry.insert(Arrival::Frame { frame, arrived });
                Offer::Taken
            }
            Entry::Occupied(mut entry) if matches!(entry.get(), Arrival::Refused) => {
                entry.insert(Arrival::Frame { frame, arrived });
                Offer::Taken
            }
            Entry::Occupied(entry) => match entry.into_mut() {
                Arrival::Frame { frame: before, .. } => Offer::Held { before, again: frame },
                Arrival::Refused => Offer::Taken,
            },
        }
    }

    /// Takes note of a number whose frame was refused before it got here.
    pub(crate) fn refused(&mut self, sequence: Sequence) {
        if !self.has_passed(sequence) {
            self.held.entry(sequence.0).or_insert(Arrival::Refused);
        }
    }

    /// The next frame or gap that passes by `now`; `None` where what is held still waits.
    pub(crate) fn pass(&mut self, now: Instant) -> Option<Passed<T>> {
        self.pass_where(|reorder| {
            reorder.held.len() > reorder.max_held || reorder.deadline().is_some_and(|at| at <= now)
        })
    }

    /// The next frame or gap, where nothing more comes.
    pub(crate) fn pass_last(&mut self) -> Option<Passed<T>> {
        self.pass_where(|_| true)
    }

    fn pass_where(&mut self, gives_up: impl Fn(&Self) -> bool) -> Option<Passed<T>> {
        loop {
            let (&first, _) = self.held.first_key_value()?;
            if !self.is_next(first) {
                if !gives_up(self) {
                    return None;
                }
                // Before the first frame of a drive nobody knows with which number it begins: nothing is missing.
                if let Some(passed) = self.passed.replace(first.saturating_sub(1)) {
                    return Some(Passed::Gap(passed + 1..=first - 1));
                }
            }
            self.passed = Some(first);
            match self.held.remove(&first)? {
                Arrival::Frame { frame, .. } => return Some(Passed::Frame(frame)),
                Arrival::Refused => {}
            }
        }
    }

    fn is_next(&self, number: u64) -> bool {
        self.passed.map_or(number <= FIRST, |passed| number <= passed.saturating_add(1))
    }

    /// When the first missing number is given up; `None` where nothing is held.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        let arrivals = self.held.values().filter_map(|arrival| match arrival {
            Arrival::Frame { arrived, .. } => Some(*arrived),
            Arrival::Refused => None,
        });
        arrivals.min().map(|first| first + self.max_wait)
    }

    /// Forgets what is held, which was never acked: a new stream begins after `last`.
    pub(crate) fn restart(&mut self, last: Option<Sequence>) {
        self.held.clear();
        self.passed = last.map(|last| last.0);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const WAIT: Duration = Duration::from_millis(200);

    fn reorder(last: Option<u64>) -> Reorder<u64> {
        Reorder::new(4, WAIT, last.map(Sequence))
    }

    fn offer(reorder: &mut Reorder<u64>, number: u64, arrived: Instant) {
        assert_eq!(reorder.offer(Sequence(number), number, arrived), Offer::Taken);
    }

    fn passed(reorder: &mut Reorder<u64>, now: Instant) -> Vec<Passed<u64>> {
        std::iter::from_fn(|| reorder.pass(now)).collect()
    }

    #[test]
    fn a_frame_that_comes_early_waits_for_the_one_before_it() {
        let (mut reorder, now) = (reorder(Some(5)), Instant::now());
        offer(&mut reorder, 7, now);
        assert_eq!(passed(&mut reorder, now), []);
        offer(&mut reorder, 6, now);
        assert_eq!(passed(&mut reorder, now), [Passed::Frame(6), Passed::Frame(7)]);
        assert_eq!(reorder.deadline(), None);
    }

    #[test]
    fn what_does_not_come_in_time_is_a_gap_that_ends_before_the_frame_that_waited() {
        let (mut reorder, now) = (reorder(Some(5)), Instant::now());
        offer(&mut reorder, 8, now);
        offer(&mut reorder, 10, now + WAIT / 2);
        assert_eq!(passed(&mut reorder, now + WAIT / 2), []);
        assert_eq!(passed(&mut reorder, now + WAIT), [Passed::Gap(6..=7), Passed::Frame(8)]);
        assert_eq!(passed(&mut reorder, now + WAIT * 2), [Passed::Gap(9..=9), Passed::Frame(10)]);
        assert!(reorder.has_passed(Sequence(7)) && !reorder.has_passed(Sequence(11)));
    }

    #[test]
    fn more_frames_than_the_window_holds_do_not_wait() {
        let (mut reorder, now) = (reorder(Some(5)), Instant::now());
        (7..=10).for_each(|number| offer(&mut reorder, number, now));
        assert_eq!(passed(&mut reorder, now), []);
        offer(&mut reorder, 11, now);
        let held = (7..=11).map(Passed::Frame);
        assert_eq!(passed(&mut reorder, now), std::iter::once(Passed::Gap(6..=6)).chain(held).collect::<Vec<_>>());
    }

    #[test]
    fn the_number_of_a_refused_frame_is_not_waited_for() {
        let (mut reorder, now) = (reorder(Some(5)), Instant::now());
        reorder.refused(Sequence(6));
        offer(&mut reorder, 7, now);
        assert_eq!(passed(&mut reorder, now), [Passed::Frame(7)]);
    }

    #[test]
    fn a_drive_begins_with_any_number_and_at_once_with_0_or_1() {
        let now = Instant::now();
        for first in [0, 1] {
            let mut reorder = reorder(None);
            offer(&mut reorder, first, now);
            assert_eq!(passed(&mut reorder, now), [Passed::Frame(first)]);
        }
        let mut reorder = reorder(None);
        offer(&mut reorder, 1000, now);
        assert_eq!(passed(&mut reorder, now), []);
        assert_eq!(passed(&mut reorder, now + WAIT), [Passed::Frame(1000)]);
    }

    #[test]
    fn what_is_held_passes_when_nothing_more_comes() {
        let (mut reorder, now) = (reorder(Some(5)), Instant::now());
        offer(&mut reorder, 8, now);
        let last: Vec<_> = std::iter::from_fn(|| reorder.pass_last()).collect();
        assert_eq!(last, [Passed::Gap(6..=7), Passed::Frame(8)]);
    }

    #[test]
    fn a_number_that_is_held_is_given_back_with_the_frame_before_it() {
        let (mut reorder, now) = (reorder(Some(5)), Instant::now());
        offer(&mut reorder, 8, now);
        assert_eq!(reorder.offer(Sequence(8), 88, now), Offer::Held { before: &8, again: 88 });
    }

    proptest! {
        /// Whatever comes in whatever order: what passes rises, every number passes once or lies in one gap, and no more
        /// is held than the window allows.
        #[test]
        fn what_passes_is_in_order_and_whole(numbers in prop::collection::vec(1_u64..60, 1..120)) {
            let (mut reorder, now) = (reorder(None), Instant::now());
            let (mut next, mut frames, mut missing) = (None::<u64>, 0, 0);
            let mut came = std::collections::BTreeSet::new();
            let mut note = |passed: Passed<u64>| {
                let (first, last) = match passed {
                    Passed::Frame(number) => { frames += 1; (number, number) }
                    Passed::Gap(gap) => { missing += gap.clone().count(); (*gap.start(), *gap.end()) }
                };
                assert!(next.is_none_or(|next| next == first), "{next:?} {first}");
                next = Some(last + 1);
            };
            for number in numbers {
                if !reorder.has_passed(Sequence(number)) && reorder.offer(Sequence(number), number, now) == Offer::Taken {
                    came.insert(number);
                }
                std::iter::from_fn(|| reorder.pass(now)).for_each(&mut note);
                assert!(reorder.held.len() <= 4);
            }
            std::iter::from_fn(|| reorder.pass_last()).for_each(&mut note);
            assert_eq!(frames, came.len());
            let (first, last) = (*came.first().unwrap(), *came.last().unwrap());
            assert_eq!(usize::try_from(last - first).unwrap() + 1, frames + missing);
        }
    }
}
