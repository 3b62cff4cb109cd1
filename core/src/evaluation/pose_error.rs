//! Relative pose error over a length of road.
//!
//! Paper: "Evaluation on Pose Update", after KITTI's odometry benchmark: from every frame to the first one that is at least
//! the length ahead along the true path, how far the estimated motion is from the true one, in degrees and in metres (KITTI
//! divides by the length, the paper does not).

use std::ops::AddAssign;

use crate::geometry::pose::Pose;

/// Sums of relative pose errors; they add up over drives.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RelativePoseError {
    /// Number of pairs of frames.
    pub pairs: u64,
    /// Sum of rotation errors, degrees.
    pub rotation_deg_sum: f64,
    /// Sum of translation errors, metres.
    pub translation_m_sum: f64,
}

impl RelativePoseError {
    /// Mean rotation error, degrees; 0 without pairs.
    #[must_use]
    pub fn rotation_deg(&self) -> f64 {
        self.rotation_deg_sum / self.pairs.max(1) as f64
    }

    /// Mean translation error, metres; 0 without pairs.
    #[must_use]
    pub fn translation_m(&self) -> f64 {
        self.translation_m_sum / self.pairs.max(1) as f64
    }
}

impl AddAssign for RelativePoseError {
    fn add_assign(&mut self, other: Self) {
        self.pairs += other.pairs;
        self.rotation_deg_sum += other.rotation_deg_sum;
        self.translation_m_sum += other.translation_m_sum;
    }
}

/// Error of `estimate` against `truth` (poses of the same frames, each in a frame of its own) over `length_m` of true path.
///
/// ```
/// use lanemap_core::{Pose, evaluation::relative_pose_error};
///
/// let drive = |step_m: f64| (0..21).map(|i| Pose::translation(step_m * f64::from(i), 0.0, 0.0)).collect::<Vec<_>>();
/// let error = relative_pose_error(&drive(1.0), &drive(1.1), 10.0);
/// assert_eq!(error.pairs, 11);
/// assert!((error.translation_m() - 1.0).abs() < 1e-9 && error.rotation_deg() < 1e-9);
/// ```
#[must_use]
pub fn relative_pose_error(truth: &[Pose], estimate: &[Pose], length_m: f64) -> RelativePoseError {
    let travelled_m = path_lengths_m(truth);
    let mut error = RelativePoseError::default();
    let mut last = 0;
    for first in 0..truth.len().min(estimate.len()) {
        while last < travelled_m.len() && travelled_m[last] - travelled_m[first] < length_m - 1e-9 {
            last += 1;
        }
        if last >= truth.len().min(estimate.len()) {
            break;
        }
        let true_motion = truth[first].inverse() * truth[last];
        let motion = estimate[first].inverse() * estimate[last];
        let difference = true_motion.inverse() * motion;
        error += RelativePoseError {
            pairs: 1,
            rotation_deg_sum: difference.rotation.angle().to_degrees(),
            translation_m_sum: difference.translation.vector.norm(),
        };
    }
    error
}

/// Length of the path up to each pose, metres.
fn path_lengths_m(poses: &[Pose]) -> Vec<f64> {
    let mut travelled_m = 0.0;
    let mut previous = poses.first();
    poses
        .iter()
        .map(|pose| {
            if let Some(previous) = previous.replace(pose) {
                travelled_m += (pose.translation.vector - previous.translation.vector).norm();
            }
            travelled_m
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn a_turn_of_the_estimate_shows_as_rotation_only_where_it_happens() {
        let truth: Vec<Pose> = (0..21).map(|i| Pose::translation(f64::from(i), 0.0, 0.0)).collect();
        let mut bent = truth.clone();
        for pose in &mut bent[15..] {
            pose.rotation = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::z() * 0.1);
        }
        let error = relative_pose_error(&truth, &bent, 10.0);
        // Frames 5 to 10 look across the turn: six pairs of eleven.
        assert!((error.rotation_deg() - 0.1_f64.to_degrees() * 6.0 / 11.0).abs() < 1e-9);
    }

    #[test]
    fn a_frame_of_its_own_does_not_matter_to_the_estimate() {
        let truth: Vec<Pose> = (0..21).map(|i| Pose::translation(f64::from(i), 0.0, 0.0)).collect();
        let elsewhere = Pose::new(Vector3::new(100.0, -50.0, 3.0), Vector3::new(0.0, 0.1, 2.0));
        let moved: Vec<Pose> = truth.iter().map(|pose| elsewhere * pose).collect();
        let error = relative_pose_error(&truth, &moved, 5.0);
        assert!(error.translation_m() < 1e-9 && error.rotation_deg() < 1e-5);
    }

    #[test]
    fn a_drive_shorter_than_the_length_has_no_error() {
        let truth = [Pose::identity(), Pose::translation(4.0, 0.0, 0.0)];
        assert_eq!(relative_pose_error(&truth, &truth, 10.0), RelativePoseError::default());
    }
}
