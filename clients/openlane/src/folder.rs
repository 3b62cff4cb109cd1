//! Drives as folders of frames.

use std::{
    fs,
    path::{Path, PathBuf},
};

use nalgebra::Point3;

use lanemap_core::{
    Detection, FrameParts, Odometry, Sequence, TimestampNs, evaluation::GroundFrame, geometry::Pose,
    geometry::TangentCovariance,
};

use crate::{
    annotation::Annotation,
    detection_file::DetectionFile,
    error::OpenLaneError,
    timestamp::{timestamp_from_stem, timestamp_stem},
};

/// A folder of drives.
pub struct Drives;

impl Drives {
    /// The drives of a folder in the order of their names; with `only`, those whose name contains one of its texts.
    ///
    /// # Errors
    /// A folder that cannot be read, or a text of `only` that no drive's name contains.
    pub fn list(root: impl AsRef<Path>, only: &[String]) -> Result<Vec<DriveFolder>, OpenLaneError> {
        let root = root.as_ref();
        let mut names = drive_names(&annotations_root(root))?;
        if let Some(missing) = only.iter().find(|text| !names.iter().any(|name| name.contains(text.as_str()))) {
            return Err(OpenLaneError::NoSuchDrive { root: root.to_owned(), name: missing.clone() });
        }
        if !only.is_empty() {
            names.retain(|name| only.iter().any(|text| name.contains(text.as_str())));
        }
        names.iter().map(|name| DriveFolder::open(root, name)).collect()
    }
}

/// Drives lie in the folder itself, or in its `annotations` as in OpenLane's own example.
fn annotations_root(root: &Path) -> PathBuf {
    let inner = root.join("annotations");
    if inner.is_dir() { inner } else { root.to_owned() }
}

fn drive_names(folder: &Path) -> Result<Vec<String>, OpenLaneError> {
    let mut names: Vec<String> = entries(folder)?
        .into_iter()
        .filter(|path| path.is_dir())
        .filter_map(|path| Some(path.file_name()?.to_str()?.to_owned()))
        .filter(|name| name.starts_with("segment-"))
        .collect();
    names.sort_unstable();
    Ok(names)
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>, OpenLaneError> {
    let io = |source| OpenLaneError::Io { path: folder.to_owned(), source };
    fs::read_dir(folder).map_err(io)?.map(|entry| entry.map(|entry| entry.path()).map_err(io)).collect()
}

/// One drive: its frames in the order of time.
#[derive(Clone, Debug)]
pub struct DriveFolder {
    name: String,
    annotations: PathBuf,
    results: PathBuf,
    times: Vec<TimestampNs>,
}

impl DriveFolder {
    /// Opens the drive `name` (e.g. `segment-ps-001-real`) of a folder of drives. Reads the list of frames, no frame.
    ///
    /// # Errors
    /// No such drive, or a JSON file in it that is not named by a timestamp.
    pub fn open(root: impl AsRef<Path>, name: &str) -> Result<Self, OpenLaneError> {
        let root = root.as_ref();
        let annotations = annotations_root(root).join(name);
        if !annotations.is_dir() {
            return Err(OpenLaneError::NoSuchDrive { root: root.to_owned(), name: name.to_owned() });
        }
        let mut times = entries(&annotations)?
            .into_iter()
            .filter(|path| path.extension().is_some_and(|extension| extension == "json"))
            .map(|path| {
                let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
                timestamp_from_stem(stem).ok_or_else(|| OpenLaneError::FileName { path: path.clone() })
            })
            .collect::<Result<Vec<_>, _>>()?;
        times.sort_unstable();
        Ok(Self { name: name.to_owned(), annotations, results: root.join("results").join(name), times })
    }

    /// Reads detections from `root/NAME` instead of the drives' own `results/NAME`.
    #[must_use]
    pub fn with_results(mut self, root: impl AsRef<Path>) -> Self {
        self.results = root.as_ref().join(&self.name);
        self
    }

    /// Name of the drive's folder.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of frames.
    #[must_use]
    pub fn len(&self) -> usize {
        self.times.len()
    }

    /// Whether the drive has no frame.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.times.is_empty()
    }

    /// Times of the frames, rising.
    #[must_use]
    pub fn times(&self) -> &[TimestampNs] {
        &self.times
    }

    /// Reads the frames one by one, in the order of time.
    #[must_use]
    pub fn frames(&self) -> impl ExactSizeIterator<Item = Result<DriveFrame, OpenLaneError>> + '_ {
        self.times.iter().map(|time| self.frame(*time))
    }

    /// Reads the frame of one time. A frame without a result file has `detections: None`.
    ///
    /// # Errors
    /// A file that cannot be read, is cut short, or whose fields have another shape; the error names file and field.
    pub fn frame(&self, time: TimestampNs) -> Result<DriveFrame, OpenLaneError> {
        let annotation = self.annotation(time)?;
        let result = self.results.join(timestamp_stem(time)).with_extension("json");
        let detections = if result.exists() { Some(DetectionFile::read(&result)?) } else { None };
        Ok(DriveFrame { time, annotation, detections })
    }

    /// Reads the annotation of one time.
    ///
    /// # Errors
    /// As [`DriveFolder::frame`].
    pub fn annotation(&self, time: TimestampNs) -> Result<Annotation, OpenLaneError> {
        Annotation::read(&self.annotations.join(timestamp_stem(time)).with_extension("json"))
    }
}

/// One frame of a drive: its annotation beside what the detector saw.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveFrame {
    /// Time of measurement.
    pub time: TimestampNs,
    /// The truth.
    pub annotation: Annotation,
    /// The detections; `None` where the frame has no result file.
    pub detections: Option<DetectionFile>,
}

impl DriveFrame {
    /// Detections in the vehicle frame, as the mapper takes them.
    #[must_use]
    pub fn detections_vehicle(&self) -> Vec<Detection> {
        let ground = self.annotation.ground_frame();
        let lanes = self.detections.iter().flat_map(|file| &file.lanes);
        lanes
            .map(|lane| Detection {
                category: lane.category,
                points_vehicle: lane.points_ground.iter().map(|point| ground.vehicle_from_ground(point)).collect(),
            })
            .collect()
    }

    /// Detections in the ground frame, as the scorers take them.
    #[must_use]
    pub fn detections_ground(&self) -> Vec<Vec<Point3<f64>>> {
        self.detections.iter().flat_map(|file| &file.lanes).map(|lane| lane.points_ground.clone()).collect()
    }

    /// True lines in the vehicle frame.
    #[must_use]
    pub fn truth_vehicle(&self) -> Vec<Vec<Point3<f64>>> {
        let mount = &self.annotation.vehicle_from_camera;
        self.annotation.lanes.iter().map(|lane| lane.points_vehicle(mount)).collect()
    }

    /// True lines in the ground frame.
    #[must_use]
    pub fn truth_ground(&self) -> Vec<Vec<Point3<f64>>> {
        let ground: GroundFrame = self.annotation.ground_frame();
        let to_ground = |line: Vec<Point3<f64>>| line.iter().map(|point| ground.ground_from_vehicle(point)).collect();
        self.truth_vehicle().into_iter().map(to_ground).collect()
    }

    /// The frame as the mapper takes it, without a GNSS fix.
    ///
    /// `odometry_from_vehicle` is the annotation's pose, or another sequence of poses (noisy odometry);
    /// `motion_covariance` that of the motion since the previous frame.
    #[must_use]
    pub fn frame_parts(
        &self,
        sequence: Sequence,
        odometry_from_vehicle: Pose,
        motion_covariance: Option<TangentCovariance>,
    ) -> FrameParts {
        FrameParts {
            sequence,
            time: self.time,
            odometry: Odometry { odometry_from_vehicle, motion_covariance },
            gnss: None,
            detections: self.detections_vehicle(),
            occlusions: Vec::new(),
        }
    }
}
