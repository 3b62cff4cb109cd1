//! A strict scorer of a local map: one-to-one, both ways, within the image, with the errors of what was found.
//!
//! As `score_map.py`. Truth and predictions are resampled every 0.5 m (lines shorter than 2 m are left out) and cropped to
//! the [`ScoreBox`] and to the image; fewer than 5 points left are no line. A pair is valid when more than 75 % of the truth's
//! points have a point of the prediction within 0.5 m, and more than 75 % of the prediction's one of the truth. The
//! matching has maximum size, and among those the largest shares.

use nalgebra::Point3;
use pathfinding::prelude::{Matrix, kuhn_munkres};

use super::{
    authors_scorer::{VALID_SHARE, VALID_WITHIN_M},
    chain::Chain,
    counts::Counts,
    ground_frame::GroundFrame,
    score_box::ScoreBox,
};
use crate::{
    geometry::polyline::{length_m, resample},
    sensor::Sensor,
};

const STEP_M: f64 = 0.5;
const SHORTEST_M: f64 = 2.0;
const FEWEST_POINTS: usize = 5;

/// How far a point of a found line lies from its truth, metres, above or equal to zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineError {
    /// Across the truth, horizontally.
    pub lateral_m: f64,
    /// Up or down.
    pub vertical_m: f64,
}

/// Counts of a frame, and an error for each point of each line found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StrictScore {
    /// Counts.
    pub counts: Counts,
    /// Errors of the true positives' points.
    pub errors: Vec<LineError>,
}

/// Scores the predicted lines of one frame; lines are points in the ground frame, metres, in the order along the line.
///
/// ```
/// use lanemap_core::{Sensor, evaluation::score_strict};
/// use nalgebra::Point3;
///
/// let line = |x: f64| (3..50).map(|y| Point3::new(x, f64::from(y), 0.0)).collect::<Vec<_>>();
/// let score = score_strict(&[line(0.0)], &[line(0.2), line(-0.3), line(3.0)], &Sensor::default());
/// assert_eq!((score.counts.true_positives, score.counts.predictions), (1, 3));
/// assert!((score.errors[0].lateral_m - 0.2).abs() < 1e-12);
/// ```
#[must_use]
pub fn score_strict(truth: &[Vec<Point3<f64>>], predicted: &[Vec<Point3<f64>>], sensor: &Sensor) -> StrictScore {
    let truth: Vec<_> = truth.iter().filter_map(|line| in_view(line, sensor)).collect();
    let predicted: Vec<_> = predicted.iter().filter_map(|line| in_view(line, sensor)).collect();
    let pairs = matching(&truth, &predicted);
    let counts =
        Counts { true_positives: pairs.len() as u64, truths: truth.len() as u64, predictions: predicted.len() as u64 };
    let errors = pairs.iter().flat_map(|(t, p)| line_errors(&truth[*t], &predicted[*p])).collect();
    StrictScore { counts, errors }
}

fn in_view(line: &[Point3<f64>], sensor: &Sensor) -> Option<Vec<Point3<f64>>> {
    if length_m(line) < SHORTEST_M {
        return None;
    }
    let (score_box, ground) = (ScoreBox::default(), GroundFrame::below(sensor));
    let mut points = resample(line, STEP_M);
    points.retain(|point| score_box.contains(point) && sensor.sees(&ground.vehicle_from_ground(point)));
    (points.len() >= FEWEST_POINTS).then_some(points)
}

/// Pairs (truth, prediction) of a matching of maximum size.
fn matching(truth: &[Vec<Point3<f64>>], predicted: &[Vec<Point3<f64>>]) -> Vec<(usize, usize)> {
    if truth.is_empty() || predicted.is_empty() {
        return Vec::new();
    }
    let worth = |t: usize, p: usize| pair_worth(&truth[t], &predicted[p]);
    // `kuhn_munkres` wants no more rows than columns.
    let transposed = truth.len() > predicted.len();
    let (rows, columns) = if transposed { (predicted.len(), truth.len()) } else { (truth.len(), predicted.len()) };
    let weights = Matrix::from_fn(
        rows,
        columns,
        |(row, column)| {
            if transposed { worth(column, row) } else { worth(row, column) }
        },
    );
    let (_, columns) = kuhn_munkres(&weights);
    let pairs = columns.iter().enumerate().filter(|(row, column)| weights[(*row, **column)] > 0);
    pairs.map(|(row, column)| if transposed { (*column, row) } else { (row, *column) }).collect()
}

/// Weight of a pair: 0 where it is not valid, else 1 and a little for its shares, in units of 1e-9.
fn pair_worth(truth: &[Point3<f64>], predicted: &[Point3<f64>]) -> i64 {
    let of_truth = Chain::new(predicted).share_within(truth, VALID_WITHIN_M);
    if of_truth <= VALID_SHARE {
        return 0;
    }
    let of_predicted = Chain::new(truth).share_within(predicted, VALID_WITHIN_M);
    if of_predicted <= VALID_SHARE {
        return 0;
    }
    // Between 1e9 and 1.02e9, so the cast is exact enough and cannot overflow.
    #[allow(clippy::cast_possible_truncation)]
    let worth = ((1.0 + 0.01 * (of_truth + of_predicted)) * 1e9) as i64;
    worth
}

fn line_errors(truth: &[Point3<f64>], predicted: &[Point3<f64>]) -> Vec<LineError> {
    let chain = Chain::new(truth);
    let error = |point: &Point3<f64>| {
        let nearest = chain.nearest(point)?.min(truth.len() - 2);
        let tangent = (truth[nearest + 1] - truth[nearest]).xy();
        let tangent = tangent / tangent.norm().max(1e-9);
        let offset = point - truth[nearest];
        let lateral_m = (offset.y * tangent.x - offset.x * tangent.y).abs();
        Some(LineError { lateral_m, vertical_m: offset.z.abs() })
    };
    predicted.iter().filter_map(error).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::FieldOfView;

    fn line(x: f64, from: i32, to: i32) -> Vec<Point3<f64>> {
        (from..=to).map(|y| Point3::new(x, f64::from(y), 0.0)).collect()
    }

    #[test]
    fn a_prediction_that_runs_far_beyond_the_truth_does_not_count() {
        let truth = [line(0.0, 5, 20)];
        assert_eq!(score_strict(&truth, &[line(0.1, 5, 24)], &Sensor::default()).counts.true_positives, 1);
        assert_eq!(score_strict(&truth, &[line(0.1, 5, 30)], &Sensor::default()).counts.true_positives, 0);
    }

    #[test]
    fn two_predictions_cannot_claim_one_truth() {
        let score = score_strict(&[line(0.0, 5, 40)], &[line(0.1, 5, 40), line(-0.1, 5, 40)], &Sensor::default());
        assert_eq!(score.counts, Counts { true_positives: 1, truths: 1, predictions: 2 });
    }

    #[test]
    fn the_matching_is_as_large_as_can_be() {
        // The left prediction fits both truths, the right one only the right truth.
        let truth = [line(0.0, 5, 40), line(0.6, 5, 40)];
        let predicted = [line(0.3, 5, 40), line(1.0, 5, 40)];
        let score = score_strict(&truth, &predicted, &Sensor::default());
        assert_eq!(score.counts.true_positives, 2);
    }

    #[test]
    fn what_the_image_does_not_show_is_not_compared() {
        let view = FieldOfView { tan_left: 0.5, tan_right: 0.5, tan_up: 0.5, tan_down: 0.5 };
        let narrow = Sensor { field_of_view: Some(view), ..Sensor::default() };
        // At 8 m to the right the image begins 16 m ahead.
        let predicted = [line(8.0, 16, 40)];
        assert_eq!(score_strict(&[line(8.0, 3, 40)], &predicted, &narrow).counts.true_positives, 1);
        assert_eq!(score_strict(&[line(8.0, 3, 40)], &predicted, &Sensor::default()).counts.true_positives, 0);
    }

    #[test]
    fn stubs_are_left_out() {
        let score = score_strict(&[line(0.0, 5, 6)], &[vec![Point3::origin()], Vec::new()], &Sensor::default());
        assert_eq!(score.counts, Counts::default());
    }
}
