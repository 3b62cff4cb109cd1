//! Fusion: contributions in, one map out. A pure function, whatever the order in which contributions arrived.
//!
//! Drives are taken in the order of their starts. Each is laid on the lines so far, matched, and adds its witnesses; what
//! lies on no line extends one or begins one. Then all corrections are solved together, and the lines are made again,
//! a few times over.

use std::{
    collections::{BTreeMap, BTreeSet},
    ops::Range,
};

use nalgebra::Point3;

use super::{
    alignment::{Sighting, Target, align},
    contribution::{Contribution, DriveId},
    correction::Correction,
    line::{FusedLane, FusedLaneId, FusedPoint, Line, Lines, witness_at},
    matching::{Run, match_lane},
    params::FleetParams,
    persistence::{Belief, Evidence, LEAST_VIEWS, views},
    placement::{Placement, place},
    prepared::{PreparedDrive, PreparedLane, normal_of},
};
use crate::{
    category::Category,
    geometry::georeference::{Anchor, GeoreferenceFit},
};

/// How a drive lies in the map.
#[derive(Clone, Debug, PartialEq)]
pub struct FusedDrive {
    /// The drive.
    pub drive: DriveId,
    /// Its correction; `None` where it was kept apart.
    pub correction: Option<Correction>,
}

/// A map of many drives.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FusedMap {
    /// Its lines, in the order of their names.
    pub lanes: Vec<FusedLane>,
    /// Its drives, in the order of their seniority.
    pub drives: Vec<FusedDrive>,
}

/// Fuses contributions into one map, east-north-up metres at `anchor`.
///
/// Of two contributions of one drive the later in the slice counts.
#[must_use]
pub fn fuse(contributions: &[Contribution], anchor: &Anchor, params: &FleetParams) -> FusedMap {
    let mut by_seniority = BTreeMap::new();
    for contribution in contributions.iter().filter(|contribution| !contribution.trajectory.is_empty()) {
        by_seniority.insert(contribution.seniority(), contribution);
    }
    let drives: Vec<PreparedDrive<'_>> =
        by_seniority.values().map(|contribution| PreparedDrive::new(contribution, anchor, params)).collect();
    let mut fusion = Fusion::new(&drives, params);
    fusion.place_all();
    for _ in 0..params.rounds {
        fusion.align_all();
        fusion.draw_lines();
    }
    fusion.into_map()
}

struct Fusion<'a> {
    drives: &'a [PreparedDrive<'a>],
    params: &'a FleetParams,
    corrections: Vec<Correction>,
    placed: Vec<bool>,
    lines: Lines,
}

/// Distance between two stations of a line in the alignment, knots.
const STATION_KNOTS: usize = 2;

impl<'a> Fusion<'a> {
    fn new(drives: &'a [PreparedDrive<'a>], params: &'a FleetParams) -> Self {
        let corrections: Vec<Option<Correction>> = drives.iter().map(|drive| by_gnss(drive, params)).collect();
        let placed = corrections.iter().map(Option::is_some).collect();
        let corrections = drives.iter().zip(corrections).map(|(drive, correction)| {
            correction.unwrap_or_else(|| drive.rigid_correction(0.0, |point| *point, params))
        });
        Self { drives, params, corrections: corrections.collect(), placed, lines: Lines::default() }
    }

    /// Lays every drive on the lines of those before it.
    fn place_all(&mut self) {
        for index in 0..self.drives.len() {
            if !self.placed[index] {
                continue;
            }
            let drive = &self.drives[index];
            let sigma_m = self.prior_sigma_m(index);
            let posterior = |line: usize| self.posterior(line);
            let placement =
                place(drive, index, &self.corrections[index], &self.lines, &posterior, sigma_m, self.params);
            match placement {
                Placement::Alone => {}
                Placement::Refused { .. } => {
                    self.placed[index] = false;
                    continue;
                }
                Placement::Found(sightings) => {
                    self.fit_one(index, sightings);
                    for _ in 0..2 {
                        let sightings = self.sightings_of(index);
                        self.fit_one(index, sightings);
                    }
                }
            }
            self.add_drive(index);
        }
    }

    /// Solves for one drive's correction while the lines stay.
    fn fit_one(&mut self, index: usize, mut sightings: Vec<Sighting>) {
        sightings.iter_mut().for_each(|sighting| sighting.drive = 0);
        let correction = &mut self.corrections[index..=index];
        align(&[&self.drives[index]], correction, &sightings, 0, self.params);
    }

    /// Standard deviation of where GNSS puts a drive against the map so far.
    fn prior_sigma_m(&self, index: usize) -> f64 {
        let fixes = &self.drives[index].fixes;
        let mean = fixes.iter().map(|fix| fix.horizontal_sigma_m).sum::<f64>() / fixes.len().max(1) as f64;
        let own = mean.max(self.params.gnss_bias_sigma_m);
        let before = self.placed[..index].iter().filter(|placed| **placed).count().max(1);
        own * (1.0 + 1.0 / before as f64).sqrt()
    }

    fn sightings_of(&self, index: usize) -> Vec<Sighting> {
        let matched = self.match_drive(index);
        let mut sightings = Vec::new();
        for (lane, runs) in self.drives[index].lanes.iter().zip(&matched) {
            for run in runs {
                let line = &self.lines.lines[run.line];
                let Some(curve) = line.curve() else { continue };
                for (sample, parameter) in lane.samples[run.samples.clone()].iter().zip(&run.parameters).step_by(2) {
                    let (place, normal) = (curve.point(*parameter), normal_of(&curve.derivative(*parameter)));
                    let deflation = self.params.lane_correlation_m / (2.0 * self.params.sample_m);
                    sightings.push(Sighting {
                        drive: index,
                        arc_m: sample.arc_m,
                        map: sample.map,
                        normal,
                        across: Target::Fixed(place.coords.xy().dot(&normal)),
                        height: Target::Fixed(place.z),
                        lateral_variance_m2: (sample.lateral_variance_m2 + self.params.lane_sigma_m.powi(2))
                            * deflation,
                        height_variance_m2: (sample.height_variance_m2 + self.params.lane_sigma_height_m.powi(2))
                            * deflation,
                    });
                }
            }
        }
        sightings
    }

    /// Runs of each lane of a drive on the lines.
    fn match_drive(&self, index: usize) -> Vec<Vec<Run>> {
        let drive = &self.drives[index];
        let correction = &self.corrections[index];
        let posterior = |line: usize| self.posterior(line);
        let run_of = |lane: &PreparedLane<'_>, taken: &[Run]| {
            let is_taken = |line: usize, parameter: f64| {
                taken.iter().any(|run| {
                    let (low, high) = ends(run);
                    run.line == line && parameter > low - 0.5 && parameter < high + 0.5
                })
            };
            let own = &lane.lane.category_posterior;
            match_lane(lane, own, correction, &self.lines, &posterior, &is_taken, self.params)
        };
        let first: Vec<Vec<Run>> = drive.lanes.iter().map(|lane| run_of(lane, &[])).collect();
        let mut order: Vec<usize> = (0..first.len()).collect();
        let fit = |lane: &usize| {
            let runs = &first[*lane];
            let samples: usize = runs.iter().map(|run| run.parameters.len()).sum();
            runs.iter().map(|run| run.cost * run.parameters.len() as f64).sum::<f64>() / samples.max(1) as f64
                - (samples as f64).sqrt() * 0.1
        };
        order.sort_by(|a, b| fit(a).total_cmp(&fit(b)).then(a.cmp(b)));
        let mut matched = vec![Vec::new(); first.len()];
        let mut taken: Vec<Run> = Vec::new();
        for lane in order {
            let runs = run_of(&drive.lanes[lane], &taken);
            taken.extend(runs.iter().cloned());
            matched[lane] = runs;
        }
        matched
    }

    /// Adds a drive's witnesses to the lines, and the lines that it alone saw.
    fn add_drive(&mut self, index: usize) {
        let matched = self.match_drive(index);
        let before = self.lines.lines.len();
        let mut touched = std::collections::BTreeSet::new();
        for (lane_index, runs) in matched.iter().enumerate() {
            for run in runs {
                self.testify(index, lane_index, run);
                touched.insert(run.line);
            }
            let extended = self.add_rest(index, lane_index, runs);
            touched.extend(extended);
        }
        for line in touched.into_iter().filter(|line| *line < before) {
            self.lines.lines[line].settle(&self.corrections, self.params);
        }
        self.lines.index();
    }

    /// Witnesses of a run at the knots of its line.
    fn testify(&mut self, index: usize, lane_index: usize, run: &Run) {
        let lane = &self.drives[index].lanes[lane_index];
        let line = &mut self.lines.lines[run.line];
        let first_sample = *run.samples.start();
        for (step, pair) in run.parameters.windows(2).enumerate() {
            let (low, high) = (pair[0].min(pair[1]), pair[0].max(pair[1]));
            let (from, to) = (&lane.samples[first_sample + step], &lane.samples[first_sample + step + 1]);
            let mut knot = super::prepared::count_of(low.ceil());
            while (knot as f64) < high && knot < line.points.len() {
                let share = (knot as f64 - pair[0]) / (pair[1] - pair[0]);
                let parameter = from.parameter + (to.parameter - from.parameter) * share;
                line.testify(knot, witness_at(index, lane_index, lane, first_sample + step, parameter));
                knot += 1;
            }
        }
    }

    /// What of a lane lies on no line: extends the line that it leaves at its end, or begins a line.
    fn add_rest(&mut self, index: usize, lane_index: usize, runs: &[Run]) -> Vec<usize> {
        let samples = self.drives[index].lanes[lane_index].samples.len();
        let mut extended = Vec::new();
        let mut next = 0;
        let mut before: Option<&Run> = None;
        let mut piece = 0;
        for run in runs.iter().map(Some).chain([None]) {
            let end = run.map_or(samples, |run| *run.samples.start());
            if end > next {
                let rest = next..=end - 1;
                let grows = before.filter(|run| self.leaves_at_end(run, true)).map(|run| (run, true));
                let grows = grows.or_else(|| run.filter(|run| self.leaves_at_end(run, false)).map(|run| (run, false)));
                match grows {
                    Some((run, onward)) => {
                        self.extend(index, lane_index, run, onward, rest);
                        extended.push(run.line);
                    }
                    None => self.begin(index, lane_index, rest, &mut piece),
                }
            }
            if let Some(run) = run {
                next = *run.samples.end() + 1;
            }
            before = run;
        }
        extended
    }

    /// Whether a run ends (`onward`) or begins where its line does.
    fn leaves_at_end(&self, run: &Run, onward: bool) -> bool {
        const NEAR_END: f64 = 1.5;
        let last = (self.lines.lines[run.line].points.len() - 1) as f64;
        let forward = run.parameters[run.parameters.len() - 1] >= run.parameters[0];
        let at = if onward { run.parameters[run.parameters.len() - 1] } else { run.parameters[0] };
        if forward == onward { at > last - NEAR_END } else { at < NEAR_END }
    }

    fn extend(
        &mut self,
        index: usize,
        lane_index: usize,
        run: &Run,
        onward: bool,
        rest: std::ops::RangeInclusive<usize>,
    ) {
        let lane = &self.drives[index].lanes[lane_index];
        let correction = &self.corrections[index];
        let forward = run.parameters[run.parameters.len() - 1] >= run.parameters[0];
        let at_tail = forward == onward;
        let line = &mut self.lines.lines[run.line];
        let order: Vec<usize> = if onward { rest.collect() } else { rest.rev().collect() };
        for sample in order {
            let near = &lane.samples[sample];
            let place = correction.apply(&near.map, near.arc_m);
            let end = if at_tail { line.points[line.points.len() - 1] } else { line.points[0] };
            let direction = if at_tail { line.tangent(line.points.len() - 1) } else { -line.tangent(0) };
            let offset = place - end;
            if offset.norm() < self.params.line_knot_m || offset.dot(&direction) <= 0.0 {
                continue;
            }
            let witness = witness_at(index, lane_index, lane, sample, near.parameter);
            if at_tail {
                line.points.push(place);
                line.witnesses.push(vec![witness]);
            } else {
                line.points.insert(0, place);
                line.witnesses.insert(0, vec![witness]);
            }
        }
    }

    fn begin(&mut self, index: usize, lane_index: usize, rest: std::ops::RangeInclusive<usize>, piece: &mut u32) {
        let drive = &self.drives[index];
        let lane = &drive.lanes[lane_index];
        let correction = &self.corrections[index];
        let (mut points, mut witnesses): (Vec<Point3<f64>>, Vec<_>) = (Vec::new(), Vec::new());
        for sample in rest {
            let near = &lane.samples[sample];
            let place = correction.apply(&near.map, near.arc_m);
            if points.last().is_some_and(|last| nalgebra::distance(last, &place) < self.params.line_knot_m) {
                continue;
            }
            points.push(place);
            witnesses.push(vec![witness_at(index, lane_index, lane, sample, near.parameter)]);
        }
        let length_m = (points.len().saturating_sub(1)) as f64 * self.params.line_knot_m;
        if length_m < self.params.shortest_lane_m {
            return;
        }
        let contribution = drive.contribution;
        let id = FusedLaneId {
            started: contribution.started,
            drive: contribution.drive,
            lane: lane.lane.id,
            piece: *piece,
            stretch: 0,
        };
        *piece += 1;
        self.lines.push(Line { id, points, witnesses });
    }

    /// Solves for all corrections and all lines together.
    fn align_all(&mut self) {
        let mut sightings = Vec::new();
        let mut stations = 0;
        let deflation = self.params.lane_correlation_m / (STATION_KNOTS as f64 * self.params.line_knot_m);
        for line in &self.lines.lines {
            for knot in (0..line.points.len()).step_by(STATION_KNOTS) {
                if line.witnesses[knot].len() < 2 {
                    continue;
                }
                let normal = normal_of(&line.tangent(knot));
                sightings.extend(line.witnesses[knot].iter().map(|witness| Sighting {
                    drive: witness.drive,
                    arc_m: witness.arc_m,
                    map: witness.map,
                    normal,
                    across: Target::Station(stations),
                    height: Target::Station(stations),
                    lateral_variance_m2: (witness.lateral_variance_m2 + self.params.lane_sigma_m.powi(2)) * deflation
                        / witness.share,
                    height_variance_m2: (witness.height_variance_m2 + self.params.lane_sigma_height_m.powi(2))
                        * deflation
                        / witness.share,
                }));
                stations += 1;
            }
        }
        let drives: Vec<&PreparedDrive<'_>> = self.drives.iter().collect();
        align(&drives, &mut self.corrections, &sightings, stations, self.params);
    }

    /// Makes the lines again from the corrections as they are.
    fn draw_lines(&mut self) {
        self.lines = Lines::default();
        for index in 0..self.drives.len() {
            if self.placed[index] {
                self.add_drive(index);
            }
        }
        for line in &mut self.lines.lines {
            line.settle(&self.corrections, self.params);
        }
        self.lines.index();
    }

    /// Belief over the categories of a line: the mean of its witnesses', weighed by how much of it each saw.
    fn posterior(&self, line: usize) -> Vec<f64> {
        let mut sum = vec![0.0; Category::ALL.len()];
        for witness in self.lines.lines[line].witnesses.iter().step_by(4).flatten() {
            let own = &self.drives[witness.drive].lanes[witness.lane].lane.category_posterior;
            sum.iter_mut().zip(own).for_each(|(sum, own)| *sum += own);
        }
        let total: f64 = sum.iter().sum();
        if total > 0.0 {
            sum.iter_mut().for_each(|value| *value /= total);
        }
        sum
    }

    /// Probability of each knot of each line to be there, and the drives that had it in view.
    fn existence(&self) -> Vec<Vec<Belief>> {
        let mut beliefs: Vec<Vec<Belief>> =
            self.lines.lines.iter().map(|line| vec![Belief::new(); line.points.len()]).collect();
        for index in (0..self.drives.len()).filter(|index| self.placed[*index]) {
            let views = views(&self.drives[index], &self.corrections[index], &self.lines);
            for ((line, beliefs), views) in self.lines.lines.iter().zip(&mut beliefs).zip(&views.of) {
                for ((witnesses, belief), (views, side_m)) in line.witnesses.iter().zip(beliefs).zip(views) {
                    if witnesses.iter().any(|witness| witness.drive == index) {
                        belief.hear(Evidence::Seen, f64::from(*side_m));
                    } else if *views >= LEAST_VIEWS {
                        belief.hear(Evidence::Missed, f64::from(*side_m));
                    }
                }
            }
        }
        beliefs
    }

    fn into_map(self) -> FusedMap {
        let existence = self.existence();
        let mut lanes: Vec<FusedLane> = Vec::new();
        for (line, existence) in existence.iter().enumerate() {
            let points = self.fused_points(line, existence);
            for (stretch, knots) in stretches(&points, self.params).into_iter().enumerate() {
                lanes.extend(self.fused_lane(line, stretch, &points[knots.clone()], knots));
            }
        }
        lanes.sort_by_key(|lane| lane.id);
        let drives = self.drives.iter().zip(&self.placed).zip(self.corrections).map(|((drive, placed), correction)| {
            FusedDrive { drive: drive.contribution.drive, correction: placed.then_some(correction) }
        });
        FusedMap { lanes, drives: drives.collect() }
    }

    fn fused_points(&self, index: usize, existence: &[Belief]) -> Vec<FusedPoint> {
        let line = &self.lines.lines[index];
        let points = (0..line.points.len()).map(|knot| {
            let normal = normal_of(&line.tangent(knot));
            let mean = line.mean_offset(knot, &normal, &self.corrections, self.params);
            FusedPoint {
                position: line.points[knot],
                lateral_sigma_m: mean.across_information.max(1e-6).powf(-0.5),
                height_sigma_m: mean.height_information.max(1e-6).powf(-0.5),
                drives: u32::try_from(line.witnesses[knot].len()).unwrap_or(u32::MAX),
                existence: existence[knot].probability,
            }
        });
        points.collect()
    }

    fn fused_lane(
        &self,
        index: usize,
        stretch: usize,
        points: &[FusedPoint],
        knots: Range<usize>,
    ) -> Option<FusedLane> {
        let line = &self.lines.lines[index];
        let witnesses = || line.witnesses[knots.clone()].iter().flatten();
        let lanes: BTreeSet<(usize, usize)> = witnesses().map(|witness| (witness.drive, witness.lane)).collect();
        let drives: BTreeSet<usize> = lanes.iter().map(|(drive, _)| *drive).collect();
        let seen = || lanes.iter().map(|(drive, lane)| self.drives[*drive].lanes[*lane].lane);
        let category_posterior = self.posterior(index);
        let best = (0..category_posterior.len())
            .max_by(|a, b| category_posterior[*a].total_cmp(&category_posterior[*b]))
            .unwrap_or(0);
        Some(FusedLane {
            id: FusedLaneId { stretch: u32::try_from(stretch).unwrap_or(u32::MAX), ..line.id },
            category: Category::ALL[best],
            category_posterior,
            points: points.to_vec(),
            drives: u32::try_from(drives.len()).unwrap_or(u32::MAX),
            observations: seen().map(|lane| u64::from(lane.observations)).sum(),
            first_seen: seen().map(|lane| lane.first_seen).min()?,
            last_seen: seen().map(|lane| lane.last_seen).max()?,
        })
    }
}

/// Runs of knots that are there and whose place is known, of at least the shortest length.
fn stretches(points: &[FusedPoint], params: &FleetParams) -> Vec<Range<usize>> {
    let mut stretches: Vec<Range<usize>> = Vec::new();
    let shown = |point: &FusedPoint| {
        point.existence >= params.least_existence && point.lateral_sigma_m <= params.most_lateral_sigma_m
    };
    for (knot, _) in points.iter().enumerate().filter(|(_, point)| shown(point)) {
        match stretches.last_mut() {
            Some(open) if open.end + params.bridged_knots >= knot => open.end = knot + 1,
            _ => stretches.push(knot..knot + 1),
        }
    }
    stretches.retain(|knots| (knots.len() as f64 - 1.0) * params.line_knot_m >= params.shortest_lane_m);
    stretches
}

fn ends(run: &Run) -> (f64, f64) {
    let (first, last) = (run.parameters[0], run.parameters[run.parameters.len() - 1]);
    (first.min(last), first.max(last))
}

/// Where GNSS and odometry alone put a drive; `None` without fixes.
fn by_gnss(drive: &PreparedDrive<'_>, params: &FleetParams) -> Option<Correction> {
    let mut fit = GeoreferenceFit::default();
    for point in &drive.contribution.trajectory {
        if let Some(fix) = &point.fix {
            let pose = crate::geometry::Pose::new(point.position.coords, nalgebra::Vector3::z() * point.yaw_rad);
            fit.observe(fix, &pose);
        }
    }
    let yaw = crate::geometry::pose::yaw_rad(&fit.georeference()?.enu_from_map);
    let first = drive.fixes.first()?;
    let turn = nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::z_axis(), yaw);
    let correction = drive.rigid_correction(yaw, |point| first.shared + turn * (point - first.map), params);
    let mut corrections = [correction];
    align(&[drive], &mut corrections, &[], 0, params);
    let [correction] = corrections;
    Some(correction)
}
