//! From the wire to a validated frame: parsed once, trusted afterwards.
//!
//! Points come in the session's axis convention and leave in the vehicle frame. Counts are checked before anything is
//! copied, so that a message of a million points costs no more than its own bytes.

use lanemap_core::{
    Detection, Frame, FrameLimits, FrameParts, GnssFix, Occlusion, Odometry, Sequence, TimestampNs,
    frame::MAX_OCCLUSIONS,
};

use super::{DecodeError, PointFrame, category, points, pose, required, tangent_covariance};
use crate::v1;

/// Least points of a lane line.
const MIN_POINTS: usize = 2;

/// Decodes and validates a frame whose points are given in `frame`.
///
/// # Errors
/// The first field that is missing, not finite, out of range, too long or too short; paths begin with `frame.`, but for
/// those of [`DecodeError::Frame`].
pub fn frame(message: &v1::Frame, frame: &PointFrame, limits: &FrameLimits) -> Result<Frame, DecodeError> {
    Ok(Frame::new(frame_parts(message, frame, limits)?, limits)?)
}

fn frame_parts(message: &v1::Frame, frame: &PointFrame, limits: &FrameLimits) -> Result<FrameParts, DecodeError> {
    let count = message.detections.len();
    at_most(count, limits.max_detections, || "frame.detections".to_owned())?;
    at_most(message.occlusions.len(), MAX_OCCLUSIONS, || "frame.occlusions".to_owned())?;
    let wire_odometry = required(message.odometry.as_ref(), || "frame.odometry".to_owned())?;
    let detections = message.detections.iter().enumerate();
    Ok(FrameParts {
        sequence: Sequence(message.sequence),
        time: TimestampNs(message.time_unix_ns),
        odometry: odometry(wire_odometry)?,
        gnss: message.gnss.as_ref().map(gnss_fix).transpose()?,
        detections: detections
            .map(|(index, message)| detection(message, index, frame, limits))
            .collect::<Result<_, _>>()?,
        occlusions: message.occlusions.iter().map(occlusion).collect(),
    })
}

fn occlusion(message: &v1::Occlusion) -> Occlusion {
    Occlusion { from_rad: message.from_rad, to_rad: message.to_rad, range_m: message.range_m }
}

fn odometry(message: &v1::Odometry) -> Result<Odometry, DecodeError> {
    let odometry_from_vehicle = pose(message.odometry_from_vehicle.as_ref(), "frame.odometry.odometry_from_vehicle")?;
    let covariance = message.motion_covariance.as_ref();
    let motion_covariance =
        covariance.map(|m| tangent_covariance(m, "frame.odometry.motion_covariance")).transpose()?;
    Ok(Odometry { odometry_from_vehicle, motion_covariance })
}

fn gnss_fix(message: &v1::GnssFix) -> Result<GnssFix, DecodeError> {
    let position = required(message.position.as_ref(), || "frame.gnss.position".to_owned())?;
    Ok(GnssFix {
        latitude_deg: position.latitude_deg,
        longitude_deg: position.longitude_deg,
        height_m: position.height_m,
        horizontal_sigma_m: message.horizontal_sigma_m,
        vertical_sigma_m: message.vertical_sigma_m,
        yaw_enu_rad: message.yaw_enu_rad,
    })
}

fn detection(
    message: &v1::Detection,
    index: usize,
    frame: &PointFrame,
    limits: &FrameLimits,
) -> Result<Detection, DecodeError> {
    let field = || format!("frame.detections[{index}].points");
    let count = message.xyz.len() / 3;
    at_most(count, limits.max_points_per_detection, field)?;
    if count < MIN_POINTS {
        return Err(DecodeError::TooFew { field: field(), count, least: MIN_POINTS });
    }
    let mut points_vehicle = points(&message.xyz, || format!("frame.detections[{index}].xyz"))?;
    // Named before they are turned: a rotation would spread a NaN over all three axes.
    for (k, point) in points_vehicle.iter().enumerate() {
        for (axis, value) in ["x", "y", "z"].into_iter().zip(point.iter()) {
            super::finite(*value, || format!("{}[{k}].{axis}", field()))?;
        }
    }
    for point in &mut points_vehicle {
        *point = frame.to_vehicle(point);
    }
    let category = category(message.category, || format!("frame.detections[{index}].category"))?;
    Ok(Detection { category, points_vehicle })
}

fn at_most(count: usize, limit: usize, field: impl FnOnce() -> String) -> Result<(), DecodeError> {
    if count > limit {
        return Err(DecodeError::TooMany { field: field(), count, limit });
    }
    Ok(())
}
