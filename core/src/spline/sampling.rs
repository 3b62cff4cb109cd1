//! Sampling a curve: points at equal parameter steps, close enough to draw.
//!
//! The step in parameter is `step_m / chord`, so points are `step_m` apart within the few percent by which chords differ.
//! The last point is always the curve's end.

use nalgebra::Point3;

use super::curve::{ControlPolygon, Curve};
use crate::lane_map::MapLane;

/// Points of a curve between two parameters, both included, about `step_m` apart for chords of `chord_m`.
#[must_use]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a count of points, positive and small
pub fn sample<P: ControlPolygon + ?Sized>(
    curve: &Curve<'_, P>,
    from: f64,
    to: f64,
    pieces_per_chord: usize,
) -> Vec<Point3<f64>> {
    let from = from.max(curve.first_parameter());
    let to = to.min(curve.last_parameter());
    if to < from {
        return Vec::new();
    }
    let pieces = ((to - from) * pieces_per_chord as f64).ceil().max(1.0) as usize;
    (0..=pieces).map(|k| curve.point(from + (to - from) * k as f64 / pieces as f64)).collect()
}

impl MapLane {
    /// The line as drawn: points about `step_m` apart from its first to its last end, map frame, metres.
    ///
    /// ```
    /// # use lanemap_core::{lane_map::*, Category, TimestampNs};
    /// # use nalgebra::{Matrix3, Point3};
    /// let control_points = (0..4)
    ///     .map(|i| ControlPoint { position: Point3::new(3.0 * f64::from(i), 0.0, 0.0), covariance: Matrix3::zeros() })
    ///     .collect();
    /// let lane = MapLane {
    ///     id: LaneId(1), category: Category::WhiteSolid, category_posterior: vec![],
    ///     category_stretches: vec![], control_points,
    ///     ends: EndRule::Reflected, drawn_from: 0.0, drawn_to: 2.5, existence: 1.0, observations: 9,
    ///     first_seen: TimestampNs(0), last_seen: TimestampNs(0),
    /// };
    /// let line = lane.polyline(0.5);
    /// assert_eq!(line.len(), 16);
    /// assert!((line[15].x - 7.5).abs() < 1e-12);
    /// ```
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a count of points, positive and small
    pub fn polyline(&self, step_m: f64) -> Vec<Point3<f64>> {
        let points = self.control_points.as_slice();
        let Some(curve) = Curve::new(points, self.ends) else { return Vec::new() };
        let chord_m = points.windows(2).map(|pair| (pair[1].position - pair[0].position).norm()).sum::<f64>()
            / (points.len() - 1) as f64;
        let pieces_per_chord = (chord_m / step_m).ceil().clamp(1.0, 1_000.0) as usize;
        sample(&curve, self.drawn_from, self.drawn_to, pieces_per_chord)
    }
}
