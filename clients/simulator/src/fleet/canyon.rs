//! Street canyons: places among tall buildings where GNSS jumps.
//!
//! A canyon is a disc in plan about a place on a street, the same for all drives of a fleet.

use nalgebra::Point2;

use crate::{
    random::{SimRng, happens, uniform},
    road::{LinkKind, RoadNetwork},
};

/// A place where GNSS is spoilt.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Canyon {
    /// Its middle, world frame, metres.
    pub place: Point2<f64>,
    /// Its radius, metres.
    pub radius_m: f64,
}

impl Canyon {
    /// Whether a place in plan lies in it.
    #[must_use]
    pub fn holds(&self, place: &Point2<f64>) -> bool {
        (place - self.place).norm_squared() < self.radius_m.powi(2)
    }

    /// Canyons of 20 to 35 m radius (drives of 40 to 70 m) on about a share of the streets, one each.
    pub(crate) fn scatter(network: &RoadNetwork, share: f64, rng: &mut SimRng) -> Vec<Self> {
        let streets = network.links().iter().filter(|link| link.kind == LinkKind::Street);
        let drawn = streets.map(|link| {
            let (here, at, radius_m) = (happens(rng, share), uniform(rng, 0.3, 0.7), uniform(rng, 20.0, 35.0));
            let points = link.reference.points();
            here.then(|| Self { place: points[crate::count_of(at * points.len() as f64)], radius_m })
        });
        drawn.flatten().collect()
    }
}
