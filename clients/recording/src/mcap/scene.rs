//! What Foxglove draws without being told how: lines, the vehicle's frame, its place on the earth.

use lanemap_core::{Category, Detection, Frame, GnssFix, TimestampNs, geometry::Pose};
use prost_types::Timestamp;

use self::foxglove::{
    Color, FrameTransform, LinePrimitive, LocationFix, Point3, Quaternion, SceneEntity, SceneUpdate, Vector3,
    line_primitive, location_fix::PositionCovarianceType,
};

/// Foxglove's own messages.
pub(super) mod foxglove {
    #![allow(
        missing_docs,
        unused_qualifications,
        clippy::all,
        clippy::pedantic,
        reason = "generated from foxglove/scene.proto"
    )]
    include!(concat!(env!("OUT_DIR"), "/foxglove.rs"));
}

/// Descriptors of Foxglove's messages.
pub(super) const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/foxglove_descriptor_set.bin"));

/// Name of the frame in which a drive's odometry is given.
const ODOMETRY: &str = "odometry";
/// Name of the vehicle's frame.
const VEHICLE: &str = "vehicle";
/// Width of a drawn line, metres.
const THICKNESS_M: f64 = 0.15;

/// The vehicle in its odometry frame.
pub(super) fn transform(frame: &Frame) -> FrameTransform {
    let Pose { rotation, translation } = frame.odometry().odometry_from_vehicle;
    FrameTransform {
        timestamp: Some(timestamp(frame.time())),
        parent_frame_id: ODOMETRY.to_owned(),
        child_frame_id: VEHICLE.to_owned(),
        translation: Some(Vector3 { x: translation.x, y: translation.y, z: translation.z }),
        rotation: Some(Quaternion { x: rotation.i, y: rotation.j, z: rotation.k, w: rotation.w }),
    }
}

/// The lines seen in a frame; they take the place of those of the frame before.
pub(super) fn scene(frame: &Frame) -> SceneUpdate {
    let entity = SceneEntity {
        timestamp: Some(timestamp(frame.time())),
        frame_id: VEHICLE.to_owned(),
        id: "detections".to_owned(),
        lines: frame.detections().iter().map(line).collect(),
        ..SceneEntity::default()
    };
    SceneUpdate { entities: vec![entity], deletions: Vec::new() }
}

/// A fix.
pub(super) fn location(time: TimestampNs, fix: &GnssFix) -> LocationFix {
    let (horizontal, vertical) = (fix.horizontal_sigma_m.powi(2), fix.vertical_sigma_m.powi(2));
    LocationFix {
        latitude: fix.latitude_deg,
        longitude: fix.longitude_deg,
        altitude: fix.height_m,
        position_covariance: vec![horizontal, 0.0, 0.0, 0.0, horizontal, 0.0, 0.0, 0.0, vertical],
        position_covariance_type: PositionCovarianceType::DiagonalKnown.into(),
        timestamp: Some(timestamp(time)),
        frame_id: VEHICLE.to_owned(),
    }
}

fn line(detection: &Detection) -> LinePrimitive {
    // A detection's points come in any order; a drawn line wants them along the road.
    let mut points: Vec<Point3> =
        detection.points_vehicle.iter().map(|point| Point3 { x: point.x, y: point.y, z: point.z }).collect();
    points.sort_by(|a, b| a.x.total_cmp(&b.x));
    LinePrimitive {
        r#type: line_primitive::Type::LineStrip.into(),
        thickness: THICKNESS_M,
        points,
        color: Some(color(detection.category)),
        ..LinePrimitive::default()
    }
}

fn color(category: Category) -> Color {
    let [r, g, b] = match category.openlane_code() {
        1..=6 => [1.0, 1.0, 1.0],
        7..=12 => [1.0, 0.8, 0.1],
        20 | 21 => [0.55, 0.6, 0.7],
        _ => [0.9, 0.3, 0.6],
    };
    Color { r, g, b, a: 1.0 }
}

fn timestamp(time: TimestampNs) -> Timestamp {
    const NS_PER_S: i64 = 1_000_000_000;
    let nanos = i32::try_from(time.0.rem_euclid(NS_PER_S)).unwrap_or_default();
    Timestamp { seconds: time.0.div_euclid(NS_PER_S), nanos }
}
