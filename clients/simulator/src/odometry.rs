//! Odometry: true motion followed by the paper's 3-DOF noise, and what the vehicle says of its uncertainty.
//!
//! `T'_k = T'_{k-1} (T_{k-1}^-1 T_k) N_k`, `N_k` a yaw `N(0, sigma_yaw)` and an x, y shift `N(0, sigma_translation)` in
//! the moving frame ([`lanemap_openlane::noisy_odometry`]).

use lanemap_core::{Pose, TangentCovariance, geometry::pose::covariance_from_sigmas};
use lanemap_openlane::noisy_odometry;

use crate::random::SimRng;

/// What is left of the noise on the axes that the model does not disturb: metres, and radians.
const RESIDUAL_M: f64 = 0.0001;
const RESIDUAL_RAD: f64 = 0.0001 * std::f64::consts::PI / 180.0;

/// Noise of the motion between two frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OdometryNoise {
    /// Standard deviation of the yaw, degrees.
    pub yaw_sigma_deg: f64,
    /// Standard deviation of x and of y, metres.
    pub translation_sigma_m: f64,
}

impl OdometryNoise {
    /// The covariance of one motion that a vehicle with this odometry would state; never less than a tenth of a millimetre and 0.0001 degrees.
    #[must_use]
    pub fn motion_covariance(&self) -> TangentCovariance {
        let plane_m = self.translation_sigma_m.max(RESIDUAL_M);
        let yaw_rad = self.yaw_sigma_deg.to_radians().max(RESIDUAL_RAD);
        covariance_from_sigmas([plane_m, plane_m, RESIDUAL_M], [RESIDUAL_RAD, RESIDUAL_RAD, yaw_rad])
    }

    /// Noisy poses from true ones; the first is kept.
    pub fn apply(&self, true_poses: &[Pose], rng: &mut SimRng) -> Vec<Pose> {
        noisy_odometry(true_poses, self.yaw_sigma_deg, self.translation_sigma_m, rng)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};
    use lanemap_core::geometry::pose::log;
    use nalgebra::{Translation3, UnitQuaternion};

    #[test]
    fn each_motion_is_off_by_the_stated_noise_and_by_nothing_else() {
        let noise = OdometryNoise { yaw_sigma_deg: 0.3, translation_sigma_m: 0.2 };
        let truth: Vec<Pose> = (0..20_000)
            .map(|k| Pose::from_parts(Translation3::new(f64::from(k), 0.0, 0.0), UnitQuaternion::identity()))
            .collect();
        let noisy = noise.apply(&truth, &mut Seed(1).stream(Purpose::Odometry, 0));
        assert_eq!(noisy[0], truth[0]);
        let mut square = nalgebra::Vector6::zeros();
        for k in 1..truth.len() {
            let error = log(&((truth[k - 1].inverse() * truth[k]).inverse() * (noisy[k - 1].inverse() * noisy[k])));
            square += error.component_mul(&error) / truth.len() as f64;
        }
        let sigma = square.map(f64::sqrt);
        assert!((sigma[0] - 0.2).abs() < 0.01 && (sigma[1] - 0.2).abs() < 0.01);
        assert!((sigma[5] - 0.3_f64.to_radians()).abs() < 0.0003);
        assert!(sigma[2] + sigma[3] + sigma[4] < 1e-6);
    }

    #[test]
    fn without_noise_the_poses_are_the_true_ones() {
        let truth = [Pose::identity(), Pose::translation(1.0, 0.2, 0.0), Pose::translation(2.0, 0.3, 0.1)];
        let same = OdometryNoise::default().apply(&truth, &mut Seed(1).stream(Purpose::Odometry, 0));
        for (a, b) in truth.iter().zip(&same) {
            assert!((a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12);
        }
    }
}
