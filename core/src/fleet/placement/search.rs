//! The search for the most probable shifts: one per window of the way, on a square of steps.

use std::{collections::BTreeMap, f64::consts::PI};

use nalgebra::Vector2;

use super::{BESIDE_M, OFF_THE_MAP, OUTLIER, Prior, SCATTER_M, STRIDE, Vote, WINDOW_M, meeting::Meeting};
use crate::fleet::{params::FleetParams, prepared::count_of};

/// Step of the search, metres.
const STEP_M: f64 = 0.5;
/// Largest search, steps to each side.
const MOST_STEPS: usize = 40;
/// Shift across the road that counts as another place, metres.
const ANOTHER_PLACE_M: f64 = 1.4;

/// The shifts that are searched: a square about none.
#[derive(Clone, Copy, Debug)]
struct Square {
    /// Steps to each side.
    side: usize,
}

/// Log-likelihoods of one window, by shift.
type Likelihood = Vec<f64>;

/// Shifts along the way, one for each window.
#[derive(Clone, Debug)]
pub(in crate::fleet) struct Shifts {
    square: Square,
    path: Vec<usize>,
}

/// What a search found.
pub(super) struct Found {
    pub(super) shifts: Shifts,
    /// Logarithm of how much more probable they are than any others.
    pub(super) margin: f64,
}

/// The most probable shifts.
pub(super) fn most_probable(votes: &[Vote<'_>], meetings: &[Meeting], prior: &Prior, params: &FleetParams) -> Found {
    let square = Square { side: count_of((prior.reach_m(params) / STEP_M).ceil()).min(MOST_STEPS) };
    let windows = likelihoods(votes, meetings, square, prior, params);
    let path = most_probable_path(&windows, square, params);
    let margin = margin(&windows, &path, votes, square);
    Found { shifts: Shifts { square, path }, margin }
}

impl Shifts {
    /// The shift in a window; beyond the last that of the last, metres.
    pub(in crate::fleet) fn at(&self, window: usize) -> Vector2<f64> {
        let state = self.path.get(window).or(self.path.last());
        state.map_or_else(Vector2::zeros, |state| self.square.shift(*state))
    }

    /// The mean of all, metres.
    pub(in crate::fleet) fn mean(&self) -> Vector2<f64> {
        let sum: Vector2<f64> = self.path.iter().map(|state| self.square.shift(*state)).sum();
        sum / self.path.len().max(1) as f64
    }

    /// How far to the left a sample is moved, metres.
    pub(super) fn move_of(&self, vote: &Vote<'_>) -> f64 {
        vote.normal.dot(&self.at(vote.window))
    }
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

/// Log-likelihood of every shift in every window; of none where a window has no votes.
fn likelihoods(
    votes: &[Vote<'_>],
    meetings: &[Meeting],
    square: Square,
    prior: &Prior,
    params: &FleetParams,
) -> Vec<Likelihood> {
    /// Step of the table of a sample's support, metres.
    const FINE_M: f64 = 0.125;
    let windows = votes.iter().map(|vote| vote.window).max().unwrap_or(0) + 1;
    let share = (STRIDE as f64 * params.sample_m / params.lane_correlation_m).min(1.0);
    let shifts: Vec<Vector2<f64>> = (0..square.count()).map(|state| square.shift(state)).collect();
    let farthest_m = square.side as f64 * STEP_M * 2.0_f64.sqrt();
    let half = count_of(farthest_m / FINE_M) + 1;
    let moves_m: Vec<f64> = (0..=2 * half).map(|step| (step as f64 - half as f64) * FINE_M).collect();
    let mut support = Support::of(&moves_m);
    // Samples of one window whose lanes run alike vote alike: their support is summed before it is asked for at each shift.
    let mut alike: BTreeMap<(usize, i64), (Vector2<f64>, Vec<f64>)> = BTreeMap::new();
    for vote in votes {
        let of_direction = || (vote.normal, vec![0.0; 2 * half + 1]);
        let (_, table) = alike.entry((vote.window, direction(&vote.normal))).or_insert_with(of_direction);
        support.add_to(table, vote, share);
    }
    let mut windows: Vec<Likelihood> = vec![Vec::new(); windows];
    let add = |window: &mut Likelihood, normal: &Vector2<f64>, table: &[f64]| {
        for (sum, shift) in window.iter_mut().zip(&shifts) {
            *sum += table[count_of(normal.dot(shift) / FINE_M + half as f64 + 0.5)];
        }
    };
    for ((window, _), (normal, table)) in &alike {
        let window = &mut windows[*window];
        window.resize(square.count(), 0.0);
        add(window, normal, table);
    }
    // Where no line is, nothing is placed.
    for meeting in meetings {
        let window = windows.get_mut(count_of(meeting.arc_m / WINDOW_M)).filter(|window| !window.is_empty());
        if let Some(window) = window {
            let table: Vec<f64> = moves_m.iter().map(|move_m| meeting.support(*move_m, WINDOW_M)).collect();
            add(window, &meeting.normal, &table);
        }
    }
    let occupied = windows.iter().filter(|window| !window.is_empty()).count().max(1) as f64;
    for window in windows.iter_mut().filter(|window| !window.is_empty()) {
        for (sum, shift) in window.iter_mut().zip(&shifts) {
            *sum -= 0.5 * (shift - prior.shift_m).norm_squared() / (prior.sigma_m * prior.sigma_m) / occupied;
        }
    }
    windows
}

/// Log-likelihood of a sample that moves to the left, by the move.
struct Support<'a> {
    moves_m: &'a [f64],
    /// By the line that explains it best, and the distance from the nearest.
    best: Vec<f64>,
    misfit_m: Vec<f64>,
}

impl<'a> Support<'a> {
    fn of(moves_m: &'a [f64]) -> Self {
        Self { moves_m, best: vec![0.0; moves_m.len()], misfit_m: vec![0.0; moves_m.len()] }
    }

    /// Adds that of a sample, of which `share` counts. One line after the other: the loops have no branches.
    fn add_to(&mut self, sums: &mut [f64], vote: &Vote<'_>, share: f64) {
        self.best.fill(f64::NEG_INFINITY);
        self.misfit_m.fill(f64::INFINITY);
        for beside in &vote.lines {
            let moves = self.moves_m.iter().zip(&mut self.best).zip(&mut self.misfit_m);
            for ((move_m, best), misfit_m) in moves {
                let offset_m = move_m - beside.move_m;
                let ratio = offset_m / SCATTER_M;
                let own = beside.log_agreement - 0.5 * ratio * ratio;
                *best = if own > *best { own } else { *best };
                *misfit_m = if offset_m.abs() < *misfit_m { offset_m.abs() } else { *misfit_m };
            }
        }
        let (off_the_map, outlier) = (OFF_THE_MAP.ln(), OUTLIER.ln());
        for ((sum, best), misfit_m) in sums.iter_mut().zip(&self.best).zip(&self.misfit_m) {
            let unmatched = if *misfit_m > BESIDE_M { off_the_map } else { outlier };
            *sum += share * if *best > unmatched { *best } else { unmatched };
        }
    }
}

/// A direction to within half a degree.
#[expect(clippy::cast_possible_truncation, reason = "an angle, in steps")]
fn direction(normal: &Vector2<f64>) -> i64 {
    const STEPS_PER_RADIAN: f64 = 128.0;
    (normal.y.atan2(normal.x) * STEPS_PER_RADIAN).round() as i64
}

/// The most probable state of each window.
fn most_probable_path(windows: &[Likelihood], square: Square, params: &FleetParams) -> Vec<usize> {
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

/// Logarithm of how much more probable the path is than the same path shifted across the road to another place.
fn margin(windows: &[Likelihood], path: &[usize], votes: &[Vote<'_>], square: Square) -> f64 {
    const DIRECTIONS: usize = 16;
    let least = windows.iter().map(|window| window.iter().copied().fold(f64::INFINITY, f64::min));
    let least: Vec<f64> = least.collect();
    let total = |east: isize, north: isize| -> f64 {
        let at = |((window, least), state): ((&Likelihood, &f64), &usize)| match square.moved(*state, east, north) {
            _ if window.is_empty() => 0.0,
            Some(state) => window[state],
            None => *least,
        };
        windows.iter().zip(&least).zip(path).map(at).sum()
    };
    let mean_across = |direction: Vector2<f64>| {
        let sum: f64 = votes.iter().map(|vote| vote.normal.dot(&direction).abs()).sum();
        sum / votes.len() as f64
    };
    let mut best_other = f64::NEG_INFINITY;
    for direction in 0..DIRECTIONS {
        let (sin, cos) = (2.0 * PI * direction as f64 / DIRECTIONS as f64).sin_cos();
        let across = mean_across(Vector2::new(cos, sin));
        for radius in 1..=2 * square.side {
            let shift = Vector2::new(cos, sin) * (radius as f64 * STEP_M);
            if across * radius as f64 * STEP_M >= ANOTHER_PLACE_M {
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
