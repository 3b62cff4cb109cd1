//! Prediction: the last corrected pose, carried on by odometry, with its uncertainty.
//!
//! `map_from_vehicle' = map_from_vehicle * motion`, `P' = A P A^T + Q`, where `A` carries a perturbation of the old vehicle's
//! axes across the motion (`geometry::pose::transport`) and `Q` is the covariance of the motion in the new vehicle's axes.
//!
//! Ours: what lanes say of the pose is off by an error `c` that the same lines repeat from frame to frame. It is part of the
//! state, `c' = phi c`, `phi = exp(-dt / tau)`, so that ten frames that agree are not ten witnesses: with good odometry the pose
//! hardly follows the detector, with bad odometry it follows at once.

use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};

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
        let motion = previous_odometry.inverse() * odometry.odometry_from_vehicle;
        let carry = transport(&motion);
        let noise = odometry
            .motion_covariance
            .unwrap_or_else(|| covariance_from_sigmas([params.odometry_sigma_m; 3], [params.odometry_sigma_rad; 3]));
        let mut covariance = carry * self.covariance * carry.transpose() + noise;
        forget_along(&mut covariance, params.map_memory_m);
        let phi = if params.correlation_s > 0.0 { (-seconds.max(0.0) / params.correlation_s).exp() } else { 0.0 };
        Self {
            map_from_vehicle: self.map_from_vehicle * motion,
            covariance: (covariance + covariance.transpose()) * 0.5,
            detector_error: self.detector_error * phi,
            detector_covariance: self.detector_covariance * (phi * phi),
            cross_covariance: carry * self.cross_covariance * phi,
            remembered: phi,
        }
    }
}

/// Bounds the uncertainty along the road: the map around the vehicle was made by its own last poses, so that what it
/// lost along the road long ago is lost to both alike.
fn forget_along(covariance: &mut TangentCovariance, bound_m: f64) {
    let variance = covariance[(0, 0)];
    if variance > bound_m * bound_m {
        let shrink = bound_m / variance.sqrt();
        covariance.row_mut(0).scale_mut(shrink);
        covariance.column_mut(0).scale_mut(shrink);
    }
}
