//! GNSS noise: what a receiver makes of a true pose.
//!
//! `p' = p + b + d(t)`, heading and height with biases: `b` a horizontal bias of 0.5 to 1.5 m in a direction of its own
//! per drive, `d` a slow drift (0.15 m, periods about 20 s), 0.3 degrees of heading, 0.5 m of height.

use lanemap_core::Pose;
use nalgebra::{Translation3, UnitQuaternion, Vector3};

use crate::{
    drive::TrueState,
    noise::SmoothNoise,
    random::{SimRng, normal, uniform},
};

/// Figures of a receiver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GnssModel {
    /// Least horizontal bias, metres.
    pub min_bias_m: f64,
    /// Greatest horizontal bias, metres.
    pub max_bias_m: f64,
    /// Standard deviation of the drift on each axis, metres.
    pub drift_sigma_m: f64,
    /// Middle period of the drift, seconds.
    pub drift_period_s: f64,
    /// Standard deviation of the heading bias, degrees.
    pub heading_sigma_deg: f64,
    /// Standard deviation of the height bias, metres.
    pub height_sigma_m: f64,
}

impl Default for GnssModel {
    fn default() -> Self {
        Self {
            min_bias_m: 0.5,
            max_bias_m: 1.5,
            drift_sigma_m: 0.15,
            drift_period_s: 20.0,
            heading_sigma_deg: 0.3,
            height_sigma_m: 0.5,
        }
    }
}

impl GnssModel {
    /// The poses that a receiver gives over one drive, one per true state.
    pub fn observe(&self, states: &[TrueState], rng: &mut SimRng) -> Vec<Pose> {
        let Some(start) = states.first() else { return Vec::new() };
        let direction_rad = uniform(rng, 0.0, std::f64::consts::TAU);
        let bias = Vector3::new(direction_rad.cos(), direction_rad.sin(), 0.0)
            * uniform(rng, self.min_bias_m, self.max_bias_m)
            + Vector3::z() * (self.height_sigma_m * normal(rng));
        let heading_rad = self.heading_sigma_deg.to_radians() * normal(rng);
        let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad);
        let (shortest_s, longest_s) = (self.drift_period_s * 0.5, self.drift_period_s * 2.0);
        let east = SmoothNoise::new(self.drift_sigma_m, shortest_s, longest_s, rng);
        let north = SmoothNoise::new(self.drift_sigma_m, shortest_s, longest_s, rng);
        states
            .iter()
            .map(|state| {
                let t_s = state.time.seconds_since(start.time);
                let drift = Vector3::new(east.at(t_s), north.at(t_s), 0.0);
                let place = state.world_from_vehicle.translation.vector + bias + drift;
                Pose::from_parts(Translation3::from(place), turned * state.world_from_vehicle.rotation)
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};
    use lanemap_core::TimestampNs;

    #[test]
    fn the_bias_is_a_metre_or_so_and_drifts_slowly() {
        let states: Vec<TrueState> = (0..600)
            .map(|k| TrueState {
                time: TimestampNs(k * 100_000_000),
                world_from_vehicle: Pose::identity(),
                distance_m: 0.0,
                leg: 0,
            })
            .collect();
        let mut headings_deg = Vec::new();
        for drive in 0..300 {
            let poses = GnssModel::default().observe(&states, &mut Seed(3).stream(Purpose::Gnss, drive));
            let mean: Vector3<f64> = poses.iter().map(|pose| pose.translation.vector).sum::<Vector3<f64>>() / 600.0;
            assert!((0.2..1.8).contains(&mean.xy().norm()), "{}", mean.xy().norm());
            for pair in poses.windows(2) {
                assert!((pair[1].translation.vector - pair[0].translation.vector).norm() < 0.05);
            }
            headings_deg.push(poses[0].rotation.angle().to_degrees());
        }
        let sigma_deg = (headings_deg.iter().map(|h| h * h).sum::<f64>() / 300.0).sqrt();
        assert!((sigma_deg - 0.3).abs() < 0.05);
    }
}
