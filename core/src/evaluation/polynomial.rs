//! The polynomial fit of the paper's scorer: numpy's `polyfit` with a falling order.
//!
//! Least squares by singular values on the Vandermonde matrix with columns of unit length, singular values below
//! `n * epsilon` of the largest left out, as numpy does: the scorer has to agree with the authors' to the digit.

use nalgebra::{DMatrix, DVector};

/// A polynomial, highest power first.
pub(crate) struct Polynomial {
    coefficients: Vec<f64>,
}

impl Polynomial {
    /// Fits `y(x)`: order 3, less for few points and where `y` has little spread (0 below 0.1 m, 2 below 1 m).
    pub(crate) fn fit(x: &[f64], y: &[f64]) -> Self {
        let order = order(y);
        let mut matrix = DMatrix::from_fn(x.len(), order + 1, |row, column| power(x[row], order - column));
        let scales: Vec<f64> = matrix
            .column_iter_mut()
            .map(|mut column| {
                let norm = column.norm();
                let scale = if norm > 0.0 { norm } else { 1.0 };
                column /= scale;
                scale
            })
            .collect();
        let svd = matrix.svd(true, true);
        let cut = x.len() as f64 * f64::EPSILON * svd.singular_values.max();
        // Both factors were asked for, so the only error of `solve` cannot happen.
        let solution = svd.solve(&DVector::from_column_slice(y), cut).unwrap_or_else(|_| DVector::zeros(order + 1));
        Self { coefficients: solution.iter().zip(&scales).map(|(value, scale)| value / scale).collect() }
    }

    pub(crate) fn at(&self, x: f64) -> f64 {
        self.coefficients.iter().fold(0.0, |sum, coefficient| sum * x + coefficient)
    }
}

fn order(y: &[f64]) -> usize {
    let most = y.len() - 1;
    let spread = y.iter().copied().fold(f64::NEG_INFINITY, f64::max) - y.iter().copied().fold(f64::INFINITY, f64::min);
    if spread < 0.1 {
        0
    } else if spread < 1.0 {
        most.min(2)
    } else {
        most.min(3)
    }
}

fn power(x: f64, exponent: usize) -> f64 {
    (0..exponent).fold(1.0, |product, _| product * x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_is_found_again() {
        let x: Vec<f64> = (0..30).map(f64::from).collect();
        let cubic = |x: f64| 0.002 * x.powi(3) - 0.05 * x * x + x - 4.0;
        let y: Vec<f64> = x.iter().map(|x| cubic(*x)).collect();
        assert!((Polynomial::fit(&x, &y).at(12.3) - cubic(12.3)).abs() < 1e-9);
    }

    #[test]
    fn a_flat_line_is_fitted_by_its_mean() {
        let fit = Polynomial::fit(&[0.0, 1.0, 2.0, 3.0, 4.0], &[0.0, 0.05, 0.0, 0.05, 0.0]);
        assert!((fit.at(100.0) - 0.02).abs() < 1e-12);
    }

    #[test]
    fn points_above_one_another_give_a_finite_fit() {
        let fit = Polynomial::fit(&[2.0, 2.0, 2.0], &[0.0, 1.0, 2.0]);
        assert!((fit.at(2.0) - 1.0).abs() < 1e-9);
    }
}
