//! Local reference frame (LRF): a rotation about z that brings a detection's first-to-last chord onto +x.
//!
//! Paper: "Lane Representation". The first point is the one nearest to the vehicle (the paper does not say), so +x runs
//! in the direction in which the vehicle would follow the line; the last is the one farthest from the first.

use nalgebra::{Point3, Vector3};

/// A frame turned about the vehicle's z axis, with the same origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalFrame {
    cos: f64,
    sin: f64,
}

impl LocalFrame {
    /// The frame of a set of points; `None` where they are fewer than two, or all in one place.
    #[must_use]
    pub fn along(points: &[Point3<f64>]) -> Option<Self> {
        let range = |point: &Point3<f64>| point.x.hypot(point.y);
        let first = points.iter().min_by(|a, b| range(a).total_cmp(&range(b)))?;
        let from_first = |point: &Point3<f64>| (point - first).xy().norm();
        let last = points.iter().max_by(|a, b| from_first(a).total_cmp(&from_first(b)))?;
        let chord = last - first;
        let length = chord.x.hypot(chord.y);
        (length > 1e-6).then(|| Self { cos: chord.x / length, sin: chord.y / length })
    }

    /// A vehicle point in this frame.
    #[must_use]
    pub fn local_from_vehicle(&self, point: &Point3<f64>) -> Point3<f64> {
        Point3::new(self.cos * point.x + self.sin * point.y, -self.sin * point.x + self.cos * point.y, point.z)
    }

    /// A point of this frame in the vehicle frame.
    #[must_use]
    pub fn vehicle_from_local(&self, point: &Point3<f64>) -> Point3<f64> {
        Point3::new(self.cos * point.x - self.sin * point.y, self.sin * point.x + self.cos * point.y, point.z)
    }

    /// The +x axis of this frame in the vehicle frame.
    #[must_use]
    pub fn direction(&self) -> Vector3<f64> {
        Vector3::new(self.cos, self.sin, 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chord_lies_on_the_x_axis_and_points_come_back() {
        let points = [Point3::new(20.0, 7.0, 1.0), Point3::new(4.0, 3.0, 0.0), Point3::new(10.0, 9.0, 0.5)];
        let frame = LocalFrame::along(&points).unwrap();
        let (first, last) = (frame.local_from_vehicle(&points[1]), frame.local_from_vehicle(&points[0]));
        assert!((first.y - last.y).abs() < 1e-12 && last.x > first.x);
        for point in &points {
            assert!((frame.vehicle_from_local(&frame.local_from_vehicle(point)) - point).norm() < 1e-12);
        }
    }

    #[test]
    fn points_in_one_place_have_no_frame() {
        assert!(LocalFrame::along(&[Point3::new(1.0, 2.0, 3.0); 4]).is_none());
        assert!(LocalFrame::along(&[]).is_none());
    }
}
