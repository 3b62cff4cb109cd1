//! Lateral sequence consistency: do two associations agree on which lane lies left of which, and how far?
//!
//! Paper: "Lane association", figure 3, with its misprints corrected. For the associations `(i -> j)` and `(k -> l)` the middle point of
//! one lane is compared with the chord of the other, once in the frame and once in the map: on the same side they add
//! `1 / (1 + |difference of distances|)` to each other's score (the paper's `1 / |.|` blows up). Associations that share a
//! detection or a lane are inconsistent. Scores are divided by their maximum and squared.
//!
//! The side is a signed cross product with the chord from near to far, so it does not depend on the compass heading (the
//! authors' slope formula does).

use nalgebra::Point3;

use super::{LaneShape, chamfer::Edge};

/// Score of each edge in `[0, 1]`.
#[must_use]
pub fn consistency_scores(edges: &[Edge], detections: &[LaneShape], lanes: &[LaneShape]) -> Vec<f64> {
    let mut scores = vec![0.0; edges.len()];
    for (a, first) in edges.iter().enumerate() {
        for (b, second) in edges.iter().enumerate().skip(a + 1) {
            if first.detection == second.detection || first.lane == second.lane {
                continue;
            }
            let seen = left_distance_m(&detections[first.detection], &detections[second.detection]);
            let mapped = left_distance_m(&lanes[first.lane], &lanes[second.lane]);
            if seen.signum() == mapped.signum() {
                let agreement = 1.0 / (1.0 + (seen - mapped).abs());
                scores[a] += agreement;
                scores[b] += agreement;
            }
        }
    }
    let largest = scores.iter().copied().fold(0.0, f64::max);
    if largest > 0.0 {
        for score in &mut scores {
            *score = (*score / largest).powi(2);
        }
    } else {
        scores.fill(1.0);
    }
    scores
}

/// Signed distance of the middle of `other` to the left of the chord of `base`, in plan, metres.
fn left_distance_m(base: &LaneShape, other: &LaneShape) -> f64 {
    let (start, end) = (base.points[0], base.points[base.points.len() - 1]);
    let middle = other.points[other.points.len() / 2];
    cross(&start, &end, &middle) / (end - start).xy().norm().max(1e-9)
}

fn cross(start: &Point3<f64>, end: &Point3<f64>, point: &Point3<f64>) -> f64 {
    let (chord, offset) = (end - start, point - start);
    chord.x * offset.y - chord.y * offset.x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::category::Category;

    fn line(y: f64) -> LaneShape {
        LaneShape::seen_once(Category::WhiteSolid, (0..40).map(|k| Point3::new(f64::from(k), y, 0.0)).collect(), 0.1)
    }

    #[test]
    fn an_association_that_swaps_two_lanes_scores_lowest() {
        let lanes = [line(0.0), line(3.5), line(7.0)];
        let detections = [line(0.3), line(3.8), line(7.3)];
        let edge = |detection, lane| Edge { detection, lane, distance_m: 0.3 };
        let scores = consistency_scores(&[edge(0, 0), edge(1, 1), edge(2, 2), edge(0, 1)], &detections, &lanes);
        assert!((scores.iter().copied().fold(0.0, f64::max) - 1.0).abs() < 1e-12);
        assert!(scores[3] < 0.5 * scores[..3].iter().copied().fold(1.0, f64::min));
    }
}
