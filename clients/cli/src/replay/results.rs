//! The online local map of every frame, in OpenLane's result format.

use std::path::{Path, PathBuf};

use anyhow::Context;
use lanemap_core::{LocalWindow, Mapper, TimestampNs};
use lanemap_openlane::{Annotation, DetectedLane, DetectionFile, write_result};

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
    pub fn write(&self, time: TimestampNs, annotation: &Annotation, mapper: &Mapper) -> anyhow::Result<()> {
        let ground = annotation.ground_frame();
        let lanes = mapper
            .local_map(&LocalWindow::default())
            .into_iter()
            .map(|lane| DetectedLane {
                category: lane.category,
                track_id: i64::try_from(lane.id.0).unwrap_or(i64::MAX),
                points_ground: lane.points_vehicle.iter().map(|point| ground.ground_from_vehicle(point)).collect(),
            })
            .collect();
        write_result(&self.root, self.drive, time, annotation, &DetectionFile { lanes })
            .context("the local map cannot be written; --results-dir must name a folder that can be made")
    }
}
