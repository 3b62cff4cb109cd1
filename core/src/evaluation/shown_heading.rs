//! The heading that one frame shows to a vehicle that knows the true map and which line is which.
//!
//! Ours: what the detector's own errors leave of the heading when nothing else can go wrong, as the limit beside the pose
//! tables. A detection's lateral residual against its true line is `e(r) = y + yaw r + b(r) + white`, where
//! `b(r) = c_0 + c_1 r + c_2 r^2` is the line's own error, `c ~ N(0, S)`. Generalised least squares over all lines of the frame:
//! `H = sum J^T V^-1 J`, `g = sum J^T V^-1 e`, `V = B S B^T + white^2`, `J = [1, r]`; the answer is the yaw of `H^-1 g`.
//!
//! `S` and the white noise are those of the simulated detector of the shared drives, fitted to some 4,000 of its lines, so that
//! no other weighting does much better on them.
//! Not used: memory. With errors correlated over half a second, and odometry off by half a degree per frame, earlier frames
//! add little; what they add shows where a mapper's figure over 10 m is below this one.

use nalgebra::{DMatrix, DVector, Matrix2, Matrix2xX, Matrix3, MatrixXx2, Point3, Vector2, Vector3};

/// Range at which the covariance is quoted, metres.
const REFERENCE_M: f64 = 50.0;
/// Covariance of a line's offset, slope and bend, at the reference range, m^2.
const LINE_COVARIANCE: [[f64; 3]; 3] = [[0.02, 0.0, 0.0], [0.0, 0.25, -0.2], [0.0, -0.2, 0.33]];
/// White noise of a point, metres.
const WHITE_M: f64 = 0.08;
/// A detection farther than this from every true line, on average, is a ghost, metres.
const GHOST_M: f64 = 1.2;
/// Fewer points beside a true line than this say nothing of a direction.
const LEAST_POINTS: usize = 3;

/// Yaw by which the detections of a frame are turned to the left of the true lines, radians; both in the vehicle frame.
///
/// `None` where no detection lies along a true line.
///
/// ```
/// use lanemap_core::evaluation::shown_heading;
/// use nalgebra::Point3;
///
/// let line = |slope: f64| (1..=10).map(|k| f64::from(k) * 5.0).map(|x| Point3::new(x, 1.5 + slope * x, 0.0)).collect::<Vec<_>>();
/// let yaw_rad = shown_heading(&[line(0.1)], &[line(0.105)]).unwrap();
/// assert!(yaw_rad > 0.0 && yaw_rad < 0.006);
/// ```
#[must_use]
pub fn shown_heading(truth: &[Vec<Point3<f64>>], detections: &[Vec<Point3<f64>>]) -> Option<f64> {
    let (mut hessian, mut gradient, mut lines) = (Matrix2::zeros(), Vector2::zeros(), 0);
    for detection in detections {
        let Some((jacobian, weighted, residuals)) = nearest_residuals(truth, detection).and_then(|r| weigh(&r)) else {
            continue;
        };
        hessian += &jacobian * &weighted;
        gradient += weighted.transpose() * residuals;
        lines += 1;
    }
    let solved = hessian.try_inverse()? * gradient;
    (lines > 0).then_some(solved.y)
}

/// Range and lateral residual of a detection's points against the true line that it lies along.
fn nearest_residuals(truth: &[Vec<Point3<f64>>], detection: &[Point3<f64>]) -> Option<Vec<(f64, f64)>> {
    let against = |line: &Vec<Point3<f64>>| {
        let beside = |point: &Point3<f64>| Some((point.x, point.y - left_at(line, point.x)?));
        let residuals: Vec<(f64, f64)> = detection.iter().filter_map(beside).collect();
        let mean = residuals.iter().map(|(_, residual)| residual.abs()).sum::<f64>() / residuals.len().max(1) as f64;
        (residuals.len() >= LEAST_POINTS && mean < GHOST_M).then_some((mean, residuals))
    };
    truth.iter().filter_map(against).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, residuals)| residuals)
}

/// How far to the left a line is at a distance ahead; `None` beyond its ends.
fn left_at(line: &[Point3<f64>], ahead_m: f64) -> Option<f64> {
    let piece = line.windows(2).find(|pair| (pair[0].x - ahead_m) * (pair[1].x - ahead_m) <= 0.0)?;
    let length = piece[1].x - piece[0].x;
    let share = if length == 0.0 { 0.0 } else { (ahead_m - piece[0].x) / length };
    Some(piece[0].y + share * (piece[1].y - piece[0].y))
}

/// `J^T`, `V^-1 J` and the residuals of one line.
fn weigh(residuals: &[(f64, f64)]) -> Option<(Matrix2xX<f64>, MatrixXx2<f64>, DVector<f64>)> {
    let count = residuals.len();
    let line = Matrix3::from_fn(|row, column| LINE_COVARIANCE[row][column]);
    let powers: Vec<Vector3<f64>> = residuals.iter().map(|(range_m, _)| powers_of(range_m / REFERENCE_M)).collect();
    let white = |row: usize, column: usize| if row == column { WHITE_M * WHITE_M } else { 0.0 };
    let covariance =
        DMatrix::from_fn(count, count, |row, column| powers[row].dot(&(line * powers[column])) + white(row, column));
    let jacobian = MatrixXx2::from_fn(count, |row, column| if column == 0 { 1.0 } else { residuals[row].0 });
    let weighted = covariance.cholesky()?.solve(&jacobian);
    Some((
        jacobian.transpose(),
        weighted,
        DVector::from_iterator(count, residuals.iter().map(|(_, residual)| *residual)),
    ))
}

fn powers_of(range: f64) -> Vector3<f64> {
    Vector3::new(1.0, range, range * range)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(left_m: f64, slope: f64) -> Vec<Point3<f64>> {
        (1..=10).map(|k| f64::from(k) * 5.0).map(|x| Point3::new(x, left_m + slope * x, 0.0)).collect()
    }

    #[test]
    fn lines_that_are_all_turned_alike_show_nothing_but_the_turn() {
        let truth = [line(-5.0, 0.0), line(-1.5, 0.0), line(2.0, 0.0)];
        let turned = [line(-5.0, 0.004), line(-1.5, 0.004), line(2.0, 0.004)];
        assert!((shown_heading(&truth, &turned).unwrap() - 0.004).abs() < 1e-9);
    }

    #[test]
    fn a_shift_of_all_lines_is_no_turn() {
        let truth = [line(-1.5, 0.0), line(2.0, 0.0)];
        let shifted = [line(-1.2, 0.0), line(2.3, 0.0)];
        assert!(shown_heading(&truth, &shifted).unwrap().abs() < 1e-9);
    }

    #[test]
    fn a_ghost_and_an_empty_frame_show_no_heading() {
        assert_eq!(shown_heading(&[line(0.0, 0.0)], &[line(2.0, 0.1)]), None);
        assert_eq!(shown_heading(&[line(0.0, 0.0)], &[]), None);
    }
}
