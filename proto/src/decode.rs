//! From the wire to the types of `lanemap-core`: the parts that both sides read.
//!
//! Each function takes the path of its field, so that an error names it. Whether numbers lie in their ranges is for
//! `Frame::new` to say; here a message becomes a type or it does not.

mod frame;
mod sensor;

pub use frame::frame;
pub use sensor::{PointFrame, sensor};

use lanemap_core::{
    Category, CategoryStretch, ControlPoint, EndRule, FrameError, LaneId, LaneMap, LocalLane, MapLane, TimestampNs,
    geometry::{Pose, TangentCovariance},
};
use nalgebra::{Matrix3, Point3, Quaternion, Translation3, UnitQuaternion};
use thiserror::Error;

use crate::v1;

/// How far the norm of a quaternion may be from 1 to be taken for a rotation.
pub const ROTATION_NORM_TOLERANCE: f64 = 1e-3;

/// Below this distance from 1 a squared norm is rounding, and the quaternion is taken bit by bit.
const ROUNDING: f64 = 1e-14;

/// Entries of the upper triangle of a 6x6 matrix.
const UPPER_TRIANGLE: usize = 21;

/// Why a message is not what it should be.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum DecodeError {
    /// A required field is missing.
    #[error("{field} is missing")]
    Missing {
        /// Path of the field.
        field: String,
    },
    /// A number is NaN or infinite.
    #[error("{field} is not finite: {value}")]
    NotFinite {
        /// Path of the field.
        field: String,
        /// The number.
        value: f64,
    },
    /// A quaternion is not a rotation.
    #[error("{field} is not a rotation: its norm is {norm}, limit 1 +- {limit:.0e}", limit = ROTATION_NORM_TOLERANCE)]
    NotARotation {
        /// Path of the field.
        field: String,
        /// Norm of the quaternion.
        norm: f64,
    },
    /// A list has the wrong length.
    #[error("{field} has {count} entries, needs {needs}")]
    Length {
        /// Path of the field.
        field: String,
        /// Its length.
        count: usize,
        /// What the length should be.
        needs: &'static str,
    },
    /// An enum holds a number that the protocol does not list.
    #[error("{field} = {value} is not listed in the protocol")]
    NotListed {
        /// Path of the field.
        field: String,
        /// The number.
        value: i32,
    },
    /// A value lies outside its range.
    #[error("{field} is {value}, limit: {limit}")]
    OutOfRange {
        /// Path of the field.
        field: String,
        /// The value.
        value: String,
        /// What it should be.
        limit: String,
    },
    /// A list is longer than allowed.
    #[error("{field} has {count} entries, at most {limit}")]
    TooMany {
        /// Path of the field.
        field: String,
        /// Its length.
        count: usize,
        /// Greatest length accepted.
        limit: usize,
    },
    /// A list is shorter than needed.
    #[error("{field} has {count} entries, at least {least}")]
    TooFew {
        /// Path of the field.
        field: String,
        /// Its length.
        count: usize,
        /// Least length accepted.
        least: usize,
    },
    /// The frame is whole but not valid.
    #[error("frame.{0}")]
    Frame(#[from] FrameError),
}

/// The message of a required field.
///
/// # Errors
/// The field is missing.
pub fn required<T>(message: Option<T>, field: impl FnOnce() -> String) -> Result<T, DecodeError> {
    message.ok_or_else(|| DecodeError::Missing { field: field() })
}

/// A rigid transform. A quaternion of norm 1 is taken as it is, any other within the tolerance is normalised.
///
/// # Errors
/// A part that is missing or not finite, or a quaternion that is not a rotation.
pub fn pose(message: Option<&v1::Pose>, field: &str) -> Result<Pose, DecodeError> {
    let message = required(message, || field.to_owned())?;
    let position = required(message.position.as_ref(), || format!("{field}.position"))?;
    let rotation = required(message.rotation.as_ref(), || format!("{field}.rotation"))?;
    for (axis, value) in [("x", position.x), ("y", position.y), ("z", position.z)] {
        finite(value, || format!("{field}.position.{axis}"))?;
    }
    for (axis, value) in [("x", rotation.x), ("y", rotation.y), ("z", rotation.z), ("w", rotation.w)] {
        finite(value, || format!("{field}.rotation.{axis}"))?;
    }
    let translation = Translation3::new(position.x, position.y, position.z);
    Ok(Pose::from_parts(translation, unit_quaternion(rotation, field)?))
}

fn unit_quaternion(message: &v1::Quaternion, field: &str) -> Result<UnitQuaternion<f64>, DecodeError> {
    let quaternion = Quaternion::new(message.w, message.x, message.y, message.z);
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > ROTATION_NORM_TOLERANCE {
        return Err(DecodeError::NotARotation { field: format!("{field}.rotation"), norm });
    }
    if (quaternion.norm_squared() - 1.0).abs() < ROUNDING {
        return Ok(UnitQuaternion::new_unchecked(quaternion));
    }
    Ok(UnitQuaternion::new_normalize(quaternion))
}

/// The covariance of a pose.
///
/// # Errors
/// Another number of entries than 21.
pub fn tangent_covariance(message: &v1::TangentCovariance, field: &str) -> Result<TangentCovariance, DecodeError> {
    let entries = &message.upper_triangle;
    if entries.len() != UPPER_TRIANGLE {
        let field = format!("{field}.upper_triangle");
        return Err(DecodeError::Length { field, count: entries.len(), needs: "exactly 21" });
    }
    let mut covariance = TangentCovariance::zeros();
    let mut next = entries.iter();
    for row in 0..6 {
        for (column, entry) in (row..6).zip(&mut next) {
            covariance[(row, column)] = *entry;
            covariance[(column, row)] = *entry;
        }
    }
    Ok(covariance)
}

/// Points from `x0, y0, z0, x1, ...`.
///
/// # Errors
/// A length that is not a multiple of 3.
pub fn points(xyz: &[f64], field: impl FnOnce() -> String) -> Result<Vec<Point3<f64>>, DecodeError> {
    let (triples, rest) = xyz.as_chunks::<3>();
    if !rest.is_empty() {
        return Err(DecodeError::Length { field: field(), count: xyz.len(), needs: "a multiple of 3" });
    }
    Ok(triples.iter().map(|&[x, y, z]| Point3::new(x, y, z)).collect())
}

/// A kind of lane line.
///
/// # Errors
/// A number that the protocol does not list.
pub fn category(code: i32, field: impl FnOnce() -> String) -> Result<Category, DecodeError> {
    let category = u8::try_from(code).ok().and_then(Category::from_openlane_code);
    category.ok_or_else(|| DecodeError::NotListed { field: field(), value: code })
}

/// The lanes of a map.
///
/// # Errors
/// A lane that lacks a part, or holds a number that this build does not know.
pub fn lane_map(message: &v1::LaneMap) -> Result<LaneMap, DecodeError> {
    let lanes = message.lanes.iter().enumerate();
    Ok(LaneMap { lanes: lanes.map(|(index, message)| lane(message, index)).collect::<Result<_, _>>()? })
}

fn lane(message: &v1::Lane, index: usize) -> Result<MapLane, DecodeError> {
    let controls = message.control_points.iter().enumerate();
    Ok(MapLane {
        id: LaneId(message.id),
        category: category(message.category, || format!("lanes[{index}].category"))?,
        category_posterior: message.category_posterior.clone(),
        category_stretches: message.category_stretches.iter().map(category_stretch).collect(),
        control_points: controls
            .map(|(k, message)| control_point(message, || format!("lanes[{index}].control_points[{k}]")))
            .collect::<Result<_, _>>()?,
        ends: end_rule(message.ends, || format!("lanes[{index}].ends"))?,
        drawn_from: message.drawn_from,
        drawn_to: message.drawn_to,
        existence: message.existence,
        observations: message.observations,
        first_seen: TimestampNs(message.first_seen_unix_ns),
        last_seen: TimestampNs(message.last_seen_unix_ns),
    })
}

fn category_stretch(message: &v1::CategoryStretch) -> CategoryStretch {
    CategoryStretch { to: message.to, posterior: message.posterior.clone() }
}

fn control_point(message: &v1::ControlPoint, field: impl Fn() -> String) -> Result<ControlPoint, DecodeError> {
    let position = required(message.position.as_ref(), || format!("{}.position", field()))?;
    let c = required(message.covariance.as_ref(), || format!("{}.covariance", field()))?;
    Ok(ControlPoint {
        position: Point3::new(position.x, position.y, position.z),
        covariance: Matrix3::new(c.xx, c.xy, c.xz, c.xy, c.yy, c.yz, c.xz, c.yz, c.zz),
    })
}

fn end_rule(code: i32, field: impl FnOnce() -> String) -> Result<EndRule, DecodeError> {
    match v1::EndRule::try_from(code) {
        Ok(v1::EndRule::Open) => Ok(EndRule::Open),
        Ok(v1::EndRule::Reflected) => Ok(EndRule::Reflected),
        Ok(v1::EndRule::Unspecified) | Err(_) => Err(DecodeError::NotListed { field: field(), value: code }),
    }
}

/// A piece of a lane, vehicle frame.
///
/// # Errors
/// A category that is not listed, or coordinates that are not triples.
pub fn local_lane(message: &v1::LocalLane) -> Result<LocalLane, DecodeError> {
    Ok(LocalLane {
        id: LaneId(message.id),
        category: category(message.category, || "lanes.category".to_owned())?,
        points_vehicle: points(&message.xyz, || "lanes.xyz".to_owned())?,
    })
}

fn finite(value: f64, field: impl FnOnce() -> String) -> Result<(), DecodeError> {
    if value.is_finite() { Ok(()) } else { Err(DecodeError::NotFinite { field: field(), value }) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use prost::Message;

    use super::*;
    use crate::encode;

    fn any_pose() -> impl Strategy<Value = Pose> {
        (prop::array::uniform3(-1e6..1e6f64), prop::array::uniform3(-3.0..3.0f64)).prop_map(|(t, r)| {
            Pose::from_parts(Translation3::new(t[0], t[1], t[2]), UnitQuaternion::from_scaled_axis(r.into()))
        })
    }

    proptest! {
        #[test]
        fn a_pose_crosses_the_wire_bit_by_bit(pose in any_pose()) {
            prop_assert_eq!(super::pose(Some(&encode::pose(&pose)), "pose").unwrap(), pose);
        }

        #[test]
        fn a_covariance_crosses_the_wire_bit_by_bit(entries in prop::array::uniform21(-1.0..1.0f64)) {
            let message = v1::TangentCovariance { upper_triangle: entries.to_vec() };
            let covariance = tangent_covariance(&message, "covariance").unwrap();
            prop_assert_eq!(covariance, covariance.transpose());
            prop_assert_eq!(encode::tangent_covariance(&covariance), message);
        }
    }

    #[test]
    fn a_lane_map_crosses_the_wire_whole_with_the_stretches_that_are_painted_alike() {
        let uniform = vec![1.0 / 15.0; Category::ALL.len()];
        let solid = |to: f64| {
            let mut posterior = vec![0.1 / 14.0; Category::ALL.len()];
            posterior[2] = 0.9;
            CategoryStretch { to, posterior }
        };
        let covariance = Matrix3::new(0.04, 0.01, 0.002, 0.01, 0.09, 0.003, 0.002, 0.003, 0.16);
        let control_points =
            (0..4).map(|k| ControlPoint { position: Point3::new(3.0 * f64::from(k), 1.75, -0.1), covariance });
        let lane = MapLane {
            id: LaneId(7),
            category: Category::WhiteDashed,
            category_posterior: uniform.clone(),
            category_stretches: vec![CategoryStretch { to: 1.5, posterior: uniform }, solid(3.0)],
            control_points: control_points.collect(),
            ends: EndRule::Reflected,
            drawn_from: 0.25,
            drawn_to: 2.75,
            existence: 0.97,
            observations: 42,
            first_seen: TimestampNs(1_000_000_007),
            last_seen: TimestampNs(9_000_000_011),
        };
        let map = LaneMap { lanes: vec![lane.clone(), MapLane { id: LaneId(8), ends: EndRule::Open, ..lane }] };
        let message = v1::LaneMap { lanes: map.lanes.iter().map(encode::lane).collect(), ..v1::LaneMap::default() };
        let bytes = message.encode_to_vec();
        assert_eq!(lane_map(&v1::LaneMap::decode(bytes.as_slice()).unwrap()), Ok(map));
    }

    #[test]
    fn every_category_crosses_the_wire() {
        for category in Category::ALL {
            assert_eq!(super::category(encode::category(category).into(), String::new), Ok(category));
        }
    }

    #[test]
    fn a_quaternion_of_norm_two_is_no_rotation() {
        let message = v1::Pose {
            position: Some(v1::Point::default()),
            rotation: Some(v1::Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 2.0 }),
        };
        let error = pose(Some(&message), "start.sensor.vehicle_from_sensor").unwrap_err();
        let text = "start.sensor.vehicle_from_sensor.rotation is not a rotation: its norm is 2, limit 1 +- 1e-3";
        assert_eq!(error.to_string(), text);
    }
}
