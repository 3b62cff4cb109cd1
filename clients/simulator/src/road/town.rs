//! A town: streets on a disturbed grid, avenues, a boulevard, roundabouts, and a motorway past it with ramps.
//!
//! Streets run from west to east and from south to north, each with its own number of lanes, width and marking over its
//! whole length: most have a lane each way, every third is an avenue of two, the middle one from south to north a
//! boulevard of three. Lines end at junctions, [`network::MOUTH_M`](super::network::MOUTH_M) before their middle, and begin anew
//! behind them. Some junctions are [roundabouts](roundabout); north of the town runs a [motorway](motorway). The origin
//! is the middle of the grid.

mod grid;
pub mod motorway;
pub mod roundabout;

use super::{RoadNetwork, Terrain};
use crate::random::{Purpose, Seed};

/// What kind of town to build.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TownPlan {
    /// Junctions from west to east, at least 3.
    pub columns: u16,
    /// Junctions from south to north, at least 2.
    pub rows: u16,
    /// Distance between neighbouring junctions, metres.
    pub spacing_m: f64,
    /// Share of the junctions, of those with room for one, that are roundabouts.
    pub roundabout_share: f64,
    /// Share of the streets whose middle is a double line: two lines a quarter of a metre apart.
    pub double_line_share: f64,
    /// Whether a motorway runs past the town.
    pub motorway: bool,
}

/// How far north of the town the motorway runs, metres.
const MOTORWAY_NORTH_M: f64 = 330.0;
/// Distance between junctions of a large town, metres.
const SPACING_M: f64 = 400.0;

impl TownPlan {
    /// A town with its motorway on a square of this size, km: 3.2 for about 10 km^2 and 65 km of road.
    #[must_use]
    pub fn square_km(size_km: f64) -> Self {
        let junctions = |length_m: f64| u16::try_from(crate::count_of(length_m / SPACING_M)).unwrap_or(u16::MAX) + 1;
        Self {
            columns: junctions(size_km * 1e3).max(3),
            rows: junctions(size_km * 1e3 - MOTORWAY_NORTH_M).max(2),
            spacing_m: SPACING_M,
            roundabout_share: 0.25,
            double_line_share: 0.25,
            motorway: true,
        }
    }

    /// A town of five by three junctions with its motorway, on about 1.6 by 1.1 km: for tests.
    #[must_use]
    pub fn small() -> Self {
        Self { columns: 5, rows: 3, roundabout_share: 0.4, ..Self::square_km(1.6) }
    }

    /// Builds the town on land nowhere steeper than `max_grade`.
    #[must_use]
    pub fn build(&self, max_grade: f64, seed: Seed) -> RoadNetwork {
        let mut network = RoadNetwork::on(Terrain::random(max_grade, &mut seed.stream(Purpose::Terrain, 0)));
        let rng = &mut seed.stream(Purpose::Network, 0);
        let plan = Self { columns: self.columns.max(3), rows: self.rows.max(2), ..*self };
        let corners = grid::build(&plan, &mut network, rng);
        if plan.motorway {
            motorway::build(&plan, &corners, &mut network, rng);
        }
        network
    }
}

#[cfg(test)]
mod tests;
