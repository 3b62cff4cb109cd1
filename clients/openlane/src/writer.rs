//! Writes frames in OpenLane's two formats, under OpenLane's folder and file names.

use std::{fs, path::Path};

use nalgebra::{Matrix4, Point3};
use serde::Serialize;

use lanemap_core::{TimestampNs, geometry::Pose};

use crate::{
    annotation::Annotation,
    detection_file::{DetectedLane, DetectionFile},
    error::OpenLaneError,
    timestamp::timestamp_stem,
};

#[derive(Serialize)]
struct ResultJson<'a> {
    intrinsic: [[f64; 3]; 3],
    extrinsic: [[f64; 4]; 4],
    file_path: &'a str,
    lane_lines: Vec<ResultLaneJson>,
}

#[derive(Serialize)]
struct ResultLaneJson {
    xyz: Vec<[f64; 3]>,
    uv: [(); 0],
    visibility: [(); 0],
    category: u8,
    attribute: u8,
    track_id: i64,
}

#[derive(Serialize)]
struct AnnotationJson<'a> {
    extrinsic: [[f64; 4]; 4],
    intrinsic: [[f64; 3]; 3],
    #[serde(skip_serializing_if = "Option::is_none")]
    pose: Option<[[f64; 4]; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    gnss_pose: Option<[[f64; 4]; 4]>,
    lane_lines: Vec<AnnotationLaneJson>,
    file_path: &'a str,
}

#[derive(Serialize)]
struct AnnotationLaneJson {
    category: u8,
    visibility: Vec<f64>,
    uv: [[(); 0]; 2],
    xyz: [Vec<f64>; 3],
    attribute: i64,
    track_id: i64,
}

/// Writes `root/NAME/TIMESTAMP.json` in the *result* format: points in the ground frame, `[n][3]`.
///
/// `of` is the annotation of the same frame; the file's own `extrinsic` is its camera in standard axes
/// (x right, y down, z front) in the ground frame, as OpenLane's detectors write it. Numbers keep every digit.
///
/// # Errors
/// A folder or file that cannot be written.
pub fn write_result(
    root: &Path,
    name: &str,
    time: TimestampNs,
    of: &Annotation,
    lanes: &DetectionFile,
) -> Result<(), OpenLaneError> {
    let json = ResultJson {
        intrinsic: of.intrinsic.rows(),
        extrinsic: ground_from_standard_camera(&of.vehicle_from_camera),
        file_path: &of.image,
        lane_lines: lanes.lanes.iter().map(ResultLaneJson::from).collect(),
    };
    write(root, name, time, &json)
}

/// Writes `root/NAME/TIMESTAMP.json` in the *annotation* format: points in the camera frame, `[3][n]`.
///
/// # Errors
/// A folder or file that cannot be written.
pub fn write_annotation(
    root: &Path,
    name: &str,
    time: TimestampNs,
    annotation: &Annotation,
) -> Result<(), OpenLaneError> {
    let lane = |lane: &crate::AnnotatedLane| AnnotationLaneJson {
        category: lane.category.openlane_code(),
        visibility: vec![1.0; lane.points_camera.len()],
        uv: [[], []],
        xyz: [0, 1, 2].map(|axis| lane.points_camera.iter().map(|point| point[axis]).collect()),
        attribute: lane.attribute,
        track_id: lane.track_id,
    };
    let json = AnnotationJson {
        extrinsic: rows(&annotation.vehicle_from_camera.to_homogeneous()),
        intrinsic: annotation.intrinsic.rows(),
        pose: annotation.world_from_vehicle.map(|pose| rows(&pose.to_homogeneous())),
        gnss_pose: annotation.world_from_vehicle_gnss.map(|pose| rows(&pose.to_homogeneous())),
        lane_lines: annotation.lanes.iter().map(lane).collect(),
        file_path: &annotation.image,
    };
    write(root, name, time, &json)
}

impl From<&DetectedLane> for ResultLaneJson {
    fn from(lane: &DetectedLane) -> Self {
        let xyz = |point: &Point3<f64>| [point.x, point.y, point.z];
        Self {
            xyz: lane.points_ground.iter().map(xyz).collect(),
            uv: [],
            visibility: [],
            category: lane.category.openlane_code(),
            attribute: 0,
            track_id: lane.track_id,
        }
    }
}

fn write(root: &Path, name: &str, time: TimestampNs, json: &impl Serialize) -> Result<(), OpenLaneError> {
    let folder = root.join(name);
    fs::create_dir_all(&folder).map_err(|source| OpenLaneError::Io { path: folder.clone(), source })?;
    let path = folder.join(timestamp_stem(time)).with_extension("json");
    let text = serde_json::to_vec(json).map_err(|source| OpenLaneError::Json { path: path.clone(), source })?;
    fs::write(&path, text).map_err(|source| OpenLaneError::Io { path, source })
}

fn ground_from_standard_camera(vehicle_from_camera: &Pose) -> [[f64; 4]; 4] {
    let ground_from_vehicle_axes = Matrix4::new(
        0.0, -1.0, 0.0, 0.0, //
        1.0, 0.0, 0.0, 0.0, //
        0.0, 0.0, 1.0, 0.0, //
        0.0, 0.0, 0.0, 1.0,
    );
    let camera_from_standard_axes = Matrix4::new(
        0.0, 0.0, 1.0, 0.0, //
        -1.0, 0.0, 0.0, 0.0, //
        0.0, -1.0, 0.0, 0.0, //
        0.0, 0.0, 0.0, 1.0,
    );
    let mut mount = vehicle_from_camera.to_homogeneous();
    mount[(0, 3)] = 0.0;
    mount[(1, 3)] = 0.0;
    rows(&(ground_from_vehicle_axes * mount * camera_from_standard_axes))
}

fn rows(matrix: &Matrix4<f64>) -> [[f64; 4]; 4] {
    [0, 1, 2, 3].map(|row| [0, 1, 2, 3].map(|column| matrix[(row, column)]))
}
