//! OpenLane's ground frame, in which its detectors report and its scorers measure.
//!
//! Axes x right, y front, z up; the origin lies straight below the camera, at the height of the vehicle's origin. The
//! frame keeps only the height of the camera's mount, so its horizontal offset has to be added to reach the vehicle
//! frame: `vehicle = (g.y + t_x, -g.x + t_y, g.z)`.

use nalgebra::{Point3, Vector3};

use crate::sensor::Sensor;

/// The ground frame below one camera.
///
/// ```
/// use lanemap_core::{Sensor, evaluation::GroundFrame};
/// use nalgebra::Point3;
///
/// let mut sensor = Sensor::default();
/// sensor.vehicle_from_sensor.translation.vector = [1.5, 0.0, 2.0].into();
/// let ground = GroundFrame::below(&sensor);
/// let five_ahead_of_the_camera = Point3::new(0.0, 5.0, -0.3);
/// assert_eq!(ground.vehicle_from_ground(&five_ahead_of_the_camera), Point3::new(6.5, 0.0, -0.3));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundFrame {
    offset_m: Vector3<f64>,
}

impl GroundFrame {
    /// The ground frame below the camera of a sensor.
    #[must_use]
    pub fn below(sensor: &Sensor) -> Self {
        Self { offset_m: sensor.ground_offset() }
    }

    /// A point of the ground frame in the vehicle frame, metres.
    #[must_use]
    pub fn vehicle_from_ground(&self, point: &Point3<f64>) -> Point3<f64> {
        Point3::new(point.y + self.offset_m.x, -point.x + self.offset_m.y, point.z)
    }

    /// A point of the vehicle frame in the ground frame, metres.
    #[must_use]
    pub fn ground_from_vehicle(&self, point: &Point3<f64>) -> Point3<f64> {
        Point3::new(self.offset_m.y - point.y, point.x - self.offset_m.x, point.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;

    #[test]
    fn the_ground_frame_and_the_vehicle_frame_undo_each_other() {
        let sensor = Sensor { vehicle_from_sensor: Pose::translation(1.5, -0.25, 2.0), field_of_view: None };
        let ground = GroundFrame::below(&sensor);
        let point = Point3::new(20.0, 3.5, -0.375);
        assert_eq!(ground.ground_from_vehicle(&point), Point3::new(-3.75, 18.5, -0.375));
        assert_eq!(ground.vehicle_from_ground(&ground.ground_from_vehicle(&point)), point);
    }
}
