//! Motion: the way from one frame to the next, by odometry and by how a vehicle moved until now.
//!
//! Ours; the paper takes odometry as it comes. A vehicle does not change its speed or its turning at once, and odometry that is
//! off by half a degree from frame to frame says in every frame what it cannot do. So the twist `v` (motion per second, in the
//! vehicle's axes) is part of the state and changes slowly, `v' = v + w`, `w ~ N(0, q dt)`, and odometry's motion is a
//! measurement of `v dt` with the covariance that the vehicle states. It is Kalman's update:
//! `S = P_v dt^2 + Q`, `K = P dt S^-1` for the twist and for all that is correlated with it. Good
//! odometry (`Q` small) is taken as it is, poor odometry is tempered. As lanes correct the pose, they correct the twist too.
//!
//! Turning changes the more, the more the vehicle turns: straight roads are held straight, and a junction is followed.
//! How far the vehicle went is left to odometry, and the way to the side is tempered little: with both held tight the simulated
//! drives of `tests/tests/localization.rs` were laid metres along a road that bends as evenly as a circle.
//! Not guaranteed: a motion that odometry states poorly and that no vehicle makes (a skid) is followed late.

use nalgebra::{Cholesky, Const, Matrix6, Vector6};
use serde::{Deserialize, Serialize};

use super::PoseEstimate;
use crate::{
    geometry::{
        Pose, TangentCovariance,
        pose::{exp, log, perturb},
    },
    params::Steadiness,
};

/// What nothing is known of before the first motion: standard deviations per second, metres and radians.
const UNKNOWN: [f64; 6] = [30.0, 5.0, 5.0, 1.0, 1.0, 1.0];

/// How the vehicle moves, and what that has to do with where it is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Twist {
    /// Motion per second, in the vehicle's axes, metres and radians.
    pub per_second: Vector6<f64>,
    /// Its covariance.
    pub covariance: Matrix6<f64>,
    /// Covariance of the pose (rows) with it.
    pub with_pose: Matrix6<f64>,
    /// Covariance of the detector's error (rows) with it.
    pub with_error: Matrix6<f64>,
}

impl Twist {
    /// Nothing is known.
    #[must_use]
    pub fn unknown() -> Self {
        Self {
            per_second: Vector6::zeros(),
            covariance: Matrix6::from_diagonal(&Vector6::from(UNKNOWN.map(|sigma| sigma * sigma))),
            with_pose: Matrix6::zeros(),
            with_error: Matrix6::zeros(),
        }
    }
}

/// A motion from one frame to the next, `a_from_b`, and what its error is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// The motion.
    pub a_from_b: Pose,
    /// Its error per error of the twist, seconds: 0 where it was not weighed against the twist.
    pub by_twist_s: f64,
    /// Covariance of the error that has nothing to do with the twist.
    pub noise: TangentCovariance,
}

impl Motion {
    /// The motion that odometry reports, whatever the vehicle did until now.
    #[must_use]
    pub fn reported(a_from_b: Pose, covariance: TangentCovariance) -> Self {
        Self { a_from_b, by_twist_s: 0.0, noise: covariance }
    }
}

/// Weighs a reported motion over `seconds` against the twist: the estimate before the motion, which learns from it, and the
/// motion that is believed.
#[must_use]
pub fn weigh(estimate: &PoseEstimate, reported: &Motion, seconds: f64, params: &Steadiness) -> (PoseEstimate, Motion) {
    let twist = &estimate.twist;
    let prior = twist.covariance + Matrix6::from_diagonal(&(change_variance(twist, params) * seconds));
    let expected = exp(&(twist.per_second * seconds));
    // The axes turn by a few degrees within a motion. Were that carried along, a height that odometry knows to a tenth of a
    // millimetre would tell of the way ahead, by the pitch of the road.
    let surprise = log(&(expected.inverse() * reported.a_from_b));
    let (shown, pose_shown, error_shown) = (prior * seconds, twist.with_pose * seconds, twist.with_error * seconds);
    let Some(factor) = (shown * seconds + reported.noise).cholesky() else { return (*estimate, *reported) };
    let (gain, pose_gain, error_gain) =
        (gain_of(&shown, &factor), gain_of(&pose_shown, &factor), gain_of(&error_shown, &factor));
    let covariance = symmetric(&(prior - gain * shown.transpose()));
    let learned = PoseEstimate {
        map_from_vehicle: perturb(&estimate.map_from_vehicle, &(pose_gain * surprise)),
        covariance: symmetric(&(estimate.covariance - pose_gain * pose_shown.transpose())),
        detector_error: estimate.detector_error + error_gain * surprise,
        detector_covariance: symmetric(&(estimate.detector_covariance - error_gain * error_shown.transpose())),
        cross_covariance: estimate.cross_covariance - pose_gain * error_shown.transpose(),
        remembered: estimate.remembered,
        twist: Twist {
            per_second: twist.per_second + gain * surprise,
            covariance,
            with_pose: twist.with_pose - pose_gain * shown.transpose(),
            with_error: twist.with_error - error_gain * shown.transpose(),
        },
    };
    let believed = perturb(&expected, &(gain * surprise * seconds));
    (learned, Motion { a_from_b: believed, by_twist_s: seconds, noise: Matrix6::zeros() })
}

/// How much the twist changes in a second, as variances.
fn change_variance(twist: &Twist, params: &Steadiness) -> Vector6<f64> {
    let turn = params.turn_rad_s + params.turn_share * twist.per_second[5].abs();
    Vector6::new(params.speed_mps, params.sway_mps, params.heave_mps, params.tilt_rad_s, params.tilt_rad_s, turn)
        .map(|sigma| sigma * sigma)
}

/// `C S^-1`.
fn gain_of(shown: &Matrix6<f64>, factor: &Cholesky<f64, Const<6>>) -> Matrix6<f64> {
    factor.solve(&shown.transpose()).transpose()
}

fn symmetric(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    (matrix + matrix.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        frame::Odometry,
        geometry::pose::{covariance_from_sigmas, yaw_rad},
        params::{Params, Preset, TrackingParams},
    };
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    fn params() -> TrackingParams {
        Params::preset(Preset::Default).tracking
    }

    /// Carries an estimate along motions as odometry of this noise (metres, radians) reports them, ten a second.
    fn driven(motions: &[Pose], noise_m: f64, noise_rad: f64, seed: u64) -> Vec<PoseEstimate> {
        let covariance = covariance_from_sigmas([noise_m, noise_m, 1e-4], [1e-5, 1e-5, noise_rad]);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let mut draw = |sigma: f64| {
            let unit: f64 = StandardNormal.sample(&mut rng);
            sigma * unit
        };
        let (mut odometry_from_vehicle, mut estimate) = (Pose::identity(), PoseEstimate::first(Pose::identity()));
        let mut estimates = vec![estimate];
        for motion in motions {
            let error = Vector6::new(draw(noise_m), draw(noise_m), 0.0, 0.0, 0.0, draw(noise_rad));
            let next = perturb(&(odometry_from_vehicle * motion), &error);
            let odometry = Odometry { odometry_from_vehicle: next, motion_covariance: Some(covariance) };
            estimate = estimate.predict(&odometry_from_vehicle, &odometry, 0.1, &params());
            odometry_from_vehicle = next;
            estimates.push(estimate);
        }
        estimates
    }

    fn ahead(way_m: f64, turn_rad: f64) -> Pose {
        exp(&Vector6::new(way_m, 0.0, 0.0, 0.0, 0.0, turn_rad))
    }

    #[test]
    fn odometry_that_is_right_is_taken_as_it_is_through_a_sharp_turn_and_a_stop() {
        let motions: Vec<Pose> =
            [ahead(1.4, 0.0), ahead(1.2, 0.0), ahead(0.8, 0.12), ahead(0.7, 0.15), ahead(0.0, 0.0)].to_vec();
        let last = driven(&motions, 1e-6, 1e-6, 1).last().unwrap().map_from_vehicle;
        let truth = motions.iter().fold(Pose::identity(), |pose, motion| pose * motion);
        let error = log(&(truth.inverse() * last));
        assert!(error.norm() < 2e-5, "{error}");
    }

    #[test]
    fn a_vehicle_that_goes_straight_on_is_held_straight_though_odometry_says_otherwise() {
        let motions = vec![ahead(1.4, 0.0); 60];
        let (mut tempered, mut by_odometry) = (0.0, 0.0);
        for seed in 1..=20 {
            let noise_rad = 0.5_f64.to_radians();
            let estimates = driven(&motions, 0.5, noise_rad, seed);
            for estimate in &estimates[30..] {
                tempered += (0.1 * estimate.twist.per_second[5]).powi(2);
                by_odometry += noise_rad.powi(2);
            }
        }
        assert!(tempered < 0.1 * by_odometry, "{tempered} {by_odometry}");
    }

    #[test]
    fn a_turn_at_a_junction_is_followed() {
        let motions: Vec<Pose> =
            (0..60).map(|k| ahead(0.5, if (25..50).contains(&k) { 1.6 * 0.04 } else { 0.0 })).collect();
        let estimates = driven(&motions, 0.05, 0.1_f64.to_radians(), 3);
        let off = 1.6 - yaw_rad(&estimates.last().unwrap().map_from_vehicle);
        assert!(off.abs() < 1.5_f64.to_radians(), "{off}");
    }

    #[test]
    fn what_is_believed_of_pose_error_and_twist_together_stays_a_covariance() {
        let motions: Vec<Pose> = (0..200).map(|k| ahead(1.0, 0.02 * f64::from(k % 7 - 3))).collect();
        for PoseEstimate { covariance, detector_covariance, cross_covariance, twist, .. } in
            driven(&motions, 0.5, 0.01, 5)
        {
            let mut whole = nalgebra::SMatrix::<f64, 18, 18>::identity() * 1e-9;
            let blocks = [
                (0, 0, covariance),
                (0, 6, cross_covariance),
                (0, 12, twist.with_pose),
                (6, 6, detector_covariance),
                (6, 12, twist.with_error),
                (12, 12, twist.covariance),
            ];
            for (row, column, block) in blocks {
                let mut view = whole.fixed_view_mut::<6, 6>(row, column);
                view += block;
                if row != column {
                    whole.fixed_view_mut::<6, 6>(column, row).copy_from(&block.transpose());
                }
            }
            assert!(whole.cholesky().is_some());
        }
    }
}
