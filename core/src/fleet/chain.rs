//! Normal equations of a single drive: a chain of knots, each tied to the next, and a few unknowns that all have in common.
//!
//! `[A B; B' C] [x; y] = [a; c]` with `A` banded (half-bandwidth [`BAND`]) and `C` of at most [`BORDER`] unknowns: `A = L D L'`,
//! `S = C - B' A^-1 B`, `y = S^-1 (c - B' A^-1 a)`, `x = A^-1 (a - B y)`. Linear in the length of the drive, where a sparse
//! solver spends most of its time on finding this out.

use std::cmp::Ordering;

use nalgebra::{SMatrix, SVector};

use super::sparse::Equations;

/// Half-bandwidth: two knots of three unknowns.
const BAND: usize = 5;
/// Most unknowns that all knots have in common.
const BORDER: usize = 4;
/// Right-hand sides that are solved with the band: the border's columns, and the right side itself.
const SIDES: usize = BORDER + 1;

/// `sum w (a . x - b)^2` of a chain, to be minimised.
#[derive(Debug)]
pub(super) struct ChainEquations {
    chained: usize,
    common: usize,
    /// Row `i` of the lower band: `A[i][i - BAND + k]`.
    band: Vec<[f64; BAND + 1]>,
    /// Row `i` of `B`, and the right side last.
    sides: Vec<[f64; SIDES]>,
    corner: SMatrix<f64, BORDER, BORDER>,
    corner_right: SVector<f64, BORDER>,
}

impl ChainEquations {
    /// No row yet; the first `chained` of the unknowns are the chain's. Every unknown is held weakly at 0.
    pub(super) fn new(chained: usize, unknowns: usize, weak: f64) -> Self {
        debug_assert!(unknowns - chained <= BORDER, "at most {BORDER} unknowns in common");
        let mut row = [0.0; BAND + 1];
        row[BAND] = weak;
        // What of the corner is not used is held as well, so that it can be solved as a whole.
        let corner = SMatrix::from_fn(|i, j| match (i == j, i < unknowns - chained) {
            (true, true) => weak,
            (true, false) => 1.0,
            _ => 0.0,
        });
        Self {
            chained,
            common: unknowns - chained,
            band: vec![row; chained],
            sides: vec![[0.0; SIDES]; chained],
            corner,
            corner_right: SVector::zeros(),
        }
    }

    /// Adds to the entry of two unknowns, `low <= high`; not again for `(high, low)`.
    fn add_entry(&mut self, low: usize, high: usize, value: f64) {
        if high < self.chained {
            debug_assert!(high - low <= BAND, "a row couples knots that are neighbours");
            self.band[high][BAND + low - high] += value;
        } else if low < self.chained {
            self.sides[low][high - self.chained] += value;
        } else {
            let (low, high) = (low - self.chained, high - self.chained);
            self.corner[(low, high)] += value;
            if low != high {
                self.corner[(high, low)] += value;
            }
        }
    }

    /// `A = L D L'` in place: `L` below the diagonal, `D` on it; `None` where a pivot is not positive.
    fn factorise(&mut self) -> Option<()> {
        for i in 0..self.chained {
            let first = i.saturating_sub(BAND);
            // First L[i][j] D[j], from which the products of the row are made.
            for j in first..i {
                let common = first.max(j.saturating_sub(BAND))..j;
                let sum: f64 = common.map(|m| self.band[i][BAND + m - i] * self.band[j][BAND + m - j]).sum();
                self.band[i][BAND + j - i] -= sum;
            }
            for j in first..i {
                let scaled = self.band[i][BAND + j - i];
                let lower = scaled / self.band[j][BAND];
                self.band[i][BAND + j - i] = lower;
                self.band[i][BAND] -= scaled * lower;
            }
            // Neither is NaN.
            if self.band[i][BAND].partial_cmp(&0.0) != Some(Ordering::Greater) {
                return None;
            }
        }
        Some(())
    }

    /// `A^-1` of all sides, in place.
    fn substitute(&mut self) {
        for i in 0..self.chained {
            for m in i.saturating_sub(BAND)..i {
                let lower = self.band[i][BAND + m - i];
                let before = self.sides[m];
                for (side, before) in self.sides[i].iter_mut().zip(before) {
                    *side -= lower * before;
                }
            }
        }
        for i in (0..self.chained).rev() {
            let pivot = self.band[i][BAND];
            for side in &mut self.sides[i] {
                *side /= pivot;
            }
        }
        for i in (0..self.chained).rev() {
            let after = self.sides[i];
            for m in i.saturating_sub(BAND)..i {
                let lower = self.band[i][BAND + m - i];
                for (side, after) in self.sides[m].iter_mut().zip(after) {
                    *side -= lower * after;
                }
            }
        }
    }

    /// The solution, or `None` where the matrix is not positive definite.
    pub(super) fn solve(mut self) -> Option<Vec<f64>> {
        let columns: Vec<[f64; SIDES]> = self.sides.clone();
        self.factorise()?;
        self.substitute();
        let (mut corner, mut right) = (self.corner, self.corner_right);
        for (column, solved) in columns.iter().zip(&self.sides) {
            for i in 0..self.common {
                right[i] -= column[i] * solved[BORDER];
                for j in 0..self.common {
                    corner[(i, j)] -= column[i] * solved[j];
                }
            }
        }
        let common = corner.cholesky()?.solve(&right);
        let chained = self
            .sides
            .iter()
            .map(|solved| solved[BORDER] - (0..self.common).map(|j| solved[j] * common[j]).sum::<f64>());
        let mut solution: Vec<f64> = chained.collect();
        solution.extend(common.iter().take(self.common));
        Some(solution)
    }
}

impl Equations for ChainEquations {
    fn add(&mut self, row: &[(usize, f64)], value: f64, weight: f64) {
        for (position, (i, a)) in row.iter().enumerate() {
            match i.checked_sub(self.chained) {
                None => self.sides[*i][BORDER] += weight * a * value,
                Some(common) => self.corner_right[common] += weight * a * value,
            }
            for (j, b) in &row[..=position] {
                self.add_entry(*i.min(j), *i.max(j), weight * a * b);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::fleet::sparse::{Chain, Elimination, JointEquations};

    proptest! {
        #[test]
        fn a_chain_is_solved_as_the_sparse_solver_solves_it(
            knots in 1_usize..12,
            common in 1_usize..=4,
            coefficients in proptest::collection::vec(-2.0..2.0_f64, 600),
        ) {
            let unknowns = 3 * knots + common;
            let mut chain = ChainEquations::new(3 * knots, unknowns, 1e-3);
            let mut sparse = JointEquations::new(&[Chain { first: 0, knots }], 3, common, 0, 1e-3);
            let mut next = coefficients.iter().cycle().copied();
            let mut draw = move || next.next().unwrap_or(1.0);
            for knot in 0..knots {
                for _ in 0..4 {
                    let last = (3 * knot + 6).min(3 * knots);
                    let mut row: Vec<(usize, f64)> = (3 * knot..last).map(|i| (i, draw())).collect();
                    row.extend((3 * knots..unknowns).map(|i| (i, draw())));
                    let (value, weight) = (draw(), 0.1 + draw().abs());
                    chain.add(&row, value, weight);
                    sparse.add(&row, value, weight);
                }
            }
            let (chain, sparse) = (chain.solve().unwrap(), sparse.solve(&mut Elimination::default()).unwrap());
            for (a, b) in chain.iter().zip(&sparse) {
                prop_assert!((a - b).abs() < 1e-7 * (1.0 + b.abs()), "{a} {b}");
            }
        }
    }
}
