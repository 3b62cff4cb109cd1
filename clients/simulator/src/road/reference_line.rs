//! The reference line of a road in plan: points one metre apart with their heading.
//!
//! Between two mouths the line follows the chord, displaced to the left by `y(t) = A sin^2(pi t) sin(2 pi k t + phi)`:
//! smooth everywhere, leaving and arriving along the chord. `A` is lowered until the tightest bend keeps its radius.

use std::f64::consts::{PI, TAU};

use nalgebra::{Point2, Vector2};

/// Spacing of the points, metres.
const STEP_M: f64 = 1.0;

/// A line in plan, parameterised by arc length.
#[derive(Clone, Debug)]
pub struct ReferenceLine {
    points: Vec<Point2<f64>>,
    headings_rad: Vec<f64>,
}

/// How a link bends between its mouths.
#[derive(Clone, Copy, Debug)]
pub struct Bends {
    /// Displacement asked for, metres.
    pub amplitude_m: f64,
    /// Waves along the link.
    pub waves: f64,
    /// Phase of the wave.
    pub phase_rad: f64,
    /// Tightest radius allowed, metres.
    pub min_radius_m: f64,
}

impl ReferenceLine {
    /// The line between two mouths.
    #[must_use]
    pub fn between(start: Point2<f64>, end: Point2<f64>, bends: &Bends) -> Self {
        let chord_m = (end - start).norm();
        let shape = |t: f64| (PI * t).sin().powi(2) * (TAU * bends.waves * t + bends.phase_rad).sin();
        let amplitude_m = bends.amplitude_m.min(gentlest_amplitude_m(&shape, chord_m, bends.min_radius_m));
        let along = (end - start) / chord_m;
        let left = Vector2::new(-along.y, along.x);
        let samples = crate::count_of(chord_m * 4.0).max(8);
        let dense: Vec<_> = (0..=samples)
            .map(|k| {
                let t = k as f64 / samples as f64;
                start + (end - start) * t + left * (amplitude_m * shape(t))
            })
            .collect();
        Self::through(&dense)
    }

    /// The line through points, resampled to even steps of about one metre.
    #[must_use]
    pub fn through(dense: &[Point2<f64>]) -> Self {
        let points = resample_evenly(dense);
        let headings_rad = headings(&points);
        Self { points, headings_rad }
    }

    /// The closed line through points, of which the last is the first again.
    #[must_use]
    pub(crate) fn closed_through(dense: &[Point2<f64>]) -> Self {
        let mut line = Self::through(dense);
        let last = line.points.len() - 1;
        line.points[last] = line.points[0];
        // At the seam as anywhere else: from the point before to the point after.
        let across = line.points[1] - line.points[last - 1];
        let seam_rad = across.y.atan2(across.x);
        line.headings_rad[0] = line.headings_rad[1] + wrap(seam_rad - line.headings_rad[1]);
        line.headings_rad[last] = line.headings_rad[last - 1] + wrap(seam_rad - line.headings_rad[last - 1]);
        line
    }

    /// The part between two points, by their indices.
    #[must_use]
    pub(crate) fn slice(&self, points: std::ops::Range<usize>) -> Self {
        Self { points: self.points[points.clone()].to_vec(), headings_rad: self.headings_rad[points].to_vec() }
    }

    /// Places beside the line, one per point of it, where `offset_at_m` gives an offset to the left at a distance.
    #[must_use]
    pub(crate) fn offset_line(&self, offset_at_m: impl Fn(f64) -> Option<f64>) -> Vec<Point2<f64>> {
        let length_m = self.length_m();
        let at_m = |k: usize| (k as f64 / (self.len() - 1) as f64 * length_m).min(length_m);
        (0..self.len()).filter_map(|k| Some(self.offset_point(k, offset_at_m(at_m(k))?))).collect()
    }

    /// Length, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.points.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum()
    }

    /// Number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether the line has no point.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Point `index` moved to the left by `offset_m`.
    #[must_use]
    pub fn offset_point(&self, index: usize, offset_m: f64) -> Point2<f64> {
        let heading_rad = self.headings_rad[index];
        self.points[index] + Vector2::new(-heading_rad.sin(), heading_rad.cos()) * offset_m
    }

    /// Headings at the points, radians from the x axis, without jumps of a whole turn.
    #[must_use]
    pub fn headings_rad(&self) -> &[f64] {
        &self.headings_rad
    }

    /// Points in plan, metres.
    #[must_use]
    pub fn points(&self) -> &[Point2<f64>] {
        &self.points
    }
}

/// The amplitude at which the displacement's sharpest bend has radius `min_radius_m` (small-slope curvature).
fn gentlest_amplitude_m(shape: &impl Fn(f64) -> f64, chord_m: f64, min_radius_m: f64) -> f64 {
    let step = 1e-3;
    let sharpest = (1..1000)
        .map(|k| {
            let t = f64::from(k) * step;
            ((shape(t + step) - 2.0 * shape(t) + shape(t - step)) / (step * step)).abs() / (chord_m * chord_m)
        })
        .fold(1e-12, f64::max);
    1.0 / (min_radius_m * sharpest)
}

fn resample_evenly(dense: &[Point2<f64>]) -> Vec<Point2<f64>> {
    let length_m: f64 = dense.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
    let pieces = crate::count_of((length_m / STEP_M).round()).max(1);
    let step_m = length_m / pieces as f64;
    let mut points = Vec::with_capacity(pieces + 1);
    let (mut segment, mut before_m) = (0, 0.0);
    for k in 0..=pieces {
        let wanted_m = step_m * k as f64;
        while segment + 2 < dense.len() && before_m + (dense[segment + 1] - dense[segment]).norm() < wanted_m {
            before_m += (dense[segment + 1] - dense[segment]).norm();
            segment += 1;
        }
        let piece = dense[segment + 1] - dense[segment];
        let share = ((wanted_m - before_m) / piece.norm().max(1e-12)).min(1.0);
        points.push(dense[segment] + piece * share);
    }
    points
}

fn headings(points: &[Point2<f64>]) -> Vec<f64> {
    let last = points.len() - 1;
    let mut headings_rad: Vec<f64> = Vec::with_capacity(points.len());
    for k in 0..points.len() {
        let direction = points[(k + 1).min(last)] - points[k.saturating_sub(1)];
        let raw = direction.y.atan2(direction.x);
        let previous = headings_rad.last().copied().unwrap_or(raw);
        headings_rad.push(previous + wrap(raw - previous));
    }
    headings_rad
}

/// An angle brought into `[-pi, pi)`.
#[must_use]
pub fn wrap(angle_rad: f64) -> f64 {
    (angle_rad + PI).rem_euclid(TAU) - PI
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bends_keep_their_radius_and_leave_along_the_chord() {
        let bends = Bends { amplitude_m: 80.0, waves: 1.5, phase_rad: 0.7, min_radius_m: 90.0 };
        let line = ReferenceLine::between(Point2::origin(), Point2::new(500.0, 0.0), &bends);
        for pair in line.headings_rad().windows(2) {
            assert!((pair[1] - pair[0]).abs() < 1.0 / 85.0, "radius below 85 m");
        }
        for pair in line.points().windows(2) {
            assert!(((pair[1] - pair[0]).norm() - 1.0).abs() < 0.01);
        }
        assert!(line.headings_rad()[0].abs() < 0.02);
        assert!((line.points()[line.len() - 1] - Point2::new(500.0, 0.0)).norm() < 1e-9);
        let widest = line.points().iter().map(|point| point.y.abs()).fold(0.0, f64::max);
        assert!(widest > 5.0, "the link does bend: {widest}");
    }
}
