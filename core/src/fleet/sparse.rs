//! Sparse normal equations: rows of few coefficients are added, and the whole is solved by faer's Cholesky.

use faer::{
    Col, Side,
    linalg::solvers::Solve,
    sparse::{SparseColMat, Triplet},
};

/// `sum w (a . x - b)^2`, to be minimised.
pub(super) trait Equations {
    /// Adds `weight (sum coefficient x[index] - value)^2`; no index twice.
    fn add(&mut self, row: &[(usize, f64)], value: f64, weight: f64);

    /// The solution, or `None` where the matrix is not positive definite.
    fn solve(self) -> Option<Vec<f64>>;
}

/// Of any pattern.
#[derive(Debug)]
pub(super) struct NormalEquations {
    triplets: Vec<Triplet<usize, usize, f64>>,
    right: Vec<f64>,
}

impl NormalEquations {
    /// No row yet. Every unknown is held weakly at 0, so that one without rows stays there.
    pub(super) fn new(unknowns: usize, weak: f64) -> Self {
        let triplets = (0..unknowns).map(|i| Triplet::new(i, i, weak)).collect();
        Self { triplets, right: vec![0.0; unknowns] }
    }
}

impl Equations for NormalEquations {
    fn add(&mut self, row: &[(usize, f64)], value: f64, weight: f64) {
        for (position, (i, a)) in row.iter().enumerate() {
            self.right[*i] += weight * a * value;
            // Only the lower half is kept.
            let lower = row[..=position].iter().map(|(j, b)| Triplet::new(*i.max(j), *i.min(j), weight * a * b));
            self.triplets.extend(lower);
        }
    }

    fn solve(self) -> Option<Vec<f64>> {
        let unknowns = self.right.len();
        let matrix = SparseColMat::<usize, f64>::try_new_from_triplets(unknowns, unknowns, &self.triplets).ok()?;
        let factor = matrix.sp_cholesky(Side::Lower).ok()?;
        let solution = factor.solve(Col::from_fn(unknowns, |i| self.right[i]));
        Some((0..unknowns).map(|i| solution[i]).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chain_between_two_ends_is_a_straight_line() {
        let mut equations = NormalEquations::new(5, 1e-12);
        equations.add(&[(0, 1.0)], 1.0, 1e6);
        equations.add(&[(4, 1.0)], 9.0, 1e6);
        for i in 0..4 {
            equations.add(&[(i, -1.0), (i + 1, 1.0)], 0.0, 1.0);
        }
        let solution = equations.solve().unwrap();
        for (x, expected) in solution.iter().zip([1.0, 3.0, 5.0, 7.0, 9.0]) {
            assert!((x - expected).abs() < 1e-4, "{solution:?}");
        }
    }
}
