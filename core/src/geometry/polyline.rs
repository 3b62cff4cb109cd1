//! Polylines in space: length, resampling at equal steps, the nearest point.

use nalgebra::Point3;

/// Length of a polyline, metres.
#[must_use]
pub fn length_m(points: &[Point3<f64>]) -> f64 {
    points.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum()
}

/// Points at arc lengths `0, step, 2 step, ..` below the length of the polyline (its end is not repeated).
///
/// Repeated points are passed over; a polyline of no length gives its first point.
#[must_use]
pub fn resample(points: &[Point3<f64>], step_m: f64) -> Vec<Point3<f64>> {
    let Some(first) = points.first() else { return Vec::new() };
    let mut samples = vec![*first];
    let mut travelled_m = 0.0;
    for pair in points.windows(2) {
        let piece = pair[1] - pair[0];
        let piece_m = piece.norm();
        if piece_m < 1e-9 {
            continue;
        }
        while samples.len() as f64 * step_m < travelled_m + piece_m {
            let along = (samples.len() as f64 * step_m - travelled_m) / piece_m;
            samples.push(pair[0] + piece * along);
        }
        travelled_m += piece_m;
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bent_line_is_resampled_at_equal_steps_along_its_length() {
        let bent = [Point3::origin(), Point3::new(1.0, 0.0, 0.0), Point3::new(1.0, 2.0, 0.0)];
        let samples = resample(&bent, 0.5);
        assert_eq!(samples.len(), 6);
        assert!((samples[3] - Point3::new(1.0, 0.5, 0.0)).norm() < 1e-12);
        assert!((length_m(&bent) - 3.0).abs() < 1e-12);
    }

    #[test]
    fn a_line_of_repeated_points_is_one_point() {
        assert_eq!(resample(&[Point3::origin(); 4], 0.5).len(), 1);
        assert!(resample(&[], 0.5).is_empty());
    }
}
