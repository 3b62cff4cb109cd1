//! Other vehicles on the road, and what they hide from the camera.
//!
//! Others keep to lanes of the ego vehicle's road. One that drives the same way is, at time `t`, where the ego vehicle
//! will be at `t + h + r t`: it has the headway `h`, gains or loses by the rate `r ~ N(0, 0.03)`, and slows down for the
//! same bends. One that comes towards it is where the ego vehicle is at `c - t`. Headways on a lane are a renewal process:
//! a least gap, and an exponential part that makes up the density. A place where the road lacks that lane has no vehicle.
//!
//! A vehicle is a rectangle in plan and taken to be higher than the camera: nothing on the road behind it is seen. Its
//! shadow is an [`Occlusion`]: the sector that it fills as seen from below the camera, from its nearest point on.

use lanemap_core::{Occlusion, Pose, Sensor, geometry::pose::yaw_rad};
use nalgebra::{Point2, Rotation2, Vector2};

use crate::{
    drive::{Path, Route, TrueState},
    random::{SimRng, happens, normal, uniform},
    road::{LinkKind, RoadNetwork},
};

/// Figures of the traffic.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrafficModel {
    /// Vehicles on a kilometre of every lane; 0: empty roads.
    pub vehicles_per_km: f64,
    /// Share of lorries, 10 to 16 m long.
    pub lorry_share: f64,
    /// Share of the vehicles whose shadow is told of in the frames: how good the fleet's object detector is. 0: it has none.
    pub told_share: f64,
}

impl TrafficModel {
    /// No other vehicle.
    #[must_use]
    pub fn none() -> Self {
        Self { vehicles_per_km: 0.0, ..Self::town() }
    }

    /// The traffic of a town: a vehicle every 100 m of each lane.
    #[must_use]
    pub fn town() -> Self {
        Self { vehicles_per_km: 10.0, lorry_share: 0.1, told_share: 1.0 }
    }
}

/// Most lanes on one side of a road.
const MAX_LANES: u8 = 3;
/// Least time between two vehicles of a lane, seconds.
const LEAST_HEADWAY_S: f64 = 1.5;
/// How far along the path vehicles are looked for: behind and ahead, metres.
const BEHIND_M: f64 = 20.0;
const AHEAD_M: f64 = 90.0;
/// Standard deviation of the rate at which a vehicle gains on the ego vehicle.
const GAIN_SIGMA: f64 = 0.03;
/// Room that the ego vehicle has to itself: along its lane in front of and behind its middle, and to each side, metres.
const OWN_LENGTH_M: f64 = 7.0;
const OWN_SIDE_M: f64 = 2.0;
/// Spacing of the points on a vehicle's outline that are looked at, metres.
const OUTLINE_STEP_M: f64 = 0.5;

/// Another vehicle at one time: a rectangle in plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OtherVehicle {
    /// Its middle, world frame, metres.
    pub place: Point2<f64>,
    /// Where it heads, radians from the x axis.
    pub heading_rad: f64,
    /// Its length, metres.
    pub length_m: f64,
    /// Its width, metres.
    pub width_m: f64,
    /// Whether the frames tell of its shadow.
    pub told: bool,
}

/// The other vehicles about one drive.
#[derive(Clone, Debug, Default)]
pub(super) struct Traffic {
    drivers: Vec<Driver>,
}

#[derive(Clone, Copy, Debug)]
struct Driver {
    oncoming: bool,
    lane: u8,
    /// Headway of one that goes the same way, or the time `c` of one that comes towards, seconds.
    time_s: f64,
    gain: f64,
    length_m: f64,
    width_m: f64,
    told: bool,
}

/// Where the ego vehicle is along its path at any time, also before its start and after its end.
#[derive(Debug)]
struct Progress<'a>(&'a [TrueState]);

impl Traffic {
    /// The traffic of a drive.
    pub(super) fn draw(model: &TrafficModel, states: &[TrueState], rng: &mut SimRng) -> Self {
        let [first, .., last] = states else { return Self::default() };
        let duration_s = last.time.seconds_since(first.time);
        let speed_mps = (last.distance_m / duration_s).max(1.0);
        let mut drivers = Vec::new();
        if model.vehicles_per_km <= 0.0 {
            return Self { drivers };
        }
        let mean_s = (1e3 / (model.vehicles_per_km * speed_mps)).max(LEAST_HEADWAY_S);
        let (before_s, after_s) = (BEHIND_M / speed_mps * 2.0, AHEAD_M / speed_mps * 2.0);
        for lane in 0..MAX_LANES {
            for oncoming in [false, true] {
                let gained_s = 2.0 * GAIN_SIGMA * duration_s;
                let (mut time_s, end_s) = if oncoming {
                    (0.0, 2.0 * duration_s + after_s)
                } else {
                    (-before_s - gained_s, after_s + gained_s)
                };
                loop {
                    time_s += LEAST_HEADWAY_S - (mean_s - LEAST_HEADWAY_S) * uniform(rng, 1e-9, 1.0).ln();
                    if time_s > end_s {
                        break;
                    }
                    drivers.push(Driver::draw(model, oncoming, lane, time_s, rng));
                }
            }
        }
        Self { drivers }
    }

    /// The vehicles near the ego vehicle at frame `index`.
    pub(super) fn around(
        &self,
        network: &RoadNetwork,
        route: &Route,
        path: &Path,
        states: &[TrueState],
        index: usize,
    ) -> Vec<OtherVehicle> {
        let (ego, progress) = (&states[index], Progress(states));
        let now_s = ego.time.seconds_since(states[0].time);
        let mut vehicles = Vec::new();
        for driver in &self.drivers {
            let distance_m = progress.at_m(driver.time_on_path_s(now_s));
            let ahead_m = distance_m - ego.distance_m;
            if !(-BEHIND_M..AHEAD_M).contains(&ahead_m) || !(0.0..path.length_m()).contains(&distance_m) {
                continue;
            }
            let on_path = path.at(distance_m);
            let link = network.link(route.legs[on_path.leg].link);
            let has_lane = driver.lane < link.carriageway.forward_lanes()
                && (!driver.oncoming || (link.carriageway.is_two_way() && link.kind == LinkKind::Street));
            if !has_lane {
                continue;
            }
            let lane_m = (f64::from(driver.lane) + 0.5) * link.lane_width_m;
            let left_m = on_path.right_of_reference_m + if driver.oncoming { lane_m } else { -lane_m };
            if left_m.abs() < OWN_SIDE_M && ahead_m.abs() < OWN_LENGTH_M + 0.5 * driver.length_m {
                continue;
            }
            let left = Vector2::new(-on_path.heading_rad.sin(), on_path.heading_rad.cos());
            vehicles.push(OtherVehicle {
                place: on_path.place + left * left_m,
                heading_rad: on_path.heading_rad + if driver.oncoming { std::f64::consts::PI } else { 0.0 },
                length_m: driver.length_m,
                width_m: driver.width_m,
                told: driver.told,
            });
        }
        vehicles
    }
}

impl Driver {
    fn draw(model: &TrafficModel, oncoming: bool, lane: u8, time_s: f64, rng: &mut SimRng) -> Self {
        let gain = GAIN_SIGMA * normal(rng).clamp(-2.0, 2.0);
        let lorry = happens(rng, model.lorry_share);
        let (length_m, width_m) = if lorry { (uniform(rng, 10.0, 16.0), 2.5) } else { (uniform(rng, 3.8, 5.2), 1.85) };
        Self { oncoming, lane, time_s, gain, length_m, width_m, told: happens(rng, model.told_share) }
    }

    /// The time at which the ego vehicle is where this one is now.
    fn time_on_path_s(&self, now_s: f64) -> f64 {
        if self.oncoming { self.time_s - now_s } else { now_s + self.time_s + self.gain * now_s }
    }
}

impl Progress<'_> {
    /// Distance along the path at a time since the drive's start.
    fn at_m(&self, time_s: f64) -> f64 {
        let states = self.0;
        let last = states.len() - 1;
        let period_s = states[1].time.seconds_since(states[0].time);
        let frame = time_s / period_s;
        let segment = crate::count_of(frame.max(0.0)).min(last - 1);
        let (a, b) = (states[segment].distance_m, states[segment + 1].distance_m);
        a + (b - a) * (frame - segment as f64)
    }
}

impl OtherVehicle {
    /// What it hides from a camera on a vehicle; `None` where it is not in front of the camera at all.
    #[must_use]
    pub fn shadow(&self, world_from_vehicle: &Pose, sensor: &Sensor) -> Option<Occlusion> {
        let into_vehicle = Rotation2::new(-yaw_rad(world_from_vehicle));
        let camera = sensor.ground_offset().xy();
        let middle = into_vehicle * (self.place - Point2::from(world_from_vehicle.translation.vector.xy())) - camera;
        let turned = Rotation2::new(self.heading_rad - yaw_rad(world_from_vehicle));
        let mut shadow: Option<Occlusion> = None;
        for corner in self.outline() {
            let point = middle + turned * corner;
            if point.x < 0.1 {
                continue;
            }
            let (bearing_rad, range_m) = (point.y.atan2(point.x), point.norm());
            let so_far = shadow.unwrap_or(Occlusion { from_rad: bearing_rad, to_rad: bearing_rad, range_m });
            shadow = Some(Occlusion {
                from_rad: so_far.from_rad.min(bearing_rad),
                to_rad: so_far.to_rad.max(bearing_rad),
                range_m: so_far.range_m.min(range_m),
            });
        }
        shadow
    }

    /// Points on its outline about its middle, x ahead.
    fn outline(&self) -> impl Iterator<Item = Vector2<f64>> {
        let half = Vector2::new(0.5 * self.length_m, 0.5 * self.width_m);
        let corners =
            [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)].map(|(x, y)| half.component_mul(&Vector2::new(x, y)));
        (0..4).flat_map(move |side| {
            let (from, to) = (corners[side], corners[(side + 1) % 4]);
            let pieces = crate::count_of((to - from).norm() / OUTLINE_STEP_M).max(1);
            (0..pieces).map(move |k| from + (to - from) * (k as f64 / pieces as f64))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn a_car_ahead_hides_the_road_behind_it_and_nothing_before_or_beside_it() {
        let car =
            OtherVehicle { place: Point2::new(22.0, 0.0), heading_rad: 0.0, length_m: 4.0, width_m: 2.0, told: true };
        let sensor = Sensor { vehicle_from_sensor: Pose::translation(2.0, 0.0, 1.5), field_of_view: None };
        let shadow = car.shadow(&Pose::identity(), &sensor).unwrap();
        let hidden = |x: f64, y: f64| shadow.hides(&Point3::new(x, y, 0.0), &sensor);
        // Its rear is 18 m in front of the camera and 2 m wide.
        assert!((shadow.range_m - 18.0).abs() < 0.1, "{}", shadow.range_m);
        assert!((shadow.to_rad - (1.0_f64 / 18.0).atan()).abs() < 1e-3);
        assert!(hidden(38.0, 1.9) && hidden(38.0, -1.9) && !hidden(38.0, 2.1) && !hidden(38.0, -2.1));
        assert!(!hidden(19.5, 0.0));
        let behind = OtherVehicle { place: Point2::new(-10.0, 0.0), ..car };
        assert!(behind.shadow(&Pose::identity(), &sensor).is_none());
    }
}
