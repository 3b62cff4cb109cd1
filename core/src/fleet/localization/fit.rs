//! How well a drive lies at a place: its lanes are laid on the lines from there outwards, as far as odometry lets them.
//!
//! The drive's correction, rigid at first, is solved with every sample held by the line that it lies on, in a reach that
//! grows from where the hypothesis was found: what is near there is right to a metre, what is far off is not yet. The score
//! is a log-likelihood: of every sample, by its distance to the nearest line, as in [`placement`](crate::fleet::placement),
//! and of what odometry has to be off by for it.

use std::collections::HashSet;

use nalgebra::{Matrix3, Point3, Vector2, Vector3};

use super::hypotheses::Hypothesis;
use crate::fleet::{
    alignment::{RobustScales, Sighting, Target, align_one},
    contribution::Contribution,
    correction::Correction,
    georeferenced::UNBOUNDED_M,
    line::Lines,
    matching::{Foot, foot_on},
    params::FleetParams,
    prepared::{LaneSample, PreparedDrive, PreparedLane, Restraints, count_of, normal_of},
};

/// Reach, gate and robust scale of each step, metres.
const STEPS: [(f64, f64, f64); 8] = [
    (60.0, 2.5, UNBOUNDED_M),
    (60.0, 1.6, 1.0),
    (60.0, 1.4, 1.0),
    (120.0, 1.4, 1.0),
    (240.0, 1.4, 0.6),
    (480.0, 1.4, 0.6),
    (f64::INFINITY, 1.4, 0.3),
    (f64::INFINITY, 1.2, 0.3),
];
/// Share of the samples in reach that must lie on a line for the next step to be taken.
const LEAST_ON_THE_WAY: f64 = 0.45;
/// Distance at which a sample still lies on a line, metres.
const ON_LINE_M: f64 = 0.7;
/// Distance within which a line would be expected to be this one, metres.
const BESIDE_M: f64 = 2.2;
/// Scatter of a sample about its line, beside what the drive states, metres.
const SCATTER_M: f64 = 0.2;
/// Likelihood of a sample beside a line that it is not on.
const OUTLIER: f64 = 0.03;
/// The same where no line is near: the map may not reach so far yet.
const OFF_THE_MAP: f64 = 0.12;
/// Distance between drive and line to the side within which the camera sees nearly every line, metres.
const IN_SIGHT_M: f64 = 4.5;
/// Knots of a line to each side of a sample that it shows.
const SHOWN_KNOTS: usize = 4;

/// A drive that is sought.
#[derive(Debug)]
pub(super) struct Sought<'a> {
    pub(super) contribution: &'a Contribution,
    pub(super) prepared: &'a PreparedDrive<'a>,
    /// What of it holds its shape; without what holds its place.
    restraints: Restraints,
    params: &'a FleetParams,
}

/// A drive laid on lines.
#[derive(Clone, Debug)]
pub(super) struct Fit {
    pub(super) correction: Correction,
    /// Logarithm of how probable it is, but for a constant of the drive.
    pub(super) score: f64,
    /// From where on the way samples were seen that lie on a line, in order, metres.
    pub(super) on_line_m: Vec<f64>,
    /// Share of all samples near which the map has lines.
    pub(super) on_map: f64,
    /// Share of those that lie on one.
    pub(super) explained: f64,
    /// Median distance across of these from their lines, metres.
    pub(super) median_m: f64,
    /// Share of the lines beside the way that the drive shows, of those that it should.
    pub(super) shown: f64,
    /// What holds it, at the middle of its way: east, north, turn.
    information: Matrix3<f64>,
}

/// A sample on, or beside, a line.
struct OnLine {
    line: usize,
    parameter: f64,
    across_m: f64,
    height_m: f64,
}

impl<'a> Sought<'a> {
    pub(super) fn new(
        contribution: &'a Contribution,
        prepared: &'a PreparedDrive<'a>,
        params: &'a FleetParams,
    ) -> Self {
        let restraints = Restraints { fixes: Vec::new(), ..prepared.restraints.clone() };
        Self { contribution, prepared, restraints, params }
    }

    /// Its lanes, pass by pass.
    pub(super) fn lanes(&self) -> impl Iterator<Item = &PreparedLane<'a>> {
        self.prepared.passes.iter().flat_map(|pass| &pass.lanes)
    }

    fn samples(&self) -> impl Iterator<Item = (&PreparedLane<'a>, &LaneSample)> {
        let lanes = self.prepared.passes.iter().flat_map(|pass| &pass.coarse_lanes);
        lanes.flat_map(|lane| lane.samples.iter().map(move |sample| (lane, sample)))
    }

    /// Way on it and place of the middle of its way, map frame.
    pub(super) fn middle(&self) -> (f64, Point3<f64>) {
        let way = &self.contribution.trajectory;
        let point = &way[way.len() / 2];
        (point.arc_m, point.position)
    }

    /// Lays the drive on lines about a place; `None` where it does not fit there.
    pub(super) fn fit(&self, at: &Hypothesis, lines: &Lines) -> Option<Fit> {
        let mut correction =
            Correction::rigid(&self.contribution.trajectory, at.yaw_rad, |point| at.apply(point), self.params);
        let whole_m = self.contribution.trajectory.last().map_or(0.0, |last| last.arc_m);
        let mut done_m = 0.0;
        for (reach_m, gate_m, robust_m) in STEPS {
            if reach_m.is_finite() && done_m > whole_m && reach_m > done_m {
                continue;
            }
            done_m = reach_m;
            let (sightings, of) = self.sightings(&correction, lines, at.arc_m, reach_m, gate_m);
            if (sightings.len() as f64) < LEAST_ON_THE_WAY * of as f64 || sightings.len() < 8 {
                return None;
            }
            let scales = RobustScales { lanes_m: robust_m, fixes_m: UNBOUNDED_M };
            align_one(&self.restraints, &mut correction, &sightings, scales);
        }
        correction.knots().iter().all(|knot| knot.shared.coords.iter().all(|value| value.is_finite())).then_some(())?;
        Some(self.judge(correction, lines))
    }

    /// Samples within reach that lie on a line, and how many there are in reach.
    fn sightings(
        &self,
        correction: &Correction,
        lines: &Lines,
        arc_m: f64,
        reach_m: f64,
        gate_m: f64,
    ) -> (Vec<Sighting>, usize) {
        let mut sightings = Vec::new();
        let mut of = 0;
        let deflation = self.params.lane_correlation_m / (2.0 * self.params.sample_m);
        for (_, sample) in self.samples().filter(|(_, sample)| (sample.arc_m - arc_m).abs() <= reach_m) {
            of += 1;
            let Some(on) = nearest(lines, correction, sample, gate_m) else { continue };
            let Some(curve) = lines.lines[on.line].curve() else { continue };
            let (place, normal) = (curve.point(on.parameter), normal_of(&curve.derivative(on.parameter)));
            sightings.push(Sighting {
                drive: 0,
                arc_m: sample.arc_m,
                map: sample.map,
                normal,
                across: Target::Fixed(place.coords.xy().dot(&normal)),
                height: Target::Fixed(place.z),
                lateral_variance_m2: (sample.lateral_variance_m2 + SCATTER_M * SCATTER_M) * deflation,
                height_variance_m2: (sample.height_variance_m2 + SCATTER_M * SCATTER_M) * deflation,
            });
        }
        (sightings, of)
    }

    fn judge(&self, correction: Correction, lines: &Lines) -> Fit {
        let share = (2.0 * self.params.sample_m / self.params.lane_correlation_m).min(1.0);
        let (_, middle) = self.middle();
        let middle = correction.apply(&middle, self.middle().0);
        let (mut score, mut all, mut near) = (0.0, 0_usize, 0_usize);
        let (mut on_line_m, mut across_m) = (Vec::new(), Vec::new());
        let mut information = Matrix3::zeros();
        let mut shown: HashSet<(usize, usize)> = HashSet::new();
        for (lane, sample) in self.samples() {
            all += 1;
            let Some(on) = nearest(lines, &correction, sample, BESIDE_M) else {
                score += share * OFF_THE_MAP.ln();
                continue;
            };
            near += 1;
            let variance_m2 = sample.lateral_variance_m2 + SCATTER_M * SCATTER_M;
            let agreement = agreement(&lane.lane.category_posterior, lines.lines[on.line].posterior());
            let likelihood = agreement * (-0.5 * on.across_m * on.across_m / variance_m2).exp();
            score += share * likelihood.max(OUTLIER).ln();
            if on.across_m.abs() > ON_LINE_M {
                continue;
            }
            on_line_m.push(sample.arc_m);
            across_m.push(on.across_m.abs());
            shown.insert((on.line, count_of(on.parameter + 0.5)));
            let line = &lines.lines[on.line];
            let normal = normal_of(&line.tangent(count_of(on.parameter + 0.5).min(line.points.len() - 1)));
            let arm = (correction.apply(&sample.map, sample.arc_m) - middle).xy();
            let row = Vector3::new(normal.x, normal.y, Vector2::new(-arm.y, arm.x).dot(&normal));
            information += row * row.transpose() * (share / variance_m2);
        }
        on_line_m.sort_by(f64::total_cmp);
        across_m.sort_by(f64::total_cmp);
        let cost = self.odometry_cost(&correction);
        Fit {
            score: score - 0.5 * cost,
            on_map: near as f64 / all.max(1) as f64,
            explained: on_line_m.len() as f64 / near.max(1) as f64,
            median_m: across_m.get(across_m.len() / 2).copied().unwrap_or(f64::INFINITY),
            shown: self.shown_share(&correction, lines, &shown),
            on_line_m,
            information,
            correction,
        }
    }

    /// Of the lines right beside the way, how many the drive shows: 1 where there are none.
    fn shown_share(&self, correction: &Correction, lines: &Lines, shown: &HashSet<(usize, usize)>) -> f64 {
        const STRIDE: usize = 4;
        let (mut expected, mut seen) = (0_usize, 0_usize);
        for point in self.contribution.trajectory.iter().step_by(STRIDE) {
            let place = correction.apply(&point.position, point.arc_m);
            for (line, knot) in lines.near(&place, IN_SIGHT_M) {
                // Its end is not beside the way.
                if knot == 0 || knot + 1 == lines.lines[line].points.len() {
                    continue;
                }
                expected += 1;
                let around = knot.saturating_sub(SHOWN_KNOTS)..=knot + SHOWN_KNOTS;
                seen += usize::from(around.into_iter().any(|knot| shown.contains(&(line, knot))));
            }
        }
        if expected == 0 { 1.0 } else { seen as f64 / expected as f64 }
    }

    /// What odometry has to be off by, as a sum of squares in standard deviations: that of all the way is free but for its
    /// own standard deviation, as in [`alignment`](crate::fleet::alignment).
    fn odometry_cost(&self, correction: &Correction) -> f64 {
        let mut scale = CommonError::new(self.restraints.drift_sigma.scale);
        let mut turning = CommonError::new(self.restraints.drift_sigma.turn_rad_per_m);
        for (pair, step) in correction.knots().windows(2).zip(&self.restraints.steps) {
            let predicted = pair[0].apply(&pair[1].map);
            let residual = (pair[1].shared - predicted).xy();
            let way = (predicted - pair[0].shared).xy();
            for axis in 0..2 {
                scale.add(residual[axis], way[axis], 1.0 / step.position_m2);
            }
            let turn = pair[1].yaw_rad - pair[0].yaw_rad;
            turning.add(turn, pair[1].arc_m - pair[0].arc_m, 1.0 / step.yaw_rad2);
        }
        scale.cost() + turning.cost()
    }
}

impl Fit {
    /// Covariance of where the middle of the way lies, m^2, and of its turn, rad^2, were all errors independent. `None`
    /// where a direction is open.
    pub(super) fn covariance(&self) -> Option<Matrix3<f64>> {
        self.information.try_inverse().filter(|covariance| (0..3).all(|axis| covariance[(axis, axis)] > 0.0))
    }
}

/// Residuals that have one unknown factor in common.
struct CommonError {
    square: f64,
    mixed: f64,
    lever: f64,
}

impl CommonError {
    fn new(sigma: f64) -> Self {
        Self { square: 0.0, mixed: 0.0, lever: sigma.powi(-2) }
    }

    fn add(&mut self, residual: f64, lever: f64, weight: f64) {
        self.square += weight * residual * residual;
        self.mixed += weight * residual * lever;
        self.lever += weight * lever * lever;
    }

    /// What is left with the best factor, whose own cost is counted.
    fn cost(&self) -> f64 {
        self.square - self.mixed * self.mixed / self.lever
    }
}

/// The line on which a sample lies, or beside which, within a gate.
fn nearest(lines: &Lines, correction: &Correction, sample: &LaneSample, gate_m: f64) -> Option<OnLine> {
    /// Least cosine of the angle between a lane and its line.
    const LEAST_COSINE: f64 = 0.9;
    /// Difference in height that is another level of the road, metres.
    const ANOTHER_LEVEL_M: f64 = 6.0;
    let place = correction.apply(&sample.map, sample.arc_m);
    let normal = normal_of(&correction.turn(&sample.tangent, sample.arc_m));
    let beside = lines.near(&place, gate_m + 2.0).into_iter().filter_map(|(line, knot)| {
        let Foot { parameter, across_m, height_m, .. } = foot_on(lines, line, knot as f64, &place)?;
        let cosine = normal_of(&lines.lines[line].tangent(knot)).dot(&normal);
        let fits = across_m.abs() <= gate_m && cosine.abs() >= LEAST_COSINE && height_m.abs() <= ANOTHER_LEVEL_M;
        fits.then_some(OnLine { line, parameter, across_m, height_m })
    });
    beside.min_by(|a, b| {
        (a.across_m.abs(), a.height_m.abs())
            .partial_cmp(&(b.across_m.abs(), b.height_m.abs()))
            .unwrap_or(std::cmp::Ordering::Equal)
    })
}

fn agreement(a: &[f64], b: &[f64]) -> f64 {
    const FLOOR: f64 = 0.3;
    FLOOR + (1.0 - FLOOR) * a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>().min(1.0)
}
