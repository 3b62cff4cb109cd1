//! The mapper: one vehicle's frames in, one drive's lane map out.
//!
//! [`Mapper::step`] is the paper's pipeline (figure 2) in its order: predict, observe, associate, correct the pose, then
//! smooth, grow and begin lanes, and judge what exists.

mod local_map;
mod scene;

use std::collections::BTreeMap;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::{
    association::{LaneShape, PoseUncertainty, associate_by_chamfer, associate_jointly},
    error::SnapshotError,
    frame::{Frame, Sequence, TimestampNs},
    geometry::{
        Pose, TangentCovariance,
        georeference::{Georeference, GeoreferenceFit},
        pose::without_negative_zeros,
    },
    landmark::{
        Landmark, clean_up, duplicate,
        existence::DETECTION,
        index::{LaneIndex, NearbyRun},
        information::Knot,
    },
    lane_map::{LaneId, LaneMap, LocalLane, LocalWindow},
    observation::{LaneObservation, observe},
    params::{Params, Preset},
    sensor::Sensor,
    tracking::{PoseEstimate, update_pose},
};
use scene::Scene;

/// Version of the bytes that [`Mapper::snapshot`] writes.
const SNAPSHOT_VERSION: u16 = 9;

/// A mapper of one drive. Deterministic: the same frames give the same bytes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Mapper {
    params: Params,
    sensor: Sensor,
    pose: PoseEstimate,
    /// Odometry of the last frame; `None` before the first.
    odometry_from_vehicle: Option<Pose>,
    /// Time of the last frame.
    time: TimestampNs,
    /// Frames taken.
    frames: u64,
    /// Way of the vehicle by odometry, metres.
    way_m: f64,
    lanes: BTreeMap<LaneId, Landmark>,
    index: LaneIndex,
    last_lane: u64,
    /// Lanes that the last frame saw.
    seen_now: Vec<LaneId>,
    georeference: GeoreferenceFit,
}

/// A detection that was taken for a lane of the map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AssociatedDetection {
    /// Index of the detection in its frame.
    pub detection: usize,
    /// The lane.
    pub lane: LaneId,
}

/// What one step changed.
#[derive(Clone, Debug, PartialEq)]
pub struct StepReport {
    /// The frame's number.
    pub sequence: Sequence,
    /// Detections taken for lanes that the map already had.
    pub associated: Vec<AssociatedDetection>,
    /// Detections that began a lane.
    pub born: Vec<AssociatedDetection>,
    /// Lanes that became longer.
    pub grown: Vec<LaneId>,
    /// Lanes that were given up, or joined to another.
    pub dropped: Vec<LaneId>,
    /// Corrected pose of the vehicle in the map frame.
    pub map_from_vehicle: Pose,
    /// Covariance of that pose relative to the map around it, in the vehicle's axes.
    pub covariance: TangentCovariance,
}

impl Mapper {
    /// A mapper that knows nothing yet. Its map frame is the odometry frame of the drive at the first frame.
    #[must_use]
    pub fn new(params: Params, mut sensor: Sensor) -> Self {
        // As in a frame: the mapper is the same on both sides of the wire.
        sensor.vehicle_from_sensor = without_negative_zeros(&sensor.vehicle_from_sensor);
        Self {
            params,
            sensor,
            pose: PoseEstimate::first(Pose::identity()),
            odometry_from_vehicle: None,
            time: TimestampNs(0),
            frames: 0,
            way_m: 0.0,
            lanes: BTreeMap::new(),
            index: LaneIndex::default(),
            last_lane: 0,
            seen_now: Vec::new(),
            georeference: GeoreferenceFit::default(),
        }
    }

    /// Takes one frame. Frames come in the order of their sequence; the caller sees to that.
    pub fn step(&mut self, frame: &Frame) -> StepReport {
        let predicted = self.predict(frame);
        let observations = self.observe(frame);
        let scene = Scene::around(&predicted, &self.lanes, &self.index, &self.params);
        let matching = self.associate(&observations, &scene, &predicted);
        self.pose = self.correct_pose(&observations, &scene, &matching, &predicted);
        let mut report = self.update_lanes(frame, &observations, &scene, &matching.lane_of);
        report.dropped = self.judge_existence(&scene);
        report.dropped.extend(self.join_duplicates(&scene));
        if let Some(fix) = frame.gnss() {
            self.georeference.observe(fix, &self.pose.map_from_vehicle);
        }
        report
    }

    fn predict(&mut self, frame: &Frame) -> PoseEstimate {
        let odometry = frame.odometry();
        let previous = self.odometry_from_vehicle.replace(odometry.odometry_from_vehicle);
        let seconds = frame.time().seconds_since(self.time);
        self.time = frame.time();
        self.frames += 1;
        if let Some(previous) = &previous {
            self.way_m += nalgebra::distance(
                &previous.translation.vector.into(),
                &odometry.odometry_from_vehicle.translation.vector.into(),
            );
            self.index.forget_touched_before(self.way_m - self.params.landmark.left_behind_m);
        }
        match previous {
            Some(previous) => self.pose.predict(&previous, odometry, seconds, &self.params.tracking),
            None => PoseEstimate::first(odometry.odometry_from_vehicle),
        }
    }

    fn observe(&self, frame: &Frame) -> Vec<LaneObservation> {
        let detections = frame.detections().iter().enumerate();
        detections
            .filter_map(|(index, detection)| observe(detection, index, &self.sensor, &self.params.observation))
            .collect()
    }

    fn associate(&self, observations: &[LaneObservation], scene: &Scene, predicted: &PoseEstimate) -> Matching {
        let params = &self.params.association;
        let detections: Vec<LaneShape> = observations
            .iter()
            .map(|observation| {
                LaneShape::seen_once(observation.category, observation.samples.clone(), params.category_confusion)
            })
            .collect();
        let sigma = |axis: usize| predicted.covariance[(axis, axis)].max(0.0).sqrt();
        let uncertainty = PoseUncertainty { yaw_rad: sigma(5), along_m: sigma(0), across_m: sigma(1) };
        match self.params.preset {
            Preset::Paper => {
                let lane_of = associate_by_chamfer(&detections, &scene.shapes, &uncertainty, params, true);
                Matching { lane_of, start: predicted.map_from_vehicle }
            }
            Preset::Default => {
                let found = associate_jointly(&detections, &scene.shapes, &uncertainty, params);
                let start = scene::displaced(&predicted.map_from_vehicle, &found.pose_error);
                Matching { lane_of: found.lane_of, start }
            }
        }
    }

    fn correct_pose(
        &self,
        observations: &[LaneObservation],
        scene: &Scene,
        matching: &Matching,
        predicted: &PoseEstimate,
    ) -> PoseEstimate {
        let matched = scene.matched_lanes(observations, &matching.lane_of, &self.lanes, &self.params);
        if matched.is_empty() {
            return *predicted;
        }
        update_pose(predicted, &matching.start, &matched, &self.params.tracking)
    }

    fn update_lanes(
        &mut self,
        frame: &Frame,
        observations: &[LaneObservation],
        scene: &Scene,
        lane_of: &[Option<usize>],
    ) -> StepReport {
        let mut report = StepReport {
            sequence: frame.sequence(),
            associated: Vec::new(),
            born: Vec::new(),
            grown: Vec::new(),
            dropped: Vec::new(),
            map_from_vehicle: self.pose.map_from_vehicle,
            covariance: self.pose.covariance,
        };
        self.seen_now.clear();
        for (observation, shape) in observations.iter().zip(lane_of) {
            let detection = observation.detection;
            if let Some(run) = shape.map(|shape| scene.runs[shape]) {
                if self.extend_lane(&run, observation, frame.time()) {
                    report.grown.push(run.lane);
                }
                report.associated.push(AssociatedDetection { detection, lane: run.lane });
            } else if let Some(lane) = self.begin_lane(observation, frame.time()) {
                report.born.push(AssociatedDetection { detection, lane });
            }
        }
        report
    }

    /// Takes an associated observation into its lane; whether the lane became longer.
    fn extend_lane(&mut self, run: &NearbyRun, observation: &LaneObservation, time: TimestampNs) -> bool {
        let Some(lane) = self.lanes.get_mut(&run.lane) else { return false };
        let params = &self.params.landmark;
        let grown = lane.grow(observation, &self.pose.map_from_vehicle, params);
        // What the run leaves out lies behind, out of view.
        if lane.existence.probability() > self.params.landmark.published_existence && lane.knots().0 < run.first {
            lane.existence.prove();
        }
        let near = scene::near_knots(lane, run);
        Self::take_in(lane, observation, time, &self.pose.map_from_vehicle, near, &self.sensor, &self.params);
        lane.seen_at_frame = self.frames;
        self.seen_now.push(run.lane);
        self.index.update(run.lane, lane.information(), near.0, near.1, self.way_m);
        grown
    }

    /// Begins a lane with an observation that is none of the map's.
    fn begin_lane(&mut self, observation: &LaneObservation, time: TimestampNs) -> Option<LaneId> {
        let id = LaneId(self.last_lane + 1);
        let pose = &self.pose.map_from_vehicle;
        let mut lane = Landmark::begin(id, observation, pose, time, &self.params)?;
        (lane.born_at_frame, lane.seen_at_frame) = (self.frames, self.frames);
        self.last_lane += 1;
        let all = lane.knots();
        Self::take_in(&mut lane, observation, time, &self.pose.map_from_vehicle, all, &self.sensor, &self.params);
        self.index.update(id, lane.information(), all.0, all.1, self.way_m);
        self.lanes.insert(id, lane);
        self.seen_now.push(id);
        Some(id)
    }

    /// What every observation does to its lane: smooth it, vote on its extent and category, raise its existence.
    fn take_in(
        lane: &mut Landmark,
        observation: &LaneObservation,
        time: TimestampNs,
        map_from_vehicle: &Pose,
        near: (Knot, Knot),
        sensor: &Sensor,
        params: &Params,
    ) {
        let seconds = time.seconds_since(lane.last_seen);
        lane.smooth(observation, map_from_vehicle, seconds, near, params);
        let visibility =
            |point: &Point3<f64>| scene::visibility(&map_from_vehicle.inverse_transform_point(point), sensor, params);
        lane.vote_extent(observation, map_from_vehicle, near, visibility, &params.landmark);
        lane.category.vote(observation.category);
        lane.existence.seen(DETECTION);
        lane.missed = 0;
        lane.observations += 1;
        lane.last_seen = time;
    }

    /// Lowers the existence of lanes that this frame should have seen, and gives up those that are not there: forgets
    /// them, or, where they were there before, sees no more of them.
    fn judge_existence(&mut self, scene: &Scene) -> Vec<LaneId> {
        if self.params.preset == Preset::Paper {
            return self.end_trials(scene);
        }
        let mut dropped = Vec::new();
        for run in &scene.runs {
            if self.seen_now.contains(&run.lane) {
                continue;
            }
            let Some(lane) = self.lanes.get_mut(&run.lane) else { continue };
            let chance =
                scene::detection_probability(lane, run, &self.pose.map_from_vehicle, &self.sensor, &self.params);
            lane.existence.missed(chance);
            lane.missed += 1;
            if lane.existence.is_given_up() {
                dropped.push(*run);
            }
        }
        dropped.retain(|run| !self.retire(run));
        let dropped: Vec<LaneId> = dropped.iter().map(|run| run.lane).collect();
        for id in &dropped {
            self.forget(*id);
        }
        dropped
    }

    /// Keeps a lane that is given up for the stretch that was there; whether there was one.
    fn retire(&mut self, run: &NearbyRun) -> bool {
        let least = self.params.landmark.published_existence;
        let Some(lane) = self.lanes.get_mut(&run.lane).filter(|lane| lane.existence.greatest_probability() > least)
        else {
            return false;
        };
        lane.retired = true;
        let pose = &self.pose.map_from_vehicle;
        let visibility =
            |point: &Point3<f64>| scene::visibility(&pose.inverse_transform_point(point), &self.sensor, &self.params);
        lane.vote_missed((run.first, run.last), visibility, &self.params.landmark);
        self.index.remove(run.lane);
        self.seen_now.retain(|seen| *seen != run.lane);
        true
    }

    /// The authors' rule: a lane that few frames saw by the end of its trial is given up.
    fn end_trials(&mut self, scene: &Scene) -> Vec<LaneId> {
        let params = &self.params.landmark;
        let failed = |lane: &Landmark| {
            self.frames - lane.born_at_frame == params.trial_frames && lane.observations < params.least_observations
        };
        let nearby = scene.runs.iter().map(|run| run.lane);
        let dropped: Vec<LaneId> = nearby.filter(|id| self.lanes.get(id).is_some_and(failed)).collect();
        for id in &dropped {
            self.forget(*id);
        }
        dropped
    }

    fn forget(&mut self, id: LaneId) {
        self.lanes.remove(&id);
        self.index.remove(id);
        self.seen_now.retain(|seen| *seen != id);
    }

    /// Joins lanes that turned out to be one; the younger goes into the older.
    fn join_duplicates(&mut self, scene: &Scene) -> Vec<LaneId> {
        if self.params.preset == Preset::Paper {
            return Vec::new();
        }
        let mut joined = Vec::new();
        for (position, old_run) in scene.runs.iter().enumerate() {
            for (further, young_run) in scene.runs.iter().enumerate().skip(position + 1) {
                let (old, young) = (old_run.lane, young_run.lane);
                if !joined.contains(&old)
                    && !joined.contains(&young)
                    && scene.may_run_together(position, further)
                    && self.are_one(old_run, young_run)
                {
                    self.join(old_run, young);
                    joined.push(young);
                }
            }
        }
        joined
    }

    /// Whether two lanes turn out to be one by what this frame shows of them.
    fn are_one(&mut self, old_run: &NearbyRun, young_run: &NearbyRun) -> bool {
        let unseen = match (self.seen_now.contains(&old_run.lane), self.seen_now.contains(&young_run.lane)) {
            (true, true) => None,
            (true, false) => Some(self.detection_probability(young_run)),
            (false, true) => Some(self.detection_probability(old_run)),
            (false, false) => return false,
        };
        let is_telling = |young| duplicate::is_telling(young, old_run.lane, unseen);
        if !self.lanes.get(&young_run.lane).is_some_and(is_telling) {
            return false;
        }
        let Some(distance_m) = self.run_together(old_run, young_run) else { return false };
        let Some(young) = self.lanes.get_mut(&young_run.lane) else { return false };
        duplicate::judge(young, old_run.lane, unseen.is_none(), distance_m)
    }

    fn run_together(&self, old: &NearbyRun, young: &NearbyRun) -> Option<f64> {
        let (a, b) = (self.lanes.get(&old.lane)?, self.lanes.get(&young.lane)?);
        duplicate::run_together(b, (young.first, young.last), a, (old.first, old.last), &self.params.landmark)
    }

    fn detection_probability(&self, run: &NearbyRun) -> f64 {
        let pose = &self.pose.map_from_vehicle;
        let of = |lane| scene::detection_probability(lane, run, pose, &self.sensor, &self.params);
        self.lanes.get(&run.lane).map_or(0.0, of)
    }

    fn join(&mut self, old_run: &NearbyRun, young: LaneId) {
        let old = old_run.lane;
        let Some(other) = self.lanes.remove(&young) else { return };
        self.index.remove(young);
        let seen = self.seen_now.contains(&young);
        self.seen_now.retain(|id| *id != young);
        if let Some(lane) = self.lanes.get_mut(&old) {
            lane.absorb(&other, &self.params.landmark);
            let (first, last) = scene::near_knots(lane, old_run);
            self.index.update(old, lane.information(), first, last, self.way_m);
            if seen {
                self.seen_now.push(old);
            }
        }
    }

    /// Corrected pose of the vehicle at the last frame.
    #[must_use]
    pub fn map_from_vehicle(&self) -> Pose {
        self.pose.map_from_vehicle
    }

    /// Parameters of this mapper.
    #[must_use]
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// Where on the earth the map frame lies, once GNSS fixes have determined it.
    #[must_use]
    pub fn georeference(&self) -> Option<Georeference> {
        self.georeference.georeference()
    }

    /// Every lane of the drive that is worth showing, in the order of birth.
    #[must_use]
    pub fn lane_map(&self) -> LaneMap {
        let shown = self.lanes.values().filter(|lane| local_map::is_published(lane, &self.params));
        LaneMap { lanes: shown.filter_map(|lane| local_map::map_lane(lane, &self.params)).collect() }
    }

    /// The map of a drive that is over: [`Mapper::lane_map`] after the preset's [`clean_up`], where it has one.
    #[must_use]
    pub fn finished_lane_map(&self) -> LaneMap {
        let params = &self.params.landmark;
        let LaneMap { mut lanes } = self.lane_map();
        if let Some(rule) = &params.clean_up {
            let given_up = clean_up::given_up(self.lanes.values(), rule, params);
            lanes.retain(|lane| !given_up.contains(&lane.id));
        }
        LaneMap { lanes }
    }

    /// The map around the vehicle at the last frame, in its own axes.
    #[must_use]
    pub fn local_map(&self, window: &LocalWindow) -> Vec<LocalLane> {
        local_map::local_map(self, window)
    }

    /// The whole state as bytes; [`Mapper::restore`] goes on from there as if nothing had happened.
    #[must_use]
    pub fn snapshot(&self) -> Vec<u8> {
        // Writing to memory fails only for types that postcard cannot hold, and a mapper has none of them (tested).
        postcard::to_stdvec(&(SNAPSHOT_VERSION, self)).unwrap_or_default()
    }

    /// A mapper from the bytes of [`Mapper::snapshot`].
    ///
    /// # Errors
    /// Bytes of another format version, or that do not decode.
    pub fn restore(bytes: &[u8]) -> Result<Self, SnapshotError> {
        let (found, rest): (u16, &[u8]) = postcard::take_from_bytes(bytes)?;
        if found != SNAPSHOT_VERSION {
            return Err(SnapshotError::Version { found, expected: SNAPSHOT_VERSION });
        }
        Ok(postcard::from_bytes(rest)?)
    }
}

/// What association found.
struct Matching {
    /// For each observation the index of its lane in the scene.
    lane_of: Vec<Option<usize>>,
    /// The pose at which the frame fits best, where the pose update starts.
    start: Pose,
}
