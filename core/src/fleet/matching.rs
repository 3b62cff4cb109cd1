//! Matching: which stretch of a drive's lane lies on which line of the map.
//!
//! Every sample of a lane is laid on a line near it or on none, such that the sum over the lane is least (Viterbi): the
//! distance across in standard deviations, how badly the categories agree, and a price for every change of line. Lanes
//! of one drive do not share a stretch of a line: where two want it, the one that fits it better has it.
//! A lane may run against the line's direction: oncoming traffic sees the same paint.

use std::ops::RangeInclusive;

use nalgebra::{Point3, Vector2, Vector3};

use super::{
    correction::{Correction, CorrectionWalk},
    line::{Line, Lines},
    params::FleetParams,
    prepared::{PreparedLane, count_of, normal_of},
};
use crate::{
    category::Category,
    spline::foot_point::{FootOffset, foot_offset},
};

/// A stretch of a lane that lies on one line.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Run {
    pub(super) line: usize,
    /// First and last sample of the lane.
    pub(super) samples: RangeInclusive<usize>,
    /// Parameter on the line of each of these samples.
    pub(super) parameters: Vec<f64>,
    /// Mean cost of a sample.
    pub(super) cost: f64,
}

/// A line near a sample.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    line: usize,
    parameter: f64,
    cost: f64,
}

/// Price of a change from one line to another.
const CHANGE: f64 = 6.0;
/// Price of leaving a line for none, or the other way.
const LEAVE: f64 = 3.0;
/// Cost of a sample on no line: that of a distance of 3 standard deviations.
const NONE: f64 = 4.5;
/// What the places of drive and line are off by besides the drive's own variance, metres.
const ALIGNMENT_SIGMA_M: f64 = 0.2;
/// Least cosine of the angle between a lane and its line.
const LEAST_COSINE: f64 = 0.88;
/// Shortest run, samples.
const SHORTEST_RUN: usize = 3;
/// Knots by which a lane may jump along a line between two samples.
const LONGEST_JUMP: f64 = 3.0;
/// Way after which lines are looked for again, and followed in between, metres: no line is so short that it lies between.
const LOOKED_FOR_EACH_M: f64 = 12.0;

/// Candidates of every sample of a lane, one sample after the other.
#[derive(Debug, Default)]
struct Candidates {
    all: Vec<Candidate>,
    /// Where those of each sample end.
    ends: Vec<usize>,
}

/// Lines near one sample, each with its nearest knot.
type Near = Vec<(usize, usize)>;

/// Runs of one lane on the lines, in the order of the lane. `is_taken` tells which stretches other lanes of the drive have.
pub(super) fn match_lane(
    lane: &PreparedLane<'_>,
    correction: &Correction,
    lines: &Lines,
    is_taken: &dyn Fn(usize, f64) -> bool,
    params: &FleetParams,
) -> Vec<Run> {
    let mut walk = CorrectionWalk::new(correction);
    let shared: Vec<(Point3<f64>, Vector3<f64>)> =
        lane.samples.iter().map(|sample| walk.apply(&sample.map, &sample.tangent, sample.arc_m)).collect();
    let near = |sample: usize| lines.near(&shared[sample].0, params.gate_m + params.line_knot_m);
    let mut agreement: Vec<(usize, f64)> = Vec::new();
    let mut candidates = Candidates::default();
    let Some(last) = shared.len().checked_sub(1) else { return Vec::new() };
    let step_m = nalgebra::distance(&shared[0].0, &shared[last.min(1)].0).max(params.sample_m);
    let stretch = count_of(LOOKED_FOR_EACH_M / step_m).max(1);
    let mut at_start: Near = near(0);
    for start in (0..=last).step_by(stretch) {
        let end = (start + stretch).min(last);
        let at_end = if end > start { near(end) } else { Near::new() };
        let lines_near = lines_of(&at_start, &at_end);
        let of_stretch = start..(start + stretch).min(last + 1);
        let samples = lane.samples[of_stretch.clone()].iter().zip(&shared[of_stretch]);
        for (sample, (own, (place, direction))) in samples.enumerate() {
            let variance = own.lateral_variance_m2 + ALIGNMENT_SIGMA_M.powi(2);
            for beside in &lines_near {
                let guess = beside.guess(sample, end - start);
                if is_surely_beyond(&lines.lines[beside.line], guess, place, params.gate_m) {
                    continue;
                }
                let Some(foot) = foot_on(lines, beside.line, guess, place) else { continue };
                let heading = direction.xy();
                let parallel = heading.dot(&foot.tangent).abs() >= LEAST_COSINE * heading.norm() * foot.tangent.norm();
                let within = foot.across_m.abs() <= params.gate_m && foot.height_m.abs() <= params.gate_height_m;
                if !parallel || !within || is_taken(beside.line, foot.parameter) {
                    continue;
                }
                let known = agreement.iter().find(|(line, _)| *line == beside.line).map(|(_, cost)| *cost);
                let of_category = known.unwrap_or_else(|| {
                    let posterior = lines.lines[beside.line].posterior();
                    let cost = category_cost(&lane.lane.category_posterior, posterior);
                    agreement.push((beside.line, cost));
                    cost
                });
                candidates.all.push(Candidate {
                    line: beside.line,
                    parameter: foot.parameter,
                    cost: 0.5 * foot.across_m * foot.across_m / variance + of_category,
                });
            }
            candidates.ends.push(candidates.all.len());
        }
        at_start = at_end;
    }
    runs(&candidates)
}

/// A line near a stretch of a lane, with its knots nearest to the ends of the stretch, where it is near them.
struct NearStretch {
    line: usize,
    at_start: Option<usize>,
    at_end: Option<usize>,
}

impl NearStretch {
    /// About where on the line a sample of the stretch lies.
    fn guess(&self, sample: usize, samples: usize) -> f64 {
        let share = if samples == 0 { 0.0 } else { sample as f64 / samples as f64 };
        match (self.at_start, self.at_end) {
            // A line that comes back to the lane is two in between.
            (Some(start), Some(end)) if start.abs_diff(end) > 16 => {
                if share < 0.5 {
                    start as f64
                } else {
                    end as f64
                }
            }
            (Some(start), Some(end)) => start as f64 + (end as f64 - start as f64) * share,
            (Some(knot), None) | (None, Some(knot)) => knot as f64,
            (None, None) => 0.0,
        }
    }
}

/// The lines near either end of a stretch, in their order.
fn lines_of(at_start: &[(usize, usize)], at_end: &[(usize, usize)]) -> Vec<NearStretch> {
    let mut lines: Vec<NearStretch> =
        at_start.iter().map(|(line, knot)| NearStretch { line: *line, at_start: Some(*knot), at_end: None }).collect();
    for (line, knot) in at_end {
        match lines.iter_mut().find(|near| near.line == *line) {
            Some(near) => near.at_end = Some(*knot),
            None => lines.push(NearStretch { line: *line, at_start: None, at_end: Some(*knot) }),
        }
    }
    lines.sort_unstable_by_key(|near| near.line);
    lines
}

/// Runs of all lanes of a pass. Where two lanes want one stretch of a line, the one that fits better has it.
pub(super) fn match_lanes(
    lanes: &[PreparedLane<'_>],
    correction: &Correction,
    lines: &Lines,
    params: &FleetParams,
) -> Vec<Vec<Run>> {
    let mut matched: Vec<Vec<Run>> =
        lanes.iter().map(|lane| match_lane(lane, correction, lines, &|_, _| false, params)).collect();
    let mut order: Vec<usize> = (0..lanes.len()).collect();
    order.sort_by(|a, b| misfit(&matched[*a]).total_cmp(&misfit(&matched[*b])).then(a.cmp(b)));
    let mut taken: Vec<Run> = Vec::new();
    for lane in order {
        if matched[lane].iter().any(|run| taken.iter().any(|other| overlap(run, other))) {
            let is_taken =
                |line: usize, parameter: f64| taken.iter().any(|run| run.line == line && covers(run, parameter));
            matched[lane] = match_lane(&lanes[lane], correction, lines, &is_taken, params);
        }
        taken.extend(matched[lane].iter().cloned());
    }
    matched
}

/// How badly a lane fits its lines: the mean cost of a sample, less for a long run.
fn misfit(runs: &[Run]) -> f64 {
    let samples: usize = runs.iter().map(|run| run.parameters.len()).sum();
    let cost: f64 = runs.iter().map(|run| run.cost * run.parameters.len() as f64).sum();
    cost / samples.max(1) as f64 - 0.14 * (samples as f64).sqrt()
}

fn covers(run: &Run, parameter: f64) -> bool {
    let (low, high) = run.ends();
    parameter > low - 0.5 && parameter < high + 0.5
}

fn overlap(a: &Run, b: &Run) -> bool {
    let ((a_low, a_high), (b_low, b_high)) = (a.ends(), b.ends());
    a.line == b.line && a_low < b_high + 0.5 && b_low < a_high + 0.5
}

impl Run {
    /// Lowest and highest parameter on the line.
    pub(super) fn ends(&self) -> (f64, f64) {
        let (first, last) = (self.parameters[0], self.parameters[self.parameters.len() - 1]);
        (first.min(last), first.max(last))
    }

    /// Whether the lane runs in the line's direction.
    pub(super) fn is_forward(&self) -> bool {
        self.parameters[self.parameters.len() - 1] >= self.parameters[0]
    }
}

/// Where a place lies beside a line.
#[derive(Clone, Copy, Debug)]
pub(super) struct Foot {
    pub(super) parameter: f64,
    /// To the left of the line, metres.
    pub(super) across_m: f64,
    /// Above the line, metres.
    pub(super) height_m: f64,
    /// Along the line, horizontally.
    pub(super) tangent: Vector2<f64>,
}

/// Whether a place lies farther across from a line than `gate_m`, told without a foot point: beside the knot about which it is
/// guessed to lie, with room for a bend of 10 m of radius.
fn is_surely_beyond(line: &Line, guess: f64, place: &Point3<f64>, gate_m: f64) -> bool {
    const ALONG_M: f64 = 4.5;
    const BEND_M: f64 = 1.1;
    let last = line.points.len() - 1;
    let knot = count_of(guess + 0.5).min(last);
    let chord = (line.points[(knot + 1).min(last)] - line.points[knot.saturating_sub(1)]).xy();
    let offset = (place - line.points[knot]).xy();
    let (chord_m2, across_m) = (chord.norm_squared(), gate_m + BEND_M);
    let (along, across) = (offset.dot(&chord), chord.perp(&offset));
    along * along <= ALONG_M * ALONG_M * chord_m2 && across * across > across_m * across_m * chord_m2
}

/// Foot point of a place on a line, looked for from a parameter on.
pub(super) fn foot_on(lines: &Lines, line: usize, start: f64, place: &Point3<f64>) -> Option<Foot> {
    let curve = lines.lines[line].curve()?;
    let FootOffset { parameter, offset, derivative } = foot_offset(&curve, place, start)?;
    let across_m = offset.xy().dot(&normal_of(&derivative));
    Some(Foot { parameter, across_m, height_m: offset.z, tangent: derivative.xy() })
}

/// Minus the logarithm of the probability that two witnesses of one line name these categories, at most 2.
fn category_cost(a: &[f64], b: &[f64]) -> f64 {
    const FLOOR: f64 = 0.135;
    if a.len() != Category::ALL.len() || b.len() != Category::ALL.len() {
        return 0.0;
    }
    let same: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
    -(FLOOR + (1.0 - FLOOR) * same.min(1.0)).ln()
}

impl Candidates {
    fn of(&self, sample: usize) -> &[Candidate] {
        let start = sample.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.all[start..self.ends[sample]]
    }
}

/// The cheapest way through the candidates, as runs.
fn runs(candidates: &Candidates) -> Vec<Run> {
    let samples = candidates.ends.len();
    // States of a sample: its candidates, then none. Those of all samples stand one after the other.
    let first_of = |sample: usize| sample + sample.checked_sub(1).map_or(0, |before| candidates.ends[before]);
    let states = candidates.all.len() + samples;
    let (mut costs, mut from) = (Vec::with_capacity(states), Vec::with_capacity(states));
    for sample in 0..samples {
        let now = candidates.of(sample);
        let own = |state: usize| now.get(state).map_or(NONE, |candidate| candidate.cost);
        let Some(earlier) = sample.checked_sub(1) else {
            costs.extend((0..=now.len()).map(own));
            from.resize(costs.len(), 0);
            continue;
        };
        let (before, first) = (candidates.of(earlier), first_of(earlier));
        for state in 0..=now.len() {
            let reach = (0..=before.len())
                .map(|previous| (costs[first + previous] + change(before.get(previous), now.get(state)), previous));
            let (cost, previous) = reach.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0));
            costs.push(cost + own(state));
            from.push(previous);
        }
    }
    let Some(last) = samples.checked_sub(1) else { return Vec::new() };
    let at_end = &costs[first_of(last)..];
    let mut state = (0..at_end.len()).min_by(|a, b| at_end[*a].total_cmp(&at_end[*b])).unwrap_or(0);
    let mut path = vec![0; samples];
    for sample in (0..samples).rev() {
        path[sample] = state;
        state = from[first_of(sample) + state];
    }
    collect_runs(candidates, &path)
}

fn change(before: Option<&Candidate>, now: Option<&Candidate>) -> f64 {
    match (before, now) {
        (None, None) => 0.0,
        (Some(before), Some(now)) if before.line == now.line => {
            if (before.parameter - now.parameter).abs() > LONGEST_JUMP { CHANGE } else { 0.0 }
        }
        (Some(_), Some(_)) => CHANGE,
        _ => LEAVE,
    }
}

fn collect_runs(candidates: &Candidates, path: &[usize]) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    let mut open: Option<Run> = None;
    for (index, state) in path.iter().enumerate() {
        let chosen = candidates.of(index).get(*state);
        let goes_on = match (&open, chosen) {
            (Some(run), Some(chosen)) => {
                let last = run.parameters[run.parameters.len() - 1];
                run.line == chosen.line && (chosen.parameter - last).abs() <= LONGEST_JUMP
            }
            _ => false,
        };
        if !goes_on {
            runs.extend(open.take());
        }
        if let Some(chosen) = chosen {
            let run = open.get_or_insert_with(|| Run {
                line: chosen.line,
                samples: index..=index,
                parameters: Vec::new(),
                cost: 0.0,
            });
            run.samples = *run.samples.start()..=index;
            run.parameters.push(chosen.parameter);
            run.cost += chosen.cost;
        }
    }
    runs.extend(open);
    runs.retain(|run| run.parameters.len() >= SHORTEST_RUN);
    for run in &mut runs {
        run.cost /= run.parameters.len() as f64;
    }
    runs
}
