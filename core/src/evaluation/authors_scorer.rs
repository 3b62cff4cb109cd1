//! The paper's scorer of a local map.
//!
//! Paper: "Evaluation on Map Quality", as the authors' `lane_evaluator.py` computes it and `score_map.py` repeats it. Truth is
//! cropped to the [`ScoreBox`], refitted with cubics along its chord and resampled every 0.1 m; predictions are cropped
//! 10 m and 20 m wider before, and to the box after. A prediction is a true positive if for *any* truth more than 75 % of
//! the truth's points have a point of the prediction within 0.5 m.
//!
//! Rotations use fused multiply-add, as numpy's do: a point that lies on the border of the box then falls on the same side.
//!
//! It flatters: several predictions may claim one truth, and what a prediction says beyond the truth costs nothing.
//! [`score_strict`](super::score_strict) is the one to believe.

use nalgebra::Point3;

use super::{chain::Chain, counts::Counts, polynomial::Polynomial, score_box::ScoreBox};

/// Spacing of the resampled lines, metres.
const STEP_M: f64 = 0.1;
/// How near a point must come to be valid, metres.
pub(crate) const VALID_WITHIN_M: f64 = 0.5;
/// Share of valid points above which a line is found.
pub(crate) const VALID_SHARE: f64 = 0.75;

/// Scores the predicted lines of one frame; lines are points in the ground frame, metres, in the order along the line.
///
/// ```
/// use lanemap_core::evaluation::score_authors;
/// use nalgebra::Point3;
///
/// let line = |x: f64| (3..50).map(|y| Point3::new(x, f64::from(y), 0.0)).collect::<Vec<_>>();
/// let counts = score_authors(&[line(0.0)], &[line(0.2), line(-0.2), line(3.0)]);
/// assert_eq!((counts.true_positives, counts.truths, counts.predictions), (2, 1, 3));
/// ```
#[must_use]
pub fn score_authors(truth: &[Vec<Point3<f64>>], predicted: &[Vec<Point3<f64>>]) -> Counts {
    let inner = ScoreBox::default();
    let wide = inner.widened(10.0, 20.0);
    let truth: Vec<_> = truth.iter().filter_map(|line| refit(&inner.crop(line))).collect();
    let predicted: Vec<_> = predicted
        .iter()
        .filter_map(|line| refit(&wide.crop(line)))
        .map(|line| inner.crop(&line))
        .filter(|line| !line.is_empty())
        .collect();
    let finds = |line: &&Vec<Point3<f64>>| {
        let chain = Chain::new(line);
        truth.iter().any(|points| chain.share_within(points, VALID_WITHIN_M) > VALID_SHARE)
    };
    Counts {
        true_positives: predicted.iter().filter(finds).count() as u64,
        truths: truth.len() as u64,
        predictions: predicted.len() as u64,
    }
}

/// Cubics `y(x)` and `z(x)` along the horizontal chord from the first point to the last, every 0.1 m; `None` for no points.
fn refit(line: &[Point3<f64>]) -> Option<Vec<Point3<f64>>> {
    let (first, last) = (line.first()?, line.last()?);
    let chord = (last - first).xy();
    let chord_m = chord.norm();
    if line.len() == 1 || chord_m < 1e-9 {
        return Some(vec![*first]);
    }
    let (cos, sin) = (chord.x / chord_m, chord.y / chord_m);
    let x: Vec<f64> = line.iter().map(|point| sin.mul_add(point.y, cos * point.x)).collect();
    let y: Vec<f64> = line.iter().map(|point| cos.mul_add(point.y, -sin * point.x)).collect();
    let z: Vec<f64> = line.iter().map(|point| point.z).collect();
    let (across, height) = (Polynomial::fit(&x, &y), Polynomial::fit(&x, &z));
    let from = x.iter().copied().fold(f64::INFINITY, f64::min);
    let to = x.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let sample = |along: f64| {
        let across = across.at(along);
        Point3::new((-sin).mul_add(across, cos * along), cos.mul_add(across, sin * along), height.at(along))
    };
    Some(equal_steps(from, to).map(sample).collect())
}

/// numpy's `linspace(from, to, max(int((to - from) / 0.1), 1))`.
fn equal_steps(from: f64, to: f64) -> impl Iterator<Item = f64> {
    // The box bounds the chord: at most a few thousand steps.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let count = (((to - from) / STEP_M) as usize).max(1);
    let step = (to - from) / (count.max(2) - 1) as f64;
    (0..count).map(move |index| if index > 0 && index + 1 == count { to } else { from + step * index as f64 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(x: f64, from: f64, to: f64) -> Vec<Point3<f64>> {
        let points = 48;
        (0..points).map(|i| Point3::new(x, from + (to - from) * f64::from(i) / f64::from(points - 1), -0.3)).collect()
    }

    #[test]
    fn a_prediction_over_less_than_three_quarters_of_the_truth_does_not_count() {
        let truth = [line(1.0, 3.5, 43.5)];
        assert_eq!(score_authors(&truth, &[line(1.1, 3.5, 32.0)]).true_positives, 0);
        assert_eq!(score_authors(&truth, &[line(1.1, 3.5, 35.0)]).true_positives, 1);
    }

    #[test]
    fn lines_outside_the_box_do_not_count_at_all() {
        let counts = score_authors(&[line(11.0, 5.0, 40.0)], &[line(11.0, 5.0, 40.0), Vec::new()]);
        assert_eq!(counts, Counts::default());
    }

    #[test]
    fn a_single_point_is_a_line_of_one_point() {
        let point = vec![Point3::new(0.0, 10.0, 0.0)];
        let counts = score_authors(std::slice::from_ref(&point), std::slice::from_ref(&point));
        assert_eq!(counts, Counts { true_positives: 1, truths: 1, predictions: 1 });
    }
}
