//! Which network to build: a town's grid, or one long road.

use nalgebra::{Point2, Vector2};

use crate::{
    random::{SimRng, choose, uniform},
    road::{cross_section::Carriageway, reference_line::Bends},
};

/// The shape of a road network, before chance has its say.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NetworkPlan {
    /// Junctions on a disturbed grid, two-way roads of one or two lanes each way between them.
    Grid {
        /// Junctions from west to east, at least 2.
        columns: u16,
        /// Junctions from south to north, at least 2.
        rows: u16,
        /// Mean distance between neighbouring junctions, metres.
        spacing_m: f64,
    },
    /// One road of one-way carriageways, with a junction about every 900 m.
    Chain {
        /// Length, metres.
        length_m: f64,
    },
}

/// A link to be built between two junctions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlannedLink {
    pub from: usize,
    pub to: usize,
    pub carriageway: Carriageway,
    pub bends: Bends,
}

/// Half the shift of a grid's junction from its place, as a share of the spacing.
const GRID_DISTURBANCE: f64 = 0.12;
/// Mean distance between the junctions of a chain, metres.
const CHAIN_SPACING_M: f64 = 900.0;
/// Largest turn of a chain at a junction, radians.
const CHAIN_TURN_RAD: f64 = 0.35;

impl NetworkPlan {
    /// Places the junctions and chooses the links.
    pub(crate) fn place(&self, rng: &mut SimRng) -> (Vec<Point2<f64>>, Vec<PlannedLink>) {
        match *self {
            Self::Grid { columns, rows, spacing_m } => place_grid(columns.max(2), rows.max(2), spacing_m, rng),
            Self::Chain { length_m } => place_chain(length_m, rng),
        }
    }
}

fn place_grid(columns: u16, rows: u16, spacing_m: f64, rng: &mut SimRng) -> (Vec<Point2<f64>>, Vec<PlannedLink>) {
    let mut junctions = Vec::new();
    for row in 0..rows {
        for column in 0..columns {
            let mut disturbed = |cell: u16| (f64::from(cell) + uniform(rng, -1.0, 1.0) * GRID_DISTURBANCE) * spacing_m;
            junctions.push(Point2::new(disturbed(column), disturbed(row)));
        }
    }
    let (columns, rows) = (usize::from(columns), usize::from(rows));
    let mut links = Vec::new();
    for row in 0..rows {
        for column in 0..columns {
            let here = row * columns + column;
            let east = (column + 1 < columns).then_some(here + 1);
            let north = (row + 1 < rows).then_some(here + columns);
            for to in [east, north].into_iter().flatten() {
                let lanes_each = if choose(rng, 3) == 0 { 1 } else { 2 };
                let carriageway = Carriageway::TwoWay { lanes_each };
                links.push(PlannedLink { from: here, to, carriageway, bends: bends(rng, 70.0) });
            }
        }
    }
    (junctions, links)
}

fn place_chain(length_m: f64, rng: &mut SimRng) -> (Vec<Point2<f64>>, Vec<PlannedLink>) {
    let mut heading_rad = uniform(rng, -0.5, 0.5);
    let mut junctions = vec![Point2::origin()];
    let mut links = Vec::new();
    let mut left_m = length_m;
    while left_m > 0.0 {
        let spacing_m = uniform(rng, 0.8, 1.2) * CHAIN_SPACING_M;
        heading_rad = (heading_rad + uniform(rng, -1.0, 1.0) * CHAIN_TURN_RAD).clamp(-1.2, 1.2);
        let from = junctions.len() - 1;
        junctions.push(junctions[from] + Vector2::new(heading_rad.cos(), heading_rad.sin()) * spacing_m);
        let lanes = if choose(rng, 2) == 0 { 2 } else { 3 };
        links.push(PlannedLink {
            from,
            to: from + 1,
            carriageway: Carriageway::OneWay { lanes },
            bends: bends(rng, 160.0),
        });
        left_m -= spacing_m;
    }
    (junctions, links)
}

fn bends(rng: &mut SimRng, min_radius_m: f64) -> Bends {
    Bends {
        amplitude_m: uniform(rng, 0.0, 45.0),
        waves: uniform(rng, 0.4, 1.6),
        phase_rad: uniform(rng, 0.0, std::f64::consts::TAU),
        min_radius_m,
    }
}
