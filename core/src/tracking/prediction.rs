//! Prediction: the last corrected pose, carried on by odometry, with its uncertainty.
//!
//! `map_from_vehicle' = map_from_vehicle * motion`, `P' = [A N] P [A N]^T + Q`, where `A` carries a perturbation of the old
//! vehicle's axes across the motion (`geometry::pose::transport`), `N = dt I` is the error of the motion per error of the twist
//! (`motion`), and `Q` is the covariance of what is left of the motion's error, in the new vehicle's axes.
//!
//! Ours: what lanes say of the pose is off by an error `c` that the same lines repeat from frame to frame. It is part of the
//! state, `c' = phi c`, `phi = exp(-dt / tau)`, so that ten frames that agree are not ten witnesses: with good odometry the pose
//! hardly follows the detector, with bad odometry it follows at once.

use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};

use super::motion::{Motion, Twist, weigh};
use crate::geometry::{
    Pose, TangentCovariance,
    pose::{covariance_from_sigmas, transport},
};
use crate::{frame::Odometry, params::TrackingParams};

/// A pose of the vehicle in the map, with its covariance in the vehicle's axes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseEstimate {
    /// The pose.
    pub map_from_vehicle: Pose,
    /// Its covariance relative to the map around it.
    pub covariance: TangentCovariance,
    /// Error of the pose that the lanes show, vehicle axes, metres and radians.
    pub detector_error: Vector6<f64>,
    /// Covariance of that error.
    pub detector_covariance: Matrix6<f64>,
    /// Covariance of the pose (rows) with that error (columns).
    pub cross_covariance: Matrix6<f64>,
    /// Share of that error which the last prediction kept.
    pub remembered: f64,
    /// How the vehicle moves.
    pub twist: Twist,
}

impl PoseEstimate {
    /// The first pose of a drive: it defines the map frame, so it has no error.
    #[must_use]
    pub fn first(odometry_from_vehicle: Pose) -> Self {
        Self {
            map_from_vehicle: odometry_from_vehicle,
            covariance: TangentCovariance::zeros(),
            detector_error: Vector6::zeros(),
            detector_covariance: Matrix6::zeros(),
            cross_covariance: Matrix6::zeros(),
            remembered: 0.0,
            twist: Twist::unknown(),
        }
    }

    /// Carries the estimate on by the motion between two odometry poses, `seconds` apart.
    #[must_use]
    pub fn predict(
        &self,
        previous_odometry: &Pose,
        odometry: &Odometry,
        seconds: f64,
        params: &TrackingParams,
    ) -> Self {
        let noise = odometry
            .motion_covariance
            .unwrap_or_else(|| covariance_from_sigmas([params.odometry_sigma_m; 3], [params.odometry_sigma_rad; 3]));
        let reported = Motion::reported(previous_odometry.inverse() * odometry.odometry_from_vehicle, noise);
        let (before, motion) = match &params.steadiness {
            Some(steadiness) if seconds > 0.0 => weigh(self, &reported, seconds, steadiness),
            _ => (*self, reported),
        };
        let phi = if params.correlation_s > 0.0 { (-seconds.max(0.0) / params.correlation_s).exp() } else { 0.0 };
        before.carried(&motion, phi, params)
    }

    /// The estimate at the end of a motion, over which `phi` of the detector's error remains.
    fn carried(&self, motion: &Motion, phi: f64, params: &TrackingParams) -> Self {
        let Motion { a_from_b, by_twist_s, noise } = motion;
        let carry = transport(a_from_b);
        let pose_with_twist = carry * self.twist.with_pose;
        let through_twist = pose_with_twist * *by_twist_s;
        let mut covariance = carry * self.covariance * carry.transpose()
            + through_twist
            + through_twist.transpose()
            + self.twist.covariance * by_twist_s.powi(2)
            + noise;
        let mut cross_covariance =
            (carry * self.cross_covariance + self.twist.with_error.transpose() * *by_twist_s) * phi;
        let mut with_pose = pose_with_twist + self.twist.covariance * *by_twist_s;
        let kept = forget_along(&mut covariance, params.map_memory_m);
        cross_covariance.row_mut(0).scale_mut(kept);
        with_pose.row_mut(0).scale_mut(kept);
        Self {
            map_from_vehicle: self.map_from_vehicle * a_from_b,
            covariance: (covariance + covariance.transpose()) * 0.5,
            detector_error: self.detector_error * phi,
            detector_covariance: self.detector_covariance * (phi * phi),
            cross_covariance,
            remembered: phi,
            twist: Twist { with_pose, with_error: self.twist.with_error * phi, ..self.twist },
        }
    }
}

/// Bounds the uncertainty along the road: the map around the vehicle was made by its own last poses, so that what it
/// lost along the road long ago is lost to both alike. Returns the share of the error along the road that is kept.
fn forget_along(covariance: &mut TangentCovariance, bound_m: f64) -> f64 {
    let kept = bound_m / covariance[(0, 0)].sqrt().max(bound_m);
    covariance.row_mut(0).scale_mut(kept);
    covariance.column_mut(0).scale_mut(kept);
    kept
}
