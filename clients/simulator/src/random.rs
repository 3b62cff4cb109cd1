//! Seeds: every random choice of a simulation comes from one number, and no choice disturbs another.
//!
//! Each purpose (terrain, routes, the detector of drive 3, ..) draws from a `ChaCha` stream of its own, so that a
//! change to one model, or one more drive, leaves the others as they were.

use rand::Rng;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rand_distr::{Distribution, StandardNormal};

/// The generator that every model of the simulator draws from.
pub type SimRng = ChaCha8Rng;

/// The one number that fixes a simulation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Seed(pub u64);

/// What a stream of random numbers is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Heights of the land.
    Terrain = 1,
    /// Junctions, links and their lines.
    Network = 2,
    /// Which way a drive goes, and on which lanes.
    Route = 3,
    /// Speed, lateral wander, attitude.
    Motion = 4,
    /// The lane detector.
    Detector = 5,
    /// Odometry noise.
    Odometry = 6,
    /// GNSS noise.
    Gnss = 7,
    /// Track numbers of detections in written files.
    TrackIds = 8,
    /// Other vehicles on the road.
    Traffic = 9,
    /// Changes of the road.
    Changes = 10,
    /// What is wrong with a drive.
    Poison = 11,
    /// Where buildings spoil GNSS.
    Canyons = 12,
}

impl Seed {
    /// The generator for one purpose of one drive (or of item 0, for what all drives share).
    #[must_use]
    pub fn stream(self, purpose: Purpose, item: u32) -> SimRng {
        let mut rng = SimRng::seed_from_u64(self.0);
        rng.set_stream(((purpose as u64) << 32) | u64::from(item));
        rng
    }
}

/// A draw from the standard normal distribution.
pub fn normal(rng: &mut SimRng) -> f64 {
    StandardNormal.sample(rng)
}

/// A draw from the uniform distribution over `[low, high)`.
pub fn uniform(rng: &mut SimRng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Whether an event of this probability happens.
pub fn happens(rng: &mut SimRng, probability: f64) -> bool {
    rng.random::<f64>() < probability
}

/// One of `count` choices, all as likely; 0 where there is no choice.
pub fn choose(rng: &mut SimRng, count: usize) -> usize {
    if count < 2 { 0 } else { rng.random_range(0..count) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_seed_repeats_and_purposes_differ() {
        let draw = |seed, purpose, item| Seed(seed).stream(purpose, item).random::<u64>();
        assert_eq!(draw(7, Purpose::Route, 2), draw(7, Purpose::Route, 2));
        assert_ne!(draw(7, Purpose::Route, 2), draw(7, Purpose::Motion, 2));
        assert_ne!(draw(7, Purpose::Route, 2), draw(7, Purpose::Route, 3));
        assert_ne!(draw(7, Purpose::Route, 2), draw(8, Purpose::Route, 2));
    }
}
