//! Whether two stretches of road are the same place.
//!
//! A change of the road is found anew with every fusion: the stretch is longer once more drives have been there, and lies
//! centimetres aside once they are aligned anew. So it is known by where it is: two stretches are the same place where
//! half of the shorter lies along the other. In plan, metres.

use nalgebra::{Point2, Point3};

/// Share of the shorter stretch that must lie along the other.
const LEAST_SHARE: f64 = 0.5;

/// Whether half of one stretch, the shorter one, lies within a distance of the other.
pub(super) fn is_same(one: &[Point3<f64>], other: &[Point3<f64>], within_m: f64) -> bool {
    let (shorter, longer) = if length_m(one) <= length_m(other) { (one, other) } else { (other, one) };
    let near = shorter.iter().filter(|point| distance_m(point, longer) <= within_m).count();
    !shorter.is_empty() && near as f64 >= LEAST_SHARE * shorter.len() as f64
}

/// Length of a stretch, metres.
pub(super) fn length_m(points: &[Point3<f64>]) -> f64 {
    points.windows(2).map(|pair| (pair[1] - pair[0]).xy().norm()).sum()
}

/// Distance of a point from a stretch; infinite where that is empty.
pub(super) fn distance_m(point: &Point3<f64>, stretch: &[Point3<f64>]) -> f64 {
    let at = point.xy();
    if let [only] = stretch {
        return nalgebra::distance(&at, &only.xy());
    }
    let chords = stretch.windows(2).map(|pair| from_chord_m(&at, &pair[0].xy(), &pair[1].xy()));
    chords.fold(f64::INFINITY, f64::min)
}

fn from_chord_m(at: &Point2<f64>, from: &Point2<f64>, to: &Point2<f64>) -> f64 {
    let along = to - from;
    let share = (at - from).dot(&along) / along.norm_squared().max(1e-12);
    nalgebra::distance(at, &(from + along * share.clamp(0.0, 1.0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along(from_m: f64, to_m: f64, aside_m: f64) -> Vec<Point3<f64>> {
        vec![
            Point3::new(from_m, aside_m, 0.0),
            Point3::new(f64::midpoint(from_m, to_m), aside_m, 9.0),
            Point3::new(to_m, aside_m, 0.0),
        ]
    }

    #[test]
    fn a_stretch_that_grew_is_the_same_place_and_the_next_one_along_the_line_is_not() {
        assert!(is_same(&along(0.0, 30.0, 0.0), &along(-40.0, 90.0, 0.4), 1.5));
        assert!(!is_same(&along(0.0, 30.0, 0.0), &along(40.0, 90.0, 0.0), 1.5));
        assert!(!is_same(&along(0.0, 30.0, 0.0), &along(0.0, 30.0, 3.5), 1.5));
        assert!(!is_same(&[], &along(0.0, 30.0, 0.0), 1.5));
    }
}
