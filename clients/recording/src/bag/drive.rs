//! Reads a drive from a bag: pairs poses and lanes by their stamps.

use std::{
    collections::BTreeMap,
    io::{Read, Seek},
    path::Path,
};

use lanemap_core::{FrameParts, Odometry, Sensor, Sequence, TimestampNs, geometry::Pose};
use lanemap_openlane::Annotation;

use super::{
    definition::Definitions,
    lanes::{LanesReader, PoseReader},
    records::{Connection, Met, Place, Records, content_at},
};
use crate::{
    drive::{BagOptions, Camera, FrameFault, RecordedFrame},
    error::RecordingError,
    input::Input,
    open::camera_of,
};

/// Connections of a bag, more than which none has.
const MAX_CONNECTIONS: usize = 4096;
/// Most messages of one topic: 28 hours at 100 Hz.
const MAX_MESSAGES: usize = 10_000_000;
/// Topics named in an error, and faults kept word by word.
const MOST_NAMED: usize = 12;
/// Faults kept.
const MOST_FAULTS: usize = 1000;

/// Said of a bag without a camera.
const NO_CAMERA: &str = "the bag does not say how the camera is mounted: the camera is taken for the vehicle, and the map is \
                         that of the camera; name an OpenLane annotation of the same camera to have the vehicle's";

/// A drive in a ROS 1 bag.
#[derive(Debug)]
pub struct BagDrive<R> {
    input: Input<R>,
    name: String,
    camera: Camera,
    vehicle_from_camera: Pose,
    lanes: BTreeMap<u32, LanesReader>,
    frames: Vec<PairedFrame>,
    faults: Vec<FrameFault>,
    notes: Vec<String>,
}

/// Lanes with the pose of the same stamp.
#[derive(Clone, Copy, Debug)]
struct PairedFrame {
    time: TimestampNs,
    world_from_camera: Pose,
    connection: u32,
    place: Place,
}

impl<R: Read + Seek> BagDrive<R> {
    /// Opens a bag, and reads its poses and the stamps of its lanes.
    ///
    /// # Errors
    /// No bag, a topic that is not there, or messages that lack a field or hold it as another type. A bag that is cut short,
    /// or whose chunks are in part not in order, is opened; [`BagDrive::frames`] ends with the errors that say so.
    pub fn open(path: &Path, source: R, options: &BagOptions) -> Result<Self, RecordingError> {
        let mut input = Input::new(path, source)?;
        let index = Index::of(&mut input, options)?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut notes = Vec::new();
        let camera = if let Some(camera) = &options.camera {
            camera_from(&camera_of(camera, &name)?)
        } else {
            notes.push(NO_CAMERA.to_owned());
            Camera { sensor: Sensor::default(), intrinsic: None, image: None }
        };
        Ok(index.into_drive(input, name, camera, notes))
    }

    /// Name of the drive: that of the file, without its ending.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of frames: lanes that have a pose of the same stamp.
    #[must_use]
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether the drive has no frame.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// What the bag does not say, and what is assumed in its place.
    #[must_use]
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Reads the frames in the order of their stamps, numbered from 1; then come the faults of the whole bag.
    pub fn frames(&mut self) -> impl Iterator<Item = Result<RecordedFrame, FrameFault>> + Send + '_
    where
        R: Send,
    {
        let Self { input, camera, vehicle_from_camera, lanes, frames, faults, .. } = self;
        let mut content = Content::default();
        let read = frames.iter().enumerate().map(move |(index, paired)| {
            let read = frame(input, &mut content, lanes, vehicle_from_camera, paired, index);
            let frame = || format!("stamp {}", seconds(paired.time));
            read.map(|parts| RecordedFrame {
                parts,
                poses_are_true: true,
                world_from_vehicle_gnss: None,
                camera: camera.clone(),
            })
            .map_err(|error| FrameFault { frame: frame(), error })
        });
        read.chain(faults.drain(..).map(Err))
    }
}

/// The content of the chunk that was read last.
#[derive(Default)]
struct Content {
    offset: Option<u64>,
    bytes: Vec<u8>,
}

fn frame<R: Read + Seek>(
    input: &mut Input<R>,
    content: &mut Content,
    lanes: &BTreeMap<u32, LanesReader>,
    vehicle_from_camera: &Pose,
    paired: &PairedFrame,
    index: usize,
) -> Result<FrameParts, RecordingError> {
    let Place { offset, start, length } = paired.place;
    if content.offset != Some(offset) {
        *content = Content { offset: Some(offset), bytes: content_at(input, offset)? };
    }
    let (start, length) = (start as usize, length as usize);
    let refuse = |problem: String| RecordingError::record(input.path(), offset, format!("a message {problem}"));
    let bytes = content.bytes.get(start..).and_then(|rest| rest.get(..length));
    let bytes = bytes.ok_or_else(|| refuse("is no longer where it was".to_owned()))?;
    let reader = lanes.get(&paired.connection).ok_or_else(|| refuse("has no connection".to_owned()))?;
    let detections = reader.read(bytes, vehicle_from_camera).map_err(refuse)?;
    let odometry_from_vehicle = paired.world_from_camera * vehicle_from_camera.inverse();
    Ok(FrameParts {
        sequence: Sequence(index as u64 + 1),
        time: paired.time,
        odometry: Odometry { odometry_from_vehicle, motion_covariance: None },
        gnss: None,
        detections,
        occlusions: Vec::new(),
    })
}

fn camera_from(annotation: &Annotation) -> Camera {
    Camera { sensor: annotation.sensor(), intrinsic: Some(annotation.intrinsic), image: None }
}

/// What a bag holds of a drive.
struct Index {
    path: std::path::PathBuf,
    topics: BTreeMap<String, String>,
    pose_readers: BTreeMap<u32, PoseReader>,
    lanes_readers: BTreeMap<u32, LanesReader>,
    poses: BTreeMap<TimestampNs, Pose>,
    lanes: BTreeMap<TimestampNs, (u32, Place)>,
    faults: Vec<FrameFault>,
    more_faults: usize,
}

impl Index {
    fn of<R: Read + Seek>(input: &mut Input<R>, options: &BagOptions) -> Result<Self, RecordingError> {
        let mut index = Self {
            path: input.path().to_owned(),
            topics: BTreeMap::new(),
            pose_readers: BTreeMap::new(),
            lanes_readers: BTreeMap::new(),
            poses: BTreeMap::new(),
            lanes: BTreeMap::new(),
            faults: Vec::new(),
            more_faults: 0,
        };
        let mut records = Records::new(input)?;
        loop {
            match records.next(&mut |met| index.meet(met, options)) {
                Ok(true) => {}
                Ok(false) => break,
                // What messages lack is wrong with all of them; anything else is a fault of its place.
                Err(error @ RecordingError::Content { .. }) => return Err(error),
                Err(error) => index.fault("the bag".to_owned(), error),
            }
        }
        index.require(&options.pose_topic, index.pose_readers.is_empty(), "--bag-pose-topic")?;
        index.require(&options.lanes_topic, index.lanes_readers.is_empty(), "--bag-lanes-topic")?;
        Ok(index)
    }

    fn meet(&mut self, met: Met<'_>, options: &BagOptions) -> Result<(), RecordingError> {
        match met {
            Met::Connection(connection) => self.connect(&connection, options),
            Met::Message { connection, place, data } => {
                let refuse = |problem: String| (place, problem);
                let taken = if let Some(reader) = self.pose_readers.get(&connection) {
                    reader.read(data).map_err(refuse).and_then(|(time, pose)| self.take_pose(place, time, pose))
                } else if let Some(reader) = self.lanes_readers.get(&connection) {
                    reader.stamp(data).map_err(refuse).and_then(|time| self.take_lanes(connection, place, time))
                } else {
                    Ok(())
                };
                if let Err((place, problem)) = taken {
                    let problem = format!("a message at byte {} of the chunk's content {problem}", place.start);
                    let error = RecordingError::record(&self.path, place.offset, problem);
                    self.fault("a message".to_owned(), error);
                }
                Ok(())
            }
        }
    }

    fn connect(&mut self, connection: &Connection, options: &BagOptions) -> Result<(), RecordingError> {
        let Connection { id, topic, kind, definition } = connection;
        if self.topics.len() < MAX_CONNECTIONS {
            self.topics.insert(topic.clone(), kind.clone());
        }
        let known = self.pose_readers.contains_key(id) || self.lanes_readers.contains_key(id);
        if known || (*topic != options.pose_topic && *topic != options.lanes_topic) {
            return Ok(());
        }
        let path = self.path.clone();
        let refuse = |problem: String| RecordingError::content(&path, format!("topic {topic} ({kind}): {problem}"));
        if self.pose_readers.len() + self.lanes_readers.len() >= MAX_CONNECTIONS {
            return Err(refuse(format!("has more than {MAX_CONNECTIONS} publishers")));
        }
        let definitions = Definitions::parse(kind, definition).map_err(|error| refuse(error.to_string()))?;
        if *topic == options.pose_topic {
            self.pose_readers.insert(*id, PoseReader::new(definitions).map_err(refuse)?);
        } else {
            self.lanes_readers.insert(*id, LanesReader::new(definitions).map_err(refuse)?);
        }
        Ok(())
    }

    fn take_pose(&mut self, place: Place, time: TimestampNs, pose: Pose) -> Result<(), (Place, String)> {
        room(self.poses.len(), place)?;
        match self.poses.insert(time, pose) {
            Some(before) if before != pose => Err((place, format!("is another pose of the stamp {}", seconds(time)))),
            _ => Ok(()),
        }
    }

    fn take_lanes(&mut self, connection: u32, place: Place, time: TimestampNs) -> Result<(), (Place, String)> {
        room(self.lanes.len(), place)?;
        if self.lanes.contains_key(&time) {
            return Err((place, format!("has the stamp {} of lanes before it, which are taken", seconds(time))));
        }
        self.lanes.insert(time, (connection, place));
        Ok(())
    }

    fn fault(&mut self, frame: String, error: RecordingError) {
        if self.faults.len() < MOST_FAULTS {
            self.faults.push(FrameFault { frame, error });
        } else {
            self.more_faults += 1;
        }
    }

    fn require(&self, topic: &str, is_missing: bool, option: &str) -> Result<(), RecordingError> {
        if !is_missing {
            return Ok(());
        }
        let mut there: Vec<_> = self.topics.iter().map(|(topic, kind)| format!("{topic} ({kind})")).collect();
        let more = there.len().saturating_sub(MOST_NAMED);
        there.truncate(MOST_NAMED);
        if more > 0 {
            there.push(format!("{more} more"));
        }
        let there = if there.is_empty() { "no topic at all".to_owned() } else { there.join(", ") };
        let because = self.faults.first().map(|fault| format!(" (and: {})", fault.error)).unwrap_or_default();
        let problem = format!("has no topic {topic}; it has {there}{because}; {option} names another topic");
        Err(RecordingError::content(&self.path, problem))
    }

    fn into_drive<R>(mut self, input: Input<R>, name: String, camera: Camera, mut notes: Vec<String>) -> BagDrive<R> {
        let mut frames = Vec::with_capacity(self.lanes.len());
        for (time, (connection, place)) in std::mem::take(&mut self.lanes) {
            if let Some(pose) = self.poses.get(&time) {
                frames.push(PairedFrame { time, world_from_camera: *pose, connection, place });
                continue;
            }
            let nearest = self.nearest_pose(time);
            let problem = format!("lanes have no pose of the same stamp; the nearest is {nearest}");
            let error = RecordingError::record(&self.path, place.offset, problem);
            self.fault(format!("stamp {}", seconds(time)), error);
        }
        let unused = self.poses.len() - frames.len();
        if unused > 0 {
            notes.push(format!(
                "{unused} of {} poses have no lanes of the same stamp and are not used",
                self.poses.len()
            ));
        }
        if self.more_faults > 0 {
            let problem = format!("{} more faults of this kind", self.more_faults);
            self.faults
                .push(FrameFault { frame: "the bag".to_owned(), error: RecordingError::content(&self.path, problem) });
        }
        if let Some(lanes) = self.lanes_readers.values().find(|lanes| !lanes.has_category()) {
            notes.push(format!("{} have no category: every line is of unknown kind", lanes.points_path()));
        }
        let vehicle_from_camera = camera.sensor.vehicle_from_sensor;
        let (lanes, faults) = (self.lanes_readers, self.faults);
        BagDrive { input, name, camera, vehicle_from_camera, lanes, frames, faults, notes }
    }

    fn nearest_pose(&self, time: TimestampNs) -> String {
        let before = self.poses.range(..time).next_back().map(|(at, _)| time.seconds_since(*at));
        let after = self.poses.range(time..).next().map(|(at, _)| at.seconds_since(time));
        match (before, after) {
            (Some(before), Some(after)) if before <= after => format!("{before:.6} s before it"),
            (_, Some(after)) => format!("{after:.6} s after it"),
            (Some(before), None) => format!("{before:.6} s before it"),
            (None, None) => "not there: the bag has no pose".to_owned(),
        }
    }
}

/// Whether there is room for one more message of a topic.
fn room(messages: usize, place: Place) -> Result<(), (Place, String)> {
    if messages < MAX_MESSAGES { Ok(()) } else { Err((place, format!("is beyond the limit of {MAX_MESSAGES}"))) }
}

fn seconds(time: TimestampNs) -> String {
    format!("{}.{:09}", time.0.div_euclid(1_000_000_000), time.0.rem_euclid(1_000_000_000))
}
