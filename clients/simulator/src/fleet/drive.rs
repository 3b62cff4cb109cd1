//! One drive of a fleet: what is true of it, and the frames that it streams.

use lanemap_core::{
    Detection, Frame, FrameLimits, FrameParts, Occlusion, Odometry, Pose, Sensor, Sequence, TimestampNs,
    frame::MAX_OCCLUSIONS, geometry::pose::yaw_rad,
};
use nalgebra::{Translation3, UnitQuaternion, Vector3};

use super::{
    Fleet,
    changes::Epoch,
    poison::Poison,
    traffic::{OtherVehicle, Traffic},
};
use crate::{
    detector::Detector,
    drive::{Path, Route, TrueState, motion::FRAME_RATE_HZ},
    random::Purpose,
    road::{RoadLine, RoadLineId},
    view::{LineView, legs_in_sight, line_ids_ahead, views_of},
};

/// One drive of a fleet. It holds its poses; its frames are made as they are asked for, the same each time.
#[derive(Debug)]
pub struct FleetDrive<'a> {
    fleet: &'a Fleet,
    number: u32,
    route: Route,
    path: Path,
    epoch: Epoch,
    traffic: Traffic,
    poison: Option<Poison>,
    world_from_odometry: Pose,
    states: Vec<TrueState>,
    fixes: Vec<Pose>,
    odometry: Vec<Pose>,
}

/// One frame of a drive with what is true of it.
#[derive(Clone, Debug)]
pub struct FleetFrame {
    /// What the vehicle streams.
    pub frame: Frame,
    /// Where it truly is.
    pub truth: TrueState,
    /// What of the road is in its camera's view, from left to right, other vehicles aside.
    pub views: Vec<LineView>,
    /// Where GNSS has the vehicle, in the world.
    pub gnss_world_from_vehicle: Pose,
    /// The other vehicles about it.
    pub vehicles: Vec<OtherVehicle>,
}

/// The frames of a drive, one by one.
#[derive(Debug)]
pub struct FleetFrames<'a> {
    drive: &'a FleetDrive<'a>,
    detector: Detector,
    sensor: Sensor,
    next: usize,
}

impl<'a> FleetDrive<'a> {
    pub(super) fn new(fleet: &'a Fleet, number: u32) -> Self {
        let (scenario, seed, network) = (&fleet.scenario, fleet.seed, &fleet.network);
        let route = scenario.routes.route(network, scenario.lane_changes_per_km, seed, number);
        let lane_width_m = route.legs.first().map_or(3.5, |leg| network.link(leg.link).lane_width_m);
        let poison = scenario.poison.draw(lane_width_m, &mut seed.stream(Purpose::Poison, number));
        let mut rng = seed.stream(Purpose::Motion, number);
        let path = Path::along(network, &route, &scenario.motion.lateral_wander(&mut rng));
        let start = fleet.start_of(number);
        let states = scenario.motion.drive(network, &path, scenario.routes.length_m(), start, &mut rng);
        let mut fixes = scenario.receiver.observe(&states, &fleet.canyons, &mut seed.stream(Purpose::Gnss, number));
        let offset = poison.map_or_else(Vector3::zeros, |poison| poison.gnss_offset());
        for fix in &mut fixes {
            fix.translation.vector += offset;
        }
        let world_from_odometry = odometry_frame(&states);
        let exact: Vec<Pose> =
            states.iter().map(|state| world_from_odometry.inverse() * state.world_from_vehicle).collect();
        let more_scale = poison.map_or(0.0, |poison| poison.odometry_scale());
        let odometry = scenario.odometry.apply(&exact, more_scale, &mut seed.stream(Purpose::Odometry, number));
        let traffic = Traffic::draw(&scenario.traffic, &states, &mut seed.stream(Purpose::Traffic, number));
        let epoch = fleet.timeline.epoch(network, start);
        Self { fleet, number, route, path, epoch, traffic, poison, world_from_odometry, states, fixes, odometry }
    }

    /// Number within the fleet, from 0; also the order in time.
    #[must_use]
    pub fn number(&self) -> u32 {
        self.number
    }

    /// Time of the first frame.
    #[must_use]
    pub fn start(&self) -> TimestampNs {
        self.fleet.start_of(self.number)
    }

    /// The camera, as the drive declares it.
    #[must_use]
    pub fn sensor(&self) -> Sensor {
        self.fleet.sensor()
    }

    /// What is wrong with the drive, if anything.
    #[must_use]
    pub fn poison(&self) -> Option<Poison> {
        self.poison
    }

    /// The links and lanes that it drives.
    #[must_use]
    pub fn route(&self) -> &Route {
        &self.route
    }

    /// Where the drive's odometry frame truly lies: its origin is at the first pose, its x axis along it.
    #[must_use]
    pub fn world_from_odometry(&self) -> Pose {
        self.world_from_odometry
    }

    /// Where the vehicle truly is at each frame, metres east, north, up of the fleet's anchor.
    #[must_use]
    pub fn states(&self) -> &[TrueState] {
        &self.states
    }

    /// Distance driven, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.states.last().map_or(0.0, |state| state.distance_m)
    }

    /// A line, or a piece of one, as it is in this drive, by the number that its views bear.
    #[must_use]
    pub fn line(&self, id: RoadLineId) -> Option<&RoadLine> {
        self.epoch.find(&self.fleet.network, id)
    }

    /// The frames that the vehicle streams.
    pub fn frames(&'a self) -> impl Iterator<Item = Frame> + 'a {
        self.observed().map(|observed| observed.frame)
    }

    /// The frames with what is true of them.
    #[must_use]
    pub fn observed(&'a self) -> FleetFrames<'a> {
        let (scenario, sensor) = (&self.fleet.scenario, self.sensor());
        let detector = Detector::new(scenario.detector, sensor, self.fleet.seed.stream(Purpose::Detector, self.number));
        FleetFrames { drive: self, detector, sensor, next: 0 }
    }
}

impl Iterator for FleetFrames<'_> {
    type Item = FleetFrame;

    fn next(&mut self) -> Option<FleetFrame> {
        let (drive, index) = (self.drive, self.next);
        let truth = *drive.states.get(index)?;
        self.next += 1;
        let fleet = drive.fleet;
        let views = views_of(drive.lines_ahead(truth.leg), &truth.world_from_vehicle, &self.sensor);
        let vehicles = drive.traffic.around(&fleet.network, &drive.route, &drive.path, &drive.states, index);
        let shadow = |vehicle: &OtherVehicle| vehicle.shadow(&truth.world_from_vehicle, &self.sensor);
        let shadows: Vec<Occlusion> = vehicles.iter().filter_map(shadow).collect();
        let told = nearest(vehicles.iter().filter(|vehicle| vehicle.told).filter_map(shadow).collect());
        let seen = unhidden(self.detector.observe(&views, 1.0 / FRAME_RATE_HZ), &shadows, &self.sensor);
        let frame = valid(drive.parts(index, self.displaced(seen), told));
        Some(FleetFrame { frame, truth, views, gnss_world_from_vehicle: drive.fixes[index], vehicles })
    }
}

/// What is left of detections in the shadows of other vehicles.
fn unhidden(mut detections: Vec<Detection>, shadows: &[Occlusion], sensor: &Sensor) -> Vec<Detection> {
    for detection in &mut detections {
        detection.points_vehicle.retain(|point| !shadows.iter().any(|shadow| shadow.hides(point, sensor)));
    }
    detections.retain(|detection| detection.points_vehicle.len() >= 2);
    detections
}

/// The nearest of the occlusions, as many as a frame may have.
fn nearest(mut occlusions: Vec<Occlusion>) -> Vec<Occlusion> {
    occlusions.sort_by(|a, b| a.range_m.total_cmp(&b.range_m));
    occlusions.truncate(MAX_OCCLUSIONS);
    occlusions
}

impl FleetFrames<'_> {
    fn displaced(&self, mut detections: Vec<Detection>) -> Vec<Detection> {
        if let Some(poison) = &self.drive.poison {
            let camera = self.sensor.ground_offset();
            for point in detections.iter_mut().flat_map(|detection| &mut detection.points_vehicle) {
                *point = poison.displace(*point, &camera);
            }
        }
        detections
    }
}

impl FleetDrive<'_> {
    /// The lines of a leg and of those after it, as they are in this drive, and whether each is faced in its direction.
    fn lines_ahead(&self, leg: usize) -> impl Iterator<Item = (&RoadLine, bool)> {
        let network = &self.fleet.network;
        let ids = line_ids_ahead(network, &self.route.legs, leg).into_iter();
        let lines =
            ids.flat_map(move |(id, forward)| self.epoch.line(network, id).iter().map(move |line| (line, forward)));
        let legs = legs_in_sight(&self.route.legs, leg);
        let temporary = legs.flat_map(|leg| self.epoch.temporary(leg.link).iter().map(move |line| (line, leg.forward)));
        lines.chain(temporary)
    }

    fn parts(&self, index: usize, detections: Vec<Detection>, occlusions: Vec<Occlusion>) -> FrameParts {
        let receiver = &self.fleet.scenario.receiver;
        let (horizontal_m, vertical_m) = (receiver.stated_horizontal_m(), receiver.stated_vertical_m());
        FrameParts {
            sequence: Sequence(index as u64 + 1),
            time: self.states[index].time,
            odometry: Odometry {
                odometry_from_vehicle: self.odometry[index],
                motion_covariance: Some(self.fleet.scenario.odometry.motion_covariance()),
            },
            gnss: Some(self.fleet.on_earth.fix_at(&self.fixes[index], horizontal_m, vertical_m)),
            detections,
            occlusions,
        }
    }
}

#[expect(clippy::expect_used, reason = "simulated numbers are finite and lie within kilometres of the anchor")]
fn valid(parts: FrameParts) -> Frame {
    Frame::new(parts, &FrameLimits::default())
        .expect("simulated numbers are finite and lie within kilometres of the anchor")
}

fn odometry_frame(states: &[TrueState]) -> Pose {
    let Some(first) = states.first() else { return Pose::identity() };
    let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad(&first.world_from_vehicle));
    Pose::from_parts(Translation3::from(first.world_from_vehicle.translation.vector), heading)
}
