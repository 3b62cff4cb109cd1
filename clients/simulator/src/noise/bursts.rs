//! Bursts: a state that is on for a while, then off: missed lines, wrong categories.
//!
//! A two-state Markov chain per frame. On leaves with `1 / m` (mean burst of `m` frames); off enters with
//! `q = p / (m (1 - p))`, so that it is on a share `p` of the time in the long run. `p` may change while it runs.

use crate::random::{SimRng, happens};

/// Largest share of the time that a burst process may be on; beyond it `q` would exceed one for short bursts.
const MAX_SHARE: f64 = 0.8;

/// A process that is on in bursts.
#[derive(Clone, Copy, Debug)]
pub struct Bursts {
    on: bool,
}

impl Bursts {
    /// A process that has been running for ever at share `share`.
    pub fn stationary(share: f64, rng: &mut SimRng) -> Self {
        Self { on: happens(rng, share.clamp(0.0, MAX_SHARE)) }
    }

    /// Moves on by one frame and says whether it is on.
    pub fn advance(&mut self, share: f64, mean_frames: f64, rng: &mut SimRng) -> bool {
        let share = share.clamp(0.0, MAX_SHARE);
        let flip = if self.on { 1.0 / mean_frames } else { share / (mean_frames * (1.0 - share)) };
        if happens(rng, flip) {
            self.on = !self.on;
        }
        self.on
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};

    #[test]
    fn share_and_mean_burst_are_what_was_asked_for() {
        let mut rng = Seed(3).stream(Purpose::Detector, 0);
        let mut process = Bursts::stationary(0.3, &mut rng);
        let states: Vec<bool> = (0..300_000).map(|_| process.advance(0.3, 6.0, &mut rng)).collect();
        let on = states.iter().filter(|on| **on).count() as f64;
        let bursts = states.windows(2).filter(|pair| !pair[0] && pair[1]).count() as f64;
        assert!((on / states.len() as f64 - 0.3).abs() < 0.01);
        assert!((on / bursts - 6.0).abs() < 0.2);
    }
}
