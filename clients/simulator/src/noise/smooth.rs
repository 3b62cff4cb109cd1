//! Smooth noise: a random function with all derivatives, for wander, drift and land.
//!
//! `x(t) = sigma sqrt(2 / K) sum_k sin(2 pi f_k t + phi_k)`, `K` frequencies log-uniform between two bounds, phases
//! uniform: variance `sigma^2` over the ensemble, no energy beyond the highest frequency.

use std::f64::consts::TAU;

use crate::random::{SimRng, uniform};

/// Waves in the sum.
const WAVES: usize = 6;

/// A smooth random function of one variable (seconds or metres, as its periods are).
#[derive(Clone, Debug)]
pub struct SmoothNoise {
    amplitude: f64,
    waves: [(f64, f64); WAVES],
}

impl SmoothNoise {
    /// A function of standard deviation `sigma` whose waves have periods between `shortest` and `longest`.
    pub fn new(sigma: f64, shortest: f64, longest: f64, rng: &mut SimRng) -> Self {
        let waves = std::array::from_fn(|_| {
            let period = uniform(rng, shortest.ln(), longest.ln()).exp();
            (TAU / period, uniform(rng, 0.0, TAU))
        });
        Self { amplitude: sigma * (2.0 / WAVES as f64).sqrt(), waves }
    }

    /// The value at `t`.
    #[must_use]
    pub fn at(&self, t: f64) -> f64 {
        self.amplitude * self.waves.iter().map(|(rate, phase)| (rate * t + phase).sin()).sum::<f64>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};

    #[test]
    fn the_ensemble_has_the_stated_spread_and_no_jumps() {
        let mut rng = Seed(5).stream(Purpose::Motion, 0);
        let mut square = 0.0;
        for _ in 0..20_000 {
            let noise = SmoothNoise::new(0.2, 60.0, 250.0, &mut rng);
            square += noise.at(17.0).powi(2);
            assert!((noise.at(17.1) - noise.at(17.0)).abs() < 0.2 * 12f64.sqrt() * TAU / 60.0 * 0.1);
        }
        assert!(((square / 20_000.0).sqrt() / 0.2 - 1.0).abs() < 0.03);
    }
}
