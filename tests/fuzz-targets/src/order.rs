//! The window that puts frames in order: numbers in any order, refused, repeated, late, against a model of the rules.

use std::collections::BTreeSet;

use lanemap_core::Sequence;
use lanemap_server::fuzzing::{FuzzedOrder, Ordered};

/// Reads a window and commands from `bytes`: offer or refuse a number, let time pass, begin anew.
pub fn order(bytes: &[u8]) {
    let Some((&[held, wait], commands)) = bytes.split_first_chunk() else { return };
    let mut window = Window::new(usize::from(held % 16), u64::from(wait));
    for command in commands.chunks(3) {
        let [command, number, after] = [0, 1, 2].map(|index| command.get(index).copied().unwrap_or_default());
        window.now_ms += u64::from(after);
        let number = window.number(number);
        match command % 8 {
            0 => window.restart(),
            1 => window.refuse(number),
            2 => window.pass_all(),
            _ => window.offer(number),
        }
        window.pass();
    }
    window.pass_all();
}

/// A window, beside what the rules say that it holds.
struct Window {
    order: FuzzedOrder,
    max_held: usize,
    now_ms: u64,
    held: BTreeSet<u64>,
    refused: BTreeSet<u64>,
    /// Every number up to this one has passed, was refused, or was given up.
    passed: Option<u64>,
    /// The last frame that passed: what a new stream begins after.
    last_frame: Option<u64>,
}

impl Window {
    fn new(max_held: usize, wait_ms: u64) -> Self {
        let order = FuzzedOrder::new(max_held, wait_ms, None);
        let (held, refused) = (BTreeSet::new(), BTreeSet::new());
        Self { order, max_held, now_ms: 0, held, refused, passed: None, last_frame: None }
    }

    /// A number near what has passed, or at the end of all numbers.
    fn number(&self, code: u8) -> u64 {
        match code {
            250.. => u64::MAX - u64::from(255 - code),
            _ => self.passed.unwrap_or_default().saturating_add_signed(i64::from(code) - 16),
        }
    }

    fn is_past(&self, number: u64) -> bool {
        self.passed.is_some_and(|passed| number <= passed)
    }

    fn offer(&mut self, number: u64) {
        assert_eq!(self.order.has_passed(Sequence(number)), self.is_past(number), "{number}");
        if self.is_past(number) {
            return;
        }
        let taken = self.order.offer(Sequence(number), self.now_ms);
        assert_eq!(taken, self.held.insert(number), "a number is held once");
        self.refused.remove(&number);
    }

    fn refuse(&mut self, number: u64) {
        self.order.refused(Sequence(number));
        if !self.is_past(number) && !self.held.contains(&number) {
            self.refused.insert(number);
        }
    }

    fn pass(&mut self) {
        while let Some(passed) = self.order.pass(self.now_ms) {
            self.take(&passed);
        }
        self.forget_refused();
        assert!(self.held.len() <= self.max_held, "{} frames are held, at most {}", self.held.len(), self.max_held);
    }

    fn pass_all(&mut self) {
        while let Some(passed) = self.order.pass_last() {
            self.take(&passed);
        }
        assert!(self.held.is_empty(), "held for ever: {:?}", self.held);
        self.forget_refused();
    }

    fn restart(&mut self) {
        self.order.restart(self.last_frame.map(Sequence));
        self.passed = self.last_frame;
        self.held.clear();
        self.refused.clear();
    }

    /// What passes is the next thing there is.
    fn take(&mut self, passed: &Ordered) {
        match passed {
            Ordered::Frame(number) => {
                assert!(!self.is_past(*number), "{number} passes after {:?}", self.passed);
                assert_eq!(self.held.pop_first(), Some(*number), "frames pass in the order of their numbers");
                if let Some(before) = self.passed {
                    let missing = (before + 1..*number).find(|skipped| !self.refused.contains(skipped));
                    assert_eq!(missing, None, "a number is missing and nobody says so");
                }
                (self.passed, self.last_frame) = (Some(*number), Some(*number));
            }
            Ordered::Gap(numbers) => {
                assert!(!numbers.is_empty(), "an empty gap");
                let within = |set: &BTreeSet<u64>| set.range(numbers.clone()).next().copied();
                assert_eq!(within(&self.held), None, "a held frame is given up");
                assert_eq!(within(&self.refused), None, "a refused number is no gap");
                self.passed = Some(*numbers.end());
            }
        }
        self.forget_refused();
    }

    /// Refused numbers that were next pass without a word.
    fn forget_refused(&mut self) {
        let gone = |number: &u64| self.order.has_passed(Sequence(*number));
        let last = self.refused.iter().copied().filter(gone).max();
        self.refused.retain(|number| !self.order.has_passed(Sequence(*number)));
        self.passed = self.passed.max(last);
        assert!(self.held.first().is_none_or(|first| !self.is_past(*first)), "a held frame is of the past");
    }
}
