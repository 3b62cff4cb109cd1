//! What to simulate: every figure of a simulation in one value.

use crate::{
    camera::Camera, detector::DetectorModel, drive::MotionModel, gnss::GnssModel, odometry::OdometryNoise,
    random::Seed, road::NetworkPlan,
};

/// What to simulate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scenario {
    /// The seed that fixes everything.
    pub seed: Seed,
    /// The roads.
    pub network: NetworkPlan,
    /// Steepest slope of the land: 0.05 is 5 %.
    pub max_grade: f64,
    /// Number of drives.
    pub drives: u32,
    /// Length of each drive, metres; shorter where the road ends.
    pub length_m: f64,
    /// Whether all drives take one route (on lanes and at speeds of their own) or each its own.
    pub shared_route: bool,
    /// Speed and wander.
    pub motion: MotionModel,
    /// The lane detector.
    pub detector: DetectorModel,
    /// The noise of the odometry.
    pub odometry: OdometryNoise,
    /// The noise of GNSS.
    pub gnss: GnssModel,
    /// The camera.
    pub camera: Camera,
}

impl Scenario {
    /// Ten drives of 1.5 km each through a small hilly town.
    #[must_use]
    pub fn town(seed: u64) -> Self {
        Self {
            seed: Seed(seed),
            network: NetworkPlan::Grid { columns: 4, rows: 4, spacing_m: 420.0 },
            max_grade: 0.05,
            drives: 10,
            length_m: 1_500.0,
            shared_route: false,
            motion: MotionModel::default(),
            detector: DetectorModel::default(),
            odometry: OdometryNoise { yaw_sigma_deg: 0.05, translation_sigma_m: 0.02 },
            gnss: GnssModel::default(),
            camera: Camera::default(),
        }
    }

    /// One drive of `length_m` along one road that never comes back to where it was.
    #[must_use]
    pub fn long_road(seed: u64, length_m: f64) -> Self {
        Self {
            network: NetworkPlan::Chain { length_m: length_m * 1.1 },
            drives: 1,
            length_m,
            shared_route: true,
            motion: MotionModel { min_speed_mps: 12.0, max_speed_mps: 22.0, ..MotionModel::default() },
            ..Self::town(seed)
        }
    }
}
