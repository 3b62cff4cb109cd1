//! Placement: where a drive lies on the map that others made, to within the capture of matching.
//!
//! A GNSS bias is as large as half a lane, so the nearest line is often the wrong one. Shifts `d = (east, north)` are therefore
//! searched: the way is cut into windows, and every sample of the drive's lanes votes for each shift by the lines near it:
//!
//! `log L_w(d) = share * sum_samples log max(e, max_lines a exp(-(n . d - x)^2 / 2 s^2))`,
//!
//! where `x` is how far to the left the sample would have to move to lie on the line, `n` that direction, and `a` how well the
//! categories agree. The most probable sequence of shifts over the windows (Viterbi) allows for the drift of odometry
//! between them and for the prior of GNSS. It is believed only if it explains most of what is there, and clearly better
//! than the same sequence shifted across the road by about a lane.
//!
//! Not guaranteed: a road of equal lines without an edge in view looks the same a lane further; there the prior decides, and
//! where it does not, the drive is kept apart. On a straight road shifts along it are left to the prior.

use std::f64::consts::PI;

use nalgebra::Vector2;

use super::{
    alignment::{Sighting, Target},
    correction::Correction,
    line::Lines,
    matching::offset_from,
    params::FleetParams,
    prepared::{LaneSample, PreparedLane, count_of, normal_of},
};

/// What became of the search.
#[derive(Clone, Debug)]
pub(super) enum Placement {
    /// There is no line where the drive went: GNSS or odometry alone places it.
    Alone,
    /// It lies here, by these sightings of lines.
    Found(Vec<Sighting>),
    /// It fits nowhere, or at more places than one.
    Refused,
}

/// Way of a window, metres.
const WINDOW_M: f64 = 60.0;
/// Step of the search, metres.
const STEP_M: f64 = 0.5;
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
const LEAST_SAMPLES: usize = 8;
/// Shift across the road that counts as another place, metres.
const ANOTHER_PLACE_M: f64 = 1.4;
/// Least logarithm of how much more probable the place is than any other.
const LEAST_MARGIN: f64 = 2.0;
/// Least share of samples that must lie on a line.
const LEAST_EXPLAINED: f64 = 0.55;
/// Every how many samples of a lane one votes.
const STRIDE: usize = 4;
/// Largest search, steps to each side.
const MOST_STEPS: usize = 40;

/// One sample with the lines beside it.
struct Vote<'a> {
    sample: &'a LaneSample,
    window: usize,
    /// To the left of the lane, shared frame.
    normal: Vector2<f64>,
    lines: Vec<Beside>,
}

/// A line beside a sample.
struct Beside {
    line: usize,
    parameter: f64,
    /// Move to the left that would lay the sample on the line, metres.
    move_m: f64,
    agreement: f64,
}

/// The shifts that are searched: a square about none.
#[derive(Clone, Copy)]
struct Square {
    /// Steps to each side.
    side: usize,
}

/// Log-likelihoods of one window, by shift.
type Likelihood = Vec<f64>;

/// Lays lanes of a drive, whose number in the sightings is `drive`, on the lines.
pub(super) fn place(
    lanes: &[PreparedLane<'_>],
    drive: usize,
    correction: &Correction,
    lines: &Lines,
    prior_sigma_m: f64,
    params: &FleetParams,
) -> Placement {
    let reach_m = (params.search_sigmas * prior_sigma_m).max(2.0);
    let square = Square { side: count_of((reach_m / STEP_M).ceil()).min(MOST_STEPS) };
    let votes = votes(lanes, correction, lines, reach_m);
    if votes.len() < LEAST_SAMPLES {
        return Placement::Alone;
    }
    let windows = likelihoods(&votes, square, prior_sigma_m, params);
    let path = most_probable(&windows, square, params);
    let shift_of = |vote: &Vote<'_>| vote.normal.dot(&square.shift(path[vote.window]));
    if explained(&votes, shift_of) < LEAST_EXPLAINED || margin(&windows, &path, &votes, square) < LEAST_MARGIN {
        return Placement::Refused;
    }
    Placement::Found(sightings(&votes, shift_of, drive, lines))
}

impl Square {
    fn width(self) -> usize {
        2 * self.side + 1
    }

    fn count(self) -> usize {
        self.width() * self.width()
    }

    /// East and north of a state, metres.
    fn shift(self, state: usize) -> Vector2<f64> {
        let at = |step: usize| (step as f64 - self.side as f64) * STEP_M;
        Vector2::new(at(state % self.width()), at(state / self.width()))
    }

    /// The state so many steps to the east and north.
    fn moved(self, state: usize, east: isize, north: isize) -> Option<usize> {
        let x = (state % self.width()).checked_add_signed(east).filter(|x| *x < self.width())?;
        let y = (state / self.width()).checked_add_signed(north).filter(|y| *y < self.width())?;
        Some(y * self.width() + x)
    }
}

fn votes<'a>(lanes: &'a [PreparedLane<'_>], correction: &Correction, lines: &Lines, reach_m: f64) -> Vec<Vote<'a>> {
    let mut votes = Vec::new();
    for lane in lanes {
        for sample in lane.samples.iter().step_by(STRIDE) {
            let place = correction.apply(&sample.map, sample.arc_m);
            let normal = normal_of(&correction.turn(&sample.tangent, sample.arc_m));
            let beside = lines.near(&place, reach_m + 2.0).into_iter().filter_map(|(line, knot)| {
                let (parameter, across_m, height_m) = offset_from(lines, line, knot, &place)?;
                let cosine = normal_of(&lines.lines[line].tangent(knot)).dot(&normal);
                (cosine.abs() > 0.9 && height_m.abs() < 8.0).then(|| Beside {
                    line,
                    parameter,
                    move_m: -across_m * cosine.signum(),
                    agreement: agreement(&lane.lane.category_posterior, lines.lines[line].posterior()),
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

/// Log-likelihood of a sample that moves to the left.
fn support(vote: &Vote<'_>, move_m: f64) -> f64 {
    let best = vote.lines.iter().map(|beside| {
        let ratio = (move_m - beside.move_m) / SCATTER_M;
        beside.agreement * (-0.5 * ratio * ratio).exp()
    });
    let unmatched = if misfit_m(vote, move_m) > BESIDE_M { OFF_THE_MAP } else { OUTLIER };
    best.fold(unmatched, f64::max).ln()
}

/// Distance from a sample, moved, to the nearest line, metres.
fn misfit_m(vote: &Vote<'_>, move_m: f64) -> f64 {
    vote.lines.iter().map(|beside| (move_m - beside.move_m).abs()).fold(f64::INFINITY, f64::min)
}

/// Log-likelihood of every shift in every window; of none where a window has no votes.
fn likelihoods(votes: &[Vote<'_>], square: Square, prior_sigma_m: f64, params: &FleetParams) -> Vec<Likelihood> {
    /// Step of the table of a sample's support, metres.
    const FINE_M: f64 = 0.125;
    let windows = votes.iter().map(|vote| vote.window).max().unwrap_or(0) + 1;
    let share = (STRIDE as f64 * params.sample_m / params.lane_correlation_m).min(1.0);
    let shifts: Vec<Vector2<f64>> = (0..square.count()).map(|state| square.shift(state)).collect();
    let farthest_m = square.side as f64 * STEP_M * 2.0_f64.sqrt();
    let half = count_of(farthest_m / FINE_M) + 1;
    let mut windows: Vec<Likelihood> = vec![Vec::new(); windows];
    let mut table = vec![0.0; 2 * half + 1];
    for vote in votes {
        for (step, value) in table.iter_mut().enumerate() {
            *value = share * support(vote, (step as f64 - half as f64) * FINE_M);
        }
        let window = &mut windows[vote.window];
        window.resize(square.count(), 0.0);
        for (sum, shift) in window.iter_mut().zip(&shifts) {
            *sum += table[count_of(vote.normal.dot(shift) / FINE_M + half as f64 + 0.5)];
        }
    }
    let occupied = windows.iter().filter(|window| !window.is_empty()).count().max(1) as f64;
    for window in windows.iter_mut().filter(|window| !window.is_empty()) {
        for (sum, shift) in window.iter_mut().zip(&shifts) {
            *sum -= 0.5 * shift.norm_squared() / (prior_sigma_m * prior_sigma_m) / occupied;
        }
    }
    windows
}

/// The most probable state of each window.
fn most_probable(windows: &[Likelihood], square: Square, params: &FleetParams) -> Vec<usize> {
    let drift_m2 = params.odometry_sigma_m.powi(2) * WINDOW_M + 0.15_f64.powi(2);
    // A jump costs the sum of what its two axes cost: the best is found along one, then along the other.
    let jump = -0.5 * STEP_M * STEP_M / drift_m2;
    let mut score = vec![0.0; square.count()];
    let mut from: Vec<Vec<usize>> = Vec::with_capacity(windows.len());
    let (mut by_east, mut east_from) = (vec![0.0; square.count()], vec![0; square.count()]);
    for window in windows {
        best_of_three(&score, 1, square.width(), jump, &mut by_east, &mut east_from);
        let mut north_from = vec![0; square.count()];
        best_of_three(&by_east, square.width(), square.count(), jump, &mut score, &mut north_from);
        for before in &mut north_from {
            *before = east_from[*before];
        }
        for (score, own) in score.iter_mut().zip(window) {
            *score += own;
        }
        from.push(north_from);
    }
    let mut state = (0..square.count()).max_by(|a, b| score[*a].total_cmp(&score[*b])).unwrap_or(0);
    let mut path = vec![0; windows.len()];
    for window in (0..windows.len()).rev() {
        path[window] = state;
        state = from[window][state];
    }
    path
}

/// For each state the best of itself and its two neighbours so many states away, which cost a jump, and which it is. There is
/// no neighbour over the border of a row of `row` states.
fn best_of_three(score: &[f64], step: usize, row: usize, jump: f64, best: &mut [f64], of: &mut [usize]) {
    best.copy_from_slice(score);
    for (state, of) in of.iter_mut().enumerate() {
        *of = state;
    }
    for start in (0..score.len()).step_by(row) {
        let row = start..start + row;
        for state in row.start + step..row.end {
            if score[state - step] + jump > best[state] {
                (best[state], of[state]) = (score[state - step] + jump, state - step);
            }
        }
        for state in row.start..row.end - step {
            if score[state + step] + jump > best[state] {
                (best[state], of[state]) = (score[state + step] + jump, state + step);
            }
        }
    }
}

/// Share of the samples that lie on a line, of those that lie on one or where none can be: beside one, within a lane.
fn explained<'a>(votes: &[Vote<'a>], move_of: impl Fn(&Vote<'a>) -> f64) -> f64 {
    let misfits = votes.iter().map(|vote| misfit_m(vote, move_of(vote)));
    let misfits: Vec<f64> = misfits.filter(|misfit| *misfit <= BESIDE_M).collect();
    let on_line = misfits.iter().filter(|misfit| **misfit <= ON_LINE_M).count();
    on_line as f64 / misfits.len().max(1) as f64
}

/// Logarithm of how much more probable the path is than the same path shifted across the road to another place.
fn margin(windows: &[Likelihood], path: &[usize], votes: &[Vote<'_>], square: Square) -> f64 {
    const DIRECTIONS: usize = 16;
    let total = |east: isize, north: isize| -> f64 {
        let at = |(window, state): (&Likelihood, &usize)| match square.moved(*state, east, north) {
            _ if window.is_empty() => 0.0,
            Some(state) => window[state],
            None => window.iter().copied().fold(f64::INFINITY, f64::min),
        };
        windows.iter().zip(path).map(at).sum()
    };
    let across_m = |shift: Vector2<f64>| {
        let sum: f64 = votes.iter().map(|vote| vote.normal.dot(&shift).abs()).sum();
        sum / votes.len() as f64
    };
    let mut best_other = f64::NEG_INFINITY;
    for direction in 0..DIRECTIONS {
        let (sin, cos) = (2.0 * PI * direction as f64 / DIRECTIONS as f64).sin_cos();
        for radius in 1..=2 * square.side {
            let shift = Vector2::new(cos, sin) * (radius as f64 * STEP_M);
            if across_m(shift) >= ANOTHER_PLACE_M {
                best_other = best_other.max(total(whole(shift.x / STEP_M), whole(shift.y / STEP_M)));
            }
        }
    }
    total(0, 0) - best_other
}

#[expect(clippy::cast_possible_truncation, reason = "the cast saturates, and the square is small")]
fn whole(value: f64) -> isize {
    value.round() as isize
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
