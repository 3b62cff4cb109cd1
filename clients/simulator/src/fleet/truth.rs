//! The true map of a fleet's world at one time.

use lanemap_core::{
    Category,
    geometry::georeference::{Georeference, Wgs84},
};
use nalgebra::Point3;

use crate::road::RoadLineId;

/// A line that is truly there, or one of the pieces into which a change has cut it.
#[derive(Clone, Debug, PartialEq)]
pub struct FleetTrueLine {
    /// The painted line: the same at all times, and for all its pieces.
    pub line: RoadLineId,
    /// Kind, as seen in the direction of the points.
    pub category: Category,
    /// Points about one metre apart, metres east, north, up of the fleet's anchor.
    pub points: Vec<Point3<f64>>,
}

/// Every line that is truly there at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct FleetTruth {
    /// The lines, in the order of their numbers; pieces of one line in its direction.
    pub lines: Vec<FleetTrueLine>,
}

impl FleetTrueLine {
    /// The points on the earth.
    #[must_use]
    pub fn points_wgs84(&self, on_earth: &Georeference) -> Vec<Wgs84> {
        self.points.iter().map(|point| on_earth.to_wgs84(point)).collect()
    }

    /// Length, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.points.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum()
    }
}
