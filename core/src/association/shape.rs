//! A lane as association sees it: an ordered polyline with a belief about its category.

use nalgebra::Point3;

use crate::category::Category;

/// A detected lane or a lane of the map, in the vehicle frame at the predicted pose, metres.
#[derive(Clone, Debug, PartialEq)]
pub struct LaneShape {
    /// Most probable category.
    pub category: Category,
    /// Log-likelihood of a detection's category given this lane, by [`Category::index`]; only read of lanes of the map.
    pub category_log_likelihood: [f64; Category::ALL.len()],
    /// Points in order along the line, at most a few metres apart; at least one.
    pub points: Vec<Point3<f64>>,
}

impl LaneShape {
    /// A lane whose category was seen once, by a detector that errs with probability `confusion`.
    #[must_use]
    pub fn seen_once(category: Category, points: Vec<Point3<f64>>, confusion: f64) -> Self {
        let mut category_log_likelihood = [(confusion / (Category::ALL.len() - 1) as f64).ln(); Category::ALL.len()];
        category_log_likelihood[category.index()] = (1.0 - confusion).ln();
        Self { category, category_log_likelihood, points }
    }

    /// Index of the point nearest to `query` by walking downhill from `start`; for ordered lines without hairpins.
    #[must_use]
    pub fn nearest_from(&self, query: &Point3<f64>, start: usize) -> usize {
        let squared = |index: usize| (self.points[index] - query).norm_squared();
        let mut best = start.min(self.points.len() - 1);
        let mut best_squared = squared(best);
        while best + 1 < self.points.len() && squared(best + 1) < best_squared {
            best += 1;
            best_squared = squared(best);
        }
        while best > 0 && squared(best - 1) < best_squared {
            best -= 1;
            best_squared = squared(best);
        }
        best
    }

    /// Index of the point nearest to `query`, by looking at all of them.
    #[must_use]
    pub fn nearest(&self, query: &Point3<f64>) -> usize {
        let squared = |point: &Point3<f64>| (point - query).norm_squared();
        let compare = |a: &(usize, &Point3<f64>), b: &(usize, &Point3<f64>)| squared(a.1).total_cmp(&squared(b.1));
        self.points.iter().enumerate().min_by(compare).map_or(0, |(index, _)| index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn walking_finds_what_looking_at_all_finds() {
        let points = (0..40).map(|k| Point3::new(f64::from(k), (f64::from(k) * 0.1).sin(), 0.0)).collect();
        let shape = LaneShape::seen_once(Category::WhiteSolid, points, 0.1);
        for start in [0, 17, 39] {
            let query = Point3::new(23.4, 2.0, 0.1);
            assert_eq!(shape.nearest_from(&query, start), shape.nearest(&query));
        }
    }
}
