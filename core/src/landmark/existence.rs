//! Whether a lane exists: log-odds that a sighting raises and a miss lowers.
//!
//! Ours; the paper counts sightings six frames after birth. With `p_d` the chance that the detector
//! reports a real line and `p_f` that it reports one that is not there,
//! seen: `+ ln(p_d / p_f)`, missed while in view: `+ ln((1 - p_d) / (1 - p_f))`, not in view: nothing. Frames are
//! correlated (misses and ghosts come in bursts), so each step is taken with `INDEPENDENCE` of its weight.

//! The log-odds are those of the stretch in view. What a line was when a stretch of it left the view is kept beside them
//! ([`Existence::prove`]): a line that ends, or that traffic hides, after two kilometres was there for two kilometres.

use serde::{Deserialize, Serialize};

/// Chance that a ghost is reported again in the next frame.
const FALSE_REPORT: f64 = 0.45;
/// Frames of one burst count as this share of independent ones.
const INDEPENDENCE: f64 = 0.5;
/// Log-odds stay within `+-` this, so that what vanished can be given up.
const CERTAIN: f64 = 6.0;

/// Chance that a detector reports a line that runs well in view near the vehicle.
pub const DETECTION: f64 = 0.85;
/// A lane of less probability than this is given up.
const GIVEN_UP: f64 = 0.05;

/// Log-odds that a lane exists.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
pub struct Existence {
    /// Of the stretch in view.
    log_odds: f64,
    /// Of the stretch that left the view when most was known for it; no evidence yet: 0.
    proven_log_odds: f64,
}

impl Existence {
    /// A lane seen for the first time: as likely a ghost as not.
    #[must_use]
    pub fn at_birth() -> Self {
        Self { log_odds: 0.0, proven_log_odds: 0.0 }
    }

    /// The detector reported the lane, where it does so with `detection_probability`.
    pub fn seen(&mut self, detection_probability: f64) {
        self.add((detection_probability / FALSE_REPORT).ln().max(0.1));
    }

    /// The detector did not report the lane, though it would have with `detection_probability`.
    pub fn missed(&mut self, detection_probability: f64) {
        self.add(((1.0 - detection_probability) / (1.0 - FALSE_REPORT)).ln().min(0.0));
    }

    fn add(&mut self, evidence: f64) {
        self.log_odds = (self.log_odds + INDEPENDENCE * evidence).clamp(-CERTAIN, CERTAIN);
    }

    /// Takes the evidence of another lane that turned out to be this one.
    pub fn absorb(&mut self, other: Self) {
        self.log_odds = (self.log_odds.max(0.0) + other.log_odds.max(0.0)).clamp(-CERTAIN, CERTAIN);
        self.proven_log_odds = self.proven_log_odds.max(other.proven_log_odds);
    }

    /// A stretch of the lane leaves the view as it is believed now: no later miss speaks against it.
    pub fn prove(&mut self) {
        self.proven_log_odds = self.proven_log_odds.max(self.log_odds);
    }

    /// Probability that the lane exists, or did where it was last in view.
    #[must_use]
    pub fn greatest_probability(&self) -> f64 {
        probability(self.log_odds.max(self.proven_log_odds))
    }

    /// Whether so much speaks against the lane in view that the map gives it up.
    #[must_use]
    pub fn is_given_up(&self) -> bool {
        self.probability() < GIVEN_UP
    }

    /// Probability that the lane exists where it is in view.
    #[must_use]
    pub fn probability(&self) -> f64 {
        probability(self.log_odds)
    }
}

fn probability(log_odds: f64) -> f64 {
    1.0 / (1.0 + (-log_odds).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ghost_of_four_frames_is_given_up_and_a_real_line_survives_a_burst_of_misses() {
        let mut ghost = Existence::at_birth();
        (0..4).for_each(|_| ghost.seen(0.85));
        (0..12).for_each(|_| ghost.missed(0.85));
        assert!(ghost.probability() < 0.1);
        let mut line = Existence::at_birth();
        (0..30).for_each(|_| line.seen(0.85));
        (0..6).for_each(|_| line.missed(0.6));
        assert!(line.probability() > 0.9);
    }

    #[test]
    fn misses_at_the_end_of_a_line_do_not_speak_against_what_left_the_view() {
        let mut lane = Existence::at_birth();
        (0..30).for_each(|_| lane.seen(0.85));
        lane.prove();
        let proven = lane.probability();
        (0..40).for_each(|_| lane.missed(0.85));
        assert!(lane.is_given_up());
        assert!((lane.greatest_probability() - proven).abs() < 1e-12);
    }

    #[test]
    fn what_is_not_in_view_loses_nothing() {
        let mut lane = Existence::at_birth();
        lane.seen(0.8);
        let before = lane;
        lane.missed(0.0);
        assert_eq!(lane, before);
    }
}
