//! Synthetic roads, drives over them, and a lane detector with realistic errors. One seed, one simulation, to the byte.
//!
//! [`Simulation::run`] builds a [`road::RoadNetwork`] (hills, curves, junctions, splits and merges), drives through it
//! and lets a [`detector::Detector`] watch. A [`SimulatedDrive`] holds the truth, and gives the frames that a vehicle
//! would stream; a [`DriveSimulation`] gives them one by one; [`openlane`] writes it all as `OpenLane` folders. [`fleet`]
//! has many drives over days, for maps that are fused from them. Each model stands in a file of its own, with its
//! equations and figures.
//!
//! ```
//! use lanemap_simulator::{Scenario, Simulation};
//!
//! let scenario = Scenario { drives: 1, length_m: 200.0, ..Scenario::town(7) };
//! let simulation = Simulation::run(&scenario);
//! assert!(simulation.drives[0].frame_parts(0, None).detections.len() <= 16);
//! ```

pub mod camera;
pub mod detector;
pub mod drive;
pub mod fleet;
pub mod gnss;
pub mod noise;
pub mod odometry;
pub mod openlane;
pub mod random;
pub mod road;
pub mod scenario;
pub mod simulation;
pub mod truth_map;
pub mod view;

pub use camera::Camera;
pub use fleet::{Fleet, FleetScenario};
pub use odometry::OdometryNoise;
pub use random::Seed;
pub use scenario::Scenario;
pub use simulation::{DriveSimulation, SimulatedDrive, SimulatedFrame, Simulation};

/// A count from a finite number that is not negative, cut to whole; anything else is 0.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the cast saturates, and NaN becomes 0")]
pub(crate) fn count_of(value: f64) -> usize {
    value as usize
}
