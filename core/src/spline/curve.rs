//! A lane's curve: control points joined by Catmull-Rom segments, and what happens at its two ends.
//!
//! Control point `i` lies on the curve at parameter `i`; the segment from `i` to `i + 1` is shaped by the points
//! `i - 1 .. i + 2`. The paper leaves the first and the last control point off the curve ([`EndRule::Open`]).
//! [`EndRule::Reflected`] (ours) puts a phantom `P_{-1} = 2 P_0 - P_1` beyond each end, folded into the weights of the
//! true points, so that the curve reaches its ends and stays linear in its control points.

use std::collections::VecDeque;

use nalgebra::{Point3, Vector3};

use super::basis;
use crate::lane_map::{ControlPoint, EndRule};

/// An ordered set of control points.
pub trait ControlPolygon {
    /// Number of control points.
    fn count(&self) -> usize;
    /// Position of one; `index < count()`.
    fn at(&self, index: usize) -> Point3<f64>;
}

impl ControlPolygon for [Point3<f64>] {
    fn count(&self) -> usize {
        self.len()
    }
    fn at(&self, index: usize) -> Point3<f64> {
        self[index]
    }
}

impl ControlPolygon for VecDeque<Point3<f64>> {
    fn count(&self) -> usize {
        self.len()
    }
    fn at(&self, index: usize) -> Point3<f64> {
        self[index]
    }
}

impl ControlPolygon for [ControlPoint] {
    fn count(&self) -> usize {
        self.len()
    }
    fn at(&self, index: usize) -> Point3<f64> {
        self[index].position
    }
}

/// A point of the curve as a weighting of up to four neighbouring control points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Support {
    /// Index of the first control point.
    pub first: usize,
    /// Weights of `first .. first + 4`; zero where there is no such control point.
    pub weights: [f64; 4],
}

/// A curve over borrowed control points.
#[derive(Debug)]
pub struct Curve<'a, P: ?Sized> {
    points: &'a P,
    ends: EndRule,
}

impl<P: ?Sized> Clone for Curve<'_, P> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<P: ?Sized> Copy for Curve<'_, P> {}

impl<'a, P: ControlPolygon + ?Sized> Curve<'a, P> {
    /// A curve, or `None` where the points are too few for one segment (2 reflected, 4 open).
    #[must_use]
    pub fn new(points: &'a P, ends: EndRule) -> Option<Self> {
        let least = match ends {
            EndRule::Open => 4,
            EndRule::Reflected => 2,
        };
        (points.count() >= least).then_some(Self { points, ends })
    }

    /// The control points.
    #[must_use]
    pub fn points(&self) -> &'a P {
        self.points
    }

    /// Parameter at which the curve begins.
    #[must_use]
    pub fn first_parameter(&self) -> f64 {
        self.first_segment() as f64
    }

    /// Parameter at which the curve ends.
    #[must_use]
    pub fn last_parameter(&self) -> f64 {
        (self.last_segment() + 1) as f64
    }

    /// Index of the first segment.
    #[must_use]
    pub fn first_segment(&self) -> usize {
        match self.ends {
            EndRule::Open => 1,
            EndRule::Reflected => 0,
        }
    }

    /// Index of the last segment.
    #[must_use]
    pub fn last_segment(&self) -> usize {
        match self.ends {
            EndRule::Open => self.points.count() - 3,
            EndRule::Reflected => self.points.count() - 2,
        }
    }

    /// Segment and position on it; parameters beyond the ends stay on the first or last segment.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // floored, and clamped to the segments
    #[inline]
    fn locate(&self, parameter: f64) -> (usize, f64) {
        // A cast of a negative number is 0, and truncation is the floor of all others.
        let segment = (parameter as usize).clamp(self.first_segment(), self.last_segment());
        (segment, parameter - segment as f64)
    }

    /// Folds weights of `segment - 1 .. segment + 2` onto the control points that exist.
    fn fold(&self, segment: usize, weights: [f64; 4]) -> Support {
        let count = self.points.count();
        let [before, mut start, mut end, after] = weights;
        let (has_before, has_after) = (segment > 0, segment + 2 < count);
        if !has_before {
            start += 2.0 * before;
            end -= before;
        }
        if !has_after {
            end += 2.0 * after;
            start -= after;
        }
        match (has_before, has_after) {
            (true, true) => Support { first: segment - 1, weights: [before, start, end, after] },
            (true, false) => Support { first: segment - 1, weights: [before, start, end, 0.0] },
            (false, true) => Support { first: segment, weights: [start, end, after, 0.0] },
            (false, false) => Support { first: segment, weights: [start, end, 0.0, 0.0] },
        }
    }

    /// The weighting that gives the point at a parameter.
    #[must_use]
    #[inline]
    pub fn support(&self, parameter: f64) -> Support {
        let (segment, u) = self.locate(parameter);
        self.fold(segment, basis::weights(u))
    }

    /// Point of the curve, in the frame of its control points.
    #[must_use]
    pub fn point(&self, parameter: f64) -> Point3<f64> {
        Point3::from(self.combine(&self.support(parameter)))
    }

    /// First derivative by the parameter, metres per control point.
    #[must_use]
    pub fn derivative(&self, parameter: f64) -> Vector3<f64> {
        let (segment, u) = self.locate(parameter);
        self.combine(&self.fold(segment, basis::derivative_weights(u)))
    }

    /// Second derivative by the parameter.
    #[must_use]
    pub fn second_derivative(&self, parameter: f64) -> Vector3<f64> {
        let (segment, u) = self.locate(parameter);
        self.combine(&self.fold(segment, basis::second_derivative_weights(u)))
    }

    /// The segment that holds a parameter, ready to be evaluated many times.
    #[must_use]
    #[inline]
    pub fn segment_at(&self, parameter: f64) -> Segment {
        let (segment, _) = self.locate(parameter);
        let count = self.points.count();
        let (start, end) = (self.points.at(segment).coords, self.points.at(segment + 1).coords);
        let before = if segment > 0 { self.points.at(segment - 1).coords } else { start * 2.0 - end };
        let after = if segment + 2 < count { self.points.at(segment + 2).coords } else { end * 2.0 - start };
        Segment {
            start: segment as f64,
            coefficients: [
                start,
                (end - before) * 0.5,
                before - start * 2.5 + end * 2.0 - after * 0.5,
                (start - end) * 1.5 + (after - before) * 0.5,
            ],
        }
    }

    /// A walk along the curve, for points at parameters in their order.
    #[must_use]
    pub fn walk(&self) -> CurveWalk<'a, P> {
        CurveWalk { curve: *self, segment: self.segment_at(self.first_parameter()) }
    }

    fn combine(&self, support: &Support) -> Vector3<f64> {
        let mut sum = Vector3::zeros();
        for (k, weight) in support.weights.iter().enumerate() {
            if *weight != 0.0 {
                sum += self.points.at(support.first + k).coords * *weight;
            }
        }
        sum
    }
}

/// Points of a curve one after the other: what shapes a segment is read once for all of its points.
#[derive(Debug)]
pub struct CurveWalk<'a, P: ?Sized> {
    curve: Curve<'a, P>,
    segment: Segment,
}

impl<P: ControlPolygon + ?Sized> CurveWalk<'_, P> {
    /// Point of the curve, in the frame of its control points.
    pub fn point(&mut self, parameter: f64) -> Point3<f64> {
        if !self.segment.holds(parameter) {
            self.segment = self.curve.segment_at(parameter);
        }
        self.segment.point(parameter)
    }
}

/// One segment as a polynomial in its own `u`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    start: f64,
    coefficients: [Vector3<f64>; 4],
}

impl Segment {
    /// The polynomial: `c0 + c1 u + c2 u^2 + c3 u^3`, with `u` from 0 at the segment's start to 1 at its end.
    #[must_use]
    pub fn coefficients(&self) -> &[Vector3<f64>; 4] {
        &self.coefficients
    }

    /// Whether a parameter lies on this segment.
    #[must_use]
    #[inline]
    pub fn holds(&self, parameter: f64) -> bool {
        (0.0..=1.0).contains(&(parameter - self.start))
    }

    /// Point at a parameter of the curve.
    #[must_use]
    pub fn point(&self, parameter: f64) -> Point3<f64> {
        let u = parameter - self.start;
        let [c0, c1, c2, c3] = &self.coefficients;
        (c0 + (c1 + (c2 + c3 * u) * u) * u).into()
    }

    /// Point, first and second derivative at a parameter of the curve.
    #[must_use]
    #[inline]
    pub fn evaluate(&self, parameter: f64) -> (Point3<f64>, Vector3<f64>, Vector3<f64>) {
        let u = parameter - self.start;
        let [c0, c1, c2, c3] = &self.coefficients;
        let point = c0 + (c1 + (c2 + c3 * u) * u) * u;
        let derivative = c1 + (c2 * 2.0 + c3 * (3.0 * u)) * u;
        (point.into(), derivative, c2 * 2.0 + c3 * (6.0 * u))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arc(count: usize) -> Vec<Point3<f64>> {
        (0..count)
            .map(|i| Point3::new((i as f64 * 0.3).sin() * 10.0, (i as f64 * 0.3).cos() * 10.0, 0.1 * i as f64))
            .collect()
    }

    #[test]
    fn a_walk_passes_the_points_of_its_curve_in_any_order_and_beyond_its_ends() {
        let points = arc(7);
        for ends in [EndRule::Open, EndRule::Reflected] {
            let curve = Curve::new(points.as_slice(), ends).unwrap();
            let mut walk = curve.walk();
            for parameter in [-0.5, 0.0, 0.7, 1.0, 1.2, 3.9, 5.0, 6.0, 6.4, 2.5] {
                assert!((walk.point(parameter) - curve.point(parameter)).norm() < 1e-12);
            }
        }
    }

    #[test]
    fn control_points_lie_on_the_curve_at_their_own_parameter() {
        let points = arc(7);
        let curve = Curve::new(points.as_slice(), EndRule::Reflected).unwrap();
        for (i, point) in points.iter().enumerate() {
            assert!((curve.point(i as f64) - point).norm() < 1e-12);
        }
    }

    #[test]
    fn an_open_curve_runs_between_the_neighbours_of_its_ends() {
        let points = arc(7);
        let curve = Curve::new(points.as_slice(), EndRule::Open).unwrap();
        assert_eq!((curve.first_parameter(), curve.last_parameter()), (1.0, 5.0));
        assert!(Curve::new(&points[..3], EndRule::Open).is_none());
    }

    #[test]
    fn two_points_make_a_straight_line() {
        let points = [Point3::origin(), Point3::new(3.0, 0.0, 0.0)];
        let curve = Curve::new(points.as_slice(), EndRule::Reflected).unwrap();
        assert!((curve.point(0.25) - Point3::new(0.75, 0.0, 0.0)).norm() < 1e-12);
        assert!((curve.derivative(0.9) - Vector3::new(3.0, 0.0, 0.0)).norm() < 1e-12);
    }

    #[test]
    fn derivatives_agree_with_finite_differences_on_every_segment() {
        let points = arc(6);
        let curve = Curve::new(points.as_slice(), EndRule::Reflected).unwrap();
        let h = 1e-6;
        for step in 0..25 {
            let parameter = 0.1 + f64::from(step) * 0.196;
            let first = (curve.point(parameter + h) - curve.point(parameter - h)) / (2.0 * h);
            let second = (curve.derivative(parameter + h) - curve.derivative(parameter - h)) / (2.0 * h);
            assert!((first - curve.derivative(parameter)).norm() < 1e-7);
            assert!((second - curve.second_derivative(parameter)).norm() < 1e-6);
            let (point, derivative, bend) = curve.segment_at(parameter).evaluate(parameter);
            assert!((point - curve.point(parameter)).norm() < 1e-12);
            assert!((derivative - curve.derivative(parameter)).norm() < 1e-12);
            assert!((bend - curve.second_derivative(parameter)).norm() < 1e-12);
        }
    }
}
