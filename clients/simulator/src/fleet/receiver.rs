//! A GNSS receiver of a fleet: a bias of its own per drive, slow drift, white noise, heading, multipath among buildings.
//!
//! `p'(t) = p(t) + b + d(t) + m + w(t)` on each axis: `b ~ N(0, bias)` drawn once per drive, `d` smooth noise with periods
//! of minutes, `w` white. Within a canyon `m` is an offset of several metres in a direction of its own per drive and
//! visit, there at once and gone at once; the receiver does not notice and states the sigma that it always states, that
//! of `b`, `d` and `w` together. Heading: a bias per drive and white noise.

use std::f64::consts::TAU;

use lanemap_core::Pose;
use nalgebra::{Translation3, UnitQuaternion, Vector3};

use crate::{
    drive::TrueState,
    fleet::canyon::Canyon,
    noise::SmoothNoise,
    random::{SimRng, normal, uniform},
};

/// Figures of a receiver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReceiverModel {
    /// Standard deviation of the bias of a drive, east and north, metres.
    pub bias_sigma_m: f64,
    /// Standard deviation of the height's bias, metres.
    pub height_bias_sigma_m: f64,
    /// Standard deviation of the drift, east and north, metres.
    pub drift_sigma_m: f64,
    /// Middle period of the drift, seconds.
    pub drift_period_s: f64,
    /// Standard deviation of the white noise on each axis, metres.
    pub white_sigma_m: f64,
    /// Standard deviation of the heading's bias, degrees.
    pub heading_bias_sigma_deg: f64,
    /// Standard deviation of the heading's white noise, degrees.
    pub heading_white_sigma_deg: f64,
    /// Least offset within a canyon, metres.
    pub min_multipath_m: f64,
    /// Greatest offset within a canyon, metres.
    pub max_multipath_m: f64,
}

impl Default for ReceiverModel {
    fn default() -> Self {
        Self {
            bias_sigma_m: 1.5,
            height_bias_sigma_m: 2.0,
            drift_sigma_m: 0.2,
            drift_period_s: 120.0,
            white_sigma_m: 0.1,
            heading_bias_sigma_deg: 0.3,
            heading_white_sigma_deg: 0.2,
            min_multipath_m: 3.0,
            max_multipath_m: 8.0,
        }
    }
}

impl ReceiverModel {
    /// The standard deviation on each horizontal axis that the receiver states, metres.
    #[must_use]
    pub fn stated_horizontal_m(&self) -> f64 {
        self.stated_m(self.bias_sigma_m)
    }

    /// The standard deviation of the height that the receiver states, metres.
    #[must_use]
    pub fn stated_vertical_m(&self) -> f64 {
        self.stated_m(self.height_bias_sigma_m)
    }

    fn stated_m(&self, bias_m: f64) -> f64 {
        (bias_m.powi(2) + self.drift_sigma_m.powi(2) + self.white_sigma_m.powi(2)).sqrt().max(0.01)
    }

    /// The poses that the receiver gives over one drive, one per true state.
    pub fn observe(&self, states: &[TrueState], canyons: &[Canyon], rng: &mut SimRng) -> Vec<Pose> {
        let Some(start) = states.first() else { return Vec::new() };
        let bias = Vector3::new(self.bias_sigma_m, self.bias_sigma_m, self.height_bias_sigma_m)
            .map(|sigma_m| sigma_m * normal(rng));
        let heading_bias_rad = self.heading_bias_sigma_deg.to_radians() * normal(rng);
        let drift: [SmoothNoise; 2] = std::array::from_fn(|_| {
            SmoothNoise::new(self.drift_sigma_m, 0.5 * self.drift_period_s, 2.0 * self.drift_period_s, rng)
        });
        let mut visit: Option<(usize, Vector3<f64>)> = None;
        let mut fixes = Vec::with_capacity(states.len());
        for state in states {
            let place = state.world_from_vehicle.translation.vector;
            let canyon = canyons.iter().position(|canyon| canyon.holds(&place.xy().into()));
            visit = match (canyon, visit) {
                (Some(now), Some((before, offset))) if now == before => Some((now, offset)),
                (Some(now), _) => Some((now, self.multipath(rng))),
                (None, _) => None,
            };
            let t_s = state.time.seconds_since(start.time);
            let drifted = Vector3::new(drift[0].at(t_s), drift[1].at(t_s), 0.0);
            let white = Vector3::from_fn(|_, _| self.white_sigma_m * normal(rng));
            let reflected = visit.map_or_else(Vector3::zeros, |(_, offset)| offset);
            let heading_rad = heading_bias_rad + self.heading_white_sigma_deg.to_radians() * normal(rng);
            fixes.push(Pose::from_parts(
                Translation3::from(place + bias + drifted + reflected + white),
                UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad) * state.world_from_vehicle.rotation,
            ));
        }
        fixes
    }

    fn multipath(&self, rng: &mut SimRng) -> Vector3<f64> {
        let (direction_rad, size_m) =
            (uniform(rng, 0.0, TAU), uniform(rng, self.min_multipath_m, self.max_multipath_m));
        Vector3::new(direction_rad.cos(), direction_rad.sin(), 0.0) * size_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};
    use lanemap_core::TimestampNs;
    use nalgebra::Point2;

    fn straight_ahead(frames: i32) -> Vec<TrueState> {
        (0..frames)
            .map(|k| TrueState {
                time: TimestampNs(i64::from(k) * 100_000_000),
                world_from_vehicle: Pose::translation(f64::from(k), 0.0, 0.0),
                distance_m: f64::from(k),
                leg: 0,
            })
            .collect()
    }

    fn errors(drive: u32, states: &[TrueState], canyons: &[Canyon]) -> Vec<Vector3<f64>> {
        let fixes = ReceiverModel::default().observe(states, canyons, &mut Seed(5).stream(Purpose::Gnss, drive));
        let pairs = fixes.iter().zip(states);
        pairs.map(|(fix, state)| fix.translation.vector - state.world_from_vehicle.translation.vector).collect()
    }

    #[test]
    fn the_bias_of_drives_has_the_stated_spread_about_zero_and_is_each_drives_own() {
        let states = straight_ahead(50);
        let biases: Vec<Vector3<f64>> =
            (0..2_000).map(|drive| errors(drive, &states, &[]).iter().sum::<Vector3<f64>>() / 50.0).collect();
        let mean: Vector3<f64> = biases.iter().sum::<Vector3<f64>>() / 2_000.0;
        let model = ReceiverModel::default();
        for (axis, sigma_m) in [(0, model.stated_horizontal_m()), (1, model.stated_horizontal_m()), (2, 2.0)] {
            let spread = (biases.iter().map(|bias| bias[axis].powi(2)).sum::<f64>() / 2_000.0).sqrt();
            assert!((spread / sigma_m - 1.0).abs() < 0.06, "axis {axis}: {spread}");
            assert!(mean[axis].abs() < 0.15, "axis {axis}: {}", mean[axis]);
        }
        assert_ne!(biases[0], biases[1]);
    }

    #[test]
    fn a_canyon_shifts_the_fixes_within_it_by_metres_and_none_outside() {
        let states = straight_ahead(300);
        let canyon = Canyon { place: Point2::new(150.0, 0.0), radius_m: 20.0 };
        for drive in 0..40 {
            let errors = errors(drive, &states, &[canyon]);
            let shift = |from: usize, to: usize| (errors[to] - errors[from]).xy().norm();
            assert!(shift(125, 135) > 2.0, "in: {}", shift(125, 135));
            assert!(shift(165, 175) > 2.0, "out: {}", shift(165, 175));
            assert!(shift(135, 165) < 1.2, "within it stays: {}", shift(135, 165));
            assert!(shift(125, 175) < 1.2, "beyond it is as before: {}", shift(125, 175));
        }
    }
}
