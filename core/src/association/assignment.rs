//! Assignment: the one-to-one matching of greatest total weight, in which anyone may stay alone.
//!
//! Paper: "Lane association", Kuhn-Munkres on the bipartite graph. Rows and columns may differ in number; a column that
//! stands for "unassigned" (weight 0) is added for every row, so an edge of no positive weight is never taken.

use pathfinding::{kuhn_munkres::kuhn_munkres, matrix::Matrix};

/// Weights are compared at this resolution.
const SCALE: f64 = 1e9;
/// Weights are held below this, so that no sum of them overflows.
const LARGEST: f64 = 1e6;

/// For each row the column it is assigned to. `weight(row, column)` is `None` where there is no edge.
#[must_use]
#[allow(clippy::cast_possible_truncation)] // clamped to what i64 holds
pub fn assign(rows: usize, columns: usize, weight: impl Fn(usize, usize) -> Option<f64>) -> Vec<Option<usize>> {
    if rows == 0 {
        return Vec::new();
    }
    let mut weights = Matrix::new(rows, columns + rows, 0i64);
    for row in 0..rows {
        for column in 0..columns {
            let scaled = weight(row, column).map_or(-1.0, |value| (value.min(LARGEST) * SCALE).max(-1.0));
            weights[(row, column)] = scaled as i64;
        }
    }
    let (_, matching) = kuhn_munkres(&weights);
    matching
        .into_iter()
        .enumerate()
        .map(|(row, column)| (column < columns && weights[(row, column)] > 0).then_some(column))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The best total by trying everything.
    fn best_by_trial(weights: &[Vec<f64>], row: usize, taken: &mut Vec<bool>) -> f64 {
        if row == weights.len() {
            return 0.0;
        }
        let mut best = best_by_trial(weights, row + 1, taken);
        for column in 0..taken.len() {
            if !taken[column] && weights[row][column] > 0.0 {
                taken[column] = true;
                best = best.max(weights[row][column] + best_by_trial(weights, row + 1, taken));
                taken[column] = false;
            }
        }
        best
    }

    proptest! {
        #[test]
        fn no_other_matching_is_heavier(rows in 1..5usize, columns in 0..5usize, values in prop::collection::vec(-1.0..3.0f64, 25)) {
            let weights: Vec<Vec<f64>> = (0..rows).map(|r| values[5 * r..5 * r + columns].to_vec()).collect();
            let matching = assign(rows, columns, |r, c| Some(weights[r][c]));
            let total: f64 = matching.iter().enumerate().filter_map(|(r, c)| c.map(|c| weights[r][c])).sum();
            let best = best_by_trial(&weights, 0, &mut vec![false; columns]);
            prop_assert!((total - best).abs() < 1e-6);
        }
    }

    #[test]
    fn a_row_without_an_edge_stays_alone() {
        assert_eq!(assign(2, 1, |row, _| (row == 1).then_some(0.5)), vec![None, Some(0)]);
        assert_eq!(assign(0, 3, |_, _| Some(1.0)), vec![]);
    }
}
