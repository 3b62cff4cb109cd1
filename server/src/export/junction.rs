//! Junctions: where lanes lead on, over a crossing on which no line is painted.
//!
//! Ours. A road ends where its lines do. Each lane that is driven to the end of its road leads on to lanes that are driven away
//! from the ends of others, where a vehicle can take them: no farther than [`FARTHEST_M`], ahead, and without turning by more
//! than [`SHARPEST_TURN_RAD`]. Straight on, each lane leads to the one that it faces; a turn leads from the outermost lane of its
//! side to the outermost one. What leads through the end of another lane is left to that lane. Road ends that lanes lead
//! between are one junction; lanes that meet end to end [touch](Joints::touching), and need none.
//!
//! Not guaranteed: that a turn is allowed. A map of lines knows no signs; it knows where a road goes on.

mod joints;

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector2};

pub use self::joints::{Joints, Junction, joints};
use super::{
    map_line::{Cubic, MapLines},
    road::{Border, GapKind, Road, Section, Travel},
};

/// Longest way over a junction, metres.
const FARTHEST_M: f64 = 60.0;
/// Sharpest turn: 125 degrees.
const SHARPEST_TURN_RAD: f64 = 2.18;
/// Turns by less are straight on: 35 degrees.
const STRAIGHT_RAD: f64 = 0.61;
/// How far the chord of a way may lead away from the middle of its two courses: 25 degrees.
const ASKEW_RAD: f64 = 0.44;
/// How far to the side of a lane one lies that goes straight on from it, metres at most.
const MOST_ASIDE_M: f64 = 4.5;
/// Greatest difference in height, metres, at least and per metre of the way.
const LEAST_HEIGHT_M: f64 = 1.0;
const MOST_SLOPE: f64 = 0.15;
/// Ends of lanes that are nearer touch, metres.
const TOUCHING_M: f64 = 0.3;
/// A way that passes the end of another lane by less leads through it, metres.
const THROUGH_M: f64 = 1.5;

/// An end of a road.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RoadEnd {
    /// Index of the road.
    pub road: usize,
    /// Whether it is the one where its reference line ends.
    pub is_last: bool,
}

/// Where a lane leaves its road, or enters it.
#[derive(Clone, Debug)]
pub struct LaneEnd {
    /// The end of its road.
    pub at: RoadEnd,
    /// Its gap in the road's section there.
    pub gap: usize,
    /// Whether it is driven out of its road here.
    pub leaves: bool,
    /// Its borders, seen in the direction in which it is driven.
    pub left: Point3<f64>,
    /// See [`LaneEnd::left`].
    pub right: Point3<f64>,
    /// Unit vector in that direction, in plan.
    pub heading: Vector2<f64>,
}

/// A lane that leads on in another.
#[derive(Clone, Debug)]
pub struct Connection {
    /// The lane that ends.
    pub from: LaneEnd,
    /// The lane that begins.
    pub to: LaneEnd,
}

impl RoadEnd {
    /// The section of a road at this end.
    #[must_use]
    pub fn section(self, roads: &[Road]) -> &Section {
        let sections = &roads[self.road].sections;
        if self.is_last { &sections[sections.len() - 1] } else { &sections[0] }
    }
}

impl LaneEnd {
    fn middle(&self) -> Point3<f64> {
        nalgebra::center(&self.left, &self.right)
    }
}

impl Connection {
    /// Angle of the turn, counter-clockwise.
    fn turn_rad(&self) -> f64 {
        signed_angle(&self.from.heading, &self.to.heading)
    }

    /// The way along the middle of the lanes.
    fn way(&self) -> Cubic {
        turn(self.from.middle(), &self.from.heading, self.to.middle(), &self.to.heading)
    }

    /// How far the second lane lies to the left of where the first one leads straight on, metres.
    fn aside_m(&self) -> f64 {
        let course = (self.from.heading + self.to.heading).normalize();
        course.perp(&(self.to.middle() - self.from.middle()).xy())
    }

    /// Whether a vehicle can drive it.
    fn is_drivable(&self) -> bool {
        let way = self.to.middle() - self.from.middle();
        let (plan, turn_rad) = (way.xy(), self.turn_rad());
        let length_m = plan.norm();
        (TOUCHING_M..=FARTHEST_M).contains(&length_m)
            && turn_rad.abs() <= SHARPEST_TURN_RAD
            && (signed_angle(&self.from.heading, &plan) - 0.5 * turn_rad).abs() <= ASKEW_RAD
            && way.z.abs() <= LEAST_HEIGHT_M + MOST_SLOPE * length_m
    }

    fn touches(&self) -> bool {
        nalgebra::distance(&self.from.middle(), &self.to.middle()) < TOUCHING_M && self.turn_rad().abs() < STRAIGHT_RAD
    }
}

/// The cubic that leaves a place in one direction and enters another in another: nearly an arc. Heights go evenly.
#[must_use]
pub fn turn(start: Point3<f64>, leaving: &Vector2<f64>, end: Point3<f64>, entering: &Vector2<f64>) -> Cubic {
    let way = end - start;
    let turn_rad = signed_angle(leaving, entering).abs();
    // What makes it an arc where the turn is one: 4/3 tan(a/4) of the radius, by the chord of 2 sin(a/2) radii.
    let per_chord = if turn_rad < 1e-3 { 1.0 } else { 2.0 * (turn_rad / 4.0).tan() / (turn_rad / 2.0).sin() };
    let speed_m = way.xy().norm() * per_chord;
    let leaving = (leaving * speed_m).push(way.z);
    let entering = (entering * speed_m).push(way.z);
    Cubic([start.coords, leaving, way * 3.0 - leaving * 2.0 - entering, leaving + entering - way * 2.0])
}

fn signed_angle(from: &Vector2<f64>, to: &Vector2<f64>) -> f64 {
    from.perp(to).atan2(from.dot(to))
}

/// The ends of all lanes that reach the end of their roads.
fn lane_ends(map: &MapLines, roads: &[Road]) -> Vec<LaneEnd> {
    let mut ends = Vec::new();
    for (index, road) in roads.iter().enumerate() {
        for is_last in [false, true] {
            let at = RoadEnd { road: index, is_last };
            let section = at.section(roads);
            let course = map.lines[road.line].tangent(if is_last { section.to } else { section.from });
            let place = |border: &Border| map.lines[border.line].point(if is_last { border.to } else { border.from });
            for (gap, lane) in section.gaps.iter().enumerate().filter(|(_, gap)| gap.kind == GapKind::Lane) {
                let (left, right) = (place(&section.borders[gap]), place(&section.borders[gap + 1]));
                let along = lane.travel == Travel::Along;
                let (left, right, heading) = if along { (left, right, course) } else { (right, left, -course) };
                ends.push(LaneEnd { at, gap, leaves: along == is_last, left, right, heading });
            }
        }
    }
    ends
}

/// Which connections of one road end with another are driven.
fn driven(mut pairs: Vec<Connection>) -> Vec<Connection> {
    let turn_rad = pairs.iter().map(Connection::turn_rad).sum::<f64>() / pairs.len().max(1) as f64;
    if turn_rad.abs() > STRAIGHT_RAD {
        // How far out on the side to which it turns.
        let outermost = |end: &LaneEnd| turn_rad.signum() * end.heading.perp(&end.middle().coords.xy());
        let (from, to) = (|pair: &Connection| outermost(&pair.from), |pair: &Connection| outermost(&pair.to));
        let found = pairs.into_iter().max_by(|a, b| from(a).total_cmp(&from(b)).then(to(a).total_cmp(&to(b))));
        return found.into_iter().collect();
    }
    pairs.retain(|pair| pair.aside_m().abs() <= MOST_ASIDE_M);
    pairs.sort_by(|a, b| a.aside_m().abs().total_cmp(&b.aside_m().abs()));
    // The nearest first; a lane that no other is left for shares one.
    let mut kept: Vec<Connection> = Vec::new();
    for round in 0..2 {
        for pair in &pairs {
            let (has_from, has_to) = (
                kept.iter().any(|other| other.from.gap == pair.from.gap),
                kept.iter().any(|other| other.to.gap == pair.to.gap),
            );
            if (round == 0 && !has_from && !has_to) || (round == 1 && has_from != has_to) {
                kept.push(pair.clone());
            }
        }
    }
    kept
}

/// Drops what leads through the end of another lane that the same lane leads to, or that leads to the same lane.
fn without_detours(mut found: Vec<Connection>) -> Vec<Connection> {
    let length_m = |connection: &Connection| (connection.to.middle() - connection.from.middle()).norm();
    found.sort_by(|a, b| length_m(a).total_cmp(&length_m(b)));
    let mut kept: Vec<Connection> = Vec::new();
    let mut by_end: BTreeMap<RoadEnd, Vec<usize>> = BTreeMap::new();
    for connection in found {
        let way = connection.way();
        let passes = |end: &LaneEnd| {
            (1..20).map(|step| f64::from(step) / 20.0).any(|u| {
                let apart = end.middle() - way.point(u);
                let course = way.derivative(u).xy().normalize();
                apart.norm() < THROUGH_M && course.dot(&end.heading) > 0.7
            })
        };
        let others = |end: &RoadEnd| by_end.get(end).into_iter().flatten().map(|index| &kept[*index]);
        let is_detour = others(&connection.from.at).any(|other| other.to.at != connection.to.at && passes(&other.to))
            || others(&connection.to.at).any(|other| other.from.at != connection.from.at && passes(&other.from));
        if !is_detour {
            by_end.entry(connection.from.at).or_default().push(kept.len());
            by_end.entry(connection.to.at).or_default().push(kept.len());
            kept.push(connection);
        }
    }
    kept
}
