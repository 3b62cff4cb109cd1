//! Incremental smoothing: the banded information of a lane's control points and its solution.
//!
//! Paper: "Spline Optimization". Every term is `lambda |sum_k w_k P_{first + k} - q|^2` with four weights, so the normal
//! equations `H X = B` have one scalar matrix `H` of half-bandwidth 3 for all three axes. iSAM2 on this chain is
//! exactly: add the new terms, refactorise `H = L D L^T` from the first row they touch, substitute back until the
//! change dies out. Where the authors call GTSAM, this file does that.
//!
//! * Rows are numbered by [`Knot`]s, which may be negative: both ends grow in O(1) and no index ever shifts.
//! * Refactorisation and substitution stop at three rows in succession that come out *bit for bit* as they were: all
//!   later rows depend on these alone. So the factor and the solution are a pure function of the terms, whatever the
//!   order of solving, and a restored lane goes on with the same bits.
//! * Positions are kept relative to an anchor, so that a lane 10 km from the origin loses no digits.
//!
//! Not guaranteed: a solution where some control point is in no term at all; its row is singular. Chordal terms between
//! all neighbours and one point term anywhere suffice.

use std::collections::VecDeque;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

/// Number of a control point in its lane: it never changes, and is negative for those grown at the head.
pub type Knot = i64;

/// Control points that one term may join.
pub const WIDTH: usize = 4;

/// One quadratic term: `information * |sum_k weights[k] P_{first + k} - target|^2`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Term {
    /// First control point.
    pub first: Knot,
    /// Weights of `first .. first + 4`; zero where there is no such control point.
    pub weights: [f64; WIDTH],
    /// Where the weighted sum should be: a position for weights that sum to 1, a difference for weights that sum to 0.
    pub target: Vector3<f64>,
    /// Inverse variance, 1/m^2.
    pub information: f64,
}

/// One row of the normal equations: the diagonal, three entries to its left, and the right-hand side.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// `H[i][i - k]` for `k = 0 .. 4`.
    band: [f64; WIDTH],
    /// `B[i]`, relative to the anchor.
    right: Vector3<f64>,
}

impl Row {
    fn add(&mut self, other: &Self) {
        for (mine, theirs) in self.band.iter_mut().zip(other.band) {
            *mine += theirs;
        }
        self.right += other.right;
    }
}

/// One row of the factor: `D[i]`, `L[i][i - 1 ..= i - 3]` and the forward substituted right-hand side.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct FactorRow {
    pivot: f64,
    left: [f64; WIDTH - 1],
    forward: Vector3<f64>,
}

/// Sums of terms over a run of control points, not yet solved.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BandedSum {
    first: Knot,
    rows: VecDeque<Row>,
}

impl BandedSum {
    /// First and last knot, or `None` while there is no term.
    #[must_use]
    #[allow(clippy::cast_possible_wrap)] // a count of control points
    pub fn span(&self) -> Option<(Knot, Knot)> {
        (!self.rows.is_empty()).then(|| (self.first, self.first + self.rows.len() as Knot - 1))
    }

    /// Adds a term, with positions relative to `anchor`.
    pub fn add(&mut self, term: &Term, anchor: &Point3<f64>) {
        let used = term.weights.iter().rposition(|weight| *weight != 0.0).map_or(0, |last| last + 1);
        if used == 0 {
            return;
        }
        self.cover(term.first, used);
        let weight_sum: f64 = term.weights.iter().sum();
        let target = term.target - anchor.coords * weight_sum;
        let start = self.offset(term.first);
        for (k, weight) in term.weights.iter().enumerate().take(used) {
            let row = &mut self.rows[start + k];
            let scaled = term.information * weight;
            for back in 0..=k {
                row.band[back] += scaled * term.weights[k - back];
            }
            row.right += target * scaled;
        }
    }

    /// Makes room for `count` knots from `first`.
    fn cover(&mut self, first: Knot, count: usize) {
        if self.rows.is_empty() {
            self.first = first;
        }
        while self.first > first {
            self.rows.push_front(Row::default());
            self.first -= 1;
        }
        let needed = self.offset(first) + count;
        if self.rows.len() < needed {
            self.rows.resize(needed, Row::default());
        }
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a knot of this sum: not before its first
    fn offset(&self, knot: Knot) -> usize {
        debug_assert!(knot >= self.first);
        (knot - self.first) as usize
    }

    fn row(&self, knot: Knot) -> Option<&Row> {
        usize::try_from(knot - self.first).ok().and_then(|index| self.rows.get(index))
    }

    /// Adds all rows of another sum.
    pub fn absorb(&mut self, other: &Self) {
        if other.rows.is_empty() {
            return;
        }
        self.cover(other.first, other.rows.len());
        let start = self.offset(other.first);
        for (index, row) in other.rows.iter().enumerate() {
            self.rows[start + index].add(row);
        }
    }
}

/// The information of a lane's control points, its factor and its solution.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(from = "Stored", into = "Stored")]
pub struct BandedInformation {
    anchor: Point3<f64>,
    head: Knot,
    rows: VecDeque<Row>,
    factor: VecDeque<FactorRow>,
    offsets: VecDeque<Vector3<f64>>,
    positions: VecDeque<Point3<f64>>,
    /// Rows changed since the last solution: first and last index.
    touched: Option<(usize, usize)>,
}

/// What a snapshot keeps: the factor is a function of the rows and is made anew.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Stored {
    anchor: Point3<f64>,
    head: Knot,
    rows: VecDeque<Row>,
    offsets: VecDeque<Vector3<f64>>,
}

impl From<BandedInformation> for Stored {
    fn from(information: BandedInformation) -> Self {
        let BandedInformation { anchor, head, rows, offsets, .. } = information;
        Self { anchor, head, rows, offsets }
    }
}

impl From<Stored> for BandedInformation {
    fn from(stored: Stored) -> Self {
        let Stored { anchor, head, rows, offsets } = stored;
        let positions = offsets.iter().map(|offset| anchor + offset).collect();
        let factor = std::iter::repeat_n(FactorRow::default(), rows.len()).collect();
        let mut information = Self { anchor, head, rows, factor, offsets, positions, touched: None };
        information.refactorise(0, information.rows.len().saturating_sub(1));
        information
    }
}

impl BandedInformation {
    /// No control points yet; positions will be kept relative to `anchor`.
    #[must_use]
    pub fn new(anchor: Point3<f64>) -> Self {
        Self {
            anchor,
            head: 0,
            rows: VecDeque::new(),
            factor: VecDeque::new(),
            offsets: VecDeque::new(),
            positions: VecDeque::new(),
            touched: None,
        }
    }

    /// The point that positions are kept relative to.
    #[must_use]
    pub fn anchor(&self) -> &Point3<f64> {
        &self.anchor
    }

    /// Knot of the first control point.
    #[must_use]
    pub fn head(&self) -> Knot {
        self.head
    }

    /// Number of control points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there is no control point.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Control points in order, as last solved.
    #[must_use]
    pub fn positions(&self) -> &VecDeque<Point3<f64>> {
        &self.positions
    }

    /// Knot of the control point at an index.
    #[must_use]
    #[allow(clippy::cast_possible_wrap)] // an index of a lane
    pub fn knot(&self, index: usize) -> Knot {
        self.head + index as Knot
    }

    fn index(&self, knot: Knot) -> Option<usize> {
        usize::try_from(knot - self.head).ok().filter(|index| *index < self.rows.len())
    }

    /// Adds a control point behind the last one.
    pub fn push_tail(&mut self, position: Point3<f64>) {
        self.rows.push_back(Row::default());
        self.factor.push_back(FactorRow::default());
        self.offsets.push_back(position - self.anchor);
        self.positions.push_back(position);
        self.touch(self.rows.len() - 1, self.rows.len() - 1);
    }

    /// Adds a control point before the first one.
    pub fn push_head(&mut self, position: Point3<f64>) {
        self.head -= 1;
        self.rows.push_front(Row::default());
        self.factor.push_front(FactorRow::default());
        self.offsets.push_front(position - self.anchor);
        self.positions.push_front(position);
        self.touched = self.touched.map(|(first, last)| (first + 1, last + 1));
        self.touch(0, 0);
    }

    fn touch(&mut self, first: usize, last: usize) {
        let (low, high) = self.touched.unwrap_or((first, last));
        self.touched = Some((low.min(first), high.max(last)));
    }

    /// Adds one term for good.
    pub fn add(&mut self, term: &Term) {
        let mut sum = BandedSum::default();
        sum.add(term, &self.anchor);
        self.absorb(&sum);
    }

    /// Adds a sum of terms for good. Rows of control points that the lane does not have are left out.
    pub fn absorb(&mut self, sum: &BandedSum) {
        for (k, row) in (sum.first..).zip(&sum.rows) {
            if let Some(index) = self.index(k) {
                self.rows[index].add(row);
                self.touch(index, index);
            }
        }
    }

    /// Puts the total of `sums`, added in their order, in place of the rows of `first ..= last`.
    pub fn replace<'a>(&mut self, first: Knot, last: Knot, sums: impl Iterator<Item = &'a BandedSum> + Clone) {
        for knot in first..=last {
            let Some(index) = self.index(knot) else { continue };
            let mut row = Row::default();
            for sum in sums.clone() {
                if let Some(part) = sum.row(knot) {
                    row.add(part);
                }
            }
            if self.rows[index] != row {
                self.rows[index] = row;
                self.touch(index, index);
            }
        }
    }

    /// Brings the control points up to date with the terms. Costs what changed, not what there is.
    pub fn solve(&mut self) {
        let Some((first, last)) = self.touched.take() else { return };
        let end = self.refactorise(first, last);
        self.substitute_back(first, end);
    }

    /// Refactorises from `first`; returns the first row past `last` from which on nothing changed.
    fn refactorise(&mut self, first: usize, last: usize) -> usize {
        let mut unchanged = 0;
        for i in first..self.rows.len() {
            let row = self.factor_row(i);
            unchanged = if row == self.factor[i] { unchanged + 1 } else { 0 };
            self.factor[i] = row;
            if i >= last + WIDTH - 1 && unchanged >= WIDTH - 1 {
                return i + 1;
            }
        }
        self.rows.len()
    }

    /// Row `i` of the factor, from the three rows before it.
    fn factor_row(&self, i: usize) -> FactorRow {
        let Row { band, right } = self.rows[i];
        let nothing = FactorRow { pivot: 1.0, ..FactorRow::default() };
        let before = |back: usize| if i >= back { self.factor[i - back] } else { nothing };
        let (one, two, three) = (before(1), before(2), before(3));
        // Columns i-3, i-2, i-1 of row i, times their pivots.
        let scaled_three = band[3];
        let scaled_two = band[2] - scaled_three * two.left[0];
        let scaled_one = band[1] - scaled_three * one.left[1] - scaled_two * one.left[0];
        let left = [scaled_one / one.pivot, scaled_two / two.pivot, scaled_three / three.pivot];
        let pivot = band[0] - left[0] * scaled_one - left[1] * scaled_two - left[2] * scaled_three;
        let forward = right - one.forward * left[0] - two.forward * left[1] - three.forward * left[2];
        FactorRow { pivot, left, forward }
    }

    /// Substitutes back from `end` towards the head, until rows before `first` come out as they were.
    fn substitute_back(&mut self, first: usize, end: usize) {
        let mut unchanged = 0;
        for i in (0..end).rev() {
            let mut offset = self.factor[i].forward / self.factor[i].pivot;
            for ahead in 1..WIDTH {
                if let Some(row) = self.factor.get(i + ahead) {
                    offset -= self.offsets[i + ahead] * row.left[ahead - 1];
                }
            }
            unchanged = if offset == self.offsets[i] { unchanged + 1 } else { 0 };
            self.offsets[i] = offset;
            self.positions[i] = self.anchor + offset;
            if i + WIDTH <= first && unchanged >= WIDTH - 1 {
                return;
            }
        }
    }

    /// Variance of each control point from `from` on (selected inverse, Takahashi), m^2, the same on every axis.
    ///
    /// `Z[i][i] = 1 / D[i] - sum_k L[i + k][i] Z[i + k][i]`, from the tail to `from`; solve first.
    #[must_use]
    pub fn variances(&self, from: usize) -> Vec<f64> {
        let count = self.rows.len();
        let mut variances = vec![0.0; count.saturating_sub(from)];
        // Z[i][i .. i + 4] for the three rows after the current one.
        let mut after: [[f64; WIDTH]; WIDTH - 1] = [[0.0; WIDTH]; WIDTH - 1];
        for i in (from..count).rev() {
            let below = |ahead: usize| self.factor.get(i + ahead).map_or(0.0, |row| row.left[ahead - 1]);
            let left = [below(1), below(2), below(3)];
            let inverse = |a: usize, b: usize| after[a.min(b) - 1][a.abs_diff(b)];
            let mut band = [0.0; WIDTH];
            for ahead in 1..WIDTH {
                band[ahead] = -(1..WIDTH).map(|m| left[m - 1] * inverse(ahead, m)).sum::<f64>();
            }
            band[0] = 1.0 / self.factor[i].pivot - (1..WIDTH).map(|m| left[m - 1] * band[m]).sum::<f64>();
            variances[i - from] = band[0];
            after = [band, after[0], after[1]];
        }
        variances
    }
}

#[cfg(test)]
mod tests;
