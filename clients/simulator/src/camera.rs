//! The camera of a simulated vehicle: where it sits and what falls into its image.

use lanemap_core::{FieldOfView, Pose, Sensor};
use nalgebra::{Translation3, UnitQuaternion};

/// A pinhole camera on the vehicle. Axes: x forward along the optical axis, y left, z up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Mount.
    pub vehicle_from_camera: Pose,
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Principal point, pixels from the left; the image is twice as wide.
    pub centre_u_px: f64,
    /// Principal point, pixels from the top; the image is twice as high.
    pub centre_v_px: f64,
}

impl Default for Camera {
    /// The front camera of Waymo's cars: 1920 x 1280 pixels, 50 degrees wide, 2.1 m above the vehicle's origin.
    fn default() -> Self {
        Self {
            vehicle_from_camera: Pose::from_parts(
                Translation3::new(1.54, -0.02, 2.115),
                UnitQuaternion::from_euler_angles(0.0, 0.004, 0.002),
            ),
            focal_px: 2060.0,
            centre_u_px: 960.0,
            centre_v_px: 640.0,
        }
    }
}

impl Camera {
    /// What a session declares of this camera.
    #[must_use]
    pub fn sensor(&self) -> Sensor {
        let (horizontal, vertical) = (self.centre_u_px / self.focal_px, self.centre_v_px / self.focal_px);
        Sensor {
            vehicle_from_sensor: self.vehicle_from_camera,
            field_of_view: Some(FieldOfView {
                tan_left: horizontal,
                tan_right: horizontal,
                tan_up: vertical,
                tan_down: vertical,
            }),
        }
    }
}
