//! The path of a vehicle in plan: lane centres on the links, curves through the junctions, a little wander.
//!
//! Through a junction the path is a cubic Hermite curve from mouth to mouth; the whole is smoothed by a running mean,
//! so that curvature has no jumps, and then displaced sideways by smooth noise of the distance driven.

use nalgebra::{Point2, Vector2};

use crate::{
    drive::route::{LANE_CHANGE_M, Leg, Route},
    noise::SmoothNoise,
    road::{RoadNetwork, cross_section::smooth_step, reference_line::wrap},
};

/// Half width of the running mean, points (about metres).
const SMOOTHING_HALF_WIDTH: usize = 4;
/// Times that the running mean is applied.
const SMOOTHING_PASSES: usize = 3;
/// Links whose lane centres are nearer to one another than this join without a curve between, metres.
const SEAMLESS_M: f64 = 0.6;

/// A path in plan, parameterised by the distance driven.
#[derive(Clone, Debug)]
pub struct Path {
    points: Vec<Point2<f64>>,
    headings_rad: Vec<f64>,
    distances_m: Vec<f64>,
    lanes: Vec<LanePlace>,
}

/// Where a point of a path lies on its road.
#[derive(Clone, Copy, Debug)]
struct LanePlace {
    leg: usize,
    right_of_reference_m: f64,
    speed_scale: f64,
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
    /// How far the lane's centre lies to the right of the link's reference line, as the vehicle faces it, metres.
    pub right_of_reference_m: f64,
    /// How much faster than in a street one drives here.
    pub speed_scale: f64,
}

impl Path {
    /// The path along a route, displaced to the left by `wander` (metres, of the distance driven).
    #[must_use]
    pub fn along(network: &RoadNetwork, route: &Route, wander: &SmoothNoise) -> Self {
        let (mut points, lanes) = lane_centres(network, route);
        for _ in 0..SMOOTHING_PASSES {
            points = running_mean(&points);
        }
        let centre = Self::from_points(points, lanes);
        let displaced = (0..centre.points.len())
            .map(|k| {
                let heading_rad = centre.headings_rad[k];
                let left = Vector2::new(-heading_rad.sin(), heading_rad.cos());
                centre.points[k] + left * wander.at(centre.distances_m[k])
            })
            .collect();
        Self::from_points(displaced, centre.lanes)
    }

    fn from_points(points: Vec<Point2<f64>>, lanes: Vec<LanePlace>) -> Self {
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
        Self { points, headings_rad, distances_m, lanes }
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
            leg: self.lanes[before].leg,
            right_of_reference_m: self.lanes[before].right_of_reference_m,
            speed_scale: self.lanes[before].speed_scale,
        }
    }
}

/// Points about one metre apart along the lane centres, each with its place on the road.
fn lane_centres(network: &RoadNetwork, route: &Route) -> (Vec<Point2<f64>>, Vec<LanePlace>) {
    let mut points: Vec<Point2<f64>> = Vec::new();
    let mut lanes: Vec<LanePlace> = Vec::new();
    for (index, leg) in route.legs.iter().enumerate() {
        let (mut centre, mut offsets_m) = lane_centre(network, leg);
        let speed_scale = network.link(leg.link).kind.speed_scale();
        let place = |right_of_reference_m: f64| LanePlace { leg: index, right_of_reference_m, speed_scale };
        if let [.., before, end] = points.as_slice() {
            if (centre[0] - end).norm() < SEAMLESS_M {
                centre.remove(0);
                offsets_m.remove(0);
            } else {
                let (leaving, arriving) = ((end - before).normalize(), (centre[1] - centre[0]).normalize());
                let crossing = hermite(*end, leaving, centre[0], arriving);
                lanes.extend(std::iter::repeat_n(place(offsets_m[0]), crossing.len()));
                points.extend(crossing);
            }
        }
        lanes.extend(offsets_m.into_iter().map(place));
        points.extend(centre);
    }
    (points, lanes)
}

/// The centre of the lane driven along a link, and how far it lies to the right of the reference line.
fn lane_centre(network: &RoadNetwork, leg: &Leg) -> (Vec<Point2<f64>>, Vec<f64>) {
    let link = network.link(leg.link);
    let reference = &link.reference;
    let offset_m = |lane: u8| (f64::from(lane) + 0.5) * link.lane_width_m;
    let to_the_right = if leg.forward { -1.0 } else { 1.0 };
    (0..reference.len())
        .map(|k| {
            let (mut lane_m, mut lane) = (offset_m(leg.lane), leg.lane);
            for change in &leg.changes {
                let share = smooth_step((k as f64 - change.from_m) / LANE_CHANGE_M);
                lane_m += (offset_m(change.lane) - offset_m(lane)) * share;
                lane = change.lane;
            }
            let index = if leg.forward { k } else { reference.len() - 1 - k };
            (reference.offset_point(index, to_the_right * lane_m), lane_m)
        })
        .unzip()
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
