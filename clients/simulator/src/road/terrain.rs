//! Hills: the height of the land as a sum of plane waves.
//!
//! `z(x, y) = sum_k (g_k / w_k) sin(w_k (x cos t_k + y sin t_k) + phi_k)`, `w_k = 2 pi / length_k`: wave `k` alone is
//! never steeper than `g_k`. Roads lie on the land, so that links meet at the same height wherever they cross.

use std::f64::consts::TAU;

use nalgebra::{Point2, Vector2};

use crate::random::{SimRng, uniform};

/// Wavelength (metres) and share of the steepest grade of each wave.
const WAVES: [(f64, f64); 4] = [(1300.0, 0.30), (750.0, 0.30), (430.0, 0.27), (260.0, 0.13)];

/// A hilly land.
#[derive(Clone, Debug)]
pub struct Terrain {
    waves: [Wave; WAVES.len()],
}

#[derive(Clone, Copy, Debug)]
struct Wave {
    direction_per_m: Vector2<f64>,
    phase_rad: f64,
    amplitude_m: f64,
}

impl Terrain {
    /// A random land nowhere steeper than `max_grade` (0.06 is 6 %); 0 gives a plain.
    pub fn random(max_grade: f64, rng: &mut SimRng) -> Self {
        let waves = WAVES.map(|(length_m, share)| {
            let rate = TAU / length_m * uniform(rng, 0.9, 1.1);
            let direction_rad = uniform(rng, 0.0, TAU);
            Wave {
                direction_per_m: Vector2::new(direction_rad.cos(), direction_rad.sin()) * rate,
                phase_rad: uniform(rng, 0.0, TAU),
                amplitude_m: max_grade * share / rate,
            }
        });
        Self { waves }
    }

    /// Height, metres.
    #[must_use]
    pub fn height_m(&self, place: &Point2<f64>) -> f64 {
        self.waves.iter().map(|wave| wave.amplitude_m * wave.argument(place).sin()).sum()
    }

    /// Slope: metres of height per metre east and north.
    #[must_use]
    pub fn gradient(&self, place: &Point2<f64>) -> Vector2<f64> {
        self.waves.iter().map(|wave| wave.direction_per_m * (wave.amplitude_m * wave.argument(place).cos())).sum()
    }
}

impl Wave {
    fn argument(&self, place: &Point2<f64>) -> f64 {
        self.direction_per_m.dot(&place.coords) + self.phase_rad
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};

    #[test]
    fn the_gradient_is_the_derivative_of_the_height_and_keeps_its_bound() {
        let terrain = Terrain::random(0.06, &mut Seed(6).stream(Purpose::Terrain, 0));
        for k in 0..500 {
            let place = Point2::new(f64::from(k) * 13.7, f64::from(k) * -7.1);
            let gradient = terrain.gradient(&place);
            let step = 1e-4;
            let east = (terrain.height_m(&(place + Vector2::x() * step)) - terrain.height_m(&place)) / step;
            let north = (terrain.height_m(&(place + Vector2::y() * step)) - terrain.height_m(&place)) / step;
            assert!((gradient - Vector2::new(east, north)).norm() < 1e-5);
            assert!(gradient.norm() <= 0.06 + 1e-12);
        }
    }
}
