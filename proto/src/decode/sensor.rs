//! The camera of a session, and the axes of its points.

use lanemap_core::{FieldOfView, Sensor, geometry::Pose};
use nalgebra::{Point3, Vector3};

use super::{DecodeError, pose};
use crate::v1::{self, AxisConvention};

/// Farthest mount of a sensor from the vehicle's origin, metres, on each axis.
const MAX_MOUNT_M: f64 = 100.0;
/// Largest tangent of half an opening angle.
const MAX_TANGENT: f64 = 100.0;

/// Where the points of a session's detections are given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PointFrame {
    /// In the vehicle frame.
    Vehicle,
    /// In a sensor frame: x forward, y left, z up.
    Sensor {
        /// Mount of the sensor.
        vehicle_from_sensor: Pose,
    },
    /// In an optical frame: x right, y down, z forward.
    Optical {
        /// Mount of the sensor, whose axes are x forward, y left, z up.
        vehicle_from_sensor: Pose,
    },
    /// In OpenLane's ground frame: x right, y front, z up, straight below the sensor.
    OpenLaneGround {
        /// Horizontal position of the sensor in the vehicle frame, metres.
        offset: Vector3<f64>,
    },
}

impl PointFrame {
    /// The convention of a session with this sensor; `None` where it is not named.
    fn new(convention: AxisConvention, sensor: &Sensor) -> Option<Self> {
        let vehicle_from_sensor = sensor.vehicle_from_sensor;
        match convention {
            AxisConvention::Unspecified => None,
            AxisConvention::Vehicle => Some(Self::Vehicle),
            AxisConvention::SensorForwardLeftUp => Some(Self::Sensor { vehicle_from_sensor }),
            AxisConvention::SensorRightDownForward => Some(Self::Optical { vehicle_from_sensor }),
            AxisConvention::OpenlaneGround => Some(Self::OpenLaneGround { offset: sensor.ground_offset() }),
        }
    }

    /// A point of this frame in the vehicle frame.
    #[must_use]
    pub fn to_vehicle(&self, point: &Point3<f64>) -> Point3<f64> {
        match self {
            Self::Vehicle => *point,
            Self::Sensor { vehicle_from_sensor } => vehicle_from_sensor * point,
            Self::Optical { vehicle_from_sensor } => vehicle_from_sensor * Point3::new(point.z, -point.x, -point.y),
            Self::OpenLaneGround { offset } => Point3::new(point.y, -point.x, point.z) + offset,
        }
    }
}

/// The camera of a session's start, and where the points of its detections are given.
///
/// # Errors
/// The first field that is missing or out of range; an axis convention that is not named is refused.
pub fn sensor(message: &v1::Sensor) -> Result<(Sensor, PointFrame), DecodeError> {
    let field = "start.sensor.vehicle_from_sensor";
    let vehicle_from_sensor = pose(message.vehicle_from_sensor.as_ref(), field)?;
    for (axis, value) in ["x", "y", "z"].into_iter().zip(vehicle_from_sensor.translation.vector.iter()) {
        if value.abs() > MAX_MOUNT_M {
            let limit = format!("-{MAX_MOUNT_M} ..= {MAX_MOUNT_M}");
            return Err(out_of_range(format!("{field}.position.{axis}"), value, limit));
        }
    }
    let field_of_view = message.field_of_view.as_ref().map(field_of_view).transpose()?;
    let sensor = Sensor { vehicle_from_sensor, field_of_view };
    let listed = AxisConvention::try_from(message.axis_convention);
    let points = listed.ok().and_then(|convention| PointFrame::new(convention, &sensor)).ok_or_else(|| {
        let value = listed.map_or_else(|_| message.axis_convention.to_string(), |c| c.as_str_name().to_owned());
        let limit = "a convention that the protocol lists, other than unspecified";
        out_of_range("start.sensor.axis_convention".to_owned(), &value, limit.to_owned())
    })?;
    Ok((sensor, points))
}

fn field_of_view(message: &v1::FieldOfView) -> Result<FieldOfView, DecodeError> {
    let tangent = |value: f64, name: &str| {
        if value > 0.0 && value <= MAX_TANGENT {
            return Ok(value);
        }
        let limit = format!("above 0, at most {MAX_TANGENT}");
        Err(out_of_range(format!("start.sensor.field_of_view.{name}"), &value, limit))
    };
    Ok(FieldOfView {
        tan_left: tangent(message.tan_left, "tan_left")?,
        tan_right: tangent(message.tan_right, "tan_right")?,
        tan_up: tangent(message.tan_up, "tan_up")?,
        tan_down: tangent(message.tan_down, "tan_down")?,
    })
}

fn out_of_range(field: String, value: &impl ToString, limit: String) -> DecodeError {
    DecodeError::OutOfRange { field, value: value.to_string(), limit }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    #[test]
    fn a_point_is_the_same_point_in_every_convention() {
        let rotation = UnitQuaternion::from_euler_angles(0.0, 0.02, 0.01);
        let mount = Pose::from_parts(Translation3::new(1.5, 0.1, 1.4), rotation);
        let in_vehicle = Point3::new(20.0, 3.0, -0.3);
        let in_sensor = mount.inverse() * in_vehicle;
        let optical = Point3::new(-in_sensor.y, -in_sensor.z, in_sensor.x);
        let ground = Point3::new(-(in_vehicle.y - 0.1), in_vehicle.x - 1.5, in_vehicle.z);
        let sensor = Sensor { vehicle_from_sensor: mount, field_of_view: None };
        for (convention, point) in [
            (AxisConvention::Vehicle, in_vehicle),
            (AxisConvention::SensorForwardLeftUp, in_sensor),
            (AxisConvention::SensorRightDownForward, optical),
            (AxisConvention::OpenlaneGround, ground),
        ] {
            let frame = PointFrame::new(convention, &sensor).unwrap();
            assert!((frame.to_vehicle(&point) - in_vehicle).norm() < 1e-12, "{convention:?}");
        }
    }
}
