//! Where GNSS and odometry alone put a drive: the start of its search for a place among others.
//!
//! The heading is that of the georeference (a rotation about the vertical, fitted to fixes and poses), the place that of the
//! first fix. From there the drive's own alignment is solved a few times, with a robust scale of the fixes that falls, so
//! that fixes in a street canyon lose their hold.

use nalgebra::{Point3, Rotation3, Vector3};

use super::{
    alignment::{RobustScales, align_one},
    contribution::TrajectoryPoint,
    correction::Correction,
    params::FleetParams,
    prepared::Restraints,
};
use crate::geometry::{Pose, georeference::GeoreferenceFit, pose::yaw_rad};

/// A robust scale beyond any residual, metres.
pub(super) const UNBOUNDED_M: f64 = 1e4;

/// Where GNSS and odometry alone put a drive; `None` without fixes.
pub(super) fn by_gnss(
    trajectory: &[TrajectoryPoint],
    restraints: &Restraints,
    params: &FleetParams,
) -> Option<Correction> {
    let mut fit = GeoreferenceFit::default();
    for point in trajectory {
        if let Some(fix) = &point.fix {
            fit.observe(fix, &Pose::new(point.position.coords, Vector3::z() * point.yaw_rad));
        }
    }
    let yaw_rad = yaw_rad(&fit.georeference()?.enu_from_map);
    let first = restraints.fixes.first()?;
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw_rad);
    let shared_from_map = |point: &Point3<f64>| first.shared + turn * (point - first.map);
    let mut correction = Correction::rigid(trajectory, yaw_rad, shared_from_map, params);
    for fixes_m in [UNBOUNDED_M, 4.0 * params.gnss_robust_scale_m, 2.0 * params.gnss_robust_scale_m] {
        align_one(restraints, &mut correction, &[], RobustScales { lanes_m: UNBOUNDED_M, fixes_m });
    }
    Some(correction)
}
