//! A recorded drive, whatever it was recorded as.

use std::{fs::File, io::BufReader, path::PathBuf};

use lanemap_core::{FrameParts, Sensor, geometry::Pose};
use lanemap_openlane::{DriveFolder, Intrinsic};

use crate::{bag::BagDrive, error::RecordingError, mcap::McapDrive, openlane};

/// One frame of a recorded drive.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedFrame {
    /// The frame as recorded: poses as odometry, detections in the vehicle frame. Not validated yet.
    pub parts: FrameParts,
    /// Whether the poses are the truth, as in OpenLane folders and the bags made of them, or a vehicle's odometry.
    pub poses_are_true: bool,
    /// Pose of the vehicle in the drive's world as a GNSS receiver gave it, where the recording has that and no fix.
    pub world_from_vehicle_gnss: Option<Pose>,
    /// The camera.
    pub camera: Camera,
}

/// The camera of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Mount and field of view.
    pub sensor: Sensor,
    /// Focal lengths and principal point, where the recording has them.
    pub intrinsic: Option<Intrinsic>,
    /// Name of the image, where the recording has one.
    pub image: Option<String>,
}

/// A frame, or a piece of a recording, that cannot be read. What follows it may be whole.
#[derive(Debug)]
pub struct FrameFault {
    /// Which one, e.g. a file name, or `frame 12`.
    pub frame: String,
    /// What is wrong with it.
    pub error: RecordingError,
}

/// The frames of a drive in the order of time.
pub type Frames<'a> = Box<dyn Iterator<Item = Result<RecordedFrame, FrameFault>> + Send + 'a>;

/// A recorded drive.
#[derive(Debug)]
pub enum RecordedDrive {
    /// An OpenLane folder.
    OpenLane(DriveFolder),
    /// An MCAP file.
    Mcap(Box<McapDrive<BufReader<File>>>),
    /// A ROS 1 bag.
    Bag(Box<BagDrive<BufReader<File>>>),
}

impl RecordedDrive {
    /// Name of the drive: that of its folder, or of its file, or the one that was recorded with it.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::OpenLane(folder) => folder.name(),
            Self::Mcap(drive) => drive.name(),
            Self::Bag(drive) => drive.name(),
        }
    }

    /// Number of frames.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::OpenLane(folder) => folder.len(),
            Self::Mcap(drive) => drive.len(),
            Self::Bag(drive) => drive.len(),
        }
    }

    /// Whether the drive has no frame.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// What the recording does not say, and what is assumed in its place.
    #[must_use]
    pub fn notes(&self) -> &[String] {
        match self {
            Self::OpenLane(_) | Self::Mcap(_) => &[],
            Self::Bag(drive) => drive.notes(),
        }
    }

    /// Reads the frames. One that cannot be read is an error of its own; the rest goes on.
    pub fn frames(&mut self) -> Frames<'_> {
        match self {
            Self::OpenLane(folder) => Box::new(openlane::frames(folder)),
            Self::Mcap(drive) => Box::new(drive.frames()),
            Self::Bag(drive) => Box::new(drive.frames()),
        }
    }
}

/// How recordings are read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadOptions {
    /// Only drives whose name contains one of these texts; empty: all.
    pub only: Vec<String>,
    /// Of a bag: topic of the poses, topic of the lanes, and the camera, which a bag does not hold.
    pub bag: BagOptions,
}

/// What a bag does not say of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct BagOptions {
    /// Topic of the camera's poses in the world.
    pub pose_topic: String,
    /// Topic of the lanes.
    pub lanes_topic: String,
    /// An OpenLane annotation, or a folder of drives with one of the bag's name, whose camera is the bag's. Without it the
    /// camera is taken for the vehicle, as the paper's authors do.
    pub camera: Option<PathBuf>,
}

impl Default for BagOptions {
    fn default() -> Self {
        Self { pose_topic: "/gt_pose_wc".to_owned(), lanes_topic: "/lanes_predict".to_owned(), camera: None }
    }
}
