//! Matching: which stretch of a drive's lane lies on which line of the map.
//!
//! Every sample of a lane is laid on a line near it or on none, such that the sum over the lane is least (Viterbi): the
//! distance across in standard deviations, how badly the categories agree, and a price for every change of line. Lanes
//! of one drive do not share a stretch of a line: where two want it, the one that fits it better has it.
//! A lane may run against the line's direction: oncoming traffic sees the same paint.

use std::{collections::BTreeMap, ops::RangeInclusive};

use nalgebra::Point3;

use super::{
    correction::Correction,
    line::Lines,
    params::FleetParams,
    prepared::{PreparedLane, normal_of},
};
use crate::{category::Category, spline::foot_point::foot_point_refined};

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

/// Runs of one lane on the lines, in the order of the lane. `is_taken` tells which stretches other lanes of the drive have.
pub(super) fn match_lane(
    lane: &PreparedLane<'_>,
    correction: &Correction,
    lines: &Lines,
    is_taken: &dyn Fn(usize, f64) -> bool,
    params: &FleetParams,
) -> Vec<Run> {
    let mut agreement = BTreeMap::new();
    let mut cost_of_category = |line: usize| {
        let cost = || category_cost(&lane.lane.category_posterior, lines.lines[line].posterior());
        *agreement.entry(line).or_insert_with(cost)
    };
    let candidates = lane.samples.iter().map(|sample| {
        let place = correction.apply(&sample.map, sample.arc_m);
        let direction = correction.turn(&sample.tangent, sample.arc_m).xy();
        let variance = sample.lateral_variance_m2 + ALIGNMENT_SIGMA_M.powi(2);
        let near = lines.near(&place, params.gate_m + params.line_knot_m);
        let candidates = near.into_iter().filter_map(|(line, knot)| {
            let (parameter, across_m, height_m) = offset_from(lines, line, knot, &place)?;
            let tangent = lines.lines[line].tangent(knot).xy();
            let parallel = direction.dot(&tangent).abs() >= LEAST_COSINE * direction.norm() * tangent.norm();
            let within = across_m.abs() <= params.gate_m && height_m.abs() <= params.gate_height_m;
            (parallel && within && !is_taken(line, parameter)).then(|| Candidate {
                line,
                parameter,
                cost: 0.5 * across_m * across_m / variance + cost_of_category(line),
            })
        });
        candidates.collect()
    });
    runs(&candidates.collect::<Vec<Vec<Candidate>>>())
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

/// Foot point of a place on a line: parameter, distance across (to the left), height above.
pub(super) fn offset_from(lines: &Lines, line: usize, knot: usize, place: &Point3<f64>) -> Option<(f64, f64, f64)> {
    let line = &lines.lines[line];
    let curve = line.curve()?;
    let foot = foot_point_refined(&curve, place, knot as f64)?;
    let offset = place - curve.point(foot.parameter);
    let normal = normal_of(&curve.derivative(foot.parameter));
    Some((foot.parameter, offset.xy().dot(&normal), offset.z))
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

/// The cheapest way through the candidates, as runs.
fn runs(candidates: &[Vec<Candidate>]) -> Vec<Run> {
    // States of a sample: its candidates, then none.
    let mut costs: Vec<Vec<f64>> = Vec::with_capacity(candidates.len());
    let mut from: Vec<Vec<usize>> = Vec::with_capacity(candidates.len());
    for (index, now) in candidates.iter().enumerate() {
        let own = |state: usize| now.get(state).map_or(NONE, |candidate| candidate.cost);
        if index == 0 {
            costs.push((0..=now.len()).map(own).collect());
            from.push(vec![0; now.len() + 1]);
            continue;
        }
        let (before, before_costs) = (&candidates[index - 1], &costs[index - 1]);
        let best = (0..=now.len()).map(|state| {
            let reach = (0..=before.len())
                .map(|previous| (before_costs[previous] + change(before.get(previous), now.get(state)), previous));
            let (cost, previous) = reach.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0));
            (cost + own(state), previous)
        });
        let (cost, previous): (Vec<f64>, Vec<usize>) = best.unzip();
        costs.push(cost);
        from.push(previous);
    }
    let Some(last) = costs.last() else { return Vec::new() };
    let mut state = (0..last.len()).min_by(|a, b| last[*a].total_cmp(&last[*b])).unwrap_or(0);
    let mut path = vec![0; candidates.len()];
    for index in (0..candidates.len()).rev() {
        path[index] = state;
        state = from[index][state];
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

fn collect_runs(candidates: &[Vec<Candidate>], path: &[usize]) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    let mut open: Option<Run> = None;
    for (index, (now, state)) in candidates.iter().zip(path).enumerate() {
        let chosen = now.get(*state);
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
