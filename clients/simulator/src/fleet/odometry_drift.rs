//! Odometry of a fleet: white noise, and a scale and a turn that are wrong all through a drive.
//!
//! The true motion `(R, t)` of a frame becomes `(R Rz(k |t|), (1 + s) t)` with `s ~ N(0, scale)` and `k ~ N(0, turn)` drawn
//! once per drive, and is then followed by the white noise of [`OdometryNoise`].

use lanemap_core::{Pose, TangentCovariance, geometry::pose::covariance_from_sigmas};
use nalgebra::{Translation3, UnitQuaternion, Vector3};

use crate::{
    OdometryNoise,
    random::{SimRng, normal},
};

/// Sigmas of the axes that nothing disturbs: metres, and radians.
const RESIDUAL_M: f64 = 0.0001;
const RESIDUAL_RAD: f64 = 0.0001 * std::f64::consts::PI / 180.0;
/// Way of a frame for which the stated covariance holds, metres: at 10 m/s.
const TYPICAL_MOTION_M: f64 = 1.0;

/// Figures of an odometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OdometryDrift {
    /// White noise of every motion.
    pub noise: OdometryNoise,
    /// Standard deviation of the scale error of a drive: 0.01 is 1 %.
    pub scale_sigma: f64,
    /// Standard deviation of the turn that a drive has too much, degrees per 100 m.
    pub turn_sigma_deg_per_100m: f64,
}

impl Default for OdometryDrift {
    fn default() -> Self {
        Self {
            noise: OdometryNoise { yaw_sigma_deg: 0.02, translation_sigma_m: 0.01 },
            scale_sigma: 0.005,
            turn_sigma_deg_per_100m: 0.1,
        }
    }
}

impl OdometryDrift {
    /// Odometry that is wrong by about a share of the way: 0.01 is 1 %.
    #[must_use]
    pub fn of_way(share: f64) -> Self {
        Self { scale_sigma: share, turn_sigma_deg_per_100m: 20.0 * share, ..Self::default() }
    }

    /// The covariance of one motion that a vehicle with this odometry states.
    #[must_use]
    pub fn motion_covariance(&self) -> TangentCovariance {
        let with = |white: f64, drift: f64, least: f64| white.hypot(drift * TYPICAL_MOTION_M).max(least);
        let along_m = with(self.noise.translation_sigma_m, self.scale_sigma, RESIDUAL_M);
        let across_m = with(self.noise.translation_sigma_m, 0.0, RESIDUAL_M);
        let yaw_rad = with(self.noise.yaw_sigma_deg.to_radians(), self.turn_sigma_rad_per_m(), RESIDUAL_RAD);
        covariance_from_sigmas([along_m, across_m, RESIDUAL_M], [RESIDUAL_RAD, RESIDUAL_RAD, yaw_rad])
    }

    /// The odometry of a drive from its true poses; the first is kept. `more_scale` is added to the scale's error.
    pub fn apply(&self, truth: &[Pose], more_scale: f64, rng: &mut SimRng) -> Vec<Pose> {
        let scale = 1.0 + self.scale_sigma * normal(rng) + more_scale;
        let turn_rad_per_m = self.turn_sigma_rad_per_m() * normal(rng);
        let mut drifted: Vec<Pose> = truth.first().copied().into_iter().collect();
        for pair in truth.windows(2) {
            let motion = pair[0].inverse() * pair[1];
            let turn_rad = turn_rad_per_m * motion.translation.vector.norm();
            let wrong = Pose::from_parts(
                Translation3::from(motion.translation.vector * scale),
                motion.rotation * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn_rad),
            );
            drifted.push(drifted[drifted.len() - 1] * wrong);
        }
        self.noise.apply(&drifted, rng)
    }

    fn turn_sigma_rad_per_m(&self) -> f64 {
        self.turn_sigma_deg_per_100m.to_radians() / 100.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};

    #[test]
    fn a_drive_of_a_kilometre_is_off_by_the_stated_scale_and_turn() {
        let model = OdometryDrift { noise: OdometryNoise::default(), scale_sigma: 0.01, turn_sigma_deg_per_100m: 0.2 };
        let truth: Vec<Pose> = (0..=1_000).map(|k| Pose::translation(f64::from(k), 0.0, 0.0)).collect();
        let (mut along, mut turned) = (0.0, 0.0);
        for drive in 0..120 {
            let end = model.apply(&truth, 0.0, &mut Seed(2).stream(Purpose::Odometry, drive))[1_000];
            let way_m: f64 = end.translation.vector.norm();
            along += (way_m / 1_000.0 - 1.0).powi(2) / 120.0;
            turned += end.rotation.angle().powi(2) / 120.0;
        }
        assert!((along.sqrt() - 0.01).abs() < 0.002, "{}", along.sqrt());
        assert!((turned.sqrt().to_degrees() - 2.0).abs() < 0.4, "{}", turned.sqrt().to_degrees());
    }
}
