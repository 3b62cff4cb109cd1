//! Incremental smoothing: the banded information of a lane's control points and its solution.
//!
//! Paper: "Spline Optimization". Every point-to-spline term is `lambda |sum_k w_k P_{first + k} - q|^2` with four weights, so
//! the normal equations `H X = B` have one scalar matrix `H` of half-bandwidth 3 for all three axes. iSAM2 on this
//! chain is exactly: add the new terms, refactorise `H = L D L^T` from the first row they touch, substitute back until
//! the change dies out. Where the authors call GTSAM, this file does that.
//!
//! The width `W` (the half-bandwidth and one) is a constant: 4 suffices for the paper. Where the errors of one line in one frame are
//! correlated (`landmark::line_terms`), one frame couples all control points in view, and `W` is their number.
//!
//! * Rows are numbered by [`Knot`]s, which may be negative: both ends grow in O(1) and no index ever shifts.
//! * Refactorisation and substitution stop where no further row depends on one that came out with other bits than it had.
//!   So the factor and the solution are a pure function of the terms, whatever the order of solving, and a restored lane
//!   goes on with the same bits. What a row reaches is often less than `W`: most of a wide band is empty.
//! * Positions are kept relative to an anchor, so that a lane 10 km from the origin loses no digits.
//!
//! Not guaranteed: a solution where some control point is in no term at all; its row is singular. Chordal terms between
//! all neighbours and one point term anywhere suffice.

use std::collections::VecDeque;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

mod stored;
#[cfg(test)]
mod tests;

use stored::{Stored, StoredSum};

/// Number of a control point in its lane: it never changes, and is negative for those grown at the head.
pub type Knot = i64;

/// Control points that a point-to-spline term joins.
pub const SUPPORT: usize = 4;

/// One quadratic term: `information * |sum_k weights[k] P_{first + k} - target|^2`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Term {
    /// First control point.
    pub first: Knot,
    /// Weights of `first .. first + 4`; zero where there is no such control point.
    pub weights: [f64; SUPPORT],
    /// Where the weighted sum should be: a position for weights that sum to 1, a difference for weights that sum to 0.
    pub target: Vector3<f64>,
    /// Inverse variance, 1/m^2.
    pub information: f64,
}

/// One row of the normal equations: the diagonal, the entries to its left, and the right-hand side.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Row<const W: usize> {
    /// `H[i][i - k]` for `k = 0 .. W`.
    band: [f64; W],
    /// No entry further left than this is other than zero, and so none of the factor's.
    reach: usize,
    /// `B[i]`, relative to the anchor.
    right: Vector3<f64>,
}

impl<const W: usize> Default for Row<W> {
    fn default() -> Self {
        Self { band: [0.0; W], reach: 0, right: Vector3::zeros() }
    }
}

impl<const W: usize> Row<W> {
    fn add(&mut self, other: &Self) {
        self.reach = self.reach.max(other.reach);
        for (mine, theirs) in self.band.iter_mut().zip(other.band) {
            *mine += theirs;
        }
        self.right += other.right;
    }
}

/// One row and one column of the factor: `D[i]`, `L[i + k][i]` for `k = 1 .. W` (`below[0]` is unused), and the forward
/// substituted side. Columns lie in one piece because both sweeps read them so.
#[derive(Clone, Copy, Debug, PartialEq)]
struct FactorRow<const W: usize> {
    pivot: f64,
    /// Reach of the row that it was made of.
    reach: usize,
    /// No entry of `below` past this one was ever other than zero.
    depth: usize,
    below: [f64; W],
    forward: Vector3<f64>,
}

impl<const W: usize> Default for FactorRow<W> {
    fn default() -> Self {
        Self { pivot: 1.0, reach: 0, depth: 0, below: [0.0; W], forward: Vector3::zeros() }
    }
}

/// A dense quadratic over a run of control points: `X^T H X / 2 - B^T X`, positions as they are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DenseTerm {
    /// First control point.
    pub first: Knot,
    /// Number of control points.
    pub count: usize,
    /// `H`, `count x count`, by rows.
    pub information: Vec<f64>,
    /// `B`, one row per control point.
    pub right: Vec<Vector3<f64>>,
}

/// Sums of terms over a run of control points, not yet solved.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(from = "StoredSum", into = "StoredSum")]
pub struct BandedSum<const W: usize> {
    first: Knot,
    rows: VecDeque<Row<W>>,
}

impl<const W: usize> BandedSum<W> {
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
            row.reach = row.reach.max(k);
            row.right += target * scaled;
        }
    }

    /// Adds a dense term, with positions relative to `anchor`. Control points past the width are left out.
    pub fn add_dense(&mut self, term: &DenseTerm, anchor: &Point3<f64>) {
        let count = term.count.min(W);
        if count == 0 {
            return;
        }
        self.cover(term.first, count);
        let start = self.offset(term.first);
        for k in 0..count {
            let entries = &term.information[k * term.count..k * term.count + count];
            let row = &mut self.rows[start + k];
            for back in 0..=k {
                row.band[back] += entries[k - back];
            }
            row.reach = row.reach.max(k);
            row.right += term.right[k] - anchor.coords * entries.iter().sum::<f64>();
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

    fn row(&self, knot: Knot) -> Option<&Row<W>> {
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
pub struct BandedInformation<const W: usize> {
    anchor: Point3<f64>,
    head: Knot,
    rows: VecDeque<Row<W>>,
    factor: VecDeque<FactorRow<W>>,
    offsets: VecDeque<Vector3<f64>>,
    positions: VecDeque<Point3<f64>>,
    /// Rows changed since the last solution: first and last index.
    touched: Option<(usize, usize)>,
}

impl<const W: usize> BandedInformation<W> {
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
        let mut sum = BandedSum::<W>::default();
        sum.add(term, &self.anchor);
        self.absorb(&sum);
    }

    /// Adds a sum of terms for good. Rows of control points that the lane does not have are left out.
    pub fn absorb(&mut self, sum: &BandedSum<W>) {
        for (k, row) in (sum.first..).zip(&sum.rows) {
            if let Some(index) = self.index(k) {
                self.rows[index].add(row);
                self.touch(index, index);
            }
        }
    }

    /// Puts the total of `sums`, added in their order, in place of the rows of `first ..= last`.
    #[allow(clippy::needless_pass_by_value)] // a cheap iterator, read once for every row
    pub fn replace<'a>(&mut self, first: Knot, last: Knot, sums: impl Iterator<Item = &'a BandedSum<W>> + Clone) {
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
        let (end, reached) = self.refactorise(first, last);
        self.substitute_back(end, reached);
    }

    /// Refactorises from `first`. Returns the first row past `last` from which on nothing changes, and the first row whose
    /// substitution takes anything from a row that was refactorised.
    fn refactorise(&mut self, first: usize, last: usize) -> (usize, usize) {
        let (mut changed, mut reached) = (last, first);
        for i in first..self.rows.len() {
            if i > changed && !self.is_reached_from(i, changed) {
                return (i, reached);
            }
            reached = reached.min(i.saturating_sub(self.rows[i].reach.max(self.factor[i].reach)));
            if self.factor_row(i) {
                changed = changed.max(i);
            }
        }
        (self.rows.len(), reached)
    }

    /// Whether row `i` or one after it depends on row `changed`.
    fn is_reached_from(&self, i: usize, changed: usize) -> bool {
        (i..self.rows.len().min(changed + W)).any(|later| self.rows[later].reach >= later - changed)
    }

    /// Makes row `i` of the factor from the `W - 1` rows before it; whether any bit of it is new.
    fn factor_row(&mut self, i: usize) -> bool {
        let Row { band, reach, right } = self.rows[i];
        let before = i.min(reach.max(self.factor[i].reach));
        // `scaled[k]` becomes `L[i][j] D[j]` of column `j = i - before + k`, column by column from the left.
        let mut scaled = [0.0; W];
        for (k, entry) in scaled.iter_mut().enumerate().take(before) {
            *entry = band[before - k];
        }
        let (mut pivot, mut forward, mut changed) = (band[0], right, false);
        for k in 0..before {
            let column = &mut self.factor[i - before + k];
            let entry = scaled[k];
            let left = entry / column.pivot;
            for (later, below) in scaled[k + 1..before].iter_mut().zip(&column.below[1..]) {
                *later -= entry * below;
            }
            pivot -= left * entry;
            forward -= column.forward * left;
            changed |= column.below[before - k].to_bits() != left.to_bits();
            column.below[before - k] = left;
            column.depth = column.depth.max(before - k);
        }
        let row = &mut self.factor[i];
        changed |= row.pivot.to_bits() != pivot.to_bits() || row.forward != forward;
        (row.pivot, row.reach, row.forward) = (pivot, reach, forward);
        changed
    }

    /// Substitutes back from `end` to `reached`, and on towards the head as far as control points move.
    fn substitute_back(&mut self, end: usize, reached: usize) {
        let mut reached = reached;
        for i in (0..end).rev() {
            if i < reached {
                return;
            }
            let column = &self.factor[i];
            let mut offset = column.forward / column.pivot;
            let later = self.offsets.range(i + 1..self.rows.len().min(i + 1 + column.depth));
            for (later, below) in later.zip(&column.below[1..]) {
                offset -= later * *below;
            }
            if offset != self.offsets[i] {
                self.offsets[i] = offset;
                self.positions[i] = self.anchor + offset;
                reached = reached.min(i.saturating_sub(self.rows[i].reach));
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
        // Z[i][i .. i + W] for the rows after the current one, nearest first.
        let mut after: VecDeque<[f64; W]> = VecDeque::with_capacity(W);
        for i in (from..count).rev() {
            let reach = after.len();
            let below = |ahead: usize| self.factor[i].below[ahead];
            let mut band = [0.0; W];
            for ahead in 1..=reach {
                let inverse = |m: usize| after[ahead.min(m) - 1][ahead.abs_diff(m)];
                band[ahead] = -(1..=reach).map(|m| below(m) * inverse(m)).sum::<f64>();
            }
            band[0] = 1.0 / self.factor[i].pivot - (1..=reach).map(|m| below(m) * band[m]).sum::<f64>();
            variances[i - from] = band[0];
            after.push_front(band);
            after.truncate(W - 1);
        }
        variances
    }
}
