//! The curve of a spline tile: a Catmull-Rom spline whose parameter is the length of its chords.
//!
//! Control points lie metres to tens of metres apart, so the uniform spline of the map would swing out between a short and a
//! long chord. Here the parameter at a control point is the sum of the chords before it, and the tangent there is that of
//! the parabola through it and its neighbours (Barry and Goldman, *A recursive evaluation algorithm for a class of
//! Catmull-Rom splines*, 1988, with chordal knots). At an end it is that of the parabola which meets the next tangent; between
//! two control points alone the line is straight. Exact where the formulas are; accurate to third order in the chord.

use nalgebra::{Point3, Vector3};

/// The tangent at a control point between two others, by the length of the curve.
pub(super) fn tangent(before: &Point3<f64>, here: &Point3<f64>, after: &Point3<f64>) -> Vector3<f64> {
    let (from, to) = (here - before, after - here);
    let (from_m, to_m) = (from.norm(), to.norm());
    if from_m == 0.0 || to_m == 0.0 {
        return (after - before).try_normalize(0.0).unwrap_or_default();
    }
    (from / from_m) * (to_m / (from_m + to_m)) + (to / to_m) * (from_m / (from_m + to_m))
}

/// The tangent at an end, of the chord to the next control point and the tangent there.
pub(super) fn end_tangent(chord: &Vector3<f64>, next: &Vector3<f64>) -> Vector3<f64> {
    chord.try_normalize(0.0).map_or(*next, |chord| chord * 2.0 - next)
}

/// One piece of the curve, between two control points.
#[derive(Clone, Copy, Debug)]
pub(super) struct Piece {
    from: Point3<f64>,
    to: Point3<f64>,
    /// Derivatives by the share of the chord.
    leaves: Vector3<f64>,
    arrives: Vector3<f64>,
}

impl Piece {
    pub(super) fn new(from: Point3<f64>, to: Point3<f64>, leaves: Vector3<f64>, arrives: Vector3<f64>) -> Self {
        let chord_m = (to - from).norm();
        Self { from, to, leaves: leaves * chord_m, arrives: arrives * chord_m }
    }

    /// The point at a share of the chord, in `[0, 1]`.
    pub(super) fn point(&self, u: f64) -> Point3<f64> {
        let (u2, u3) = (u * u, u * u * u);
        let along = self.to - self.from;
        self.from + along * (3.0 * u2 - 2.0 * u3) + self.leaves * (u - 2.0 * u2 + u3) + self.arrives * (u3 - u2)
    }

    /// The derivative by the share of the chord.
    pub(super) fn derivative(&self, u: f64) -> Vector3<f64> {
        let u2 = u * u;
        let along = self.to - self.from;
        along * (6.0 * u - 6.0 * u2) + self.leaves * (1.0 - 4.0 * u + 3.0 * u2) + self.arrives * (3.0 * u2 - 2.0 * u)
    }

    /// Square of the distance from a point to the piece, near a share of its chord: two steps of Newton's method.
    pub(super) fn distance_squared(&self, point: &Point3<f64>, near: f64) -> f64 {
        let mut u = near;
        for _ in 0..2 {
            let derivative = self.derivative(u);
            let square = derivative.norm_squared();
            if square > 0.0 {
                u = (u + (point - self.point(u)).dot(&derivative) / square).clamp(0.0, 1.0);
            }
        }
        (point - self.point(u)).norm_squared()
    }
}

/// A point of a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CurvePoint {
    /// Position, in the frame of the control points, metres.
    pub position: Point3<f64>,
    /// Direction of the curve, of length 1.
    pub tangent: Vector3<f64>,
    /// The piece that it lies on: from this control point to the next one.
    pub piece: usize,
    /// How far along that piece, in `[0, 1]`, by its chord.
    pub share: f64,
}

/// A curve through control points.
#[derive(Clone, Debug, PartialEq)]
pub struct SplineCurve {
    points: Vec<Point3<f64>>,
    tangents: Vec<Vector3<f64>>,
    /// Parameter at each control point, metres.
    parameters: Vec<f64>,
}

impl SplineCurve {
    /// The curve through at least two control points; `None` with fewer.
    #[must_use]
    pub fn new(points: Vec<Point3<f64>>) -> Option<Self> {
        let last = points.len().checked_sub(2)? + 1;
        let mut tangents = vec![Vector3::zeros(); points.len()];
        for index in 1..last {
            tangents[index] = tangent(&points[index - 1], &points[index], &points[index + 1]);
        }
        if last == 1 {
            let chord = (points[1] - points[0]).try_normalize(0.0).unwrap_or_default();
            tangents = vec![chord; 2];
        } else {
            tangents[0] = end_tangent(&(points[1] - points[0]), &tangents[1]);
            tangents[last] = end_tangent(&(points[last] - points[last - 1]), &tangents[last - 1]);
        }
        let mut parameters = vec![0.0];
        for pair in points.windows(2) {
            parameters.push(parameters[parameters.len() - 1] + (pair[1] - pair[0]).norm());
        }
        Some(Self { points, tangents, parameters })
    }

    /// The control points, metres.
    #[must_use]
    pub fn points(&self) -> &[Point3<f64>] {
        &self.points
    }

    /// The parameter at each control point: the chords before it, metres. The first is 0.
    #[must_use]
    pub fn parameters(&self) -> &[f64] {
        &self.parameters
    }

    /// The last parameter: the length of all chords, metres.
    #[must_use]
    pub fn last_parameter(&self) -> f64 {
        self.parameters[self.parameters.len() - 1]
    }

    /// The point at a parameter, metres; beyond the ends it is the end.
    #[must_use]
    pub fn at(&self, parameter: f64) -> CurvePoint {
        let after = self.parameters.partition_point(|start| *start <= parameter);
        let index = after.clamp(1, self.points.len() - 1) - 1;
        let chord_m = self.parameters[index + 1] - self.parameters[index];
        let share = if chord_m == 0.0 { 0.0 } else { ((parameter - self.parameters[index]) / chord_m).clamp(0.0, 1.0) };
        let piece =
            Piece::new(self.points[index], self.points[index + 1], self.tangents[index], self.tangents[index + 1]);
        let tangent = piece.derivative(share).try_normalize(0.0).unwrap_or(self.tangents[index]);
        CurvePoint { position: piece.point(share), tangent, piece: index, share }
    }

    /// Points from the first end to the last, at most `step_m` apart by the parameter.
    ///
    /// # Panics
    /// Where `step_m` is not above 0.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a count of points, positive and bounded"
    )]
    pub fn sample(&self, step_m: f64) -> Vec<CurvePoint> {
        assert!(step_m > 0.0, "a step of {step_m} m leads nowhere");
        let steps = (self.last_parameter() / step_m).ceil().clamp(1.0, 1e7) as usize;
        (0..=steps).map(|step| self.at(self.last_parameter() * step as f64 / steps as f64)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arc(angles: &[f64]) -> Vec<Point3<f64>> {
        angles.iter().map(|angle| Point3::new(100.0 * angle.cos(), 100.0 * angle.sin(), 2.0 * angle)).collect()
    }

    #[test]
    fn the_curve_goes_through_its_control_points() {
        let points = arc(&[0.0, 0.1, 0.13, 0.3, 0.5]);
        let curve = SplineCurve::new(points.clone()).unwrap();
        for (point, parameter) in points.iter().zip(curve.parameters()) {
            assert!((curve.at(*parameter).position - point).norm() < 1e-9);
        }
    }

    #[test]
    fn a_bend_is_followed_over_uneven_chords() {
        let curve = SplineCurve::new(arc(&[0.0, 0.1, 0.15, 0.25, 0.3])).unwrap();
        for point in curve.sample(0.5) {
            assert!((point.position.xy().coords.norm() - 100.0).abs() < 0.01, "{point:?}");
            let radial = point.position.coords.xy().normalize();
            assert!(point.tangent.xy().dot(&radial).abs() < 0.01);
        }
    }

    #[test]
    fn two_points_make_a_straight_line() {
        let curve = SplineCurve::new(vec![Point3::origin(), Point3::new(3.0, 4.0, 0.0)]).unwrap();
        let middle = curve.at(2.5);
        assert!((middle.position - Point3::new(1.5, 2.0, 0.0)).norm() < 1e-12);
        assert!((middle.tangent - Vector3::new(0.6, 0.8, 0.0)).norm() < 1e-12);
        assert!(SplineCurve::new(vec![Point3::origin()]).is_none());
    }
}
