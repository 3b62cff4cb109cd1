//! A result file: the lane lines that a detector saw in a frame.

use std::path::Path;

use nalgebra::Point3;

use lanemap_core::Category;

use crate::{
    annotation::category,
    error::OpenLaneError,
    json::{Document, Node},
};

/// A frame as a detector reports it. The file's own camera is passed over: the annotation's is the one to use.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DetectionFile {
    /// The detected lane lines.
    pub lanes: Vec<DetectedLane>,
}

/// A detected lane line.
#[derive(Clone, Debug, PartialEq)]
pub struct DetectedLane {
    /// What the detector took it for.
    pub category: Category,
    /// A number that means nothing from frame to frame.
    pub track_id: i64,
    /// Points in the ground frame (x right, y front, z up), metres.
    pub points_ground: Vec<Point3<f64>>,
}

impl DetectionFile {
    /// Reads a result file.
    ///
    /// # Errors
    /// A file that cannot be read, is cut short, or whose fields have another shape; the error names file and field.
    pub fn read(path: &Path) -> Result<Self, OpenLaneError> {
        Self::parse(&Document::read(path)?.root())
    }

    /// Reads the text of a result file; `path` is for messages.
    ///
    /// # Errors
    /// As [`DetectionFile::read`].
    pub fn from_json(path: &Path, text: &[u8]) -> Result<Self, OpenLaneError> {
        Self::parse(&Document::parse(path, text)?.root())
    }

    fn parse(root: &Node<'_>) -> Result<Self, OpenLaneError> {
        let lanes = root.get("lane_lines")?.items()?.map(|lane| DetectedLane::parse(&lane));
        Ok(Self { lanes: lanes.collect::<Result<_, _>>()? })
    }
}

impl DetectedLane {
    fn parse(node: &Node<'_>) -> Result<Self, OpenLaneError> {
        Ok(Self {
            category: category(&node.get("category")?)?,
            track_id: node.find("track_id").map(|node| node.integer()).transpose()?.unwrap_or_default(),
            points_ground: node.get("xyz")?.points()?,
        })
    }
}
