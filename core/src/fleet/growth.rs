//! Growth: what one pass of a drive adds to the lines.
//!
//! Where its lanes lie on lines, it is a witness at their knots. What of a lane lies on no line extends the line that it
//! leaves at its end, and begins a line elsewhere: at the start of a drive, and where roads fork. A lane that leaves one line
//! at its end and comes onto another at its start joins the two.

use std::{
    collections::{BTreeMap, BTreeSet},
    ops::RangeInclusive,
};

use super::{
    contribution::Contribution,
    correction::{Correction, CorrectionWalk},
    joining::{Link, join, leaves_at_end},
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

/// A stretch of a lane that lies on no line.
struct Rest<'a> {
    /// Number of the lane in the pass.
    lane: usize,
    samples: RangeInclusive<usize>,
    /// The run whose line it extends, and whether it goes on from that run's end (else it leads to its start).
    extends: Option<(&'a Run, bool)>,
}

/// Every run, with the number of its lane.
fn runs_of(matched: &[Vec<Run>]) -> impl Iterator<Item = (usize, &Run)> {
    matched.iter().enumerate().flat_map(|(lane, runs)| runs.iter().map(move |run| (lane, run)))
}

/// How many lines each lane of each drive has begun.
pub(super) type Pieces = BTreeMap<(usize, LaneId), u32>;

impl Growing<'_> {
    /// Adds the pass to the lines.
    pub(super) fn add_to(&self, lines: &mut Lines, correction: &Correction, pieces: &mut Pieces) {
        let matched = match_lanes(&self.pass.lanes, correction, lines, self.params);
        let before = lines.lines.len();
        let mut touched = BTreeSet::new();
        let mut changed = false;
        for (lane, run) in runs_of(&matched) {
            self.testify(lines, correction, lane, run);
            touched.insert(run.line);
        }
        // Decided for all lanes before any line grows: parameters of runs count from where the lines began.
        let rests = (0..matched.len()).flat_map(|lane| self.rests(lines, lane, &matched[lane]));
        let links =
            matched.iter().flat_map(|runs| runs.windows(2).filter_map(|pair| Link::of(lines, &pair[0], &pair[1])));
        let links: Vec<Link> = links.collect();
        for rest in rests.collect::<Vec<Rest<'_>>>() {
            changed |= match rest.extends {
                Some((run, onward)) => self.extend(lines, correction, &rest, run, onward),
                None => self.begin(lines, correction, &rest, pieces),
            };
        }
        // A mean of many is moved little by one more: it is made anew now and then.
        if self.number < SETTLED_EACH || self.number.is_multiple_of(SETTLED_EACH) {
            for line in touched.into_iter().filter(|line| *line < before) {
                lines.lines[line].settle(self.params);
            }
        }
        changed |= join(lines, &links, self.params);
        if changed {
            lines.index();
        }
    }

    /// Witnesses of a run at the knots of its line.
    fn testify(&self, lines: &mut Lines, correction: &Correction, lane_index: usize, run: &Run) {
        let lane = &self.pass.lanes[lane_index];
        let line = &mut lines.lines[run.line];
        let mut walk = CorrectionWalk::new(correction);
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
                    witness_at(self.witness(lane_index), lane, &mut walk, first_sample + step, parameter),
                );
                knot += 1;
            }
        }
    }

    fn witness(&self, lane: usize) -> (usize, usize, usize) {
        (self.drive, self.number, lane)
    }

    /// What of a lane lies on no line.
    fn rests<'r>(&self, lines: &Lines, lane: usize, runs: &'r [Run]) -> Vec<Rest<'r>> {
        let samples = self.pass.lanes[lane].samples.len();
        let mut rests = Vec::new();
        let mut next = 0;
        let mut before: Option<&Run> = None;
        for run in runs.iter().map(Some).chain([None]) {
            let end = run.map_or(samples, |run| *run.samples.start());
            if end > next {
                let left = before.filter(|run| leaves_at_end(lines, run, true)).map(|run| (run, true));
                let extends =
                    left.or_else(|| run.filter(|run| leaves_at_end(lines, run, false)).map(|run| (run, false)));
                rests.push(Rest { lane, samples: next..=end - 1, extends });
            }
            if let Some(run) = run {
                next = *run.samples.end() + 1;
            }
            before = run;
        }
        rests
    }

    fn extend(&self, lines: &mut Lines, correction: &Correction, rest: &Rest<'_>, run: &Run, onward: bool) -> bool {
        let lane = &self.pass.lanes[rest.lane];
        let at_tail = run.is_forward() == onward;
        let line = &mut lines.lines[run.line];
        let before = line.points.len();
        let mut walk = CorrectionWalk::new(correction);
        // It grows behind its last knot.
        if !at_tail {
            line.reverse();
        }
        let rest_samples = rest.samples.clone();
        let order: Vec<usize> = if onward { rest_samples.collect() } else { rest_samples.rev().collect() };
        for sample in order {
            let near = &lane.samples[sample];
            let place = walk.place(&near.map, near.arc_m);
            let last = line.points.len() - 1;
            let direction = line.tangent(last);
            let offset = place - line.points[last];
            if offset.norm() < 0.9 * self.params.line_knot_m || offset.dot(&direction) <= 0.0 {
                continue;
            }
            let witness = witness_at(self.witness(rest.lane), lane, &mut walk, sample, near.parameter);
            line.push(place, Knot { witnesses: vec![witness], ..Knot::default() });
        }
        if !at_tail {
            line.reverse();
        }
        let grown = line.points.len() - before;
        line.vote(&lane.lane.category_posterior, grown as f64 * self.params.line_knot_m);
        grown > 0
    }

    fn begin(&self, lines: &mut Lines, correction: &Correction, rest: &Rest<'_>, pieces: &mut Pieces) -> bool {
        let lane: &PreparedLane<'_> = &self.pass.lanes[rest.lane];
        let piece = pieces.entry((self.drive, lane.lane.id)).or_insert(0);
        let Contribution { started, drive, .. } = *self.contribution;
        let mut line = Line::new(FusedLaneId { started, drive, lane: lane.lane.id, piece: *piece, stretch: 0 });
        let mut walk = CorrectionWalk::new(correction);
        for sample in rest.samples.clone() {
            let near = &lane.samples[sample];
            let place = walk.place(&near.map, near.arc_m);
            let far = |last| nalgebra::distance(last, &place) >= 0.9 * self.params.line_knot_m;
            if line.points.last().is_none_or(far) {
                let witness = witness_at(self.witness(rest.lane), lane, &mut walk, sample, near.parameter);
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
