//! Roundabouts: a ring of one lane, driven counter-clockwise, between the arms of a junction.
//!
//! The ring's reference line is the inner curb, a circle of radius [`INNER_RADIUS_M`]; its lane lies outside of it. Each
//! arm has a junction of its own on the ring. From arm to arm runs a link, shortened by [`APPROACH_RAD`] at both ends to
//! leave room for the curves by which vehicles come in and go out. The outer edge is drawn between the arms.

use std::f64::consts::TAU;

use lanemap_core::Category;
use nalgebra::{Point2, Vector2};

use crate::road::{Link, LinkKind, ReferenceLine, RoadNetwork, cross_section::Carriageway};

/// Radius of the inner curb, metres.
pub const INNER_RADIUS_M: f64 = 12.0;
/// Width of the ring's lane, metres.
pub const RING_WIDTH_M: f64 = 5.5;
/// Angle between an arm and the links of the ring beside it, radians.
const APPROACH_RAD: f64 = 0.6;
/// Space between the edge of an arm and the outer edge of the ring, metres.
const CORNER_M: f64 = 2.0;

/// A roundabout whose arms are being added.
#[derive(Clone, Debug)]
pub struct Roundabout {
    centre: Point2<f64>,
    arms: Vec<Arm>,
}

#[derive(Clone, Copy, Debug)]
struct Arm {
    junction: usize,
    angle_rad: f64,
    half_width_m: f64,
}

impl Roundabout {
    /// Distance from the centre at which the lines of the arms begin, metres.
    pub const MOUTH_M: f64 = INNER_RADIUS_M + RING_WIDTH_M + 9.0;

    /// A roundabout without arms.
    pub(super) fn new(centre: Point2<f64>) -> Self {
        Self { centre, arms: Vec::new() }
    }

    /// Adds an arm that leaves in a direction; gives its junction.
    pub(super) fn add_arm(&mut self, direction: Vector2<f64>, half_width_m: f64, network: &mut RoadNetwork) -> usize {
        let angle_rad = direction.y.atan2(direction.x);
        let junction = network.add_junction(self.at(angle_rad, INNER_RADIUS_M + 0.5 * RING_WIDTH_M));
        self.arms.push(Arm { junction, angle_rad, half_width_m });
        junction
    }

    /// Adds the ring.
    pub(super) fn build(&self, network: &mut RoadNetwork) {
        let mut arms = self.arms.clone();
        arms.sort_by(|a, b| a.angle_rad.total_cmp(&b.angle_rad));
        let round = self.arc(0.0, TAU, INNER_RADIUS_M);
        let inner = network.add_line(Category::LeftCurb, &closed(&round));
        for (index, arm) in arms.iter().enumerate() {
            let next = arms[(index + 1) % arms.len()];
            let to_rad = next.angle_rad + if index + 1 == arms.len() { TAU } else { 0.0 };
            let outer_m = INNER_RADIUS_M + RING_WIDTH_M;
            let beside = |arm: &Arm| ((arm.half_width_m + CORNER_M) / outer_m).asin();
            let edge = self.arc(arm.angle_rad + beside(arm), to_rad - beside(&next), outer_m);
            let outer = network.add_line(Category::RightCurb, ReferenceLine::through(&edge).points());
            let driven = self.arc(arm.angle_rad + APPROACH_RAD, to_rad - APPROACH_RAD, INNER_RADIUS_M);
            network.add_link(Link {
                from: arm.junction,
                to: next.junction,
                reference: ReferenceLine::through(&driven),
                carriageway: Carriageway::OneWay { lanes: 1 },
                lane_width_m: RING_WIDTH_M,
                kind: LinkKind::Ring,
                lines: vec![inner, outer],
            });
        }
    }

    fn at(&self, angle_rad: f64, radius_m: f64) -> Point2<f64> {
        self.centre + Vector2::new(angle_rad.cos(), angle_rad.sin()) * radius_m
    }

    /// Points a quarter of a metre apart, counter-clockwise.
    fn arc(&self, from_rad: f64, to_rad: f64, radius_m: f64) -> Vec<Point2<f64>> {
        let pieces = crate::count_of((to_rad - from_rad) * radius_m * 4.0).max(4);
        let at = |k: usize| from_rad + (to_rad - from_rad) * k as f64 / pieces as f64;
        (0..=pieces).map(|k| self.at(at(k), radius_m)).collect()
    }
}

fn closed(round: &[Point2<f64>]) -> Vec<Point2<f64>> {
    ReferenceLine::closed_through(round).points().to_vec()
}
