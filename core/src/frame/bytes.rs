//! The bytes under which a frame is kept: the validated frame, bit by bit (postcard).
//!
//! What frames have gained since they were first kept stands behind, and only where there is some of it. So a frame kept
//! by an older version is read as one that has none of it, and a frame that has none of it has the bytes it always had.

use thiserror::Error;

use super::{Detection, Frame, FrameParts, GnssFix, Occlusion, Odometry, Sequence, TimestampNs};

/// Why bytes are not a frame.
#[derive(Debug, Error)]
#[error(transparent)]
pub struct FrameBytesError(#[from] postcard::Error);

/// A frame as it was first kept.
type First = (Sequence, TimestampNs, Odometry, Option<GnssFix>, Vec<Detection>);

impl Frame {
    /// The bytes of this frame; the same frame has the same bytes.
    ///
    /// # Errors
    /// None in practice: a frame is plain numbers.
    pub fn to_bytes(&self) -> Result<Vec<u8>, FrameBytesError> {
        let FrameParts { sequence, time, odometry, gnss, detections, occlusions } = &self.parts;
        let bytes = postcard::to_stdvec(&(sequence, time, odometry, gnss, detections))?;
        if occlusions.is_empty() {
            return Ok(bytes);
        }
        Ok(postcard::to_extend(occlusions, bytes)?)
    }

    /// The frame of [`Frame::to_bytes`], of this version or an older one.
    ///
    /// # Errors
    /// Bytes that are no frame's.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, FrameBytesError> {
        let ((sequence, time, odometry, gnss, detections), rest): (First, _) = postcard::take_from_bytes(bytes)?;
        let occlusions: Vec<Occlusion> = if rest.is_empty() { Vec::new() } else { postcard::from_bytes(rest)? };
        Ok(Self { parts: FrameParts { sequence, time, odometry, gnss, detections, occlusions } })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use serde::Serialize;

    use super::*;
    use crate::{category::Category, frame::FrameLimits, geometry::Pose};

    /// A frame as it was serialized before there were occlusions.
    #[derive(Serialize)]
    struct OlderFrame {
        sequence: Sequence,
        time: TimestampNs,
        odometry: Odometry,
        gnss: Option<GnssFix>,
        detections: Vec<Detection>,
    }

    fn parts() -> FrameParts {
        FrameParts {
            sequence: Sequence(300),
            time: TimestampNs(-7),
            odometry: Odometry { odometry_from_vehicle: Pose::translation(1.0, 2.0, 3.0), motion_covariance: None },
            gnss: None,
            detections: vec![Detection {
                category: Category::RightCurb,
                points_vehicle: vec![Point3::new(5.0, 1.0, 0.1), Point3::new(9.0, 1.2, 0.2)],
            }],
            occlusions: Vec::new(),
        }
    }

    #[test]
    fn a_frame_kept_before_there_were_occlusions_is_read_as_one_without() {
        let FrameParts { sequence, time, odometry, gnss, detections, .. } = parts();
        let older = postcard::to_stdvec(&OlderFrame { sequence, time, odometry, gnss, detections }).unwrap();
        let frame = Frame::new(parts(), &FrameLimits::default()).unwrap();
        assert_eq!(Frame::from_bytes(&older).unwrap(), frame);
        assert_eq!(frame.to_bytes().unwrap(), older);
    }

    #[test]
    fn a_frame_with_occlusions_comes_back_bit_by_bit() {
        let occlusions = vec![Occlusion { from_rad: -0.1, to_rad: 0.3, range_m: 12.5 }];
        let frame = Frame::new(FrameParts { occlusions, ..parts() }, &FrameLimits::default()).unwrap();
        let bytes = frame.to_bytes().unwrap();
        assert_eq!(Frame::from_bytes(&bytes).unwrap(), frame);
        assert!(Frame::from_bytes(&bytes[..bytes.len() - 1]).is_err(), "a torn frame is none");
    }
}
