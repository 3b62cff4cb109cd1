//! Growth: what one pass of a drive adds to the lines.
//!
//! Where its lanes lie on lines, it is a witness at their knots. What of a lane lies on no line extends the line that it
//! leaves at its end, and begins a line elsewhere: at the start of a drive, and where roads fork.

use std::{
    collections::{BTreeMap, BTreeSet},
    ops::RangeInclusive,
};

use super::{
    contribution::Contribution,
    correction::Correction,
    line::{FusedLaneId, Knot, Line, Lines, witness_at},
    matching::{Run, match_lanes},
    params::FleetParams,
    prepared::{PreparedLane, PreparedPass, count_of},
};
use crate::lane_map::LaneId;

/// A pass that is added, and what it needs to be told by.
pub(super) struct Growing<'a> {
    pub(super) contribution: &'a Contribution,
    pub(super) pass: &'a PreparedPass<'a>,
    /// Number of the drive among the corrections.
    pub(super) drive: usize,
    /// Number of the pass among those of all drives.
    pub(super) number: usize,
    pub(super) params: &'a FleetParams,
}

/// Passes after which the lines are no longer settled after each.
const SETTLED_EACH: usize = 6;

/// How many lines each lane of each drive has begun.
pub(super) type Pieces = BTreeMap<(usize, LaneId), u32>;

impl Growing<'_> {
    /// Adds the pass to the lines.
    pub(super) fn add_to(&self, lines: &mut Lines, correction: &Correction, pieces: &mut Pieces) {
        let matched = match_lanes(&self.pass.lanes, correction, lines, self.params);
        let before = lines.lines.len();
        let mut touched = BTreeSet::new();
        let mut changed = false;
        for (lane, runs) in matched.iter().enumerate() {
            for run in runs {
                self.testify(lines, correction, lane, run);
                touched.insert(run.line);
            }
            changed |= self.add_rest(lines, correction, lane, runs, pieces);
        }
        // A mean of many is moved little by one more: it is made anew now and then.
        if self.number < SETTLED_EACH || self.number.is_multiple_of(SETTLED_EACH) {
            for line in touched.into_iter().filter(|line| *line < before) {
                lines.lines[line].settle(self.params);
            }
        }
        if changed {
            lines.index();
        }
    }

    /// Witnesses of a run at the knots of its line.
    fn testify(&self, lines: &mut Lines, correction: &Correction, lane_index: usize, run: &Run) {
        let lane = &self.pass.lanes[lane_index];
        let line = &mut lines.lines[run.line];
        let first_sample = *run.samples.start();
        let (low, high) = run.ends();
        line.vote(&lane.lane.category_posterior, (high - low) * self.params.line_knot_m);
        for (step, pair) in run.parameters.windows(2).enumerate() {
            let (low, high) = (pair[0].min(pair[1]), pair[0].max(pair[1]));
            let (from, to) = (&lane.samples[first_sample + step], &lane.samples[first_sample + step + 1]);
            let mut knot = count_of(low.ceil());
            while (knot as f64) < high && knot < line.points.len() {
                let share = (knot as f64 - pair[0]) / (pair[1] - pair[0]);
                let parameter = from.parameter + (to.parameter - from.parameter) * share;
                line.testify(
                    knot,
                    witness_at(self.witness(lane_index), lane, correction, first_sample + step, parameter),
                );
                knot += 1;
            }
        }
    }

    fn witness(&self, lane: usize) -> (usize, usize, usize) {
        (self.drive, self.number, lane)
    }

    /// Adds what of a lane lies on no line; whether there was such.
    fn add_rest(
        &self,
        lines: &mut Lines,
        correction: &Correction,
        lane_index: usize,
        runs: &[Run],
        pieces: &mut Pieces,
    ) -> bool {
        let samples = self.pass.lanes[lane_index].samples.len();
        let mut added = false;
        let mut next = 0;
        let mut before: Option<&Run> = None;
        for run in runs.iter().map(Some).chain([None]) {
            let end = run.map_or(samples, |run| *run.samples.start());
            if end > next {
                let rest = next..=end - 1;
                let grows = before.filter(|run| leaves_at_end(lines, run, true)).map(|run| (run, true));
                let grows =
                    grows.or_else(|| run.filter(|run| leaves_at_end(lines, run, false)).map(|run| (run, false)));
                added |= match grows {
                    Some((run, onward)) => self.extend(lines, correction, lane_index, run, onward, rest),
                    None => self.begin(lines, correction, lane_index, rest, pieces),
                };
            }
            if let Some(run) = run {
                next = *run.samples.end() + 1;
            }
            before = run;
        }
        added
    }

    fn extend(
        &self,
        lines: &mut Lines,
        correction: &Correction,
        lane_index: usize,
        run: &Run,
        onward: bool,
        rest: RangeInclusive<usize>,
    ) -> bool {
        let lane = &self.pass.lanes[lane_index];
        let at_tail = run.is_forward() == onward;
        let line = &mut lines.lines[run.line];
        let before = line.points.len();
        let order: Vec<usize> = if onward { rest.collect() } else { rest.rev().collect() };
        for sample in order {
            let near = &lane.samples[sample];
            let place = correction.apply(&near.map, near.arc_m);
            let last = line.points.len() - 1;
            let (end, direction) =
                if at_tail { (line.points[last], line.tangent(last)) } else { (line.points[0], -line.tangent(0)) };
            let offset = place - end;
            if offset.norm() < 0.9 * self.params.line_knot_m || offset.dot(&direction) <= 0.0 {
                continue;
            }
            let witness = witness_at(self.witness(lane_index), lane, correction, sample, near.parameter);
            let knot = Knot { witnesses: vec![witness], ..Knot::default() };
            if at_tail { line.push(place, knot) } else { line.push_front(place, knot) }
        }
        let grown = line.points.len() - before;
        line.vote(&lane.lane.category_posterior, grown as f64 * self.params.line_knot_m);
        grown > 0
    }

    fn begin(
        &self,
        lines: &mut Lines,
        correction: &Correction,
        lane_index: usize,
        rest: RangeInclusive<usize>,
        pieces: &mut Pieces,
    ) -> bool {
        let lane: &PreparedLane<'_> = &self.pass.lanes[lane_index];
        let piece = pieces.entry((self.drive, lane.lane.id)).or_insert(0);
        let Contribution { started, drive, .. } = *self.contribution;
        let mut line = Line::new(FusedLaneId { started, drive, lane: lane.lane.id, piece: *piece, stretch: 0 });
        for sample in rest {
            let near = &lane.samples[sample];
            let place = correction.apply(&near.map, near.arc_m);
            let far = |last| nalgebra::distance(last, &place) >= 0.9 * self.params.line_knot_m;
            if line.points.last().is_none_or(far) {
                let witness = witness_at(self.witness(lane_index), lane, correction, sample, near.parameter);
                line.push(place, Knot { witnesses: vec![witness], ..Knot::default() });
            }
        }
        let length_m = line.points.len().saturating_sub(1) as f64 * self.params.line_knot_m;
        if length_m < self.params.shortest_lane_m {
            return false;
        }
        line.vote(&lane.lane.category_posterior, length_m);
        *piece += 1;
        lines.lines.push(line);
        true
    }
}

/// Whether a run ends (`onward`) or begins where its line does.
fn leaves_at_end(lines: &Lines, run: &Run, onward: bool) -> bool {
    const NEAR_END: f64 = 1.5;
    let last = (lines.lines[run.line].points.len() - 1) as f64;
    let at = if onward { run.parameters[run.parameters.len() - 1] } else { run.parameters[0] };
    if run.is_forward() == onward { at > last - NEAR_END } else { at < NEAR_END }
}
