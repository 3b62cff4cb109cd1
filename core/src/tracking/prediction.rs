//! Prediction: the last corrected pose, carried on by odometry, with its uncertainty.
//!
//! `map_from_vehicle' = map_from_vehicle * motion`, `P' = A P A^T + Q`, where `A` carries a perturbation of the old vehicle's
//! axes across the motion (`geometry::pose::transport`) and `Q` is the covariance of the motion in the new vehicle's axes.

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
}

impl PoseEstimate {
    /// The first pose of a drive: it defines the map frame, so it has no error.
    #[must_use]
    pub fn first(odometry_from_vehicle: Pose) -> Self {
        Self { map_from_vehicle: odometry_from_vehicle, covariance: TangentCovariance::zeros() }
    }

    /// Carries the estimate on by the motion between two odometry poses.
    #[must_use]
    pub fn predict(&self, previous_odometry: &Pose, odometry: &Odometry, params: &TrackingParams) -> Self {
        let motion = previous_odometry.inverse() * odometry.odometry_from_vehicle;
        let carry = transport(&motion);
        let noise = odometry
            .motion_covariance
            .unwrap_or_else(|| covariance_from_sigmas([params.odometry_sigma_m; 3], [params.odometry_sigma_rad; 3]));
        let covariance = carry * self.covariance * carry.transpose() + noise;
        Self {
            map_from_vehicle: self.map_from_vehicle * motion,
            covariance: (covariance + covariance.transpose()) * 0.5,
        }
    }
}
