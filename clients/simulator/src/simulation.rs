//! The whole: a scenario in, a network with several simulated drives out.

use lanemap_core::{
    Detection, FrameParts, Odometry, Pose, Sensor, Sequence, TimestampNs, geometry::georeference::Georeference,
};
use nalgebra::{Translation3, UnitQuaternion, Vector3};

use crate::{
    camera::Camera,
    detector::Detector,
    drive::{
        Path, Route, TrueState,
        motion::{FRAME_PERIOD_NS, FRAME_RATE_HZ},
    },
    odometry::OdometryNoise,
    random::{Purpose, SimRng},
    road::RoadNetwork,
    scenario::Scenario,
    view::{LineView, lines_in_view},
};

/// Time of the first frame of the first drive, nanoseconds since the Unix epoch: 1 January 2025.
const FIRST_START_NS: i64 = 1_735_689_600_000_000_000;
/// Time between the starts of drives, nanoseconds: an hour.
const START_INTERVAL_NS: i64 = 3_600_000_000_000;
/// Standard deviation that the receiver states, horizontal and vertical, metres: that of its bias.
const GNSS_SIGMA_M: f64 = 1.0;

/// A road network and the drives through it.
#[derive(Debug)]
pub struct Simulation {
    /// The roads, with every painted line.
    pub network: RoadNetwork,
    /// The drives, in the order of their numbers.
    pub drives: Vec<SimulatedDrive>,
}

/// A drive that is being simulated, frame by frame: a drive of any length takes the memory of its poses only.
#[derive(Debug)]
pub struct DriveSimulation<'a> {
    scenario: &'a Scenario,
    network: &'a RoadNetwork,
    route: Route,
    world_from_odometry: Pose,
    states: Vec<TrueState>,
    gnss: Vec<Pose>,
    odometry: Vec<Pose>,
    detector: Detector,
    sensor: Sensor,
    next: usize,
}

/// One simulated drive, whole: the truth, and what the vehicle knows of it.
#[derive(Debug)]
pub struct SimulatedDrive {
    /// Number within the simulation.
    pub number: u32,
    /// The camera.
    pub camera: Camera,
    /// Where the drive's odometry frame truly lies: its origin is at the first pose, its x axis along it.
    pub world_from_odometry: Pose,
    /// Frames at 10 Hz.
    pub frames: Vec<SimulatedFrame>,
}

/// One frame of a simulated drive.
#[derive(Debug)]
pub struct SimulatedFrame {
    /// Number in the drive, from 1.
    pub sequence: Sequence,
    /// Where the vehicle truly is.
    pub truth: TrueState,
    /// What of the road is truly in sight, from left to right.
    pub views: Vec<LineView>,
    /// Where the vehicle's odometry has it, in the odometry frame of the drive.
    pub odometry_from_vehicle: Pose,
    /// Noise of that odometry.
    pub odometry_noise: OdometryNoise,
    /// Where GNSS has it, in the world.
    pub gnss_world_from_vehicle: Pose,
    /// What the detector reports.
    pub detections: Vec<Detection>,
}

impl Simulation {
    /// Simulates a scenario. The same scenario gives the same simulation, to the byte.
    #[must_use]
    pub fn run(scenario: &Scenario) -> Self {
        let network = RoadNetwork::build(&scenario.network, scenario.max_grade, scenario.seed);
        let drives = (0..scenario.drives).map(|number| SimulatedDrive::run(scenario, &network, number)).collect();
        Self { network, drives }
    }
}

impl<'a> DriveSimulation<'a> {
    /// Drive `number` of a scenario through its network, before its first frame.
    #[must_use]
    pub fn start(scenario: &'a Scenario, network: &'a RoadNetwork, number: u32) -> Self {
        let seed = scenario.seed;
        let route = route_of(scenario, network, number);
        let mut rng = seed.stream(Purpose::Motion, number);
        let wander = scenario.motion.lateral_wander(&mut rng);
        let path = Path::along(network, &route, &wander);
        let start = TimestampNs(FIRST_START_NS + i64::from(number) * START_INTERVAL_NS);
        let states = scenario.motion.drive(network, &path, scenario.length_m, start, &mut rng);
        let gnss = scenario.gnss.observe(&states, &mut seed.stream(Purpose::Gnss, number));
        let (world_from_odometry, odometry) =
            odometry_of(scenario.odometry, &states, &mut seed.stream(Purpose::Odometry, number));
        let sensor = scenario.camera.sensor();
        let detector = Detector::new(scenario.detector, sensor, seed.stream(Purpose::Detector, number));
        Self { scenario, network, route, world_from_odometry, states, gnss, odometry, detector, sensor, next: 0 }
    }

    /// Where the drive's odometry frame truly lies: its origin is at the first pose, its x axis along it.
    #[must_use]
    pub fn world_from_odometry(&self) -> Pose {
        self.world_from_odometry
    }

    /// Where the vehicle truly is at each frame.
    #[must_use]
    pub fn states(&self) -> &[TrueState] {
        &self.states
    }

    /// Time from the first to the last frame, seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        (self.states.len().saturating_sub(1)) as f64 * FRAME_PERIOD_NS as f64 * 1e-9
    }

    /// Distance driven, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.states.last().map_or(0.0, |state| state.distance_m)
    }
}

impl Iterator for DriveSimulation<'_> {
    type Item = SimulatedFrame;

    fn next(&mut self) -> Option<SimulatedFrame> {
        let index = self.next;
        let truth = *self.states.get(index)?;
        self.next += 1;
        let legs = &self.route.legs;
        let views = lines_in_view(self.network, legs, truth.leg, &truth.world_from_vehicle, &self.sensor);
        let detections = self.detector.observe(&views, 1.0 / FRAME_RATE_HZ);
        Some(SimulatedFrame {
            sequence: Sequence(index as u64 + 1),
            truth,
            views,
            odometry_from_vehicle: self.odometry[index],
            odometry_noise: self.scenario.odometry,
            gnss_world_from_vehicle: self.gnss[index],
            detections,
        })
    }
}

impl SimulatedFrame {
    /// The frame that the vehicle would stream: what it knows, nothing of the truth. Sequences begin at 1.
    ///
    /// With `world_on_earth`, which puts the simulation's world on the earth, the frame has a GNSS fix.
    #[must_use]
    pub fn parts(&self, world_on_earth: Option<&Georeference>) -> FrameParts {
        FrameParts {
            sequence: self.sequence,
            time: self.truth.time,
            odometry: Odometry {
                odometry_from_vehicle: self.odometry_from_vehicle,
                motion_covariance: Some(self.odometry_noise.motion_covariance()),
            },
            gnss: world_on_earth.map(|world| world.fix_at(&self.gnss_world_from_vehicle, GNSS_SIGMA_M, GNSS_SIGMA_M)),
            detections: self.detections.clone(),
            occlusions: Vec::new(),
        }
    }
}

impl SimulatedDrive {
    /// Simulates one drive of a scenario through its network.
    #[must_use]
    pub fn run(scenario: &Scenario, network: &RoadNetwork, number: u32) -> Self {
        let simulation = DriveSimulation::start(scenario, network, number);
        Self {
            number,
            camera: scenario.camera,
            world_from_odometry: simulation.world_from_odometry(),
            frames: simulation.collect(),
        }
    }

    /// The frame that the vehicle would stream; see [`SimulatedFrame::parts`].
    ///
    /// # Panics
    /// Where there is no frame `index`.
    #[must_use]
    pub fn frame_parts(&self, index: usize, world_on_earth: Option<&Georeference>) -> FrameParts {
        self.frames[index].parts(world_on_earth)
    }
}

fn route_of(scenario: &Scenario, network: &RoadNetwork, number: u32) -> Route {
    // A little farther than asked, so that the last frames have road ahead of them.
    let length_m = scenario.length_m + 150.0;
    let rng = &mut scenario.seed.stream(Purpose::Route, number);
    if !scenario.shared_route {
        return Route::random(network, length_m, rng);
    }
    let first = Route::random(network, length_m, &mut scenario.seed.stream(Purpose::Route, 0));
    if number == 0 { first } else { first.on_other_lanes(network, rng) }
}

/// The true place of the odometry frame, and noisy odometry in it.
fn odometry_of(noise: OdometryNoise, states: &[TrueState], rng: &mut SimRng) -> (Pose, Vec<Pose>) {
    let Some(first) = states.first() else { return (Pose::identity(), Vec::new()) };
    let yaw_rad = lanemap_core::geometry::pose::yaw_rad(&first.world_from_vehicle);
    let world_from_odometry = Pose::from_parts(
        Translation3::from(first.world_from_vehicle.translation.vector),
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad),
    );
    let odometry_from_world = world_from_odometry.inverse();
    let exact: Vec<Pose> = states.iter().map(|state| odometry_from_world * state.world_from_vehicle).collect();
    (world_from_odometry, noise.apply(&exact, rng))
}

#[cfg(test)]
mod tests {
    use super::*;
    use lanemap_core::{Frame, FrameLimits};

    fn short(seed: u64) -> Scenario {
        Scenario { drives: 2, length_m: 300.0, ..Scenario::town(seed) }
    }

    #[test]
    fn every_frame_is_one_that_the_mapper_takes() {
        for drive in &Simulation::run(&short(1)).drives {
            assert!(drive.frames.len() > 150);
            for index in 0..drive.frames.len() {
                Frame::new(drive.frame_parts(index, None), &FrameLimits::default()).unwrap();
            }
        }
    }

    #[test]
    fn one_seed_repeats_and_two_seeds_differ() {
        let frames = |seed| {
            let simulation = Simulation::run(&short(seed));
            simulation.drives.iter().flat_map(|drive| (0..150).map(|k| drive.frame_parts(k, None))).collect::<Vec<_>>()
        };
        assert_eq!(frames(1), frames(1));
        assert_ne!(frames(1), frames(2));
    }

    #[test]
    fn one_more_drive_leaves_the_others_as_they_were() {
        let two = Simulation::run(&short(1));
        let three = Simulation::run(&Scenario { drives: 3, ..short(1) });
        assert_eq!(two.drives[1].frame_parts(100, None), three.drives[1].frame_parts(100, None));
    }

    #[test]
    fn odometry_starts_below_the_first_pose_and_drifts_from_the_truth() {
        let simulation = Simulation::run(&short(4));
        let drive = &simulation.drives[0];
        let error_m = |frame: &SimulatedFrame| {
            let believed = drive.world_from_odometry * frame.odometry_from_vehicle;
            (believed.translation.vector - frame.truth.world_from_vehicle.translation.vector).norm()
        };
        assert!(error_m(&drive.frames[0]) < 1e-9);
        let last = error_m(&drive.frames[drive.frames.len() - 1]);
        assert!(last > 0.05 && last < 20.0, "{last}");
    }
}
