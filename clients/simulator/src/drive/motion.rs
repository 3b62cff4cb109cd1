//! How the vehicle moves along its path: speed, attitude, and the true pose at 10 Hz.
//!
//! Speed: the driver's cruise speed, `v <= sqrt(a_lat / |curvature|)` in bends, reached and left with bounded
//! acceleration (a backward and a forward pass over the path). Attitude: heading of the path, pitch and roll of the
//! land under it, plus smooth wander of the suspension.

use lanemap_core::{Pose, TimestampNs};
use nalgebra::{Translation3, UnitQuaternion, Vector3};

use crate::{
    drive::path::Path,
    noise::SmoothNoise,
    random::{SimRng, uniform},
    road::RoadNetwork,
};

/// Height of the vehicle's origin (near the rear axle) above the road, metres.
pub const ORIGIN_HEIGHT_M: f64 = 0.35;
/// Frames per second.
pub const FRAME_RATE_HZ: f64 = 10.0;
/// Time between frames, nanoseconds.
pub const FRAME_PERIOD_NS: i64 = 100_000_000;
/// Spacing of the speed profile, metres.
const PROFILE_STEP_M: f64 = 1.0;
/// Slowest speed in a bend, m/s.
const CRAWL_MPS: f64 = 2.5;

/// How vehicles move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionModel {
    /// Slowest cruise speed, m/s.
    pub min_speed_mps: f64,
    /// Fastest cruise speed, m/s.
    pub max_speed_mps: f64,
    /// Lateral acceleration in bends, m/s^2.
    pub lateral_acceleration_mps2: f64,
    /// Acceleration and braking, m/s^2.
    pub acceleration_mps2: f64,
    /// Standard deviation of the lateral wander, metres.
    pub lateral_wander_m: f64,
    /// Standard deviation of pitch and of roll about the land, degrees.
    pub attitude_wander_deg: f64,
}

impl Default for MotionModel {
    fn default() -> Self {
        Self {
            min_speed_mps: 8.0,
            max_speed_mps: 15.0,
            lateral_acceleration_mps2: 2.5,
            acceleration_mps2: 1.5,
            lateral_wander_m: 0.15,
            attitude_wander_deg: 0.2,
        }
    }
}

/// Where the vehicle truly is at one frame.
#[derive(Clone, Copy, Debug)]
pub struct TrueState {
    /// Time of the frame.
    pub time: TimestampNs,
    /// True pose.
    pub world_from_vehicle: Pose,
    /// Distance driven, metres.
    pub distance_m: f64,
    /// Index of the leg of the route.
    pub leg: usize,
}

impl MotionModel {
    /// Smooth lateral wander for a path, metres of the distance driven.
    pub fn lateral_wander(&self, rng: &mut SimRng) -> SmoothNoise {
        SmoothNoise::new(self.lateral_wander_m, 60.0, 250.0, rng)
    }

    /// Drives the first `length_m` of a path, from time `start`.
    pub fn drive(
        &self,
        network: &RoadNetwork,
        path: &Path,
        length_m: f64,
        start: TimestampNs,
        rng: &mut SimRng,
    ) -> Vec<TrueState> {
        let cruise_mps = uniform(rng, self.min_speed_mps, self.max_speed_mps);
        let attitude_rad = self.attitude_wander_deg.to_radians();
        let pitch = SmoothNoise::new(attitude_rad, 1.0, 8.0, rng);
        let roll = SmoothNoise::new(attitude_rad, 1.0, 8.0, rng);
        let length_m = length_m.min(path.length_m());
        let profile_mps = self.speed_profile(path, length_m, cruise_mps);
        let mut states = Vec::new();
        let (mut distance_m, mut time) = (0.0, start);
        while distance_m < length_m {
            let elapsed_s = time.seconds_since(start);
            let world_from_vehicle = pose_on(network, path, distance_m, pitch.at(elapsed_s), roll.at(elapsed_s));
            states.push(TrueState { time, world_from_vehicle, distance_m, leg: path.at(distance_m).leg });
            let speed_mps = profile_mps[crate::count_of(distance_m / PROFILE_STEP_M).min(profile_mps.len() - 1)];
            distance_m += speed_mps / FRAME_RATE_HZ;
            time = TimestampNs(time.0 + FRAME_PERIOD_NS);
        }
        states
    }

    /// Speeds at every metre of a path.
    fn speed_profile(&self, path: &Path, length_m: f64, cruise_mps: f64) -> Vec<f64> {
        let count = crate::count_of(length_m / PROFILE_STEP_M) + 1;
        let mut speeds_mps: Vec<f64> = (0..count)
            .map(|k| {
                let here = path.at(k as f64 * PROFILE_STEP_M);
                let curvature = here.curvature_per_m.abs().max(1e-9);
                (cruise_mps * here.speed_scale).min((self.lateral_acceleration_mps2 / curvature).sqrt()).max(CRAWL_MPS)
            })
            .collect();
        let gained = 2.0 * self.acceleration_mps2 * PROFILE_STEP_M;
        for k in (1..count).rev() {
            speeds_mps[k - 1] = speeds_mps[k - 1].min((speeds_mps[k].powi(2) + gained).sqrt());
        }
        for k in 1..count {
            speeds_mps[k] = speeds_mps[k].min((speeds_mps[k - 1].powi(2) + gained).sqrt());
        }
        speeds_mps
    }
}

/// The pose on the land at a distance along a path, with a wander of pitch (nose down) and roll (left up), radians.
fn pose_on(network: &RoadNetwork, path: &Path, distance_m: f64, pitch_rad: f64, roll_rad: f64) -> Pose {
    let here = path.at(distance_m);
    let gradient = network.terrain().gradient(&here.place);
    let (sin, cos) = here.heading_rad.sin_cos();
    let climb = gradient.x * cos + gradient.y * sin;
    let left_rise = -gradient.x * sin + gradient.y * cos;
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), here.heading_rad)
        * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), pitch_rad - climb.atan())
        * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), roll_rad + left_rise.atan());
    let height_m = network.terrain().height_m(&here.place) + ORIGIN_HEIGHT_M;
    Pose::from_parts(Translation3::new(here.place.x, here.place.y, height_m), rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        drive::route::Route,
        random::{Purpose, Seed},
        road::NetworkPlan,
    };

    fn drive() -> (RoadNetwork, Vec<TrueState>) {
        let network = RoadNetwork::build(&NetworkPlan::Grid { columns: 4, rows: 4, spacing_m: 400.0 }, 0.05, Seed(5));
        let route = Route::random(&network, 3_000.0, &mut Seed(5).stream(Purpose::Route, 0));
        let model = MotionModel::default();
        let mut rng = Seed(5).stream(Purpose::Motion, 0);
        let path = Path::along(&network, &route, &model.lateral_wander(&mut rng));
        let states = model.drive(&network, &path, 3_000.0, TimestampNs(0), &mut rng);
        (network, states)
    }

    #[test]
    fn speed_and_accelerations_keep_their_bounds() {
        let (_, states) = drive();
        let at = |k: usize| states[k].world_from_vehicle.translation.vector;
        for k in 1..states.len() - 1 {
            let speed_mps = (at(k + 1) - at(k)).norm() * FRAME_RATE_HZ;
            assert!((2.0..=15.5).contains(&speed_mps), "{speed_mps}");
            let acceleration = (at(k + 1) - at(k) * 2.0 + at(k - 1)) * FRAME_RATE_HZ.powi(2);
            assert!(acceleration.norm() < 4.5, "{} at frame {k}", acceleration.norm());
        }
    }

    #[test]
    fn the_vehicle_stands_on_the_land_and_looks_where_it_goes() {
        let (network, states) = drive();
        for pair in states.windows(2) {
            let pose = pair[0].world_from_vehicle;
            let place = pose.translation.vector;
            assert!((place.z - network.terrain().height_m(&place.xy().into()) - ORIGIN_HEIGHT_M).abs() < 1e-9);
            let motion = pose.inverse() * pair[1].world_from_vehicle;
            let ahead = motion.translation.vector;
            assert!(ahead.x > 0.0 && (ahead.y / ahead.x).abs() < 0.08 && (ahead.z / ahead.x).abs() < 0.03, "{ahead}");
        }
    }
}
