//! Foot point: the point of a lane that lies nearest to an observed point.
//!
//! Paper: "Pose Update", coarse to fine. The two nearest control points choose the segment; they must be adjacent and
//! on the curve, and nearer to the query than to each other. Three inner way points make a polyline of the segment,
//! and the foot point on the polyline gives `u` ([`foot_point_coarse`]).
//!
//! Ours ([`foot_point_refined`]): from any starting parameter, Newton on `|p(t) - q|^2`, walking over segment borders,
//! up to a step of a few millimetres, after which what is left is its square: `t += <q - p, p'> / (|p'|^2 - <q - p, p''>)`,
//! with the curvature term left out where it would make the denominator small. Not guaranteed: the global minimum on a curve that doubles back within
//! a few chords of the start.

use nalgebra::{Point3, Vector3};

use super::curve::{ControlPolygon, Curve};

/// Where on a curve a query point belongs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FootPoint {
    /// Parameter on the curve: control point index and fraction.
    pub parameter: f64,
    /// Distance from the query to the curve there, metres.
    pub distance_m: f64,
}

/// Inner way points of a segment: the paper takes three.
const WAY_POINTS: u32 = 3;

/// The paper's foot point, given the control point nearest to the query; `None` beyond the ends.
///
/// `reach_m` is the greatest distance to both control points: one chord in the paper.
#[must_use]
pub fn foot_point_coarse<P: ControlPolygon + ?Sized>(
    curve: &Curve<'_, P>,
    query: &Point3<f64>,
    nearest: usize,
    reach_m: f64,
) -> Option<FootPoint> {
    let points = curve.points();
    let last = points.count() - 1;
    if nearest == 0 || nearest == last {
        return None;
    }
    let distance_to = |index: usize| (points.at(index) - query).norm();
    let next = if distance_to(nearest - 1) < distance_to(nearest + 1) { nearest - 1 } else { nearest + 1 };
    let both_inner = next != 0 && next != last;
    if !both_inner || distance_to(nearest) > reach_m || distance_to(next) > reach_m {
        return None;
    }
    Some(nearest_on_way_points(curve, nearest.min(next), query))
}

fn nearest_on_way_points<P: ControlPolygon + ?Sized>(
    curve: &Curve<'_, P>,
    segment: usize,
    query: &Point3<f64>,
) -> FootPoint {
    let pieces = f64::from(WAY_POINTS + 1);
    let mut best = FootPoint { parameter: segment as f64, distance_m: f64::INFINITY };
    let mut start = curve.point(segment as f64);
    for piece in 0..=WAY_POINTS {
        let end = curve.point(segment as f64 + f64::from(piece + 1) / pieces);
        let direction = end - start;
        let along = ((query - start).dot(&direction) / direction.norm_squared()).clamp(0.0, 1.0);
        let distance_m = (query - (start + direction * along)).norm();
        if distance_m < best.distance_m {
            best = FootPoint { parameter: segment as f64 + (f64::from(piece) + along) / pieces, distance_m };
        }
        start = end;
    }
    best
}

/// A foot point by Newton from a starting parameter; `None` where the query lies beyond an end of the curve.
#[must_use]
pub fn foot_point_refined<P: ControlPolygon + ?Sized>(
    curve: &Curve<'_, P>,
    query: &Point3<f64>,
    start: f64,
) -> Option<FootPoint> {
    let FootOffset { parameter, offset, .. } = foot_offset(curve, query, start)?;
    Some(FootPoint { parameter, distance_m: offset.norm() })
}

/// Where a query lies from its foot point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FootOffset {
    /// Curve parameter of the foot point: control point `i` lies at `i`.
    pub parameter: f64,
    /// From the foot point to the query, metres.
    pub offset: Vector3<f64>,
    /// First derivative of the curve there, metres per control point.
    pub derivative: Vector3<f64>,
}

/// As [`foot_point_refined`], with the offset from the curve and the curve's direction there, good to the last step.
#[must_use]
pub fn foot_offset<P: ControlPolygon + ?Sized>(
    curve: &Curve<'_, P>,
    query: &Point3<f64>,
    start: f64,
) -> Option<FootOffset> {
    const ITERATIONS: usize = 12;
    /// A step shorter than this is the last, control points.
    const SETTLED: f64 = 1e-3;
    /// Steps longer than this leave the neighbourhood in which the parabola is believed, control points.
    const LONGEST_STEP: f64 = 8.0;
    let (first, last) = (curve.first_parameter(), curve.last_parameter());
    let mut parameter = start.clamp(first, last);
    let mut segment = curve.segment_at(parameter);
    let mut found = FootOffset { parameter, offset: Vector3::zeros(), derivative: Vector3::zeros() };
    for _ in 0..ITERATIONS {
        if !segment.holds(parameter) {
            segment = curve.segment_at(parameter);
        }
        let (point, derivative, bend) = segment.evaluate(parameter);
        let offset = query - point;
        found = FootOffset { parameter, offset, derivative };
        let speed_squared = derivative.norm_squared();
        if speed_squared < 1e-12 {
            return None;
        }
        let gradient = offset.dot(&derivative);
        let curvature = offset.dot(&bend);
        let step = (gradient / (speed_squared - curvature).max(0.5 * speed_squared)).clamp(-LONGEST_STEP, LONGEST_STEP);
        if (parameter <= first && step < 0.0) || (parameter >= last && step > 0.0) {
            return None;
        }
        let next = parameter + step;
        parameter = next.clamp(first, last);
        if step.abs() < SETTLED && parameter.to_bits() == next.to_bits() {
            found.offset = query - (point + derivative * step);
            break;
        }
    }
    Some(FootOffset { parameter, ..found })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lane_map::EndRule;
    use proptest::prelude::*;

    fn bend() -> Vec<Point3<f64>> {
        (0..20)
            .map(|i| {
                let angle = f64::from(i) * 3.0 / 60.0;
                Point3::new(60.0 * angle.sin(), 60.0 * (1.0 - angle.cos()), 0.05 * f64::from(i))
            })
            .collect()
    }

    proptest! {
        #[test]
        fn newton_finds_the_nearest_of_a_dense_sampling(along in 0.5..18.5f64, side in -4.0..4.0f64, start in 0.0..19.0f64) {
            let points = bend();
            let curve = Curve::new(points.as_slice(), EndRule::Reflected).unwrap();
            let tangent = curve.derivative(along).normalize();
            let query = curve.point(along) + Vector3::new(-tangent.y, tangent.x, 0.3) * side;
            let found = foot_point_refined(&curve, &query, start).unwrap();
            let dense = (0..19_000).map(|k| (curve.point(f64::from(k) * 1e-3) - query).norm()).fold(f64::INFINITY, f64::min);
            prop_assert!(found.distance_m < dense + 1e-6);
        }
    }

    #[test]
    fn the_coarse_foot_point_lies_within_centimetres_of_the_refined_one() {
        let points = bend();
        let curve = Curve::new(points.as_slice(), EndRule::Open).unwrap();
        let query = curve.point(7.3) + Vector3::new(0.2, -0.4, 0.1);
        let coarse = foot_point_coarse(&curve, &query, 7, 3.0).unwrap();
        let refined = foot_point_refined(&curve, &query, 7.0).unwrap();
        assert!((coarse.parameter - refined.parameter).abs() < 0.02);
    }

    #[test]
    fn a_point_beyond_the_end_has_no_foot_point() {
        let points = bend();
        let curve = Curve::new(points.as_slice(), EndRule::Reflected).unwrap();
        let beyond = points[19] + (points[19] - points[18]);
        assert_eq!(foot_point_refined(&curve, &beyond, 15.0), None);
        assert_eq!(foot_point_coarse(&curve, &beyond, 19, 3.0), None);
    }
}
