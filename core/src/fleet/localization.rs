//! Localization: where a drive without GNSS lies on the shared map, if its lanes fit it in one place only.
//!
//! The shape of a road names it: how the heading of a line changes along it does not depend on the pose of its frame. As
//! in terrain- and curvature-aided navigation (Golden, *Terrain contour matching*, SPIE 1980; Ahmed et al., *The path
//! inference filter*, 2012; for lanes on maps Poggenhans, Salscheider and Stiller, *Precise localization in high-definition
//! road maps for urban regions*, IROS 2018) the drive is found in four steps:
//!
//! 1. `hypotheses`: windows of its lanes that bend are slid along the heading profiles of all lines, both ways; the windows
//!    vote for each other's poses.
//! 2. `fit`: at each place that many of them vote for, all of its lanes are laid on all lines, from there outwards and
//!    as far as odometry lets them, and what lies where is summed to a log-likelihood.
//! 3. The best place must explain most of the drive, and the drive most of the lines beside its way.
//! 4. Every other place, those a little farther along the road and a lane over among them, must be less likely by a
//!    margin.
//!
//! What is placed says nothing of where the map lies on the earth ([`PlacedBy::Map`](super::contribution::PlacedBy)): it is
//! laid on it, and shows what it looks like.
//!
//! Not guaranteed: that the road is the right one. A drive along a road that the map does not have, and that bends and is
//! painted as one that it has, to a decimetre and over all of the drive, is laid there. A straight road is never found, nor is
//! one of several that look alike: that is told.
//!
//! ```
//! use lanemap_core::{fleet::{CellId, Contribution, DriveId, FleetParams, PlacedBy, TrajectoryPoint}, *};
//! use lanemap_core::fleet::localization::{AtlasLine, LineAtlas, Localization, localize};
//! use nalgebra::{Matrix3, Point3};
//!
//! // A road that turns by 60 degrees to the left, then back by 30: so far to the left of its axis, so far along it.
//! let heading = |s: f64| ((s - 80.0) / 100.0).clamp(0.0, 1.0) - 0.5 * ((s - 230.0) / 80.0).clamp(0.0, 1.0);
//! let road = |left_m: f64| -> Vec<Point3<f64>> {
//!     let mut axis = Point3::origin();
//!     (0..190).map(|step| {
//!         let turn = heading(3.0 * f64::from(step));
//!         axis += nalgebra::Vector3::new(turn.cos(), turn.sin(), 0.0) * 3.0;
//!         axis + nalgebra::Vector3::new(-turn.sin(), turn.cos(), 0.0) * left_m
//!     }).collect()
//! };
//! let lines = [5.2, 1.7, -1.8];
//! let mut atlas = LineAtlas::default();
//! let cell = CellId::new(8_718, 5_685).unwrap();
//! atlas.put(cell, lines.map(|left_m| AtlasLine { points: road(left_m), category_posterior: vec![] }).to_vec());
//!
//! // A drive along it, in a frame of its own: the same place, but turned by a quarter.
//! let own = |point: &Point3<f64>| Point3::new(-point.y, point.x, 0.0);
//! let lane = |(number, left_m): (usize, f64)| MapLane {
//!     id: LaneId(number as u64), category: Category::WhiteSolid, category_posterior: vec![1.0 / 15.0; 15],
//!     category_stretches: vec![],
//!     control_points: road(left_m).iter()
//!         .map(|point| ControlPoint { position: own(point), covariance: Matrix3::identity() * 0.01 }).collect(),
//!     ends: EndRule::Reflected, drawn_from: 0.0, drawn_to: 189.0, existence: 0.9, observations: 40,
//!     first_seen: TimestampNs(0), last_seen: TimestampNs(190),
//! };
//! let way = road(0.0).iter().enumerate().map(|(index, point)| TrajectoryPoint {
//!     time: TimestampNs(index as i64), arc_m: 3.0 * index as f64, position: own(point), yaw_rad: 0.0,
//!     motion_variance_m2: 1e-4, turn_variance_rad2: 1e-7, fix: None, hidden: vec![],
//! }).collect();
//! let drive = Contribution {
//!     drive: DriveId(1), started: TimestampNs(0), sensor: Sensor::default(), placed_by: PlacedBy::Receiver,
//!     trajectory: way, lanes: lines.into_iter().enumerate().map(lane).collect(),
//! };
//! let Localization::Aligned(place) = localize(&drive, &atlas, &FleetParams::default()) else { panic!("it bends") };
//! let origin = place.georeference.enu_from_map * Point3::origin();
//! assert!(origin.coords.norm() < 0.3, "{origin}");
//! ```

mod atlas;
mod fit;
mod hypotheses;
mod placed;
mod profile;

use std::{collections::BTreeMap, ops::RangeInclusive};

use nalgebra::{Matrix3, Rotation2, Vector2, Vector3};

pub use atlas::{AtlasLine, LineAtlas};

use super::{
    cell::CellId,
    contribution::{Contribution, PlacedBy},
    line::Lines,
    params::FleetParams,
    prepared::PreparedDrive,
};
use crate::geometry::georeference::Georeference;
use fit::{Fit, Sought};
use hypotheses::{Hypothesis, hypotheses, windows};
use placed::{covariance, length_m, placed, stretch_m, worst_sigma_m};

/// Shortest way that is sought, metres: shorter ones of simulated towns were found where they were not.
pub const LEAST_WAY_M: f64 = 500.0;
/// Share of the drive's samples near which the map must have lines.
const LEAST_ON_MAP: f64 = 0.75;
/// Share of those that must lie on one.
const LEAST_EXPLAINED: f64 = 0.9;
/// Greatest median distance of samples from their lines, metres.
const MOST_MEDIAN_M: f64 = 0.2;
/// Share of the lines right beside its way that the drive must have seen.
const LEAST_SHOWN: f64 = 0.6;
/// Greatest standard deviation of the place in its worst direction, metres.
const MOST_SIGMA_M: f64 = 0.8;
/// Turn that the way on the map must make at least, radians.
const LEAST_TURN_RAD: f64 = 0.25;
/// Least logarithm of how much more probable the place is than any other.
const LEAST_MARGIN: f64 = 20.0;
/// Places at which the drive is tried.
const MOST_TRIED: usize = 150;
/// Share of the votes of the first place that the last one tried may have at most: else some as good were not tried.
const CROWDED: f64 = 0.7;
/// Distance between two places that are not the same, metres.
const ANOTHER_PLACE_M: f64 = 1.4;
/// Turn between them, radians.
const ANOTHER_HEADING_RAD: f64 = 0.1;
/// Stretches of road about the best places of which more are tried.
const MOST_STRETCHES: usize = 6;
/// Distance between two of these, metres.
const STRETCH_M: f64 = 30.0;
/// What becomes likely if it is a little farther along, or a lane over, metres.
const ALONG_M: [f64; 10] = [-80.0, -40.0, -20.0, -10.0, -5.0, 5.0, 10.0, 20.0, 40.0, 80.0];
/// The same to the side.
const ACROSS_M: [f64; 6] = [-9.6, -6.4, -3.2, 3.2, 6.4, 9.6];

/// What became of the search.
#[derive(Clone, Debug, PartialEq)]
pub enum Localization {
    /// It lies here and nowhere else.
    Aligned(Box<MapPlace>),
    /// It fits here and there, or along a straight road anywhere.
    NotUnique(Ambiguity),
    /// It fits nowhere.
    NoFit,
    /// It is too short to be sought.
    TooShort,
}

/// Why a place is not the only one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ambiguity {
    /// Its road does not bend, or the same all along.
    Straight,
    /// There is another place that it fits.
    Elsewhere,
}

/// A drive's place on the map.
#[derive(Clone, Debug, PartialEq)]
pub struct MapPlace {
    /// What the drive says there: the stretch that lies on the map, with fixes that the map gives.
    pub contribution: Contribution,
    /// The pose of its frame, 4 degrees of freedom, as right as odometry is rigid.
    pub georeference: Georeference,
    /// Covariance of east and north (m^2) and of the turn (rad^2) at the middle of its way, against the map around it.
    pub covariance: Matrix3<f64>,
    /// Logarithm of how much more probable the place is than the next.
    pub margin: f64,
    /// Way on the map, metres.
    pub way_m: f64,
}

impl MapPlace {
    /// Standard deviation in the worst direction, metres.
    #[must_use]
    pub fn sigma_m(&self) -> f64 {
        worst_sigma_m(&self.covariance)
    }
}

/// A place where the drive fits, more or less.
struct Candidate {
    cell: CellId,
    fit: Fit,
}

/// Finds a drive on the map. Its own fixes, if it has any, are not asked. The same drive and map give the same answer.
#[must_use]
pub fn localize(contribution: &Contribution, atlas: &LineAtlas, params: &FleetParams) -> Localization {
    let contribution = without_fixes(contribution);
    let [first, .., last] = contribution.trajectory.as_slice() else { return Localization::TooShort };
    if last.arc_m - first.arc_m < LEAST_WAY_M {
        return Localization::TooShort;
    }
    let Some(first_cell) = atlas.cells().next() else { return Localization::NoFit };
    let prepared = PreparedDrive::new(&contribution, &first_cell.anchor(), params);
    let sought = Sought::new(&contribution, &prepared, params);
    let windows = windows(sought.lanes());
    if windows.is_empty() {
        return Localization::NotUnique(Ambiguity::Straight);
    }
    let places = hypotheses(&windows, sought.middle(), atlas, MOST_TRIED);
    let crowded = places.len() == MOST_TRIED && places[MOST_TRIED - 1].votes > CROWDED * places[0].votes;
    let mut search = Search { atlas, sought: &sought, areas: BTreeMap::new(), candidates: Vec::new() };
    for place in &places {
        search.try_at(place);
    }
    for likely in search.likeliest() {
        for place in search.beside(likely) {
            search.try_at(&place);
        }
    }
    let Some(best) = search.best() else { return Localization::NoFit };
    let found = &search.candidates[best];
    let Some(stretch) = acceptable(&found.fit, &contribution) else { return Localization::NoFit };
    let margin = search.margin(best);
    if crowded || margin < LEAST_MARGIN {
        return Localization::NotUnique(Ambiguity::Elsewhere);
    }
    match covariance(&found.fit) {
        Some(covariance) if worst_sigma_m(&covariance) <= MOST_SIGMA_M && turns(&contribution, &stretch) => {
            let place = placed(&contribution, &prepared, &found.fit, found.cell, &stretch, covariance, margin);
            Localization::Aligned(Box::new(place))
        }
        _ => Localization::NotUnique(Ambiguity::Straight),
    }
}

fn without_fixes(contribution: &Contribution) -> Contribution {
    let mut without = contribution.clone();
    without.placed_by = PlacedBy::Receiver;
    without.trajectory.iter_mut().for_each(|point| point.fix = None);
    without
}

/// The stretch of the way that lies on the map, where the fit is good enough to be true.
fn acceptable(fit: &Fit, contribution: &Contribution) -> Option<RangeInclusive<f64>> {
    let stretch = stretch_m(&fit.on_line_m)?;
    let whole_m = contribution.trajectory.last().map_or(0.0, |last| last.arc_m);
    let is_good = fit.on_map >= LEAST_ON_MAP
        && fit.explained >= LEAST_EXPLAINED
        && fit.median_m <= MOST_MEDIAN_M
        && fit.shown >= LEAST_SHOWN
        && length_m(&stretch) >= LEAST_ON_MAP * whole_m;
    is_good.then_some(stretch)
}

/// Whether the way turns along a stretch.
fn turns(contribution: &Contribution, stretch: &RangeInclusive<f64>) -> bool {
    let way: Vec<_> = contribution.trajectory.iter().filter(|point| stretch.contains(&point.arc_m)).collect();
    let (mut heading, mut low, mut high) = (0.0_f64, 0.0_f64, 0.0_f64);
    for triple in way.windows(9).step_by(4) {
        let (before, after) =
            ((triple[4].position - triple[0].position).xy(), (triple[8].position - triple[4].position).xy());
        heading += before.perp(&after).atan2(before.dot(&after));
        (low, high) = (low.min(heading), high.max(heading));
    }
    high - low >= LEAST_TURN_RAD
}

/// A search for one drive.
struct Search<'a> {
    atlas: &'a LineAtlas,
    sought: &'a Sought<'a>,
    /// Lines around cells, as they were needed.
    areas: BTreeMap<CellId, Lines>,
    candidates: Vec<Candidate>,
}

impl Search<'_> {
    fn try_at(&mut self, place: &Hypothesis) {
        let (atlas, cell) = (self.atlas, place.cell);
        let lines = self.areas.entry(cell).or_insert_with(|| atlas.around(cell));
        if let Some(fit) = self.sought.fit(place, lines) {
            self.candidates.push(Candidate { cell, fit });
        }
    }

    fn best(&self) -> Option<usize> {
        let score = |index: &usize| self.candidates[*index].fit.score;
        (0..self.candidates.len()).max_by(|a, b| score(a).total_cmp(&score(b)).then(b.cmp(a)))
    }

    /// The best candidates of different stretches of road, the likeliest first.
    fn likeliest(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.candidates.len()).collect();
        order.sort_by(|a, b| self.candidates[*b].fit.score.total_cmp(&self.candidates[*a].fit.score).then(a.cmp(b)));
        let mut chosen: Vec<(usize, Seat)> = Vec::new();
        for candidate in order {
            let seat = self.seat(candidate);
            if chosen.len() < MOST_STRETCHES && chosen.iter().all(|(_, other)| seat.is_apart(other, STRETCH_M, 0.5)) {
                chosen.push((candidate, seat));
            }
        }
        chosen.into_iter().map(|(candidate, _)| candidate).collect()
    }

    /// Places a little farther along the way, and to its sides.
    fn beside(&self, best: usize) -> Vec<Hypothesis> {
        let Candidate { cell, fit } = &self.candidates[best];
        let (arc_m, map) = self.sought.middle();
        let (enu, yaw_rad) = (fit.correction.apply(&map, arc_m), fit.correction.yaw_rad(arc_m));
        let way = &self.sought.contribution.trajectory;
        let at = |arc_m: f64| {
            let after = way.partition_point(|point| point.arc_m < arc_m).clamp(1, way.len() - 1);
            let direction = (way[after].position - way[after - 1].position).xy();
            (way[after].position, direction.y.atan2(direction.x))
        };
        let (here, heading_rad) = at(arc_m);
        let along = ALONG_M.into_iter().map(|step_m| {
            let (there, there_rad) = at(arc_m + step_m);
            // What was here is there, turned as the way turns.
            let turn = there_rad - heading_rad;
            let moved = enu + turned(yaw_rad, &(there - here));
            Hypothesis::at(*cell, yaw_rad + turn, map, moved, arc_m)
        });
        let across = ACROSS_M.into_iter().map(|step_m| {
            let normal = Vector3::new(-heading_rad.sin(), heading_rad.cos(), 0.0);
            Hypothesis::at(*cell, yaw_rad, map, enu + turned(yaw_rad, &(normal * step_m)), arc_m)
        });
        along.chain(across).collect()
    }

    /// Logarithm of how much more probable a place is than any other.
    fn margin(&self, best: usize) -> f64 {
        let best_seat = self.seat(best);
        let is_another = |other: &usize| best_seat.is_apart(&self.seat(*other), ANOTHER_PLACE_M, ANOTHER_HEADING_RAD);
        let others = (0..self.candidates.len()).filter(is_another);
        let score = |index: usize| self.candidates[index].fit.score;
        score(best) - others.map(score).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Where a candidate puts the middle of the drive.
    fn seat(&self, candidate: usize) -> Seat {
        let (arc_m, map) = self.sought.middle();
        let Candidate { cell, fit } = &self.candidates[candidate];
        let place = cell.anchor().wgs84_from_enu(&fit.correction.apply(&map, arc_m));
        let common = self.candidates[0].cell.anchor();
        Seat { place: common.enu_from_wgs84(&place).coords.xy(), yaw_rad: fit.correction.yaw_rad(arc_m) }
    }
}

/// Where the middle of a drive lies, in the frame of the first candidate's cell.
struct Seat {
    place: Vector2<f64>,
    yaw_rad: f64,
}

impl Seat {
    fn is_apart(&self, other: &Self, metres: f64, radians: f64) -> bool {
        (self.place - other.place).norm() > metres || profile::half_turn(self.yaw_rad - other.yaw_rad).abs() > radians
    }
}

fn turned(yaw_rad: f64, step: &Vector3<f64>) -> Vector3<f64> {
    let horizontal = Rotation2::new(yaw_rad) * step.xy();
    Vector3::new(horizontal.x, horizontal.y, step.z)
}

#[cfg(test)]
mod tests;
