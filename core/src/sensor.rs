//! The lane detector's camera: where it sits and how far to each side it sees.

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::Pose;

/// A camera on a vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sensor {
    /// Mount of the camera. Sensor axes: x forward along the optical axis, y left, z up.
    pub vehicle_from_sensor: Pose,
    /// What the camera sees; `None` where nobody said: then everything in the crop box counts as in view.
    pub field_of_view: Option<FieldOfView>,
}

/// Bounds of an image, as tangents of the angles from the optical axis; all positive for a centred camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FieldOfView {
    /// Left border: `cx / fx`.
    pub tan_left: f64,
    /// Right border: `(width - cx) / fx`.
    pub tan_right: f64,
    /// Upper border: `cy / fy`.
    pub tan_up: f64,
    /// Lower border: `(height - cy) / fy`.
    pub tan_down: f64,
}

impl Default for Sensor {
    fn default() -> Self {
        Self { vehicle_from_sensor: Pose::identity(), field_of_view: None }
    }
}

impl Sensor {
    /// Whether a point (vehicle frame, metres) falls into the image, occlusion aside.
    #[must_use]
    pub fn sees(&self, point_vehicle: &Point3<f64>) -> bool {
        let Some(view) = &self.field_of_view else { return true };
        let point = self.vehicle_from_sensor.inverse_transform_point(point_vehicle);
        point.x > 0.1
            && point.y <= view.tan_left * point.x
            && -point.y <= view.tan_right * point.x
            && point.z <= view.tan_up * point.x
            && -point.z <= view.tan_down * point.x
    }

    /// Horizontal offset of the camera from the vehicle's origin, metres, vehicle axes, height left out.
    ///
    /// Ranges of the crop box are measured from below the camera, as OpenLane's ground frame does.
    #[must_use]
    pub fn ground_offset(&self) -> Vector3<f64> {
        let mount = self.vehicle_from_sensor.translation.vector;
        Vector3::new(mount.x, mount.y, 0.0)
    }
}
