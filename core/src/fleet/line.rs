//! Lines of the shared map: knots 3 m apart, each the weighted mean of what the drives say of it.
//!
//! Fusion of splines on common knots, in information form. Catmull-Rom splines are not nested under knot insertion
//! (`paper_notes.md` 2), so a drive's lane is projected: where the plane across the line at knot `k` cuts the lane's curve
//! lies its witness `q_k`, with the variance that the drive's own map gives there. The knot lies at
//! `sum w_i q_i / sum w_i` across the line, `w_i = rho_i / (s_i^2 + s_0^2)`: information adds, and since errors of one drive along
//! one line are correlated, a drive is one witness at each knot, however many frames saw it. Its variance is `1 / sum w_i`.
//! Near the ends of a drive's lane its weight tapers off, so that the mean does not jump where a witness comes or goes.

use std::collections::{BTreeSet, HashMap};

use nalgebra::{Point3, Vector2, Vector3};
use rustc_hash::FxBuildHasher;
use serde::{Deserialize, Serialize};

use super::{
    alignment::robust_weight,
    contribution::DriveId,
    correction::CorrectionWalk,
    history::Belief,
    params::FleetParams,
    prepared::{PreparedLane, normal_of},
    repainted::Paint,
};
use crate::{
    category::Category,
    frame::TimestampNs,
    lane_map::{EndRule, LaneId},
    spline::curve::Curve,
};

/// Name of a line in the shared map: its oldest witness that is believed, so that it is the same in any order of arrival.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct FusedLaneId {
    /// Start of the oldest drive that saw it.
    pub started: TimestampNs,
    /// That drive.
    pub drive: DriveId,
    /// The drive's lane.
    pub lane: LaneId,
    /// Which of the lines that this lane began, from 0.
    pub piece: u32,
    /// Which of the stretches of that line that are there, from 0.
    pub stretch: u32,
}

/// One knot of a line, as fused.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FusedPoint {
    /// Position, shared frame, metres.
    pub position: Point3<f64>,
    /// Standard deviation across the line against the map around it, metres.
    pub lateral_sigma_m: f64,
    /// Standard deviation of the height against the map around it, metres.
    pub height_sigma_m: f64,
    /// Drives that saw it.
    pub drives: u32,
    /// Probability that it is there, in `[0, 1]`.
    pub existence: f64,
    /// Start of the last drive that saw it: how fresh it is.
    pub confirmed: TimestampNs,
}

/// A line of the shared map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FusedLane {
    /// Its name.
    pub id: FusedLaneId,
    /// Most probable category.
    pub category: Category,
    /// Probability of each category, in the order of [`Category::ALL`]; sums to 1.
    pub category_posterior: Vec<f64>,
    /// Knots about 3 m apart, in the direction of travel of the oldest witness; at least 2. The curve reaches both ends.
    pub points: Vec<FusedPoint>,
    /// Drives that saw some of it.
    pub drives: u32,
    /// Frames that saw some of it.
    pub observations: u64,
    /// Time of the first frame that saw it.
    pub first_seen: TimestampNs,
    /// Time of the last frame that saw it.
    pub last_seen: TimestampNs,
}

/// What one pass of a drive says of one knot.
#[derive(Clone, Copy, Debug)]
pub(super) struct Witness {
    /// The drive, as a number among the corrections.
    pub(super) drive: usize,
    /// The pass, as a number among those of all drives; [`BASE`] for what was folded.
    pub(super) pass: usize,
    /// The lane, as a number among those of the pass.
    pub(super) lane: usize,
    /// Spline parameter of the lane there.
    pub(super) parameter: f64,
    /// Map frame of the drive.
    pub(super) map: Point3<f64>,
    pub(super) arc_m: f64,
    /// The same place by the drive's correction.
    pub(super) shared: Point3<f64>,
    pub(super) lateral_variance_m2: f64,
    pub(super) height_variance_m2: f64,
    /// 1 within the drive's lane, less near its ends.
    pub(super) share: f64,
}

/// The pass of a witness that stands for drives that were folded.
pub(super) const BASE: usize = usize::MAX;

/// A line while it is made.
#[derive(Clone, Debug)]
pub(super) struct Line {
    pub(super) id: FusedLaneId,
    pub(super) points: Vec<Point3<f64>>,
    pub(super) knots: Vec<Knot>,
    /// Sum of the category posteriors of its witnesses, by length.
    pub(super) category_votes: Vec<f64>,
    /// The same, with the sum 1.
    posterior: Vec<f64>,
    /// What is known of it from drives that were folded.
    pub(super) record: LineRecord,
    /// The lines from which a stretch moved to here.
    pub(super) moved_from: BTreeSet<usize>,
}

/// A knot of a line while it is made.
#[derive(Clone, Debug, Default)]
pub(super) struct Knot {
    pub(super) witnesses: Vec<Witness>,
    /// What is known of it from drives that were folded.
    pub(super) record: KnotRecord,
}

impl Knot {
    /// Number of drives that saw it.
    pub(super) fn drives(&self) -> u32 {
        let apart = || self.witnesses.iter().filter(|witness| witness.pass != BASE).map(|witness| witness.drive);
        // They mostly come in their order.
        let count = if apart().is_sorted() {
            let mut last = None;
            apart().filter(|drive| last.replace(*drive) != Some(*drive)).count()
        } else {
            apart().collect::<BTreeSet<usize>>().len()
        };
        self.record.drives + u32::try_from(count).unwrap_or(u32::MAX)
    }
}

/// What drives that were folded said of a line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct LineRecord {
    pub(super) drives: u32,
    pub(super) observations: u64,
    pub(super) first_seen: Option<TimestampNs>,
    pub(super) last_seen: Option<TimestampNs>,
}

/// What drives that were folded said of a knot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct KnotRecord {
    pub(super) drives: u32,
    /// `None` of a knot that none of them had.
    pub(super) belief: Option<Belief>,
    /// The same of its paint.
    pub(super) paint: Option<Paint>,
}

/// All lines, and which run near a place.
#[derive(Clone, Debug, Default)]
pub(super) struct Lines {
    pub(super) lines: Vec<Line>,
    grid: HashMap<(i32, i32), Vec<(u32, u32)>, FxBuildHasher>,
}

const CELL_M: f64 = 8.0;
/// Way over which a drive's weight grows from the end of its lane, metres.
pub(super) const TAPER_M: f64 = 12.0;

fn cell(x: f64, y: f64) -> (i32, i32) {
    #[expect(clippy::cast_possible_truncation, reason = "the cast saturates, far beyond any map")]
    let whole = |value: f64| (value / CELL_M).floor() as i32;
    (whole(x), whole(y))
}

impl Line {
    pub(super) fn new(id: FusedLaneId) -> Self {
        let categories = Category::ALL.len();
        Self {
            id,
            points: Vec::new(),
            knots: Vec::new(),
            category_votes: vec![0.0; categories],
            posterior: vec![1.0 / categories as f64; categories],
            record: LineRecord::default(),
            moved_from: BTreeSet::new(),
        }
    }

    /// Adds a knot behind the last.
    pub(super) fn push(&mut self, point: Point3<f64>, knot: Knot) {
        self.points.push(point);
        self.knots.push(knot);
    }

    /// Adds a knot before the first.
    pub(super) fn push_front(&mut self, point: Point3<f64>, knot: Knot) {
        self.points.insert(0, point);
        self.knots.insert(0, knot);
    }

    /// Turns it round.
    pub(super) fn reverse(&mut self) {
        self.points.reverse();
        self.knots.reverse();
    }

    /// The first drive that its first knot was seen by, as a number among the corrections.
    pub(super) fn first_drive(&self) -> usize {
        self.knots.iter().find_map(|knot| knot.witnesses.first()).map_or(0, |witness| witness.drive)
    }

    /// Moves all of it, with what its witnesses say.
    pub(super) fn move_by(&mut self, by_m: &Vector3<f64>) {
        for point in &mut self.points {
            *point += by_m;
        }
        for witness in self.knots.iter_mut().flat_map(|knot| &mut knot.witnesses) {
            witness.shared += by_m;
        }
    }

    /// Takes a witness' belief over the categories, for so many metres.
    pub(super) fn vote(&mut self, posterior: &[f64], length_m: f64) {
        for (sum, own) in self.category_votes.iter_mut().zip(posterior) {
            *sum += own * length_m;
        }
        let total: f64 = self.category_votes.iter().sum();
        if total > 0.0 {
            self.posterior = self.category_votes.iter().map(|vote| vote / total).collect();
        }
    }

    /// Adds the votes of a line that is now part of this one.
    pub(super) fn take_votes(&mut self, other: &Self) {
        let votes = other.category_votes.clone();
        self.vote(&votes, 1.0);
    }

    /// Its most probable category, as a number among [`Category::ALL`].
    pub(super) fn paint(&self) -> usize {
        let best = self.posterior.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
        best.map_or(0, |(category, _)| category)
    }

    /// Belief over its categories, in the order of [`Category::ALL`]: the mean of its witnesses'.
    pub(super) fn posterior(&self) -> &[f64] {
        &self.posterior
    }

    pub(super) fn curve(&self) -> Option<Curve<'_, [Point3<f64>]>> {
        Curve::new(self.points.as_slice(), EndRule::Reflected)
    }

    /// Direction at a knot, of length 1.
    pub(super) fn tangent(&self, knot: usize) -> Vector3<f64> {
        let before = self.points[knot.saturating_sub(1)];
        let after = self.points[(knot + 1).min(self.points.len() - 1)];
        (after - before).try_normalize(1e-9).unwrap_or_else(Vector3::x)
    }

    /// Adds a witness to a knot. Of two of the same pass the more certain stays.
    pub(super) fn testify(&mut self, knot: usize, witness: Witness) {
        let at = &mut self.knots[knot].witnesses;
        match at.iter_mut().find(|other| other.pass == witness.pass) {
            Some(other) if other.lateral_variance_m2 <= witness.lateral_variance_m2 => {}
            Some(other) => *other = witness,
            None => at.push(witness),
        }
    }

    /// Puts every knot to the mean of its witnesses, across the line and in height.
    pub(super) fn settle(&mut self, params: &FleetParams) {
        let mut offsets = Offsets::default();
        let moved = (0..self.points.len()).map(|knot| {
            let normal = normal_of(&self.tangent(knot));
            let mean = self.mean_of(knot, &normal, params, &mut offsets);
            self.points[knot] + Vector3::new(normal.x * mean.across_m, normal.y * mean.across_m, mean.height_m)
        });
        self.points = moved.collect();
    }

    /// Where the witnesses of a knot put it, from where it is.
    pub(super) fn mean_offset(&self, knot: usize, normal: &Vector2<f64>, params: &FleetParams) -> MeanOffset {
        self.mean_of(knot, normal, params, &mut Offsets::default())
    }

    fn mean_of(
        &self,
        knot: usize,
        normal: &Vector2<f64>,
        params: &FleetParams,
        Offsets { across, height, sorted }: &mut Offsets,
    ) -> MeanOffset {
        let place = self.points[knot];
        across.clear();
        height.clear();
        for witness in &self.knots[knot].witnesses {
            let offset = witness.shared - place;
            across.push((offset.xy().dot(normal), witness.share / witness.lateral_variance_m2));
            height.push((offset.z, witness.share / witness.height_variance_m2));
        }
        let (across_m, across_information) = robust_mean(across, params.robust_scale_m, sorted);
        let (height_m, height_information) = robust_mean(height, 2.0 * params.robust_scale_m, sorted);
        MeanOffset { across_m, height_m, across_information, height_information }
    }
}

/// Where the witnesses of a knot put it, with their weights: memory that is used for one knot after the other.
#[derive(Debug, Default)]
struct Offsets {
    across: Vec<(f64, f64)>,
    height: Vec<(f64, f64)>,
    sorted: Vec<(f64, f64)>,
}

/// Mean of the witnesses of a knot.
#[derive(Clone, Copy, Debug)]
pub(super) struct MeanOffset {
    pub(super) across_m: f64,
    pub(super) height_m: f64,
    /// 1/m^2.
    pub(super) across_information: f64,
    /// 1/m^2.
    pub(super) height_information: f64,
}

/// Mean of values with weights, from their weighted median by reweighting; and the sum of the weights that are left.
fn robust_mean(values: &[(f64, f64)], scale_m: f64, sorted: &mut Vec<(f64, f64)>) -> (f64, f64) {
    const ROUNDS: usize = 4;
    sorted.clear();
    sorted.extend_from_slice(values);
    sorted.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let mut mean = weighted_median(sorted);
    let mut information = 0.0;
    for _ in 0..ROUNDS {
        let mut sum = 0.0;
        information = 0.0;
        for (value, weight) in values {
            let weight = weight * robust_weight(value - mean, scale_m);
            sum += weight * value;
            information += weight;
        }
        if information <= 0.0 {
            return (mean, 0.0);
        }
        mean = sum / information;
    }
    (mean, information)
}

/// The median of values in their order.
fn weighted_median(sorted: &[(f64, f64)]) -> f64 {
    let half = 0.5 * sorted.iter().map(|(_, weight)| weight).sum::<f64>();
    let mut below = 0.0;
    for (index, (value, weight)) in sorted.iter().enumerate() {
        below += weight;
        if below > half * (1.0 + 1e-12) {
            return *value;
        }
        if below >= half * (1.0 - 1e-12) && index + 1 < sorted.len() {
            return 0.5 * (value + sorted[index + 1].0);
        }
    }
    sorted.last().map_or(0.0, |(value, _)| *value)
}

impl Lines {
    /// Finds knots by place again, after lines moved or grew.
    pub(super) fn index(&mut self) {
        // What they hold is used again.
        for knots in self.grid.values_mut() {
            knots.clear();
        }
        for (number, line) in self.lines.iter().enumerate() {
            let knots = line.points.iter().map(|point| cell(point.x, point.y)).enumerate();
            let knots: Vec<(usize, (i32, i32))> = knots.collect();
            for run in knots.chunk_by(|a, b| a.1 == b.1) {
                #[expect(clippy::cast_possible_truncation, reason = "a map has fewer than 2^32 lines and knots")]
                let own = run.iter().map(|(knot, _)| (number as u32, *knot as u32));
                self.grid.entry(run[0].1).or_default().extend(own);
            }
        }
    }

    /// About how much memory they take, bytes.
    pub(super) fn bytes(&self) -> usize {
        let knots = self.lines.iter().flat_map(|line| &line.knots);
        knots.map(|knot| size_of::<(Knot, Point3<f64>)>() + knot.witnesses.capacity() * size_of::<Witness>()).sum()
    }

    /// Whether a stretch of one of two lines moved to the other.
    pub(super) fn are_old_and_new(&self, a: usize, b: usize) -> bool {
        self.lines[a].moved_from.contains(&b) || self.lines[b].moved_from.contains(&a)
    }

    /// Calls `visit` with line, knot and place of every knot within about a radius of a place, horizontally.
    pub(super) fn for_each_knot_near(
        &self,
        place: &Point3<f64>,
        radius_m: f64,
        mut visit: impl FnMut(usize, usize, &Point3<f64>),
    ) {
        let (low, high) = (cell(place.x - radius_m, place.y - radius_m), cell(place.x + radius_m, place.y + radius_m));
        for x in low.0..=high.0 {
            for y in low.1..=high.1 {
                for (line, knot) in self.grid.get(&(x, y)).into_iter().flatten() {
                    let (line, knot) = (*line as usize, *knot as usize);
                    visit(line, knot, &self.lines[line].points[knot]);
                }
            }
        }
    }

    /// The lines within a radius of a place, horizontally, each with its nearest knot, in the order of the lines.
    pub(super) fn near(&self, place: &Point3<f64>, radius_m: f64) -> Vec<(usize, usize)> {
        let (low, high) = (cell(place.x - radius_m, place.y - radius_m), cell(place.x + radius_m, place.y + radius_m));
        // A handful of lines: a scan is quicker than a tree.
        let mut nearest: Vec<(u32, f64, u32)> = Vec::new();
        for x in low.0..=high.0 {
            for y in low.1..=high.1 {
                for (line, knot) in self.grid.get(&(x, y)).into_iter().flatten() {
                    let distance = (self.lines[*line as usize].points[*knot as usize] - place).xy().norm_squared();
                    if distance > radius_m * radius_m {
                        continue;
                    }
                    match nearest.iter_mut().find(|(other, ..)| other == line) {
                        Some(best) if distance < best.1 => (best.1, best.2) = (distance, *knot),
                        Some(_) => {}
                        None => nearest.push((*line, distance, *knot)),
                    }
                }
            }
        }
        nearest.sort_unstable_by_key(|(line, ..)| *line);
        nearest.into_iter().map(|(line, _, knot)| (line as usize, knot as usize)).collect()
    }
}

/// The witness that a drive's lane is at a spline parameter of its own.
pub(super) fn witness_at(
    (drive, pass, lane_index): (usize, usize, usize),
    lane: &PreparedLane<'_>,
    walk: &mut CorrectionWalk<'_>,
    sample: usize,
    parameter: f64,
) -> Witness {
    let near = &lane.samples[sample];
    let (first, last) = (&lane.samples[0], &lane.samples[lane.samples.len() - 1]);
    let map = lane.curve.point(parameter);
    let to_end_m = nalgebra::distance(&map, &first.map).min(nalgebra::distance(&map, &last.map));
    Witness {
        drive,
        pass,
        lane: lane_index,
        parameter,
        map,
        arc_m: near.arc_m,
        shared: walk.place(&map, near.arc_m),
        lateral_variance_m2: near.lateral_variance_m2,
        height_variance_m2: near.height_variance_m2,
        share: (to_end_m / TAPER_M).clamp(0.05, 1.0),
    }
}
