//! The paper's odometry: true motion followed by noise on x, y and yaw between every two frames.
//!
//! Each true relative motion is followed by a yaw `N(0, sigma)` and a shift of x and y `N(0, sigma)` in the moving
//! frame, and the results are chained (`drives/README.md`, *Odometry noise*).

use nalgebra::{Translation3, UnitQuaternion, Vector3};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use lanemap_core::geometry::Pose;

/// The noise of one motion, in the axes of the vehicle after it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MotionNoise {
    /// Shift along the road, metres.
    pub x_m: f64,
    /// Shift to the left, metres.
    pub y_m: f64,
    /// Turn to the left, radians.
    pub yaw_rad: f64,
}

impl MotionNoise {
    /// The same noise without its lateral and yaw parts, which lane lines can correct.
    #[must_use]
    pub fn along_track_only(self) -> Self {
        Self { x_m: self.x_m, ..Self::default() }
    }

    fn motion(self) -> Pose {
        Pose::from_parts(
            Translation3::new(self.x_m, self.y_m, 0.0),
            UnitQuaternion::from_scaled_axis(Vector3::z() * self.yaw_rad),
        )
    }
}

/// Draws the noise of `motions` motions.
pub fn draw_motion_noise(
    motions: usize,
    sigma_rot_deg: f64,
    sigma_trans_m: f64,
    rng: &mut impl Rng,
) -> Vec<MotionNoise> {
    let mut normal = |sigma: f64| -> f64 {
        let unit: f64 = StandardNormal.sample(&mut *rng);
        unit * sigma
    };
    (0..motions)
        .map(|_| MotionNoise {
            yaw_rad: normal(sigma_rot_deg.to_radians()),
            x_m: normal(sigma_trans_m),
            y_m: normal(sigma_trans_m),
        })
        .collect()
}

/// Follows each motion between two poses by its noise. The first pose stays; a motion without a noise stays true.
#[must_use]
pub fn apply_motion_noise(poses: &[Pose], noise: &[MotionNoise]) -> Vec<Pose> {
    let mut noisy: Vec<Pose> = poses.first().copied().into_iter().collect();
    for (index, pair) in poses.windows(2).enumerate() {
        let motion = pair[0].inverse() * pair[1] * noise.get(index).copied().unwrap_or_default().motion();
        let mut next = noisy[index] * motion;
        next.rotation.renormalize();
        noisy.push(next);
    }
    noisy
}

/// Noisy odometry from true poses.
///
/// ```
/// use lanemap_core::Pose;
/// use lanemap_openlane::noisy_odometry;
/// use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
///
/// let truth: Vec<Pose> = (0..10).map(|i| Pose::translation(f64::from(i), 0.0, 0.0)).collect();
/// let odometry = noisy_odometry(&truth, 0.3, 0.3, &mut ChaCha8Rng::seed_from_u64(7));
/// assert_eq!(odometry[0], truth[0]);
/// assert!((odometry[9].translation.vector - truth[9].translation.vector).norm() > 0.0);
/// ```
pub fn noisy_odometry(poses: &[Pose], sigma_rot_deg: f64, sigma_trans_m: f64, rng: &mut impl Rng) -> Vec<Pose> {
    let noise = draw_motion_noise(poses.len().saturating_sub(1), sigma_rot_deg, sigma_trans_m, rng);
    apply_motion_noise(poses, &noise)
}

#[cfg(test)]
mod tests {
    use super::*;
    use lanemap_core::geometry::pose;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    fn bend(frames: i32) -> Vec<Pose> {
        let step = pose::exp(&nalgebra::Vector6::new(1.0, 0.0, 0.01, 0.0, 0.002, 0.03));
        std::iter::successors(Some(Pose::translation(5000.0, -300.0, 12.0)), |last| Some(last * step))
            .take(usize::try_from(frames).unwrap())
            .collect()
    }

    #[test]
    fn each_motion_carries_noise_of_the_stated_size_and_only_in_x_y_and_yaw() {
        let truth = bend(4001);
        let noisy = noisy_odometry(&truth, 0.5, 0.2, &mut ChaCha8Rng::seed_from_u64(3));
        let mut squares = nalgebra::Vector6::zeros();
        for (t, n) in truth.windows(2).zip(noisy.windows(2)) {
            let error = pose::log(&((t[0].inverse() * t[1]).inverse() * (n[0].inverse() * n[1])));
            squares += error.component_mul(&error) / 4000.0;
        }
        let sigma = squares.map(f64::sqrt);
        assert!((sigma[0] - 0.2).abs() < 0.01 && (sigma[1] - 0.2).abs() < 0.01, "{sigma}");
        assert!((sigma[5].to_degrees() - 0.5).abs() < 0.02, "{sigma}");
        assert!(sigma[2] < 1e-9 && sigma[3] < 1e-9 && sigma[4] < 1e-9, "{sigma}");
    }

    #[test]
    fn one_seed_gives_one_odometry() {
        let truth = bend(50);
        let draw = |seed| noisy_odometry(&truth, 0.3, 0.3, &mut ChaCha8Rng::seed_from_u64(seed));
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
    }
}
