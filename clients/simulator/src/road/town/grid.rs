//! The streets of a town and their junctions.

use lanemap_core::Category;
use nalgebra::{Point2, Vector2};

use super::{TownPlan, roundabout::Roundabout};
use crate::{
    random::{SimRng, choose, happens, uniform},
    road::{
        Link, LinkKind, ReferenceLine, RoadNetwork,
        cross_section::{Carriageway, PaintedLine},
        marking::{CentreLine, Edge, Marking, mark},
        network::MOUTH_M,
        reference_line::Bends,
    },
};

/// Half the shift of a junction from its place, as a share of the spacing.
const DISTURBANCE: f64 = 0.06;
/// Widest swing of a street to either side, metres.
const SWING_M: f64 = 16.0;
/// Tightest bend of a street, metres.
const MIN_RADIUS_M: f64 = 90.0;

/// A street over its whole length.
#[derive(Clone, Copy, Debug)]
pub(super) struct Street {
    lanes_each: u8,
    lane_width_m: f64,
    marking: Marking,
}

impl Street {
    /// A street of so many lanes each way, painted by chance.
    pub(super) fn painted(lanes_each: u8, double_line_share: f64, rng: &mut SimRng) -> Self {
        let single = [Category::YellowDashed, Category::YellowSolid, Category::DoubleYellowSolid];
        let double = happens(rng, double_line_share);
        let category = if lanes_each == 1 { single[choose(rng, 2)] } else { single[choose(rng, single.len())] };
        let centre = if double { CentreLine::Double } else { CentreLine::Single(category) };
        let edge = [Edge::Line, Edge::Curb, Edge::LineAndCurb][choose(rng, 3)];
        let lane_width_m = if lanes_each == 2 { 3.5 } else { 3.25 };
        Self { lanes_each, lane_width_m, marking: Marking { centre, edge } }
    }

    fn half_width_m(&self) -> f64 {
        f64::from(self.lanes_each) * self.lane_width_m
    }

    /// Adds the street from one place to another.
    pub(super) fn lay(&self, network: &mut RoadNetwork, from: End, to: End, rng: &mut SimRng) {
        let bends = Bends {
            amplitude_m: uniform(rng, 0.0, SWING_M),
            waves: uniform(rng, 0.5, 1.2),
            phase_rad: uniform(rng, 0.0, std::f64::consts::TAU),
            min_radius_m: MIN_RADIUS_M,
        };
        let along = (to.place - from.place).normalize();
        let (start, end) = (from.place + along * from.mouth_m, to.place - along * to.mouth_m);
        let reference = ReferenceLine::between(start, end, &bends);
        let carriageway = Carriageway::TwoWay { lanes_each: self.lanes_each };
        let painted = mark(carriageway, self.lane_width_m, reference.length_m(), &self.marking);
        let places = |line: &PaintedLine| reference.offset_line(|s_m| line.offset_at_m(s_m));
        let lines = painted.iter().map(|line| network.add_line(line.category, &places(line))).collect();
        network.add_link(Link {
            from: from.junction,
            to: to.junction,
            carriageway,
            lane_width_m: self.lane_width_m,
            kind: LinkKind::Street,
            lines,
            reference,
        });
    }
}

/// Where a street begins or ends.
#[derive(Clone, Copy, Debug)]
pub(super) struct End {
    pub(super) junction: usize,
    /// Middle of the junction.
    pub(super) place: Point2<f64>,
    /// Distance from there at which the street's lines begin.
    pub(super) mouth_m: f64,
}

/// The junctions of the northernmost row, from west to east, to which the motorway is joined.
pub(super) type NorthernRow = Vec<(usize, Point2<f64>)>;

pub(super) fn build(plan: &TownPlan, network: &mut RoadNetwork, rng: &mut SimRng) -> NorthernRow {
    let (columns, rows) = (usize::from(plan.columns), usize::from(plan.rows));
    let places = places(plan, rng);
    let mut junctions = Vec::new();
    for (index, place) in places.iter().enumerate() {
        let (column, row) = (index % columns, index / columns);
        let arms = [column > 0, column + 1 < columns, row > 0, row + 1 < rows].into_iter().filter(|arm| *arm).count();
        let has_room = arms > 2 && column != columns / 2 && row + 1 < rows;
        let is_ring = has_room & happens(rng, plan.roundabout_share);
        junctions.push(if is_ring {
            GridJunction::Ring(Roundabout::new(*place))
        } else {
            GridJunction::Crossing(network.add_junction(*place))
        });
    }
    let street = |index: usize, rng: &mut SimRng| {
        Street::painted(if index % 3 == 1 { 2 } else { 1 }, plan.double_line_share, rng)
    };
    let eastward: Vec<Street> = (0..rows).map(|row| street(row, rng)).collect();
    let northward: Vec<Street> =
        (0..columns)
            .map(|column| {
                if column == columns / 2 {
                    Street::painted(3, plan.double_line_share, rng)
                } else {
                    street(column, rng)
                }
            })
            .collect();
    for here in 0..places.len() {
        let (column, row) = (here % columns, here / columns);
        let east = (column + 1 < columns).then_some((here + 1, eastward[row]));
        let north = (row + 1 < rows).then_some((here + columns, northward[column]));
        for (there, street) in [east, north].into_iter().flatten() {
            let from = junctions[here].end(places[here], places[there] - places[here], &street, network);
            let to = junctions[there].end(places[there], places[here] - places[there], &street, network);
            street.lay(network, from, to, rng);
        }
    }
    for junction in &junctions {
        if let GridJunction::Ring(ring) = junction {
            ring.build(network);
        }
    }
    let last_row = (rows - 1) * columns;
    (last_row..last_row + columns)
        .filter_map(|index| match &junctions[index] {
            GridJunction::Crossing(junction) => Some((*junction, places[index])),
            GridJunction::Ring(_) => None,
        })
        .collect()
}

#[derive(Debug)]
enum GridJunction {
    Crossing(usize),
    Ring(Roundabout),
}

impl GridJunction {
    /// The end of a street that leaves in a direction.
    fn end(&mut self, place: Point2<f64>, direction: Vector2<f64>, street: &Street, network: &mut RoadNetwork) -> End {
        match self {
            Self::Crossing(junction) => End { junction: *junction, place, mouth_m: MOUTH_M },
            Self::Ring(ring) => {
                let junction = ring.add_arm(direction, street.half_width_m(), network);
                End { junction, place, mouth_m: Roundabout::MOUTH_M }
            }
        }
    }
}

fn places(plan: &TownPlan, rng: &mut SimRng) -> Vec<Point2<f64>> {
    let middle = |count: u16| 0.5 * f64::from(count - 1);
    let mut places = Vec::new();
    for row in 0..plan.rows {
        for column in 0..plan.columns {
            let mut at = |cell: u16, count: u16| {
                (f64::from(cell) - middle(count) + uniform(rng, -1.0, 1.0) * DISTURBANCE) * plan.spacing_m
            };
            places.push(Point2::new(at(column, plan.columns), at(row, plan.rows)));
        }
    }
    places
}
