//! The online local map of every frame, in OpenLane's result format.

use std::path::{Path, PathBuf};

use anyhow::Context;
use lanemap_core::{FieldOfView, LocalWindow, Mapper, TimestampNs, evaluation::GroundFrame};
use lanemap_openlane::{Annotation, DetectedLane, DetectionFile, Intrinsic, write_result};
use lanemap_recording::Camera;

/// Width of the image of a recording that does not say it, pixels: that of OpenLane's.
const NOMINAL_WIDTH_PX: f64 = 1920.0;
/// What such a camera sees where the recording does not say that either.
const NOMINAL_VIEW: FieldOfView = FieldOfView { tan_left: 0.5, tan_right: 0.5, tan_up: 0.3, tan_down: 0.3 };

/// Writes the local maps of one drive.
pub struct ResultWriter<'a> {
    root: PathBuf,
    drive: &'a str,
}

impl<'a> ResultWriter<'a> {
    /// A writer below a folder, which is made where it does not exist.
    pub fn new(root: &Path, drive: &'a str) -> Self {
        Self { root: root.to_owned(), drive }
    }

    /// Writes what the mapper knows around the vehicle now. The lane's id within the drive is its `track_id`.
    pub fn write(&self, time: TimestampNs, camera: &Camera, mapper: &Mapper) -> anyhow::Result<()> {
        let ground = GroundFrame::below(&camera.sensor);
        let lanes = mapper
            .local_map(&LocalWindow::default())
            .into_iter()
            .map(|lane| DetectedLane {
                category: lane.category,
                track_id: i64::try_from(lane.id.0).unwrap_or(i64::MAX),
                points_ground: lane.points_vehicle.iter().map(|point| ground.ground_from_vehicle(point)).collect(),
            })
            .collect();
        write_result(&self.root, self.drive, time, &annotation_of(camera), &DetectionFile { lanes })
            .context("the local map cannot be written; --results-dir must name a folder that can be made")
    }
}

/// The camera as OpenLane's format wants it, without poses and lanes.
fn annotation_of(camera: &Camera) -> Annotation {
    Annotation {
        path: PathBuf::new(),
        intrinsic: camera.intrinsic.unwrap_or_else(|| nominal_intrinsic(camera)),
        vehicle_from_camera: camera.sensor.vehicle_from_sensor,
        world_from_vehicle: None,
        world_from_vehicle_gnss: None,
        image: camera.image.clone().unwrap_or_default(),
        lanes: Vec::new(),
    }
}

/// Focal lengths in pixels of an image of the usual width, for a recording that has only a field of view.
fn nominal_intrinsic(camera: &Camera) -> Intrinsic {
    let view = camera.sensor.field_of_view.unwrap_or(NOMINAL_VIEW);
    let focal_px = NOMINAL_WIDTH_PX / (view.tan_left + view.tan_right);
    Intrinsic { fx: focal_px, fy: focal_px, cx: view.tan_left * focal_px, cy: view.tan_up * focal_px }
}
