//! What a vehicle knows to be hidden from its camera: sectors of the ground plane behind other vehicles.
//!
//! A sector has its apex straight below the camera. Within its two bearings nothing on the road is visible farther off
//! than its range. A line that is not detected there was not missed: nobody could see whether it is there.

use std::f64::consts::{PI, TAU};

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::{FrameLimits, at_most, in_range};
use crate::{error::FrameError, sensor::Sensor};

/// Most occlusions in a frame.
pub const MAX_OCCLUSIONS: usize = 64;

/// A sector of the ground plane, seen from below the camera, in which the road is hidden from a range on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Occlusion {
    /// Bearing of the right border from the vehicle's x axis, radians counter-clockwise, in `[-pi, pi]`.
    pub from_rad: f64,
    /// Bearing of the left border, radians, in `[from_rad, from_rad + 2 pi]`.
    pub to_rad: f64,
    /// Distance in plan from below the camera beyond which nothing is visible, metres, from 0 to the farthest that a
    /// point of a frame may lie.
    pub range_m: f64,
}

impl Occlusion {
    /// Whether a point on the road (vehicle frame, metres) is hidden from the camera.
    #[must_use]
    pub fn hides(&self, point_vehicle: &Point3<f64>, sensor: &Sensor) -> bool {
        let seen = (point_vehicle - sensor.ground_offset()).xy();
        if seen.coords.norm() <= self.range_m {
            return false;
        }
        let bearing_rad = seen.y.atan2(seen.x);
        (bearing_rad - self.from_rad).rem_euclid(TAU) <= self.to_rad - self.from_rad
    }

    pub(super) fn without_negative_zeros(self) -> Self {
        Self { from_rad: self.from_rad + 0.0, to_rad: self.to_rad + 0.0, range_m: self.range_m + 0.0 }
    }
}

pub(super) fn check(occlusions: &[Occlusion], limits: &FrameLimits) -> Result<(), FrameError> {
    at_most(occlusions.len(), MAX_OCCLUSIONS, || "occlusions".to_owned())?;
    for (index, occlusion) in occlusions.iter().enumerate() {
        let Occlusion { from_rad, to_rad, range_m } = *occlusion;
        in_range(from_rad, -PI, PI, || format!("occlusions[{index}].from_rad"))?;
        in_range(to_rad, from_rad, from_rad + TAU, || format!("occlusions[{index}].to_rad"))?;
        in_range(range_m, 0.0, limits.max_point_range_m, || format!("occlusions[{index}].range_m"))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        frame::{Frame, FrameParts, Odometry, Sequence, TimestampNs},
        geometry::Pose,
    };

    fn frame(occlusions: Vec<Occlusion>) -> Result<Frame, FrameError> {
        let parts = FrameParts {
            sequence: Sequence(1),
            time: TimestampNs(0),
            odometry: Odometry { odometry_from_vehicle: Pose::identity(), motion_covariance: None },
            gnss: None,
            detections: Vec::new(),
            occlusions,
        };
        Frame::new(parts, &FrameLimits::default())
    }

    fn refusal(from_rad: f64, to_rad: f64, range_m: f64) -> String {
        frame(vec![Occlusion { from_rad, to_rad, range_m }]).unwrap_err().to_string()
    }

    #[test]
    fn what_lies_behind_an_occlusion_is_hidden_and_what_lies_before_or_beside_it_is_not() {
        let ahead = frame(vec![Occlusion { from_rad: -0.1, to_rad: 0.1, range_m: 20.0 }]).unwrap();
        let sensor = Sensor { vehicle_from_sensor: Pose::translation(2.0, 0.0, 1.5), field_of_view: None };
        let hidden = |x, y| ahead.hides(&Point3::new(x, y, -0.3), &sensor);
        assert!(hidden(32.0, 2.9) && hidden(32.0, -2.9));
        assert!(!hidden(32.0, 3.1) && !hidden(32.0, -3.1), "beside it");
        assert!(!hidden(21.9, 0.0) && hidden(22.1, 0.0), "ranges count from below the camera");
        assert!(!hidden(-30.0, 0.0), "behind the vehicle");
    }

    #[test]
    fn an_occlusion_may_lie_across_the_bearing_of_half_a_turn() {
        let behind = Occlusion { from_rad: 3.0, to_rad: 3.4, range_m: 5.0 };
        let sensor = Sensor::default();
        assert!(behind.hides(&Point3::new(-10.0, 1.0, 0.0), &sensor));
        assert!(behind.hides(&Point3::new(-10.0, -1.0, 0.0), &sensor));
        assert!(!behind.hides(&Point3::new(-10.0, -4.0, 0.0), &sensor));
    }

    #[test]
    fn a_bad_occlusion_is_refused_by_field_value_and_limit() {
        assert_eq!(refusal(f64::NAN, 1.0, 1.0), "occlusions[0].from_rad is not finite: NaN");
        assert_eq!(refusal(1.0, 0.5, 1.0), format!("occlusions[0].to_rad = 0.5 is outside 1 ..= {}", 1.0 + TAU));
        assert_eq!(refusal(0.0, 1.0, -1.0), "occlusions[0].range_m = -1 is outside 0 ..= 500");
        let many = vec![Occlusion { from_rad: 0.0, to_rad: 0.1, range_m: 9.0 }; 65];
        assert_eq!(frame(many).unwrap_err().to_string(), "occlusions has 65 entries, limit 64");
    }

    #[test]
    fn a_frame_without_occlusions_hides_nothing() {
        assert!(!frame(Vec::new()).unwrap().hides(&Point3::new(30.0, 0.0, 0.0), &Sensor::default()));
    }
}
