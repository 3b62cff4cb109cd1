//! The Catmull-Rom basis: a point of a segment as a weighting of four control points.
//!
//! Paper: "Lane Representation", equation 2 with `tau = 1/2`:
//! `p(u) = [1 u u^2 u^3] M [P_0 P_1 P_2 P_3]^T`, from `P_1` at `u = 0` to `P_2` at `u = 1`. The weights sum to 1 for every
//! `u`, so a spline moves with its control points; they may be negative, so it can leave their convex hull.
//!
//! ```
//! use lanemap_core::spline::basis::weights;
//! assert_eq!(weights(0.0), [0.0, 1.0, 0.0, 0.0]);
//! assert_eq!(weights(1.0), [0.0, 0.0, 1.0, 0.0]);
//! ```

/// Weights of the four control points at `u`.
#[must_use]
pub fn weights(u: f64) -> [f64; 4] {
    let (u2, u3) = (u * u, u * u * u);
    [-0.5 * u + u2 - 0.5 * u3, 1.0 - 2.5 * u2 + 1.5 * u3, 0.5 * u + 2.0 * u2 - 1.5 * u3, -0.5 * u2 + 0.5 * u3]
}

/// First derivative of [`weights`] by `u`.
#[must_use]
pub fn derivative_weights(u: f64) -> [f64; 4] {
    let u2 = u * u;
    [-0.5 + 2.0 * u - 1.5 * u2, -5.0 * u + 4.5 * u2, 0.5 + 4.0 * u - 4.5 * u2, -u + 1.5 * u2]
}

/// Second derivative of [`weights`] by `u`.
#[must_use]
pub fn second_derivative_weights(u: f64) -> [f64; 4] {
    [2.0 - 3.0 * u, -5.0 + 9.0 * u, 4.0 - 9.0 * u, -1.0 + 3.0 * u]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn weights_sum_to_one_and_their_derivatives_to_zero(u in 0.0..1.0f64) {
            prop_assert!((weights(u).iter().sum::<f64>() - 1.0).abs() < 1e-12);
            prop_assert!(derivative_weights(u).iter().sum::<f64>().abs() < 1e-12);
            prop_assert!(second_derivative_weights(u).iter().sum::<f64>().abs() < 1e-12);
        }

        #[test]
        fn derivatives_agree_with_finite_differences(u in 0.01..0.99f64) {
            let h = 1e-6;
            for k in 0..4 {
                let first = (weights(u + h)[k] - weights(u - h)[k]) / (2.0 * h);
                let second = (derivative_weights(u + h)[k] - derivative_weights(u - h)[k]) / (2.0 * h);
                prop_assert!((first - derivative_weights(u)[k]).abs() < 1e-8);
                prop_assert!((second - second_derivative_weights(u)[k]).abs() < 1e-8);
            }
        }
    }
}
