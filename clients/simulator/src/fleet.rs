//! Fleets: many drives over days through one world, each with a receiver, an odometry and errors of its own.
//!
//! A [`FleetScenario`] says what to simulate; [`FleetScenario::fleet`] builds its world; [`Fleet::drives`] gives the drives
//! one after the other, in the order of time, each made when it is asked for, so that a fleet of any size takes the memory
//! of its roads and one drive. The world is metres east, north, up of an anchor on the earth.
//!
//! A town of 10 km^2 is built in 0.06 s, and gives 23,000 frames a second on one core with traffic and changes: 200
//! drives of 1,000 frames take 9 s (`cargo bench -p lanemap-simulator --bench fleet`).
//!
//! ```
//! use lanemap_simulator::{Seed, fleet::{FleetRoutes, FleetScenario}};
//!
//! let routes = FleetRoutes::Shared { length_m: 200.0, both_directions: true };
//! let fleet = FleetScenario { drives: 3, routes, ..FleetScenario::winding_road() }.fleet(Seed(7));
//! for drive in fleet.drives() {
//!     assert!(drive.frames().all(|frame| frame.gnss().is_some()));
//! }
//! assert_eq!(fleet.truth_at(fleet.start_of(0)).lines.len(), 5);
//! ```

pub mod canyon;
pub mod changes;
mod drive;
pub mod odometry_drift;
pub mod poison;
pub mod receiver;
pub mod routes;
pub mod traffic;
pub mod truth;

use lanemap_core::{
    Pose, Sensor, TimestampNs,
    geometry::georeference::{Anchor, Georeference, Wgs84},
};

use crate::{
    Camera,
    detector::DetectorModel,
    drive::MotionModel,
    random::{Purpose, Seed},
    road::{Course, RoadNetwork, SingleRoad, TownPlan},
};

pub use canyon::Canyon;
use changes::Timeline;
pub use changes::{ChangeKind, ChangePlan, RoadChange};
pub use drive::{FleetDrive, FleetFrame, FleetFrames};
pub use odometry_drift::OdometryDrift;
pub use poison::{Poison, PoisonPlan};
pub use receiver::ReceiverModel;
pub use routes::FleetRoutes;
pub use traffic::{OtherVehicle, TrafficModel};
pub use truth::{FleetTrueLine, FleetTruth};

/// Time of the first frame of the first drive, nanoseconds since the Unix epoch: 1 January 2025, 8:00.
const FIRST_START_NS: i64 = 1_735_718_400_000_000_000;
/// A day, nanoseconds.
const DAY_NS: i64 = 86_400_000_000_000;
/// Where fleets drive: Turin, whose streets are a grid as well.
const TURIN: Wgs84 = Wgs84 { latitude_deg: 45.0628, longitude_deg: 7.6688, height_m: 239.0 };

/// The roads of a fleet's world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FleetRoads {
    /// One road without junctions.
    Single(SingleRoad),
    /// A town.
    Town(TownPlan),
}

/// What to simulate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FleetScenario {
    /// The roads.
    pub roads: FleetRoads,
    /// Steepest slope of the land: 0.05 is 5 %.
    pub max_grade: f64,
    /// Where the world's origin lies on the earth.
    pub anchor: Wgs84,
    /// Number of drives.
    pub drives: u32,
    /// Time from the start of one drive to that of the next, nanoseconds.
    pub interval_ns: i64,
    /// The ways that they take.
    pub routes: FleetRoutes,
    /// Mean number of lane changes in a kilometre of a road with more than one lane.
    pub lane_changes_per_km: f64,
    /// Speed and wander.
    pub motion: MotionModel,
    /// The lane detector.
    pub detector: DetectorModel,
    /// The odometry.
    pub odometry: OdometryDrift,
    /// GNSS.
    pub receiver: ReceiverModel,
    /// Share of streets with a canyon, where GNSS jumps.
    pub canyon_share: f64,
    /// The camera.
    pub camera: Camera,
    /// Other vehicles, which hide parts of the road.
    pub traffic: TrafficModel,
    /// Drives with gross errors, and drives that lie.
    pub poison: PoisonPlan,
    /// How the road changes.
    pub changes: ChangePlan,
}

impl FleetScenario {
    /// Ten drives, a day apart, along one road of 1.2 km, each 1 km long.
    fn on_road(course: Course) -> Self {
        Self {
            roads: FleetRoads::Single(SingleRoad::new(course, 1_200.0)),
            max_grade: 0.02,
            anchor: TURIN,
            drives: 10,
            interval_ns: DAY_NS,
            routes: FleetRoutes::Shared { length_m: 1_000.0, both_directions: false },
            lane_changes_per_km: 0.6,
            motion: MotionModel::default(),
            detector: DetectorModel::default(),
            odometry: OdometryDrift::default(),
            receiver: ReceiverModel::default(),
            canyon_share: 0.0,
            camera: Camera::default(),
            traffic: TrafficModel::none(),
            poison: PoisonPlan::default(),
            changes: ChangePlan::none(),
        }
    }

    /// Ten drives, a day apart, of 1 km along one straight road of two lanes each way.
    #[must_use]
    pub fn straight_road() -> Self {
        Self::on_road(Course::Straight)
    }

    /// Ten drives, a day apart, of 1 km along one winding road of two lanes each way.
    #[must_use]
    pub fn winding_road() -> Self {
        Self::on_road(Course::Winding)
    }

    /// One drive with 1 % of drift round a closed loop of 2 km and 300 m on.
    #[must_use]
    pub fn closed_loop() -> Self {
        Self {
            roads: FleetRoads::Single(SingleRoad::new(Course::Loop, 2_000.0)),
            drives: 1,
            routes: FleetRoutes::Shared { length_m: 2_300.0, both_directions: false },
            odometry: OdometryDrift::of_way(0.01),
            ..Self::on_road(Course::Loop)
        }
    }

    /// Drives of 1 km each way through a town of about 10 km^2, four a day.
    #[must_use]
    pub fn town(drives: u32) -> Self {
        Self {
            roads: FleetRoads::Town(TownPlan::square_km(3.2)),
            max_grade: 0.03,
            drives,
            interval_ns: DAY_NS / 4,
            routes: FleetRoutes::Random { length_m: 1_000.0 },
            canyon_share: 0.15,
            traffic: TrafficModel::town(),
            ..Self::on_road(Course::Straight)
        }
    }

    /// The same on a town of about 2 km^2.
    #[must_use]
    pub fn small_town(drives: u32) -> Self {
        Self { roads: FleetRoads::Town(TownPlan::small()), ..Self::town(drives) }
    }

    /// Builds the world. The same scenario and seed give the same fleet, to the byte.
    #[must_use]
    pub fn fleet(self, seed: Seed) -> Fleet {
        let network = match &self.roads {
            FleetRoads::Single(road) => road.build(self.max_grade, seed),
            FleetRoads::Town(plan) => plan.build(self.max_grade, seed),
        };
        let canyons = Canyon::scatter(&network, self.canyon_share, &mut seed.stream(Purpose::Canyons, 0));
        let on_earth = Georeference { anchor: Anchor::new(self.anchor), enu_from_map: Pose::identity() };
        let start_of = |drive| start_of(self.interval_ns, drive);
        let changes = &mut seed.stream(Purpose::Changes, 0);
        let timeline = Timeline::draw(&self.changes, &network, start_of, changes);
        Fleet { scenario: self, seed, network, canyons, timeline, on_earth }
    }
}

/// A world and the drives through it.
#[derive(Debug)]
pub struct Fleet {
    scenario: FleetScenario,
    seed: Seed,
    network: RoadNetwork,
    canyons: Vec<Canyon>,
    timeline: Timeline,
    on_earth: Georeference,
}

impl Fleet {
    /// The seed that fixes everything.
    #[must_use]
    pub fn seed(&self) -> Seed {
        self.seed
    }

    /// What is simulated.
    #[must_use]
    pub fn scenario(&self) -> &FleetScenario {
        &self.scenario
    }

    /// The roads, as they were built: see [`Fleet::truth_at`] for what is painted at a time.
    #[must_use]
    pub fn network(&self) -> &RoadNetwork {
        &self.network
    }

    /// The places where GNSS jumps.
    #[must_use]
    pub fn canyons(&self) -> &[Canyon] {
        &self.canyons
    }

    /// Where the world lies on the earth.
    #[must_use]
    pub fn georeference(&self) -> &Georeference {
        &self.on_earth
    }

    /// The camera of all drives.
    #[must_use]
    pub fn sensor(&self) -> Sensor {
        self.scenario.camera.sensor()
    }

    /// Time of the first frame of drive `number`.
    #[must_use]
    pub fn start_of(&self, number: u32) -> TimestampNs {
        start_of(self.scenario.interval_ns, number)
    }

    /// The drives in the order of time, each made when it is asked for.
    pub fn drives(&self) -> impl Iterator<Item = FleetDrive<'_>> {
        (0..self.scenario.drives).map(|number| self.drive(number))
    }

    /// One drive, without the others. Drives beyond the scenario's number are possible too.
    #[must_use]
    pub fn drive(&self, number: u32) -> FleetDrive<'_> {
        FleetDrive::new(self, number)
    }

    /// Every line that is truly there at a time.
    #[must_use]
    pub fn truth_at(&self, time: TimestampNs) -> FleetTruth {
        self.timeline.epoch(&self.network, time).truth(&self.network)
    }

    /// The changes of the road in the order of time.
    #[must_use]
    pub fn changes(&self) -> &[RoadChange] {
        self.timeline.changes()
    }
}

fn start_of(interval_ns: i64, drive: u32) -> TimestampNs {
    TimestampNs(FIRST_START_NS + i64::from(drive) * interval_ns)
}

#[cfg(test)]
mod tests;
