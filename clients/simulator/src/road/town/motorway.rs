//! A motorway: two carriageways of three lanes north of the town, joined to it at both ends and by ramps between.
//!
//! Each carriageway is one road over its whole length; its lines run on where its links change. Before a ramp leaves an
//! extra lane opens on the right and becomes the ramp: the edge line goes with the ramp, the dashed line beside the extra
//! lane ends at the nose, and from there the carriageway has a new edge line (a split). Where a ramp joins it is the mirror
//! image (a merge). The eastbound carriageway has ramps to junctions of the town, the westbound one a rest area.

use lanemap_core::Category;
use nalgebra::{Point2, Rotation2, Vector2};

use super::{
    MOTORWAY_NORTH_M, TownPlan,
    grid::{End, NorthernRow, Street},
};
use crate::{
    random::{SimRng, uniform},
    road::{
        Link, LinkKind, ReferenceLine, RoadLineId, RoadNetwork,
        cross_section::{Carriageway, smooth_step},
        network::MOUTH_M,
        reference_line::Bends,
    },
};

/// Width of a lane, metres.
pub const LANE_M: f64 = 3.75;
/// Lanes of a carriageway.
const LANES: u8 = 3;
/// Half the width of the space between the carriageways, metres.
const HALF_MEDIAN_M: f64 = 3.0;
/// How far from the terminal's middle the carriageways begin and end, metres.
const TERMINAL_MOUTH_M: f64 = 60.0;
/// How far from the terminal's middle the road to the town begins, metres.
const TERMINAL_ROAD_MOUTH_M: f64 = 30.0;
/// Length of an extra lane before a ramp leaves, and after one joins, metres.
const EXTRA_M: f64 = 250.0;
/// Length over which it opens or closes, metres.
const TAPER_M: f64 = 60.0;
/// How far before and behind a junction its ramps leave and join, metres.
const RAMP_REACH_M: f64 = 330.0;
/// Least distance between two junctions with ramps, metres.
const RAMPS_APART_M: f64 = 1_400.0;
/// How far the rest area lies beside its carriageway, metres.
const REST_AREA_M: f64 = 45.0;
/// Two lines are painted apart once there is so much between them, metres.
const NOSE_M: f64 = 0.25;

/// A ramp on its way from or to a carriageway.
#[derive(Clone, Debug)]
struct Ramp {
    /// Index of the carriageway's reference point where it leaves or joins.
    at: usize,
    /// Whether it leaves (or joins).
    leaves: bool,
    /// Its left border; its lane lies to the right of it.
    reference: ReferenceLine,
    /// The junction at its other end; a rest area's ramp is of one piece and has none.
    junction: Option<usize>,
}

pub(super) fn build(plan: &TownPlan, row: &NorthernRow, network: &mut RoadNetwork, rng: &mut SimRng) {
    let [west, .., east] = row.as_slice() else { return };
    let north_m = row.iter().map(|(_, place)| place.y).fold(f64::NEG_INFINITY, f64::max) + MOTORWAY_NORTH_M;
    let terminals = [Point2::new(west.1.x - 60.0, north_m), Point2::new(east.1.x + 60.0, north_m)];
    let junctions = terminals.map(|place| network.add_junction(place));
    for (corner, (place, junction)) in [west, east].into_iter().zip(terminals.into_iter().zip(junctions)) {
        let street = Street::painted(2, plan.double_line_share, rng);
        let from = End { junction: corner.0, place: corner.1, mouth_m: MOUTH_M };
        street.lay(network, from, End { junction, place, mouth_m: TERMINAL_ROAD_MOUTH_M }, rng);
    }
    let mouth = Vector2::x() * TERMINAL_MOUTH_M;
    let bends = Bends {
        amplitude_m: uniform(rng, 20.0, 35.0),
        waves: 1.0,
        phase_rad: uniform(rng, 0.0, std::f64::consts::TAU),
        min_radius_m: 700.0,
    };
    let centre = ReferenceLine::between(terminals[0] + mouth, terminals[1] - mouth, &bends);
    let eastbound = ReferenceLine::through(&centre.offset_line(|_| Some(-HALF_MEDIAN_M)));
    let westbound = {
        let mut places = centre.offset_line(|_| Some(HALF_MEDIAN_M));
        places.reverse();
        ReferenceLine::through(&places)
    };
    let ramps = town_ramps(&eastbound, row);
    carriageway(network, &eastbound, junctions[0], junctions[1], &ramps);
    let ramps = rest_area(&westbound);
    carriageway(network, &westbound, junctions[1], junctions[0], &ramps);
}

/// The offset of a carriageway's right edge, metres to the left.
fn edge_m() -> f64 {
    -LANE_M * f64::from(LANES)
}

/// Ramps from and to the junctions of the town's northernmost row, as many as there is room for.
fn town_ramps(carriageway: &ReferenceLine, row: &NorthernRow) -> Vec<Ramp> {
    let mut ramps: Vec<Ramp> = Vec::new();
    let mut last_x_m = f64::NEG_INFINITY;
    let room_m = RAMP_REACH_M + EXTRA_M;
    let (first_m, end_m) = (carriageway.points()[0].x, carriageway.points()[carriageway.len() - 1].x);
    for (junction, place) in row {
        if place.x - first_m < room_m || end_m - place.x < room_m || place.x - last_x_m < RAMPS_APART_M {
            continue;
        }
        last_x_m = place.x;
        let at = |x_m: f64| carriageway.points().partition_point(|point| point.x < x_m);
        let (leave, join) = (at(place.x - RAMP_REACH_M), at(place.x + RAMP_REACH_M));
        let border = |index: usize| (carriageway.offset_point(index, edge_m()), carriageway.headings_rad()[index]);
        // Half a lane to the left of the lane's centre, as the vehicle comes (or goes).
        let (from_rad, to_rad) = (125_f64.to_radians(), 55_f64.to_radians());
        let mouth = |angle_rad: f64, left_rad: f64| {
            place + direction(angle_rad) * (MOUTH_M + 6.0) + direction(left_rad) * (0.5 * LANE_M)
        };
        let (quarter, half) = (std::f64::consts::FRAC_PI_2, std::f64::consts::PI);
        let arrival = (mouth(from_rad, from_rad + half + quarter), from_rad + half);
        ramps.push(Ramp {
            at: leave,
            leaves: true,
            reference: ramp_curve(border(leave), arrival),
            junction: Some(*junction),
        });
        let departure = (mouth(to_rad, to_rad + quarter), to_rad);
        ramps.push(Ramp {
            at: join,
            leaves: false,
            reference: ramp_curve(departure, border(join)),
            junction: Some(*junction),
        });
    }
    ramps
}

/// The two ends of a rest area half way along a carriageway; both have the whole of its road.
fn rest_area(carriageway: &ReferenceLine) -> Vec<Ramp> {
    let middle = carriageway.len() / 2;
    if middle < 400 + crate::count_of(EXTRA_M) {
        return Vec::new();
    }
    let (leave, join) = (middle - 400, middle + 400);
    let length = (join - leave) as f64;
    let aside_m = |k: usize| {
        let way = (k - leave) as f64;
        REST_AREA_M * smooth_step(way / 280.0).min(smooth_step((length - way) / 280.0))
    };
    let places: Vec<_> = (leave..=join).map(|k| carriageway.offset_point(k, edge_m() - aside_m(k))).collect();
    let reference = ReferenceLine::through(&places);
    let ramp = |at, leaves| Ramp { at, leaves, reference: reference.clone(), junction: None };
    vec![ramp(leave, true), ramp(join, false)]
}

/// Adds a carriageway with its ramps, which are in the order in which they come.
fn carriageway(network: &mut RoadNetwork, reference: &ReferenceLine, from: usize, to: usize, ramps: &[Ramp]) {
    let mut lines = vec![network.add_line(Category::YellowSolid, &offset(reference, 0..reference.len(), |_| 0.0))];
    for lane in 1..LANES {
        let offset_m = -LANE_M * f64::from(lane);
        lines.push(network.add_line(Category::WhiteDashed, &offset(reference, 0..reference.len(), |_| offset_m)));
    }
    let noses: Vec<usize> =
        ramps.iter().map(|ramp| network.add_junction(reference.offset_point(ramp.at, edge_m()))).collect();
    let edges = EdgeLines::paint(network, reference, ramps);
    lines.extend(&edges.carriageway);

    let mut start = (from, 0, false);
    let ends = noses.iter().zip(ramps).map(|(nose, ramp)| (*nose, ramp.at, Some(ramp)));
    for (junction, at, ramp) in ends.chain([(to, reference.len() - 1, None)]) {
        network.add_link(Link {
            from: start.0,
            to: junction,
            reference: reference.slice(start.1..at + 1),
            carriageway: Carriageway::OneWay { lanes: LANES },
            lane_width_m: LANE_M,
            kind: LinkKind::Motorway { ramp_joins: start.2, ramp_leaves: ramp.is_some_and(|ramp| ramp.leaves) },
            lines: lines.clone(),
        });
        start = (junction, at, ramp.is_some_and(|ramp| !ramp.leaves));
    }
    for (index, ramp) in ramps.iter().enumerate() {
        let (from, to) = match (ramp.junction, ramp.leaves) {
            (Some(junction), true) => (noses[index], junction),
            (Some(junction), false) => (junction, noses[index]),
            (None, true) => (noses[index], noses[index + 1]),
            (None, false) => continue,
        };
        network.add_link(Link {
            from,
            to,
            reference: ramp.reference.clone(),
            carriageway: Carriageway::OneWay { lanes: 1 },
            lane_width_m: LANE_M,
            kind: LinkKind::Ramp,
            lines: edges.ramps[index].clone(),
        });
    }
}

/// The lines along the right edge of a carriageway and along its ramps.
#[derive(Debug, Default)]
struct EdgeLines {
    carriageway: Vec<RoadLineId>,
    ramps: Vec<Vec<RoadLineId>>,
}

impl EdgeLines {
    fn paint(network: &mut RoadNetwork, reference: &ReferenceLine, ramps: &[Ramp]) -> Self {
        let mut painted = Self { carriageway: Vec::new(), ramps: vec![Vec::new(); ramps.len()] };
        // The edge line being drawn: what it has so far, where it goes on, and the ramp from which it came.
        let (mut edge, mut from, mut came_from): (Vec<Point2<f64>>, usize, Option<usize>) = (Vec::new(), 0, None);
        // That which goes round a rest area, until it is back.
        let mut round: Option<Vec<Point2<f64>>> = None;
        for (index, ramp) in ramps.iter().enumerate() {
            let opened = came_from.map(|before: usize| ramps[before].at);
            let opens = ramp.leaves.then_some(ramp.at);
            let widened = |k: usize| edge_m() - LANE_M * openness(k, opened, opens);
            edge.extend(offset(reference, from..ramp.at + 1, widened));
            let last = ramp.reference.len() - 1;
            let outer = |points| offset(&ramp.reference, points, |_| -LANE_M);
            let (at, extra) = (ramp.at, crate::count_of(EXTRA_M));
            let dashes = if ramp.leaves { opening(at - extra, at, true) } else { opening(at, at + extra, false) };
            let done = std::mem::take(&mut edge);
            match (ramp.leaves, ramp.junction) {
                (true, None) => round = Some([done, outer(1..last)].concat()),
                (true, Some(_)) => {
                    let line = painted.edge(network, &[done, outer(1..last + 1)].concat(), came_from, ramps);
                    painted.ramps[index].push(line);
                }
                (false, _) => {
                    painted.edge(network, &done, came_from, ramps);
                    edge = round.take().unwrap_or_else(|| outer(0..last));
                }
            }
            (from, came_from) = (at, (!ramp.leaves).then_some(index));
            painted.carriageway.push(network.add_line(Category::WhiteDashed, &offset(reference, dashes, |_| edge_m())));
            // A rest area's one road is painted with its first ramp.
            if ramp.junction.is_some() || ramp.leaves {
                let inner = offset(&ramp.reference, 0..last + 1, |_| 0.0);
                let apart = apart_from(reference, &inner);
                painted.ramps[index].push(network.add_line(Category::YellowSolid, &inner[apart]));
            }
        }
        let opened = came_from.map(|before| ramps[before].at);
        edge.extend(offset(reference, from..reference.len(), |k| edge_m() - LANE_M * openness(k, opened, None)));
        painted.edge(network, &edge, came_from, ramps);
        painted
    }

    /// Adds an edge line of the carriageway, and of the ramp from which it came.
    fn edge(
        &mut self,
        network: &mut RoadNetwork,
        places: &[Point2<f64>],
        came_from: Option<usize>,
        ramps: &[Ramp],
    ) -> RoadLineId {
        let line = network.add_line(Category::WhiteSolid, places);
        self.carriageway.push(line);
        if let Some(ramp) = came_from {
            // A rest area's one road is the link of its first ramp.
            self.ramps[if ramps[ramp].junction.is_some() { ramp } else { ramp - 1 }].push(line);
        }
        line
    }
}

/// How far the extra lane is open at a point: behind a ramp that joined, and before one that leaves.
fn openness(k: usize, joined: Option<usize>, leaves: Option<usize>) -> f64 {
    let closing = joined.map_or(0.0, |at| smooth_step((at as f64 + EXTRA_M - k as f64) / TAPER_M));
    let opening = leaves.map_or(0.0, |at| smooth_step((k as f64 - at as f64 + EXTRA_M) / TAPER_M));
    closing.max(opening)
}

/// Where there is enough of the extra lane between two points for a dashed line beside it.
fn opening(from: usize, to: usize, leaves: bool) -> std::ops::Range<usize> {
    let thin = (0..crate::count_of(TAPER_M)).filter(|k| smooth_step(*k as f64 / TAPER_M) * LANE_M < NOSE_M).count();
    if leaves { from + thin..to + 1 } else { from..to + 1 - thin }
}

/// Those of the places of a ramp's left border that lie apart from the carriageway's edge.
fn apart_from(carriageway: &ReferenceLine, border: &[Point2<f64>]) -> std::ops::Range<usize> {
    let is_apart = |place: &Point2<f64>| {
        let distances = carriageway.points().iter().map(|point| (point - place).norm_squared());
        let nearest = distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(index, _)| index);
        let heading_rad = carriageway.headings_rad()[nearest];
        let left = direction(heading_rad + std::f64::consts::FRAC_PI_2);
        (place - carriageway.points()[nearest]).dot(&left) < edge_m() - NOSE_M
    };
    let first = border.iter().position(is_apart).unwrap_or(0);
    let last = border.iter().rposition(is_apart).map_or(border.len(), |index| index + 1);
    first..last
}

fn offset(
    reference: &ReferenceLine,
    points: std::ops::Range<usize>,
    offset_m: impl Fn(usize) -> f64,
) -> Vec<Point2<f64>> {
    points.map(|k| reference.offset_point(k, offset_m(k))).collect()
}

fn direction(angle_rad: f64) -> Vector2<f64> {
    Rotation2::new(angle_rad) * Vector2::x()
}

/// A cubic from a place and heading to another, with handles of two fifths of the way.
fn ramp_curve((from, from_rad): (Point2<f64>, f64), (to, to_rad): (Point2<f64>, f64)) -> ReferenceLine {
    let handle_m = 0.4 * (to - from).norm();
    let controls = [from, from + direction(from_rad) * handle_m, to - direction(to_rad) * handle_m, to];
    let samples = 4 * crate::count_of((to - from).norm()).max(8);
    let dense: Vec<_> = (0..=samples)
        .map(|k| {
            let t = k as f64 / samples as f64;
            let weights = [(1.0 - t).powi(3), 3.0 * t * (1.0 - t).powi(2), 3.0 * t * t * (1.0 - t), t.powi(3)];
            Point2::from(
                controls.iter().zip(weights).map(|(point, weight)| point.coords * weight).sum::<Vector2<f64>>(),
            )
        })
        .collect();
    ReferenceLine::through(&dense)
}
