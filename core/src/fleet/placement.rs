//! Placement: where a drive lies on the map that others made, to within the capture of matching.
//!
//! A GNSS bias is as large as half a lane, so the nearest line is often the wrong one. Lateral shifts are therefore
//! searched: the way is cut into windows, and every sample of the drive's lanes votes for each shift that would lay it on a
//! line near it, weighed by how well the categories agree:
//!
//! `log L_w(x) = share * sum_samples log(e + (1 - e) max_lines a exp(-(x - d)^2 / 2 s^2))`.
//!
//! The most probable sequence of shifts over the windows (Viterbi) allows for the drift of odometry between them and for the prior of GNSS.
//! It is believed only if it explains most of what is there, and clearly better than the same sequence a lane further.
//!
//! Not guaranteed: a road of equal lines without an edge in view looks the same a lane further; there the prior decides, and
//! where it does not, the drive is kept apart. Shifts along the road are left to GNSS and to bends.

use super::{
    alignment::{Sighting, Target},
    correction::Correction,
    line::Lines,
    matching::offset_from,
    params::FleetParams,
    prepared::{LaneSample, PreparedDrive, count_of, normal_of},
};

/// What became of the search.
#[derive(Clone, Debug)]
pub(super) enum Placement {
    /// There is no line where the drive went: GNSS alone places it.
    Alone,
    /// It lies here, by these sightings of lines.
    Found(Vec<Sighting>),
    /// It fits nowhere, or at more places than one.
    Refused {
        /// Share of the samples near lines that lie on one.
        explained: f64,
        /// Logarithm of how much more probable it is than the next best.
        margin: f64,
    },
}

/// Way of a window, metres.
const WINDOW_M: f64 = 40.0;
/// Step of the search, metres.
const STEP_M: f64 = 0.25;
/// Scatter of a sample about its line during the search, metres.
const SCATTER_M: f64 = 0.4;
/// Probability that a sample lies on none of the lines that it sees near it.
const OUTLIER: f64 = 0.05;
/// The same where no line is within [`BESIDE_M`]: the map may not reach so far yet.
const OFF_THE_MAP: f64 = 0.15;
/// Distance from a line within which no other line is expected, metres.
const BESIDE_M: f64 = 2.2;
/// Distance at which a sample still lies on a line, metres.
const ON_LINE_M: f64 = 0.8;
/// Every how many samples of a lane one is used.
const STRIDE: usize = 3;
/// Samples near lines below which there is nothing to be placed on.
const LEAST_SAMPLES: usize = 8;
/// Shift that counts as another place, metres.
const ANOTHER_PLACE_M: f64 = 1.5;
/// Least logarithm of how much more probable the place is than any other.
const LEAST_MARGIN: f64 = 2.0;
/// Least share of samples that must lie on a line.
const LEAST_EXPLAINED: f64 = 0.55;

/// One sample with the lines beside it.
struct Vote<'a> {
    drive_sample: &'a LaneSample,
    window: usize,
    /// Line, parameter, shift to the left that would lay the sample on it, agreement of the categories.
    shifts: Vec<(usize, f64, f64, f64)>,
}

/// Lays a drive on the lines; `index` is its number in the sightings.
pub(super) fn place(
    drive: &PreparedDrive<'_>,
    index: usize,
    correction: &Correction,
    lines: &Lines,
    line_posterior: &dyn Fn(usize) -> Vec<f64>,
    prior_sigma_m: f64,
    params: &FleetParams,
) -> Placement {
    let reach_m = (params.search_sigmas * prior_sigma_m).max(2.0);
    let votes = votes(drive, correction, lines, line_posterior, reach_m);
    if votes.len() < LEAST_SAMPLES {
        return Placement::Alone;
    }
    let steps = 2 * count_of((reach_m / STEP_M).ceil()) + 1;
    let windows = votes.iter().map(|vote| vote.window).max().unwrap_or(0) + 1;
    let share = (STRIDE as f64 * params.sample_m / params.lane_correlation_m).min(1.0);
    let mut likelihood = vec![vec![0.0; steps]; windows];
    for vote in &votes {
        for (step, sum) in likelihood[vote.window].iter_mut().enumerate() {
            *sum += share * support(vote, shift_of(step, steps));
        }
    }
    let occupied = likelihood.iter().filter(|window| window.iter().any(|value| *value != 0.0)).count().max(1);
    let prior = |step: usize| -0.5 * (shift_of(step, steps) / prior_sigma_m).powi(2) / occupied as f64;
    for window in &mut likelihood {
        if window.iter().any(|value| *value != 0.0) {
            window.iter_mut().enumerate().for_each(|(step, value)| *value += prior(step));
        }
    }
    let path = most_probable(&likelihood, drift_sigma_m(params));
    let explained = explained(&votes, &path, steps);
    let margin = margin(&likelihood, &path);
    if explained < LEAST_EXPLAINED || margin < LEAST_MARGIN {
        return Placement::Refused { explained, margin };
    }
    Placement::Found(sightings(&votes, &path, steps, index, lines))
}

fn drift_sigma_m(params: &FleetParams) -> f64 {
    (params.odometry_sigma_m.powi(2) * WINDOW_M).sqrt() + 0.2
}

fn shift_of(step: usize, steps: usize) -> f64 {
    (step as f64 - (steps / 2) as f64) * STEP_M
}

fn support(vote: &Vote<'_>, shift_m: f64) -> f64 {
    let best = vote.shifts.iter().map(|(_, _, needed_m, agreement)| {
        let ratio = (shift_m - needed_m) / SCATTER_M;
        agreement * (-0.5 * ratio * ratio).exp()
    });
    let unmatched = if misfit_m(vote, shift_m) > BESIDE_M { OFF_THE_MAP } else { OUTLIER };
    best.fold(unmatched, f64::max).ln()
}

/// Distance from a sample, shifted, to the nearest line, metres.
fn misfit_m(vote: &Vote<'_>, shift_m: f64) -> f64 {
    vote.shifts.iter().map(|(_, _, needed_m, _)| (shift_m - needed_m).abs()).fold(f64::INFINITY, f64::min)
}

/// Share of the samples that lie on a line, of those that lie on one or where none can be: beside one, within a lane.
fn explained(votes: &[Vote<'_>], path: &[usize], steps: usize) -> f64 {
    let misfits = votes.iter().map(|vote| misfit_m(vote, shift_of(path[vote.window], steps)));
    let misfits: Vec<f64> = misfits.filter(|misfit| *misfit <= BESIDE_M).collect();
    let on_line = misfits.iter().filter(|misfit| **misfit <= ON_LINE_M).count();
    on_line as f64 / misfits.len().max(1) as f64
}

fn votes<'a>(
    drive: &'a PreparedDrive<'_>,
    correction: &Correction,
    lines: &Lines,
    line_posterior: &dyn Fn(usize) -> Vec<f64>,
    reach_m: f64,
) -> Vec<Vote<'a>> {
    let mut votes = Vec::new();
    for lane in &drive.lanes {
        for sample in lane.samples.iter().step_by(STRIDE) {
            let place = correction.apply(&sample.map, sample.arc_m);
            let yaw = correction.yaw_rad(sample.arc_m);
            let (sin, cos) = yaw.sin_cos();
            let tangent = nalgebra::Vector3::new(
                cos * sample.tangent.x - sin * sample.tangent.y,
                sin * sample.tangent.x + cos * sample.tangent.y,
                0.0,
            );
            let own_normal = normal_of(&tangent);
            let shifts = lines.near(&place, reach_m + 2.0).into_iter().filter_map(|(line, knot)| {
                let (parameter, across_m, height_m) = offset_from(lines, line, knot, &place)?;
                let normal = normal_of(&lines.lines[line].tangent(knot));
                let cosine = normal.dot(&own_normal);
                (cosine.abs() > 0.9 && height_m.abs() < 8.0).then(|| {
                    let agreement = agreement(&lane.lane.category_posterior, &line_posterior(line));
                    (line, parameter, -across_m * cosine.signum(), agreement)
                })
            });
            let shifts: Vec<_> = shifts.collect();
            if !shifts.is_empty() {
                votes.push(Vote { drive_sample: sample, window: count_of(sample.arc_m / WINDOW_M), shifts });
            }
        }
    }
    votes
}

fn agreement(a: &[f64], b: &[f64]) -> f64 {
    const FLOOR: f64 = 0.3;
    if a.len() != b.len() || a.is_empty() {
        return 1.0;
    }
    FLOOR + (1.0 - FLOOR) * a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>().min(1.0)
}

/// The most probable step of each window.
fn most_probable(likelihood: &[Vec<f64>], drift_sigma_m: f64) -> Vec<usize> {
    let steps = likelihood[0].len();
    let reach = count_of((4.0 * drift_sigma_m / STEP_M).ceil());
    let mut score = likelihood[0].clone();
    let mut from = vec![vec![0; steps]; likelihood.len()];
    for (window, own) in likelihood.iter().enumerate().skip(1) {
        let next = (0..steps).map(|step| {
            let near = step.saturating_sub(reach)..(step + reach + 1).min(steps);
            let best = near.map(|before| {
                let jump = (step as f64 - before as f64) * STEP_M / drift_sigma_m;
                (score[before] - 0.5 * jump * jump, before)
            });
            best.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((score[step], step))
        });
        let next: Vec<(f64, usize)> = next.collect();
        score = next.iter().zip(own).map(|((before, _), own)| before + own).collect();
        from[window] = next.into_iter().map(|(_, before)| before).collect();
    }
    let mut step = (0..steps).max_by(|a, b| score[*a].total_cmp(&score[*b])).unwrap_or(0);
    let mut path = vec![0; likelihood.len()];
    for window in (0..likelihood.len()).rev() {
        path[window] = step;
        step = from[window][step];
    }
    path
}

/// Logarithm of how much more probable the path is than the same path shifted to another place.
fn margin(likelihood: &[Vec<f64>], path: &[usize]) -> f64 {
    let steps = likelihood[0].len();
    let total = |shift: isize| -> f64 {
        let at = |(window, step): (&Vec<f64>, &usize)| {
            step.checked_add_signed(shift).and_then(|step| window.get(step)).copied().unwrap_or_else(|| lowest(window))
        };
        likelihood.iter().zip(path).map(at).sum()
    };
    let least = isize::try_from(count_of(ANOTHER_PLACE_M / STEP_M)).unwrap_or(1);
    let most = isize::try_from(steps).unwrap_or(isize::MAX);
    let others = (least..most).flat_map(|shift| [total(shift), total(-shift)]);
    total(0) - others.fold(f64::NEG_INFINITY, f64::max)
}

fn lowest(window: &[f64]) -> f64 {
    window.iter().copied().fold(f64::INFINITY, f64::min)
}

/// The samples that lie on a line after the shift, with where they should lie.
fn sightings(votes: &[Vote<'_>], path: &[usize], steps: usize, drive: usize, lines: &Lines) -> Vec<Sighting> {
    const CAPTURE_M: f64 = 1.0;
    let on_line = votes.iter().filter_map(|vote| {
        let shift_m = shift_of(path[vote.window], steps);
        let nearest = vote.shifts.iter().min_by(|a, b| {
            let misfit = |shift: &(usize, f64, f64, f64)| (shift.2 - shift_m).abs() - 0.5 * shift.3;
            misfit(a).total_cmp(&misfit(b))
        })?;
        let (line, parameter, needed_m, _) = *nearest;
        if (needed_m - shift_m).abs() > CAPTURE_M {
            return None;
        }
        let curve = lines.lines[line].curve()?;
        let (place, normal) = (curve.point(parameter), normal_of(&curve.derivative(parameter)));
        let sample = vote.drive_sample;
        Some(Sighting {
            drive,
            arc_m: sample.arc_m,
            map: sample.map,
            normal,
            across: Target::Fixed(place.coords.xy().dot(&normal)),
            height: Target::Fixed(place.z),
            lateral_variance_m2: sample.lateral_variance_m2 + SCATTER_M * SCATTER_M,
            height_variance_m2: sample.height_variance_m2 + SCATTER_M * SCATTER_M,
        })
    });
    on_line.collect()
}
