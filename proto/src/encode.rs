//! From the types of `lanemap-core` to the wire. Nothing is rounded: [`decode`](crate::decode) gives the same bits back.

use lanemap_core::{
    Category, CategoryStretch, ControlPoint, Detection, EndRule, FieldOfView, Frame, GnssFix, LocalLane, MapLane,
    Occlusion, Odometry, Preset, Sensor,
    geometry::{Pose, TangentCovariance, georeference::Georeference},
};
use nalgebra::Point3;

use crate::v1;

/// A frame; its points stay in the vehicle frame ([`v1::AxisConvention::Vehicle`]).
#[must_use]
pub fn frame(frame: &Frame) -> v1::Frame {
    v1::Frame {
        sequence: frame.sequence().0,
        time_unix_ns: frame.time().0,
        odometry: Some(odometry(frame.odometry())),
        gnss: frame.gnss().map(gnss_fix),
        detections: frame.detections().iter().map(detection).collect(),
        occlusions: frame.occlusions().iter().map(occlusion).collect(),
    }
}

fn odometry(odometry: &Odometry) -> v1::Odometry {
    v1::Odometry {
        odometry_from_vehicle: Some(pose(&odometry.odometry_from_vehicle)),
        motion_covariance: odometry.motion_covariance.as_ref().map(tangent_covariance),
    }
}

fn gnss_fix(fix: &GnssFix) -> v1::GnssFix {
    v1::GnssFix {
        position: Some(v1::GeodeticPosition {
            latitude_deg: fix.latitude_deg,
            longitude_deg: fix.longitude_deg,
            height_m: fix.height_m,
        }),
        horizontal_sigma_m: fix.horizontal_sigma_m,
        vertical_sigma_m: fix.vertical_sigma_m,
        yaw_enu_rad: fix.yaw_enu_rad,
    }
}

fn detection(detection: &Detection) -> v1::Detection {
    v1::Detection { category: category(detection.category).into(), xyz: points(&detection.points_vehicle) }
}

fn occlusion(occlusion: &Occlusion) -> v1::Occlusion {
    v1::Occlusion { from_rad: occlusion.from_rad, to_rad: occlusion.to_rad, range_m: occlusion.range_m }
}

/// A sensor whose frames hold their points in the vehicle frame, as those of [`frame`] do.
#[must_use]
pub fn sensor(sensor: &Sensor) -> v1::Sensor {
    v1::Sensor {
        vehicle_from_sensor: Some(pose(&sensor.vehicle_from_sensor)),
        axis_convention: v1::AxisConvention::Vehicle.into(),
        field_of_view: sensor.field_of_view.as_ref().map(field_of_view),
    }
}

/// The bounds of an image.
fn field_of_view(view: &FieldOfView) -> v1::FieldOfView {
    v1::FieldOfView { tan_left: view.tan_left, tan_right: view.tan_right, tan_up: view.tan_up, tan_down: view.tan_down }
}

/// A rigid transform.
#[must_use]
pub fn pose(pose: &Pose) -> v1::Pose {
    let rotation = pose.rotation.coords;
    v1::Pose {
        position: Some(point(&pose.translation.vector.into())),
        rotation: Some(v1::Quaternion { x: rotation.x, y: rotation.y, z: rotation.z, w: rotation.w }),
    }
}

/// The covariance of a pose: its upper triangle.
#[must_use]
pub fn tangent_covariance(covariance: &TangentCovariance) -> v1::TangentCovariance {
    let rows = 0..6;
    let upper_triangle = rows.flat_map(|row| (row..6).map(move |column| covariance[(row, column)])).collect();
    v1::TangentCovariance { upper_triangle }
}

/// A lane of the map.
#[must_use]
pub fn lane(lane: &MapLane) -> v1::Lane {
    v1::Lane {
        id: lane.id.0,
        category: category(lane.category).into(),
        category_posterior: lane.category_posterior.clone(),
        control_points: lane.control_points.iter().map(control_point).collect(),
        ends: end_rule(lane.ends).into(),
        drawn_from: lane.drawn_from,
        drawn_to: lane.drawn_to,
        existence: lane.existence,
        observations: lane.observations,
        first_seen_unix_ns: lane.first_seen.0,
        last_seen_unix_ns: lane.last_seen.0,
        category_stretches: lane.category_stretches.iter().map(category_stretch).collect(),
    }
}

fn category_stretch(stretch: &CategoryStretch) -> v1::CategoryStretch {
    v1::CategoryStretch { to: stretch.to, posterior: stretch.posterior.clone() }
}

fn control_point(control: &ControlPoint) -> v1::ControlPoint {
    let covariance = &control.covariance;
    v1::ControlPoint {
        position: Some(point(&control.position)),
        covariance: Some(v1::PointCovariance {
            xx: covariance[(0, 0)],
            xy: covariance[(0, 1)],
            xz: covariance[(0, 2)],
            yy: covariance[(1, 1)],
            yz: covariance[(1, 2)],
            zz: covariance[(2, 2)],
        }),
    }
}

/// A piece of a lane, vehicle frame.
#[must_use]
pub fn local_lane(lane: &LocalLane) -> v1::LocalLane {
    v1::LocalLane { id: lane.id.0, category: category(lane.category).into(), xyz: points(&lane.points_vehicle) }
}

/// Where on the earth a map frame lies.
#[must_use]
pub fn georeference(georeference: &Georeference) -> v1::Georeference {
    let anchor = georeference.anchor.place();
    v1::Georeference {
        anchor: Some(v1::GeodeticPosition {
            latitude_deg: anchor.latitude_deg,
            longitude_deg: anchor.longitude_deg,
            height_m: anchor.height_m,
        }),
        enu_from_map: Some(pose(&georeference.enu_from_map)),
    }
}

/// A kind of lane line.
#[must_use]
pub fn category(category: Category) -> v1::LaneCategory {
    v1::LaneCategory::try_from(i32::from(category.openlane_code())).unwrap_or_default()
}

/// A choice of mapper.
#[must_use]
pub fn preset(preset: Preset) -> v1::MapperPreset {
    match preset {
        Preset::Paper => v1::MapperPreset::Paper,
        Preset::Default => v1::MapperPreset::Default,
    }
}

fn end_rule(rule: EndRule) -> v1::EndRule {
    match rule {
        EndRule::Open => v1::EndRule::Open,
        EndRule::Reflected => v1::EndRule::Reflected,
    }
}

fn point(point: &Point3<f64>) -> v1::Point {
    v1::Point { x: point.x, y: point.y, z: point.z }
}

fn points(points: &[Point3<f64>]) -> Vec<f64> {
    points.iter().flat_map(|point| [point.x, point.y, point.z]).collect()
}
