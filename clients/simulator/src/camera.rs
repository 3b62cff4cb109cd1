//! The camera of a simulated vehicle: where it sits and what falls into its image.

use lanemap_core::{Pose, Sensor};
use lanemap_openlane::Intrinsic;
use nalgebra::{Translation3, UnitQuaternion};

/// A pinhole camera on the vehicle. Axes: x forward along the optical axis, y left, z up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Mount.
    pub vehicle_from_camera: Pose,
    /// Focal length and principal point; the image is twice as wide and high as the principal point says.
    pub intrinsic: Intrinsic,
}

impl Default for Camera {
    /// The front camera of Waymo's cars: 1920 x 1280 pixels, 50 degrees wide, 2.1 m above the vehicle's origin.
    fn default() -> Self {
        Self {
            vehicle_from_camera: Pose::from_parts(
                Translation3::new(1.54, -0.02, 2.115),
                UnitQuaternion::from_euler_angles(0.0, 0.004, 0.002),
            ),
            intrinsic: Intrinsic { fx: 2060.0, fy: 2060.0, cx: 960.0, cy: 640.0 },
        }
    }
}

impl Camera {
    /// What a session declares of this camera.
    #[must_use]
    pub fn sensor(&self) -> Sensor {
        Sensor { vehicle_from_sensor: self.vehicle_from_camera, field_of_view: Some(self.intrinsic.field_of_view()) }
    }
}
