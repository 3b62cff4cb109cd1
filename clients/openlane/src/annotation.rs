//! An annotation: the camera, the vehicle's pose, and the true lane lines of a frame.

use std::path::{Path, PathBuf};

use nalgebra::Point3;

use lanemap_core::{Category, Sensor, evaluation::GroundFrame, geometry::Pose};

use crate::{
    error::OpenLaneError,
    intrinsic::Intrinsic,
    json::{Document, Node},
};

/// A frame as OpenLane annotates it. Fields that are not named here are passed over.
#[derive(Clone, Debug, PartialEq)]
pub struct Annotation {
    /// Where it was read from; empty for one made in memory.
    pub path: PathBuf,
    /// The camera.
    pub intrinsic: Intrinsic,
    /// Mount of the camera; camera axes x front, y left, z up.
    pub vehicle_from_camera: Pose,
    /// True pose of the vehicle, `None` before OpenLane v1.2.
    pub world_from_vehicle: Option<Pose>,
    /// Pose as a GNSS receiver would report it, where the drive has one.
    pub world_from_vehicle_gnss: Option<Pose>,
    /// Name of the image, as the file gives it.
    pub image: String,
    /// The lane lines.
    pub lanes: Vec<AnnotatedLane>,
}

/// A true lane line.
#[derive(Clone, Debug, PartialEq)]
pub struct AnnotatedLane {
    /// What it is painted as.
    pub category: Category,
    /// Number of the line, stable over the drive.
    pub track_id: i64,
    /// Place beside the vehicle: 1 left-left, 2 left, 3 right, 4 right-right, 0 other.
    pub attribute: i64,
    /// Points in the camera frame (x front, y left, z up), metres.
    pub points_camera: Vec<Point3<f64>>,
}

impl Annotation {
    /// Reads an annotation.
    ///
    /// # Errors
    /// A file that cannot be read, is cut short, or whose fields have another shape; the error names file and field.
    pub fn read(path: &Path) -> Result<Self, OpenLaneError> {
        Self::parse(path, &Document::read(path)?.root())
    }

    /// Reads the text of an annotation; `path` is for messages.
    ///
    /// # Errors
    /// As [`Annotation::read`].
    pub fn from_json(path: &Path, text: &[u8]) -> Result<Self, OpenLaneError> {
        Self::parse(path, &Document::parse(path, text)?.root())
    }

    fn parse(path: &Path, root: &Node<'_>) -> Result<Self, OpenLaneError> {
        let pose = |key| root.find(key).map(|node| node.pose()).transpose();
        Ok(Self {
            path: path.to_owned(),
            intrinsic: Intrinsic::parse(&root.get("intrinsic")?)?,
            vehicle_from_camera: root.get("extrinsic")?.pose()?,
            world_from_vehicle: pose("pose")?,
            world_from_vehicle_gnss: pose("gnss_pose")?,
            image: root.find("file_path").map(|node| node.text()).transpose()?.unwrap_or_default().to_owned(),
            lanes: root
                .get("lane_lines")?
                .items()?
                .map(|lane| AnnotatedLane::parse(&lane))
                .collect::<Result<_, _>>()?,
        })
    }

    /// Pose of the vehicle in the world.
    ///
    /// # Errors
    /// An annotation from before OpenLane v1.2, which has none.
    pub fn pose(&self) -> Result<Pose, OpenLaneError> {
        self.world_from_vehicle.ok_or_else(|| OpenLaneError::NoPose { path: self.path.clone() })
    }

    /// The camera as the mapper wants it.
    #[must_use]
    pub fn sensor(&self) -> Sensor {
        Sensor { vehicle_from_sensor: self.vehicle_from_camera, field_of_view: Some(self.intrinsic.field_of_view()) }
    }

    /// The ground frame below the camera.
    #[must_use]
    pub fn ground_frame(&self) -> GroundFrame {
        GroundFrame::below(&self.sensor())
    }
}

impl AnnotatedLane {
    fn parse(node: &Node<'_>) -> Result<Self, OpenLaneError> {
        let optional = |key| node.find(key).map(|node| node.integer()).transpose();
        Ok(Self {
            category: category(&node.get("category")?)?,
            track_id: optional("track_id")?.unwrap_or_default(),
            attribute: optional("attribute")?.unwrap_or_default(),
            points_camera: node.get("xyz")?.points_by_axis()?,
        })
    }

    /// The points in the vehicle frame, metres.
    #[must_use]
    pub fn points_vehicle(&self, vehicle_from_camera: &Pose) -> Vec<Point3<f64>> {
        self.points_camera.iter().map(|point| vehicle_from_camera * point).collect()
    }
}

pub(crate) fn category(node: &Node<'_>) -> Result<Category, OpenLaneError> {
    let code = node.integer()?;
    u8::try_from(code)
        .ok()
        .and_then(Category::from_openlane_code)
        .ok_or_else(|| node.refuse(format!("is {code}, want an OpenLane code: 0 to 12, 20 or 21")))
}
