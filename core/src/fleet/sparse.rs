//! Sparse normal equations of many drives and of stations that they share, solved by faer's Cholesky.
//!
//! The unknowns of a drive are a chain of knots, each tied to the next, and a few that all its knots have in common; a
//! station is tied to the knots that saw it, and stations are not tied to each other. So the pattern is known before any row is:
//! a column of the lower half has its own knot, the next one, the drive's common unknowns, and stations. Rows are added in
//! place, and nothing is sorted. Which order eliminates with least fill depends on the pattern alone: it is kept, and found again
//! only where the pattern is another ([`Elimination`]).

use faer::{
    Col, Side,
    linalg::solvers::Solve,
    sparse::{
        SparseColMat, SymbolicSparseColMat,
        linalg::solvers::{Llt, SymbolicLlt},
    },
};

/// `sum w (a . x - b)^2`, to be minimised.
pub(super) trait Equations {
    /// Adds `weight (sum coefficient x[index] - value)^2`; no index twice.
    fn add(&mut self, row: &[(usize, f64)], value: f64, weight: f64);
}

/// How many unknowns each knot of a drive has, and how many all knots of one have in common, at most.
const MOST_PER_KNOT: usize = 3;
const MOST_COMMON: usize = 4;
/// Entries of a column that are not stations: two knots, and what they have in common.
const CHAINED: usize = 2 * MOST_PER_KNOT + MOST_COMMON;

/// Where the unknowns of one drive stand.
#[derive(Clone, Copy, Debug)]
pub(super) struct Chain {
    pub(super) first: usize,
    pub(super) knots: usize,
}

/// A column of the lower half.
#[derive(Clone, Copy, Debug)]
struct Column {
    /// First unknown of its knot.
    knot: usize,
    /// Unknowns from there on to the end of the next knot.
    chained: usize,
    /// First of its drive's common unknowns, and their number.
    common: usize,
    commons: usize,
    entries: [f64; CHAINED],
}

/// Of many drives and stations.
#[derive(Debug)]
pub(super) struct JointEquations {
    columns: Vec<Column>,
    /// Of each column the stations that it is tied to, in their order.
    stations: Vec<Vec<(usize, f64)>>,
    /// Of each station its own entry.
    corner: Vec<f64>,
    right: Vec<f64>,
}

/// The pattern of a problem, and the order in which it is eliminated.
#[derive(Clone, Debug, Default)]
pub(super) struct Elimination {
    known: Option<(Vec<usize>, Vec<usize>, SymbolicLlt<usize>)>,
}

impl JointEquations {
    /// No row yet: drives one after the other, with `per_knot` unknowns at each knot and `common` of the drive behind them, then
    /// stations. Every unknown is held weakly at 0, so that one without rows stays there.
    pub(super) fn new(chains: &[Chain], per_knot: usize, common: usize, stations: usize, weak: f64) -> Self {
        debug_assert!(per_knot <= MOST_PER_KNOT && common <= MOST_COMMON, "the columns hold no more");
        let mut columns = Vec::new();
        for chain in chains {
            let behind = chain.first + per_knot * chain.knots;
            for unknown in chain.first..behind + common {
                let knot = chain.first + (unknown - chain.first) / per_knot * per_knot;
                let own = if unknown < behind { knot } else { behind };
                let mut entries = [0.0; CHAINED];
                let column = Column {
                    knot: own,
                    chained: (2 * per_knot).min(behind - own),
                    common: behind,
                    commons: common,
                    entries: [0.0; CHAINED],
                };
                entries[column.position(unknown)] = weak;
                columns.push(Column { entries, ..column });
            }
        }
        let unknowns = columns.len() + stations;
        Self {
            stations: vec![Vec::new(); columns.len()],
            columns,
            corner: vec![weak; stations],
            right: vec![0.0; unknowns],
        }
    }

    fn add_entry(&mut self, low: usize, high: usize, value: f64) {
        let stations = self.columns.len();
        if high < stations {
            let column = &mut self.columns[low];
            let position = column.position(high);
            column.entries[position] += value;
        } else if low < stations {
            let tied = &mut self.stations[low];
            // Rows mostly come in the order of the stations.
            match tied.last_mut() {
                Some((station, sum)) if *station == high => *sum += value,
                Some((station, _)) if *station > high => {
                    match tied.binary_search_by_key(&high, |(station, _)| *station) {
                        Ok(at) => tied[at].1 += value,
                        Err(at) => tied.insert(at, (high, value)),
                    }
                }
                _ => tied.push((high, value)),
            }
        } else {
            debug_assert_eq!(low, high, "stations are not tied to each other");
            self.corner[low - stations] += value;
        }
    }

    /// The solution, or `None` where the matrix is not positive definite.
    pub(super) fn solve(self, elimination: &mut Elimination) -> Option<Vec<f64>> {
        let unknowns = self.right.len();
        let (starts, rows, values) = self.lower_half();
        let right = self.right;
        let symbolic = elimination.of(&starts, &rows)?;
        let pattern = SymbolicSparseColMat::new_checked(unknowns, unknowns, starts, None, rows);
        let matrix = SparseColMat::new(pattern, values);
        let factor = Llt::try_new_with_symbolic(symbolic, matrix.as_ref(), Side::Lower).ok()?;
        let solution = factor.solve(Col::from_fn(unknowns, |i| right[i]));
        Some((0..unknowns).map(|i| solution[i]).collect())
    }

    /// Compressed columns: where each starts, its rows, its values.
    fn lower_half(&self) -> (Vec<usize>, Vec<usize>, Vec<f64>) {
        let most = CHAINED * self.columns.len() + self.stations.iter().map(Vec::len).sum::<usize>() + self.corner.len();
        let (mut starts, mut rows, mut values) = (vec![0], Vec::with_capacity(most), Vec::with_capacity(most));
        for (unknown, (column, stations)) in self.columns.iter().zip(&self.stations).enumerate() {
            let chained = column.knot..column.knot + column.chained;
            for row in chained.chain(column.common..column.common + column.commons).filter(|row| *row >= unknown) {
                rows.push(row);
                values.push(column.entries[column.position(row)]);
            }
            rows.extend(stations.iter().map(|(station, _)| *station));
            values.extend(stations.iter().map(|(_, value)| *value));
            starts.push(rows.len());
        }
        for (station, value) in self.corner.iter().enumerate() {
            rows.push(self.columns.len() + station);
            values.push(*value);
            starts.push(rows.len());
        }
        (starts, rows, values)
    }
}

impl Column {
    /// Where the entry of a row stands that is no station's.
    fn position(&self, row: usize) -> usize {
        if row >= self.common { 2 * MOST_PER_KNOT + row - self.common } else { row - self.knot }
    }
}

impl Equations for JointEquations {
    fn add(&mut self, row: &[(usize, f64)], value: f64, weight: f64) {
        for (position, (i, a)) in row.iter().enumerate() {
            let weighted = weight * a;
            self.right[*i] += weighted * value;
            // Only the lower half is kept.
            for (j, b) in &row[..=position] {
                self.add_entry(*i.min(j), *i.max(j), weighted * b);
            }
        }
    }
}

impl Elimination {
    /// The symbolic factor of a pattern; `None` where there is none.
    fn of(&mut self, starts: &[usize], rows: &[usize]) -> Option<SymbolicLlt<usize>> {
        match &self.known {
            Some((known_starts, known_rows, factor)) if known_starts == starts && known_rows == rows => {
                Some(factor.clone())
            }
            _ => {
                let unknowns = starts.len() - 1;
                let pattern =
                    SymbolicSparseColMat::new_checked(unknowns, unknowns, starts.to_vec(), None, rows.to_vec());
                let factor = SymbolicLlt::try_new(pattern.as_ref(), Side::Lower).ok()?;
                self.known = Some((starts.to_vec(), rows.to_vec(), factor.clone()));
                Some(factor)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chain_between_two_ends_is_a_straight_line() {
        let mut equations = JointEquations::new(&[Chain { first: 0, knots: 5 }], 1, 0, 0, 1e-12);
        equations.add(&[(0, 1.0)], 1.0, 1e6);
        equations.add(&[(4, 1.0)], 9.0, 1e6);
        for i in 0..4 {
            equations.add(&[(i, -1.0), (i + 1, 1.0)], 0.0, 1.0);
        }
        let solution = equations.solve(&mut Elimination::default()).unwrap();
        for (x, expected) in solution.iter().zip([1.0, 3.0, 5.0, 7.0, 9.0]) {
            assert!((x - expected).abs() < 1e-4, "{solution:?}");
        }
    }

    #[test]
    fn what_two_drives_say_of_a_station_is_weighed_with_what_each_has_in_common() {
        // Two drives of two knots with one common unknown each; both see the station with their second knot.
        let chains = [Chain { first: 0, knots: 2 }, Chain { first: 3, knots: 2 }];
        let mut elimination = Elimination::default();
        for shift in [0.0, 5.0] {
            let mut equations = JointEquations::new(&chains, 1, 1, 1, 1e-12);
            for (first, place) in [(0, shift), (3, shift + 2.0)] {
                equations.add(&[(first, 1.0), (first + 2, 1.0)], place, 1.0);
                equations.add(&[(first + 2, 1.0)], 0.0, 1.0);
                equations.add(&[(first + 1, 1.0), (first, -1.0)], 1.0, 1e6);
                equations.add(&[(first + 1, 1.0), (6, -1.0)], 0.0, 1e6);
            }
            // Both lie at the mean of what the two say, and their common unknowns take the rest in halves.
            let solution = equations.solve(&mut elimination).unwrap();
            let middle = shift + 1.0;
            let expected = [middle, middle + 1.0, -0.5, middle, middle + 1.0, 0.5, middle + 1.0];
            for (x, expected) in solution.iter().zip(expected) {
                assert!((x - expected).abs() < 1e-4, "{solution:?}");
            }
        }
    }
}
