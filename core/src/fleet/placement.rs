//! Placement: where a drive lies on the map that others made, to within the capture of matching.
//!
//! A GNSS bias is as large as half a lane, so the nearest line is often the wrong one. Shifts `d = (east, north)` are therefore
//! searched: the way is cut into windows, and every sample of the drive's lanes votes for each shift by the lines near it:
//!
//! `log L_w(d) = share * sum_samples log max(e, max_lines a exp(-(n . d - x)^2 / 2 s^2))`,
//!
//! where `x` is how far to the left the sample would have to move to lie on the line, `n` that direction, and `a` how well the
//! categories agree. Where drives went that the sample meets, `L` is lower: `ways` are not shared by those that
//! meet. The most probable sequence of shifts over the windows (Viterbi) allows for the drift of odometry
//! between them and for the prior of GNSS. It is believed only if it explains most of what is there, and clearly better
//! than the same sequence shifted across the road by about a lane.
//!
//! Not guaranteed: a road of equal lines without an edge in view looks the same a lane further; there the prior decides, and
//! where it does not, the drive is kept apart. On a straight road shifts along it are left to the prior.

mod meeting;
mod search;

use nalgebra::Vector2;

use meeting::{Meeting, meetings};
pub(super) use search::Shifts;

use super::{
    alignment::{Sighting, Target},
    correction::Correction,
    line::Lines,
    matching::foot_on,
    params::FleetParams,
    prepared::{LaneSample, PreparedLane, PreparedPass, count_of, normal_of},
    ways::Ways,
};

/// What is known of where a pass lies on the map before its lanes are looked at.
#[derive(Clone, Copy, Debug)]
pub(super) struct Prior {
    /// East and north, metres.
    pub(super) shift_m: Vector2<f64>,
    /// Standard deviation of each, metres.
    pub(super) sigma_m: f64,
}

impl Prior {
    /// How far shifts are searched, metres.
    pub(super) fn reach_m(&self, params: &FleetParams) -> f64 {
        (params.search_sigmas * self.sigma_m + self.shift_m.norm()).max(2.0)
    }
}

/// Lines and ways of others beside a pass.
pub(super) struct Surroundings<'a> {
    votes: Vec<Vote<'a>>,
    meetings: Vec<Meeting>,
}

/// Way of a window, metres.
const WINDOW_M: f64 = 60.0;
/// Scatter of a sample about its line during the search, metres.
const SCATTER_M: f64 = 0.45;
/// Likelihood of a sample that lies beside a line where no other can be.
const OUTLIER: f64 = 0.05;
/// The same where no line is within [`BESIDE_M`]: the map may not reach so far yet.
const OFF_THE_MAP: f64 = 0.15;
/// Distance from a line within which no other line is expected, metres.
const BESIDE_M: f64 = 2.2;
/// Distance at which a sample still lies on a line, metres.
const ON_LINE_M: f64 = 0.8;
/// Samples near lines below which there is nothing to be placed on.
pub(super) const LEAST_SAMPLES: usize = 8;
/// Least logarithm of how much more probable the place is than any other.
const LEAST_MARGIN: f64 = 2.0;
/// Least share of samples that must lie on a line.
const LEAST_EXPLAINED: f64 = 0.55;
/// Every how many samples of a lane one votes.
const STRIDE: usize = 4;

/// One sample with the lines beside it.
#[derive(Clone)]
struct Vote<'a> {
    sample: &'a LaneSample,
    window: usize,
    /// To the left of the lane, shared frame.
    normal: Vector2<f64>,
    lines: Vec<Beside>,
}

/// A line beside a sample.
#[derive(Clone, Copy)]
struct Beside {
    line: usize,
    parameter: f64,
    /// Move to the left that would lay the sample on the line, metres.
    move_m: f64,
    /// How far above the line the sample lies, metres.
    above_m: f64,
    agreement: f64,
    log_agreement: f64,
}

impl<'a> Surroundings<'a> {
    /// What lies beside a pass within a distance.
    pub(super) fn new(
        pass: &'a PreparedPass<'_>,
        correction: &Correction,
        lines: &Lines,
        ways: &Ways,
        reach_m: f64,
    ) -> Self {
        let votes = votes(&pass.lanes, correction, lines, reach_m);
        let meetings = if votes.is_empty() { Vec::new() } else { meetings(pass, correction, ways, reach_m) };
        Self { votes, meetings }
    }

    /// Number of samples beside a line.
    pub(super) fn samples(&self) -> usize {
        self.votes.len()
    }

    /// Every line beside a sample, once for each.
    pub(super) fn lines(&self) -> impl Iterator<Item = usize> {
        self.votes.iter().flat_map(|vote| vote.lines.iter().map(|beside| beside.line))
    }

    /// The same with some of the lines.
    pub(super) fn with_lines(&self, is_one: impl Fn(usize) -> bool) -> Self {
        let votes = self.votes.iter().filter_map(|vote| {
            let lines: Vec<Beside> = vote.lines.iter().filter(|beside| is_one(beside.line)).copied().collect();
            (!lines.is_empty()).then(|| Vote { lines, ..vote.clone() })
        });
        Self { votes: votes.collect(), meetings: self.meetings.clone() }
    }

    /// The shifts that lay the pass on the lines; `None` where it fits nowhere, or at more places than one.
    pub(super) fn search(&self, prior: &Prior, params: &FleetParams) -> Option<Shifts> {
        let found = search::most_probable(&self.votes, &self.meetings, prior, params);
        let is_believed = explained(&self.votes, |vote| found.shifts.move_of(vote)) >= LEAST_EXPLAINED
            && found.margin >= LEAST_MARGIN;
        is_believed.then_some(found.shifts)
    }

    /// The samples that lie on a line after the shift, with where they should lie.
    pub(super) fn sightings(&self, shifts: &Shifts, drive: usize, lines: &Lines) -> Vec<Sighting> {
        sightings(&self.votes, |vote| shifts.move_of(vote), drive, lines)
    }

    /// How far the lines would have to move, east and north, for the pass to lie on them after other shifts, metres.
    pub(super) fn move_of_lines(&self, onto_them: &Shifts, instead: &Shifts) -> Vector2<f64> {
        let moves = self.votes.iter().map(|vote| instead.at(vote.window) - onto_them.at(vote.window));
        moves.sum::<Vector2<f64>>() / self.votes.len().max(1) as f64
    }

    /// How far above the lines the pass lies after the shifts, metres: the median.
    pub(super) fn above_m(&self, shifts: &Shifts) -> f64 {
        let nearest = self.votes.iter().filter_map(|vote| {
            let move_m = shifts.move_of(vote);
            vote.lines.iter().min_by(|a, b| (a.move_m - move_m).abs().total_cmp(&(b.move_m - move_m).abs()))
        });
        let mut above: Vec<f64> = nearest.map(|beside| beside.above_m).collect();
        above.sort_by(f64::total_cmp);
        above.get(above.len() / 2).copied().unwrap_or(0.0)
    }
}

fn votes<'a>(lanes: &'a [PreparedLane<'_>], correction: &Correction, lines: &Lines, reach_m: f64) -> Vec<Vote<'a>> {
    let mut votes = Vec::new();
    for lane in lanes {
        for sample in lane.samples.iter().step_by(STRIDE) {
            let place = correction.apply(&sample.map, sample.arc_m);
            let normal = normal_of(&correction.turn(&sample.tangent, sample.arc_m));
            let beside = lines.near(&place, reach_m + 2.0).into_iter().filter_map(|(line, knot)| {
                let foot = foot_on(lines, line, knot as f64, &place)?;
                let cosine = normal_of(&lines.lines[line].tangent(knot)).dot(&normal);
                (cosine.abs() > 0.9 && foot.height_m.abs() < 8.0).then(|| {
                    let agreement = agreement(&lane.lane.category_posterior, lines.lines[line].posterior());
                    Beside {
                        line,
                        parameter: foot.parameter,
                        move_m: -foot.across_m * cosine.signum(),
                        above_m: foot.height_m,
                        agreement,
                        log_agreement: agreement.ln(),
                    }
                })
            });
            let beside: Vec<Beside> = beside.collect();
            if !beside.is_empty() {
                votes.push(Vote { sample, window: count_of(sample.arc_m / WINDOW_M), normal, lines: beside });
            }
        }
    }
    votes
}

fn agreement(a: &[f64], b: &[f64]) -> f64 {
    const FLOOR: f64 = 0.3;
    FLOOR + (1.0 - FLOOR) * a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>().min(1.0)
}

/// Distance from a sample, moved, to the nearest line, metres.
fn misfit_m(vote: &Vote<'_>, move_m: f64) -> f64 {
    vote.lines.iter().map(|beside| (move_m - beside.move_m).abs()).fold(f64::INFINITY, f64::min)
}

/// Share of the samples that lie on a line, of those that lie on one or where none can be: beside one, within a lane.
fn explained<'a>(votes: &[Vote<'a>], move_of: impl Fn(&Vote<'a>) -> f64) -> f64 {
    let misfits = votes.iter().map(|vote| misfit_m(vote, move_of(vote)));
    let misfits: Vec<f64> = misfits.filter(|misfit| *misfit <= BESIDE_M).collect();
    let on_line = misfits.iter().filter(|misfit| **misfit <= ON_LINE_M).count();
    on_line as f64 / misfits.len().max(1) as f64
}

/// The samples that lie on a line after the shift, with where they should lie.
fn sightings<'a>(votes: &[Vote<'a>], move_of: impl Fn(&Vote<'a>) -> f64, drive: usize, lines: &Lines) -> Vec<Sighting> {
    const CAPTURE_M: f64 = 1.0;
    let on_line = votes.iter().filter_map(|vote| {
        let move_m = move_of(vote);
        let misfit = |beside: &Beside| (beside.move_m - move_m).abs() - 0.5 * beside.agreement;
        let nearest = vote.lines.iter().min_by(|a, b| misfit(a).total_cmp(&misfit(b)))?;
        if (nearest.move_m - move_m).abs() > CAPTURE_M {
            return None;
        }
        let curve = lines.lines[nearest.line].curve()?;
        let (place, normal) = (curve.point(nearest.parameter), normal_of(&curve.derivative(nearest.parameter)));
        Some(Sighting {
            drive,
            arc_m: vote.sample.arc_m,
            map: vote.sample.map,
            normal,
            across: Target::Fixed(place.coords.xy().dot(&normal)),
            height: Target::Fixed(place.z),
            lateral_variance_m2: vote.sample.lateral_variance_m2 + SCATTER_M * SCATTER_M,
            height_variance_m2: vote.sample.height_variance_m2 + SCATTER_M * SCATTER_M,
        })
    });
    on_line.collect()
}
