//! Nearest-point search among the points of a line, as they follow one another.
//!
//! A point at distance `D` lets the scan skip the next `(D - r) / step` points, `step` being the longest step of the line: none
//! of them can be nearer than `r`. Exact, needs no tree, and reads a few points of a line that is far away.

use nalgebra::Point3;

/// The points of a line with their longest step.
pub(crate) struct Chain<'a> {
    points: &'a [Point3<f64>],
    longest_step_m: f64,
}

impl<'a> Chain<'a> {
    pub(crate) fn new(points: &'a [Point3<f64>]) -> Self {
        let longest_step_m = points.windows(2).map(|pair| (pair[1] - pair[0]).norm()).fold(1e-9, f64::max);
        Self { points, longest_step_m }
    }

    /// Whether a point of the line lies nearer to the query than `radius_m`.
    pub(crate) fn comes_within(&self, query: &Point3<f64>, radius_m: f64) -> bool {
        let mut index = 0;
        while let Some(point) = self.points.get(index) {
            let distance_m = (point - query).norm();
            if distance_m < radius_m {
                return true;
            }
            index += self.skippable(distance_m - radius_m);
        }
        false
    }

    /// Index of the point nearest to the query, the first of equals; `None` for an empty line.
    pub(crate) fn nearest(&self, query: &Point3<f64>) -> Option<usize> {
        let (mut index, mut best, mut best_m) = (0, None, f64::INFINITY);
        while let Some(point) = self.points.get(index) {
            let distance_m = (point - query).norm();
            if distance_m < best_m {
                (best, best_m) = (Some(index), distance_m);
            }
            index += self.skippable(distance_m - best_m);
        }
        best
    }

    /// Share of the queries that the line comes within `radius_m` of.
    pub(crate) fn share_within(&self, queries: &[Point3<f64>], radius_m: f64) -> f64 {
        let within = queries.iter().filter(|query| self.comes_within(query, radius_m)).count();
        within as f64 / queries.len().max(1) as f64
    }

    /// Points that may be passed over when all within `margin_m` of here are of no interest; at least 1.
    fn skippable(&self, margin_m: f64) -> usize {
        // A hair less than the margin, against rounding; the cast saturates.
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let steps = ((margin_m - 1e-9) / self.longest_step_m).floor().max(1.0) as usize;
        steps
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_line() -> impl Strategy<Value = Vec<Point3<f64>>> {
        prop::collection::vec(prop::array::uniform3(-3.0..3.0f64).prop_map(Point3::from), 1..40)
    }

    proptest! {
        #[test]
        fn skipping_finds_what_looking_at_every_point_finds(
            line in any_line(),
            query in prop::array::uniform3(-4.0..4.0f64).prop_map(Point3::from),
            radius_m in 0.1..3.0f64,
        ) {
            let chain = Chain::new(&line);
            let distances: Vec<f64> = line.iter().map(|point| (point - query).norm()).collect();
            let least = distances.iter().copied().fold(f64::INFINITY, f64::min);
            prop_assert_eq!(chain.comes_within(&query, radius_m), least < radius_m);
            prop_assert!(distances[chain.nearest(&query).unwrap()] <= least);
        }
    }
}
