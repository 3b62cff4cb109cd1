//! Poses: rigid transforms on SE(3), named `target_from_source`, and their uncertainty.
//!
//! The tangent space is ordered translation first: `(x, y, z, roll, pitch, yaw)`, metres and radians, and perturbs on
//! the right, `T * exp(xi)`: `xi` is expressed in the *source* frame (the vehicle's own axes, for a vehicle pose).
//! Translation and rotation are perturbed separately, `exp(xi) = (xi_t, Exp(xi_r))`: for the small corrections of a
//! mapper this differs from the full SE(3) exponential in second order only, and it keeps the Jacobians exact.

use nalgebra::{
    Isometry3, Matrix3, Matrix4, Matrix6, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3, Vector6,
};

use crate::error::PoseError;

/// A rigid transform. `target_from_source * point_source = point_target`.
pub type Pose = Isometry3<f64>;

/// Covariance of a pose in its tangent space `(x, y, z, roll, pitch, yaw)`, m^2, m rad, rad^2, in the source frame's axes.
pub type TangentCovariance = Matrix6<f64>;

/// How far a 3x3 block may be from a rotation (largest entry of `R R^T - I`) to be accepted.
///
/// Files that keep eight decimals are off by about 1e-8; one that keeps three, by 1e-3.
pub const ROTATION_TOLERANCE: f64 = 1e-3;

/// Reads a pose from a 4x4 homogeneous matrix, re-orthogonalised.
///
/// # Errors
/// A matrix with an entry that is not finite, whose upper left block is not a rotation within
/// [`ROTATION_TOLERANCE`], or whose last row is not `0 0 0 1`.
pub fn pose_from_matrix(matrix: &Matrix4<f64>) -> Result<Pose, PoseError> {
    if let Some(value) = matrix.iter().find(|value| !value.is_finite()) {
        return Err(PoseError::NotFinite { value: *value });
    }
    let last_row = matrix.fixed_view::<1, 4>(3, 0);
    if (last_row - nalgebra::RowVector4::new(0.0, 0.0, 0.0, 1.0)).amax() > 1e-9 {
        return Err(PoseError::LastRow);
    }
    let block: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let deviation = (block * block.transpose() - Matrix3::identity()).amax();
    if deviation > ROTATION_TOLERANCE || block.determinant() < 0.0 {
        return Err(PoseError::NotARotation { deviation, limit: ROTATION_TOLERANCE });
    }
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_eps(&block, 1e-14, 100, Rotation3::identity()));
    Ok(Pose::from_parts(Translation3::new(matrix[(0, 3)], matrix[(1, 3)], matrix[(2, 3)]), rotation))
}

/// Moves a pose by a tangent vector in its source frame: `target_from_source * exp(xi)`.
#[must_use]
pub fn perturb(target_from_source: &Pose, xi: &Vector6<f64>) -> Pose {
    target_from_source * exp(xi)
}

/// The transform of a tangent vector: translation `(xi_0, xi_1, xi_2)`, rotation `Exp(xi_3, xi_4, xi_5)`.
#[must_use]
pub fn exp(xi: &Vector6<f64>) -> Pose {
    Pose::from_parts(
        Translation3::new(xi[0], xi[1], xi[2]),
        UnitQuaternion::from_scaled_axis(Vector3::new(xi[3], xi[4], xi[5])),
    )
}

/// The tangent vector of a transform; inverse of [`exp`].
#[must_use]
pub fn log(pose: &Pose) -> Vector6<f64> {
    let rotation = pose.rotation.scaled_axis();
    let translation = pose.translation.vector;
    Vector6::new(translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z)
}

/// The same pose with every -0 as 0, which the wire does not tell apart.
#[must_use]
pub fn without_negative_zeros(target_from_source: &Pose) -> Pose {
    let Pose { rotation, translation } = target_from_source;
    // By IEEE 754, -0 + 0 is 0, and any other number stays as it is.
    let rotation = UnitQuaternion::new_unchecked(Quaternion::from(rotation.coords.map(|value| value + 0.0)));
    Pose::from_parts(Translation3::from(translation.vector.map(|value| value + 0.0)), rotation)
}

/// Heading of the source's x axis in the target frame, radians, counter-clockwise from the target's x axis.
#[must_use]
pub fn yaw_rad(target_from_source: &Pose) -> f64 {
    let forward = target_from_source.rotation * Vector3::x();
    forward.y.atan2(forward.x)
}

/// A diagonal covariance from standard deviations in metres and radians.
#[must_use]
pub fn covariance_from_sigmas(translation_m: [f64; 3], rotation_rad: [f64; 3]) -> TangentCovariance {
    let sigma = Vector6::new(
        translation_m[0],
        translation_m[1],
        translation_m[2],
        rotation_rad[0],
        rotation_rad[1],
        rotation_rad[2],
    );
    TangentCovariance::from_diagonal(&sigma.component_mul(&sigma))
}

/// Jacobian of `log(motion^-1 * exp(xi) * motion)` at `xi = 0`: carries a perturbation across a motion.
///
/// With `target_from_b = target_from_a * a_from_b`, a perturbation of the first (in `a`) is this times itself in `b`.
#[must_use]
pub fn transport(a_from_b: &Pose) -> Matrix6<f64> {
    let b_from_a = a_from_b.rotation.inverse().to_rotation_matrix().into_inner();
    let lever = a_from_b.translation.vector.cross_matrix();
    let mut jacobian = Matrix6::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&b_from_a);
    jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(&b_from_a);
    jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&(-b_from_a * lever));
    jacobian
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_pose() -> impl Strategy<Value = Pose> {
        (prop::array::uniform3(-50.0..50.0f64), prop::array::uniform3(-1.0..1.0f64))
            .prop_map(|(t, r)| exp(&Vector6::new(t[0], t[1], t[2], r[0], r[1], r[2])))
    }

    proptest! {
        #[test]
        fn log_inverts_exp(pose in any_pose()) {
            let again = exp(&log(&pose));
            prop_assert!((again.to_homogeneous() - pose.to_homogeneous()).amax() < 1e-9);
        }

        #[test]
        fn transport_is_the_derivative_of_a_carried_perturbation(motion in any_pose()) {
            let step = 1e-6;
            let jacobian = transport(&motion);
            for axis in 0..6 {
                let mut xi = Vector6::zeros();
                xi[axis] = step;
                let carried = log(&(motion.inverse() * exp(&xi) * motion)) / step;
                prop_assert!((carried - jacobian.column(axis)).amax() < 1e-4);
            }
        }

        #[test]
        fn a_matrix_gives_its_pose_back(pose in any_pose()) {
            let again = pose_from_matrix(&pose.to_homogeneous()).unwrap();
            prop_assert!((again.to_homogeneous() - pose.to_homogeneous()).amax() < 1e-9);
        }
    }

    #[test]
    fn a_mirror_is_not_a_rotation() {
        let mut matrix = Matrix4::identity();
        matrix[(1, 1)] = -1.0;
        assert!(matches!(pose_from_matrix(&matrix), Err(PoseError::NotARotation { .. })));
    }

    #[test]
    fn a_nan_is_named() {
        let mut matrix = Matrix4::identity();
        matrix[(0, 3)] = f64::NAN;
        assert!(matches!(pose_from_matrix(&matrix), Err(PoseError::NotFinite { .. })));
    }
}
