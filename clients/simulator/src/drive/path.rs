//! The path of a vehicle in plan: lane centres on the links, curves through the junctions, a little wander.
//!
//! Through a junction the path is a cubic Hermite curve from mouth to mouth; the whole is smoothed by a running mean,
//! so that curvature has no jumps, and then displaced sideways by smooth noise of the distance driven.

use nalgebra::{Point2, Vector2};

use crate::{
    drive::route::{Leg, Route},
    noise::SmoothNoise,
    road::{
        RoadNetwork,
        cross_section::{LANE_WIDTH_M, smooth_step},
        reference_line::wrap,
    },
};

/// Half width of the running mean, points (about metres).
const SMOOTHING_HALF_WIDTH: usize = 4;
/// Times that the running mean is applied.
const SMOOTHING_PASSES: usize = 3;
/// Length of a lane change, metres.
const LANE_CHANGE_M: f64 = 70.0;

/// A path in plan, parameterised by the distance driven.
#[derive(Clone, Debug)]
pub struct Path {
    points: Vec<Point2<f64>>,
    headings_rad: Vec<f64>,
    distances_m: Vec<f64>,
    legs: Vec<usize>,
}

/// A place on a path.
#[derive(Clone, Copy, Debug)]
pub struct PathPoint {
    /// Where, metres.
    pub place: Point2<f64>,
    /// Heading from the x axis, radians.
    pub heading_rad: f64,
    /// Curvature, 1/m, positive to the left.
    pub curvature_per_m: f64,
    /// Index of the leg of the route.
    pub leg: usize,
}

impl Path {
    /// The path along a route, displaced to the left by `wander` (metres, of the distance driven).
    #[must_use]
    pub fn along(network: &RoadNetwork, route: &Route, wander: &SmoothNoise) -> Self {
        let (mut points, legs) = lane_centres(network, route);
        for _ in 0..SMOOTHING_PASSES {
            points = running_mean(&points);
        }
        let centre = Self::from_points(points, legs);
        let displaced = (0..centre.points.len())
            .map(|k| {
                let heading_rad = centre.headings_rad[k];
                let left = Vector2::new(-heading_rad.sin(), heading_rad.cos());
                centre.points[k] + left * wander.at(centre.distances_m[k])
            })
            .collect();
        Self::from_points(displaced, centre.legs)
    }

    fn from_points(points: Vec<Point2<f64>>, legs: Vec<usize>) -> Self {
        let mut distances_m = Vec::with_capacity(points.len());
        let mut driven_m = 0.0;
        for (k, point) in points.iter().enumerate() {
            if k > 0 {
                driven_m += (point - points[k - 1]).norm();
            }
            distances_m.push(driven_m);
        }
        let last = points.len() - 1;
        let mut headings_rad: Vec<f64> = Vec::with_capacity(points.len());
        for k in 0..=last {
            let ahead = points[(k + 1).min(last)] - points[k.saturating_sub(1)];
            let raw = ahead.y.atan2(ahead.x);
            let previous = headings_rad.last().copied().unwrap_or(raw);
            headings_rad.push(previous + wrap(raw - previous));
        }
        Self { points, headings_rad, distances_m, legs }
    }

    /// Length, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.distances_m.last().copied().unwrap_or(0.0)
    }

    /// The place at a distance from the start; the nearest end where that is off the path.
    #[must_use]
    pub fn at(&self, distance_m: f64) -> PathPoint {
        let after = self.distances_m.partition_point(|known| *known <= distance_m).clamp(1, self.points.len() - 1);
        let before = after - 1;
        let step_m = (self.distances_m[after] - self.distances_m[before]).max(1e-9);
        let share = ((distance_m - self.distances_m[before]) / step_m).clamp(0.0, 1.0);
        let turn_rad = self.headings_rad[after] - self.headings_rad[before];
        PathPoint {
            place: self.points[before] + (self.points[after] - self.points[before]) * share,
            heading_rad: self.headings_rad[before] + turn_rad * share,
            curvature_per_m: turn_rad / step_m,
            leg: self.legs[before],
        }
    }
}

/// Points about one metre apart along the lane centres, each with its leg.
fn lane_centres(network: &RoadNetwork, route: &Route) -> (Vec<Point2<f64>>, Vec<usize>) {
    let mut points: Vec<Point2<f64>> = Vec::new();
    let mut legs = Vec::new();
    for (index, leg) in route.legs.iter().enumerate() {
        let centre = lane_centre(network, leg);
        if let [.., before, end] = points.as_slice() {
            let crossing = hermite(*end, (end - before).normalize(), centre[0], (centre[1] - centre[0]).normalize());
            legs.extend(std::iter::repeat_n(index, crossing.len()));
            points.extend(crossing);
        }
        legs.extend(std::iter::repeat_n(index, centre.len()));
        points.extend(centre);
    }
    (points, legs)
}

fn lane_centre(network: &RoadNetwork, leg: &Leg) -> Vec<Point2<f64>> {
    let reference = &network.link(leg.link).reference;
    let offset_m = |lane: u8| (f64::from(lane) + 0.5) * LANE_WIDTH_M;
    let change_from_m = 0.5 * (reference.len() as f64 - LANE_CHANGE_M);
    let to_the_right = if leg.forward { -1.0 } else { 1.0 };
    (0..reference.len())
        .map(|k| {
            let share = smooth_step((k as f64 - change_from_m) / LANE_CHANGE_M);
            let from_reference_m = offset_m(leg.lane) + (offset_m(leg.end_lane) - offset_m(leg.lane)) * share;
            let index = if leg.forward { k } else { reference.len() - 1 - k };
            reference.offset_point(index, to_the_right * from_reference_m)
        })
        .collect()
}

/// Points strictly between two ends on the cubic that leaves and arrives in the given directions.
fn hermite(from: Point2<f64>, leaving: Vector2<f64>, to: Point2<f64>, arriving: Vector2<f64>) -> Vec<Point2<f64>> {
    let reach_m = (to - from).norm();
    let pieces = crate::count_of(reach_m * 1.1).max(2);
    (1..pieces)
        .map(|k| {
            let t = k as f64 / pieces as f64;
            let (t2, t3) = (t * t, t * t * t);
            let weighted = from.coords * (2.0 * t3 - 3.0 * t2 + 1.0)
                + leaving * (reach_m * (t3 - 2.0 * t2 + t))
                + to.coords * (3.0 * t2 - 2.0 * t3)
                + arriving * (reach_m * (t3 - t2));
            Point2::from(weighted)
        })
        .collect()
}

fn running_mean(points: &[Point2<f64>]) -> Vec<Point2<f64>> {
    let last = points.len() - 1;
    (0..=last)
        .map(|k| {
            let half = SMOOTHING_HALF_WIDTH.min(k).min(last - k);
            let window = &points[k - half..=k + half];
            let sum: Vector2<f64> = window.iter().map(|point| point.coords).sum();
            Point2::from(sum / window.len() as f64)
        })
        .collect()
}
