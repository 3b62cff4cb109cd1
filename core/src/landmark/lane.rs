//! A lane of the map and its life: born of one observation, grown and smoothed by those that follow.
//!
//! Paper: "Spline Optimization". Every sample of an associated observation adds a point-to-spline term
//! `r_k = T p_k - p(u_k)`, weighted by its range and Huber's kernel; neighbouring control points are tied by chordal terms
//! as initialised. `default` differs in three things: the samples of one line err together (`line_terms`), second
//! differences are held small, and the last frames' foot points and weights are evaluated anew before they are folded
//! into the information for good (fluid relinearisation in a window).

use std::collections::VecDeque;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use super::{
    category::{CategoryAlong, CategoryBelief},
    existence::Existence,
    extent::{Extent, Sighting},
    foot_walk::FootWalk,
    growth::{self, GrowthRule},
    information::{BandedInformation, BandedSum, Knot, Term},
    line_terms::{ControlPointAt, LineSample, PlacedSample, line_terms},
};
use crate::{
    frame::TimestampNs,
    geometry::Pose,
    lane_map::{EndRule, LaneId},
    observation::{LaneObservation, sigma_at},
    params::{LandmarkParams, Params},
    spline::Curve,
};

/// Holds a new lane together until it has data: information of its first control point, 1/m^2.
const FAINT: f64 = 1e-6;

/// A lane of the map.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Landmark {
    /// Number within the drive.
    pub id: LaneId,
    /// What it is painted as.
    pub category: CategoryBelief,
    /// The same at each of its knots.
    pub category_along: CategoryAlong,
    /// Whether it exists.
    pub existence: Existence,
    /// Where it begins and ends.
    pub extent: Extent,
    /// Frames that saw it.
    pub observations: u32,
    /// Number of the frame that began it, counted by its mapper.
    pub born_at_frame: u64,
    /// Number of the last frame that saw it.
    pub seen_at_frame: u64,
    /// Time of the first frame that saw it.
    pub first_seen: TimestampNs,
    /// Time of the last frame that saw it.
    pub last_seen: TimestampNs,
    /// Whether it was given up where it was last in view, and is kept for the stretch that had left it: seen no more.
    pub retired: bool,
    /// Frames that missed it since it was seen last.
    pub missed: u32,
    /// Another lane that may be the same, and how many frames spoke for it (negative: against).
    pub rival: Option<(LaneId, i32)>,
    information: BandedInformation<WIDTH>,
    /// Terms that will not be evaluated again.
    folded: BandedSum<WIDTH>,
    /// Terms of the last frames.
    recent: VecDeque<RecentFrame>,
    /// Knots whose rows are out of date.
    stale: Option<(Knot, Knot)>,
    /// Samples of the last frame that saw the lane.
    last_samples: Option<Vec<LineSample>>,
}

/// Samples of one frame that are still evaluated anew.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct RecentFrame {
    samples: Vec<LineSample>,
    /// Samples of the frame before, and how much of their error is left.
    previous: Vec<LineSample>,
    phi: f64,
    /// Measurements per sample.
    white_share: f64,
    sum: BandedSum<WIDTH>,
}

/// Control points that one frame may couple: what lies in a crop box, and some to spare.
pub const WIDTH: usize = 28;

/// The samples of an observation that enter the map.
///
/// They stand at whole multiples of the step along the line, so that successive frames have the same ranges.
#[allow(clippy::cast_possible_truncation)] // stations within the crop box
fn samples_of(observation: &LaneObservation, map_from_vehicle: &Pose, step_m: f64) -> Vec<LineSample> {
    let (from, to) = observation.reported;
    let (first, last) = ((from / step_m).ceil() as i32, (to / step_m).floor() as i32);
    let sample = |station: i32| {
        let range_m = f64::from(station) * step_m;
        LineSample { station, range_m, point: map_from_vehicle * observation.point_at(range_m) }
    };
    (first..=last).map(sample).collect()
}

/// A term of one sample that errs on its own (the paper's).
fn independent_term(placed: &PlacedSample, distance_m: f64, share: f64, params: &LandmarkParams) -> Term {
    let robust = if distance_m <= params.huber_m { 1.0 } else { params.huber_m / distance_m };
    Term {
        first: placed.first,
        weights: placed.weights,
        target: placed.sample.point.coords,
        information: share * robust * sigma_at(&params.noise, placed.sample.range_m).powi(-2),
    }
}

impl ControlPointAt for Landmark {
    fn position(&self, knot: Knot) -> Vector3<f64> {
        self.positions()[self.index_of(knot)].coords
    }
}

impl Landmark {
    /// A lane begun by an observation; `None` where the line is too short for control points.
    #[must_use]
    pub fn begin(
        id: LaneId,
        observation: &LaneObservation,
        map_from_vehicle: &Pose,
        time: TimestampNs,
        all: &Params,
    ) -> Option<Self> {
        let params = &all.landmark;
        let points = growth::begin(observation, map_from_vehicle, &growth_rule(params));
        let least = match params.ends {
            EndRule::Open => 4,
            EndRule::Reflected => 3,
        };
        if points.len() < least {
            return None;
        }
        let mut lane = Self {
            id,
            category: CategoryBelief::default(),
            category_along: CategoryAlong::default(),
            existence: Existence::at_birth(),
            extent: Extent::default(),
            observations: 0,
            born_at_frame: 0,
            seen_at_frame: 0,
            first_seen: time,
            last_seen: time,
            retired: false,
            missed: 0,
            rival: None,
            information: BandedInformation::new(points[0]),
            folded: BandedSum::default(),
            recent: VecDeque::with_capacity(params.window_frames + 1),
            stale: None,
            last_samples: None,
        };
        for point in &points {
            lane.append(*point, params);
        }
        lane.fold(Term { first: 0, weights: [1.0, 0.0, 0.0, 0.0], target: points[0].coords, information: FAINT });
        Some(lane)
    }

    /// Control points in the direction of travel, map frame.
    #[must_use]
    pub fn positions(&self) -> &VecDeque<Point3<f64>> {
        self.information.positions()
    }

    /// What is known of the control points.
    #[must_use]
    pub fn information(&self) -> &BandedInformation<WIDTH> {
        &self.information
    }

    /// Knots of the first and the last control point.
    #[must_use]
    pub fn knots(&self) -> (Knot, Knot) {
        (self.information.head(), self.information.knot(self.information.len() - 1))
    }

    /// The curve; a landmark always has control points enough for one.
    #[must_use]
    pub fn curve(&self, ends: EndRule) -> Option<Curve<'_, VecDeque<Point3<f64>>>> {
        Curve::new(self.positions(), ends)
    }

    /// Index of the control point nearest to `query` among some, both ends included.
    #[must_use]
    pub fn nearest_index(&self, query: &Point3<f64>, from: usize, to: usize) -> usize {
        let last = to.min(self.information.len() - 1);
        let between = if from <= last { from..last + 1 } else { 0..0 };
        let squared = self.positions().range(between).map(|point| (point - query).norm_squared());
        squared.zip(from..).min_by(|(a, _), (b, _)| a.total_cmp(b)).map_or(from, |(_, index)| index)
    }

    /// Index of a knot, held within the lane.
    #[must_use]
    pub fn index_of(&self, knot: Knot) -> usize {
        let index = usize::try_from(knot - self.information.head()).unwrap_or(0);
        index.min(self.information.len() - 1)
    }

    /// Adds a term that will not be evaluated again.
    fn fold(&mut self, term: Term) {
        let anchor = *self.information.anchor();
        self.folded.add(&term, &anchor);
        self.mark(term.first, term.first + 3);
    }

    /// Notes that the rows of some knots are out of date.
    fn mark(&mut self, first: Knot, last: Knot) {
        let (low, high) = self.stale.unwrap_or((first, last));
        self.stale = Some((low.min(first), high.max(last)));
    }

    /// Adds a control point behind the last, tied to its neighbours.
    fn append(&mut self, point: Point3<f64>, params: &LandmarkParams) {
        let previous = self.positions().back().copied();
        self.information.push_tail(point);
        let (_, last) = self.knots();
        if let Some(previous) = previous {
            self.tie(last - 1, point - previous, params);
        }
        if self.information.len() >= 3 {
            self.straighten(last - 2, params);
        }
    }

    /// Adds a control point before the first, tied to its neighbours.
    fn prepend(&mut self, point: Point3<f64>, params: &LandmarkParams) {
        let next = self.positions()[0];
        self.information.push_head(point);
        let (first, _) = self.knots();
        self.tie(first, next - point, params);
        self.straighten(first, params);
    }

    /// The paper's constant constraint: neighbours stay as far apart as they were initialised.
    fn tie(&mut self, first: Knot, delta: Vector3<f64>, params: &LandmarkParams) {
        let information = params.chord_sigma_m.powi(-2);
        self.fold(Term { first, weights: [-1.0, 1.0, 0.0, 0.0], target: delta, information });
    }

    /// Roads bend little within two chords (ours).
    fn straighten(&mut self, first: Knot, params: &LandmarkParams) {
        let information = params.bend_sigma_m.powi(-2);
        if information > 1e-6 {
            self.fold(Term { first, weights: [1.0, -2.0, 1.0, 0.0], target: Vector3::zeros(), information });
        }
    }

    /// Grows both ends by what an observation saw beyond them; whether the lane became longer.
    pub fn grow(&mut self, observation: &LaneObservation, map_from_vehicle: &Pose, params: &LandmarkParams) -> bool {
        let rule = growth_rule(params);
        let count = self.information.len();
        let (inner, end) = (self.positions()[count - 2], self.positions()[count - 1]);
        let behind = growth::grow(observation, map_from_vehicle, &inner, &end, &rule);
        let (inner, end) = (self.positions()[1], self.positions()[0]);
        let before = growth::grow(observation, map_from_vehicle, &inner, &end, &rule);
        for point in &behind {
            self.append(*point, params);
        }
        for point in &before {
            self.prepend(*point, params);
        }
        !behind.is_empty() || !before.is_empty()
    }

    /// Takes one frame's observation into the information and solves; `near` are knots between which it lies.
    ///
    /// `seconds` have passed since the lane was last seen.
    pub fn smooth(
        &mut self,
        observation: &LaneObservation,
        map_from_vehicle: &Pose,
        seconds: f64,
        near: (Knot, Knot),
        all: &Params,
    ) {
        let samples = samples_of(observation, map_from_vehicle, all.line_error.step_m);
        let previous = self.last_samples.take().unwrap_or_default();
        let phi = if previous.is_empty() { 0.0 } else { (-seconds.max(0.0) / all.line_error.correlation_s).exp() };
        let measured = observation.measured as f64 / samples.len().max(1) as f64;
        let frame = RecentFrame { samples, previous, phi, white_share: measured.min(1.0), sum: BandedSum::default() };
        let sum = self.linearise(&frame, near, all);
        self.mark_sum(&sum);
        self.last_samples = Some(frame.samples.clone());
        self.recent.push_back(RecentFrame { sum, ..frame });
        if self.recent.len() > all.landmark.window_frames {
            self.fold_oldest(near, all);
        }
        self.solve();
    }

    /// Evaluates the oldest recent frame at the lane as it is now, for the last time.
    fn fold_oldest(&mut self, near: (Knot, Knot), all: &Params) {
        let Some(oldest) = self.recent.pop_front() else { return };
        let sum = if all.landmark.window_frames == 0 {
            oldest.sum
        } else {
            self.mark_sum(&oldest.sum);
            self.linearise(&oldest, near, all)
        };
        self.mark_sum(&sum);
        self.folded.absorb(&sum);
    }

    fn mark_sum(&mut self, sum: &BandedSum<WIDTH>) {
        if let Some((first, last)) = sum.span() {
            self.mark(first, last);
        }
    }

    /// Brings the stale rows, and with them the control points, up to date.
    fn solve(&mut self) {
        if let Some((first, last)) = self.stale.take() {
            let sums = std::iter::once(&self.folded).chain(self.recent.iter().map(|frame| &frame.sum));
            self.information.replace(first, last, sums);
        }
        self.information.solve();
    }

    /// The terms of one frame at the lane as it is now. Samples beyond its ends say nothing.
    fn linearise(&self, frame: &RecentFrame, near: (Knot, Knot), all: &Params) -> BandedSum<WIDTH> {
        let mut sum = BandedSum::default();
        let samples = self.place(&frame.samples, near, &all.landmark);
        if all.line_error.enabled {
            let previous = self.place(&frame.previous, near, &all.landmark);
            let plain: Vec<PlacedSample> = samples.iter().map(|(placed, _)| *placed).collect();
            let before: Vec<PlacedSample> = previous.iter().map(|(placed, _)| *placed).collect();
            let terms = line_terms(&plain, &before, frame.phi, frame.white_share, WIDTH, self, &all.line_error);
            for term in &terms {
                sum.add_dense(term, self.information.anchor());
            }
        } else {
            let share = (all.landmark.witnesses / samples.len() as f64).min(1.0);
            for (placed, distance_m) in &samples {
                sum.add(&independent_term(placed, *distance_m, share, &all.landmark), self.information.anchor());
            }
        }
        sum
    }

    /// Samples with their foot points' control points and distances; those beyond the ends are left out.
    fn place(&self, samples: &[LineSample], near: (Knot, Knot), params: &LandmarkParams) -> Vec<(PlacedSample, f64)> {
        let Some(curve) = self.curve(params.ends) else { return Vec::new() };
        let mut walk = FootWalk::new(self, &curve, near, params);
        let place = |sample: &LineSample| {
            let foot = walk.foot_point(&sample.point)?;
            let support = curve.support(foot.parameter);
            let first = self.information.knot(support.first);
            Some((PlacedSample { sample: *sample, first, weights: support.weights }, foot.distance_m))
        };
        samples.iter().filter_map(place).collect()
    }

    /// Counts this frame's votes on where the line begins and ends, and on what it is painted as there.
    pub fn vote_extent(
        &mut self,
        observation: &LaneObservation,
        map_from_vehicle: &Pose,
        near: (Knot, Knot),
        visibility: impl Fn(&Point3<f64>) -> f64,
        params: &LandmarkParams,
    ) {
        let Some(curve) = self.curve(params.ends) else { return };
        let head = self.information.head() as f64;
        let mut walk = FootWalk::new(self, &curve, near, params);
        let mut place = |x: f64| head + walk.nearest_parameter(&(map_from_vehicle * observation.point_at(x)));
        let (reported_from, certain_from) = (place(observation.reported.0), place(observation.certain.0));
        let (certain_to, reported_to) = (place(observation.certain.1), place(observation.reported.1));
        let along = |a: f64, b: f64| if a <= b { (a, b) } else { (b, a) };
        let sighting =
            Sighting { reported: along(reported_from, reported_to), certain: along(certain_from, certain_to) };
        // Farther beyond what was reported the detector sees nothing, and a lane may go on for kilometres.
        let blind = params.blind_range_m / params.chord_m + 1.0;
        let from = (sighting.reported.0 - blind).max(near.0 as f64).max(head);
        let to = (sighting.reported.1 + blind).min(near.1 as f64).min(head + curve.last_parameter());
        let mut extent = std::mem::take(&mut self.extent);
        let curve = self.curve(params.ends);
        if let Some(curve) = curve {
            let camera = map_from_vehicle.translation.vector;
            let variance = |point: &Point3<f64>| sigma_at(&params.noise, (point.coords - camera).norm()).powi(2);
            let mut walk = curve.walk();
            extent.vote(&sighting, (from, to), |parameter| walk.point(parameter - head), visibility, variance);
        }
        self.extent = extent;
        let (first, last) = sighting.certain;
        #[allow(clippy::cast_possible_truncation)] // knots of a lane, far below 2^53
        self.category_along.vote(observation.category, first.ceil() as Knot, last.floor() as Knot);
    }

    /// Counts the frames that missed the lane since it was seen last against what they had in view: it was drawn too far.
    pub fn vote_missed(
        &mut self,
        near: (Knot, Knot),
        visibility: impl Fn(&Point3<f64>) -> f64,
        params: &LandmarkParams,
    ) {
        let mut extent = std::mem::take(&mut self.extent);
        if let Some(curve) = self.curve(params.ends) {
            let head = self.information.head() as f64;
            let (from, to) = ((near.0 as f64).max(head), (near.1 as f64).min(head + curve.last_parameter()));
            extent.vote_absent(self.missed, from, to, |parameter| visibility(&curve.point(parameter - head)));
        }
        self.extent = extent;
    }

    /// First and last parameter of the line as drawn, counted from the first control point.
    #[must_use]
    pub fn drawn(&self, params: &LandmarkParams) -> Option<(f64, f64)> {
        let curve = self.curve(params.ends)?;
        let (first, last) = (curve.first_parameter(), curve.last_parameter());
        if params.ends == EndRule::Open {
            return Some((first, last));
        }
        let head = self.information.head() as f64;
        let (from, to) = self.extent.drawn(params.drawn_share)?;
        let (from, to) = ((from - head).max(first), (to - head).min(last));
        (to > from).then_some((from, to))
    }

    /// Adds what another lane knows, which turned out to be this one: its control points as observations of this curve.
    ///
    /// Points of the other beyond this lane's ends are appended first, so nothing that was seen is lost.
    pub fn absorb(&mut self, other: &Self, params: &LandmarkParams) {
        let variances = other.information.variances(0);
        let tail_of_mine = *self.positions().back().unwrap_or(self.information.anchor());
        let nearest = other.nearest_index(&tail_of_mine, 0, other.positions().len() - 1);
        let reaches_on = other.positions().iter().skip(nearest + 1);
        let beyond: Vec<Point3<f64>> = reaches_on.filter(|point| self.is_beyond_tail(point)).copied().collect();
        for point in beyond {
            self.append(point, params);
        }
        let near = self.knots();
        let sample = |point: &Point3<f64>| LineSample { station: 0, range_m: 0.0, point: *point };
        let samples: Vec<LineSample> = other.positions().iter().map(sample).collect();
        let mut variance_of = samples.iter().zip(&variances);
        let mut sum = BandedSum::default();
        for (placed, _) in self.place(&samples, near, params) {
            // `place` keeps the order, so the variances are walked along with it.
            let variance = variance_of.find(|(sample, _)| sample.point == placed.sample.point).map_or(1.0, |(_, v)| *v);
            let information = 1.0 / variance.max(1e-6);
            let target = placed.sample.point.coords;
            sum.add(
                &Term { first: placed.first, weights: placed.weights, target, information },
                self.information.anchor(),
            );
        }
        self.mark_sum(&sum);
        self.folded.absorb(&sum);
        self.absorb_votes(other, params);
        self.solve();
    }

    fn is_beyond_tail(&self, point: &Point3<f64>) -> bool {
        let count = self.information.len();
        let (inner, end) = (self.positions()[count - 2], self.positions()[count - 1]);
        (point - end).dot(&(end - inner)) > 0.5 * (end - inner).norm_squared()
    }

    fn absorb_votes(&mut self, other: &Self, params: &LandmarkParams) {
        self.category.absorb(&other.category);
        self.existence.absorb(other.existence);
        self.observations += other.observations;
        self.first_seen = self.first_seen.min(other.first_seen);
        self.last_seen = self.last_seen.max(other.last_seen);
        self.seen_at_frame = self.seen_at_frame.max(other.seen_at_frame);
        let mut extent = std::mem::take(&mut self.extent);
        let mut category_along = std::mem::take(&mut self.category_along);
        if let (Some(mine), Some(theirs)) = (self.curve(params.ends), other.curve(params.ends)) {
            let near = self.knots();
            let (head, their_head) = (near.0 as f64, other.information.head() as f64);
            let to_mine = |parameter: f64| {
                let mut walk = FootWalk::new(self, &mine, near, params);
                head + walk.nearest_parameter(&theirs.point(parameter - their_head))
            };
            extent.absorb(&other.extent, to_mine);
            #[allow(clippy::cast_possible_truncation)] // knots of a lane, far below 2^53
            category_along.absorb(&other.category_along, |knot| to_mine(knot as f64).round() as Knot);
        }
        self.extent = extent;
        self.category_along = category_along;
    }
}

fn growth_rule(params: &LandmarkParams) -> GrowthRule {
    let ours = params.ends == EndRule::Reflected;
    GrowthRule { chord_m: params.chord_m, extrapolate: !ours, join: ours }
}
