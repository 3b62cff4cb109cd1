//! The paper's association: bounded Chamfer distance, lateral consistency, Kuhn-Munkres.
//!
//! Paper: "Lane association", with its misprints corrected:
//! `delta_k = 2 |p_k| sin(2 sigma_theta / 2) + 2 sigma_t + 2 sigma_k`,
//! `d_ji = sqrt(M / n_a) * mean of d_k over the n_a points with d_k < delta_k`, an edge where
//! `d_ji < sqrt(2) mean(delta_k)` and the categories agree, and the weight `(1 / d_ji) S`.
//! As in the authors' code, `sigma_k` is a constant in this bound and `delta_k` has a floor.

use nalgebra::Point3;

use super::{LaneShape, PoseUncertainty, assignment::assign, consistency::consistency_scores};
use crate::params::AssociationParams;

/// An edge of the bipartite graph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// Index of the detection.
    pub detection: usize,
    /// Index of the lane.
    pub lane: usize,
    /// Bounded Chamfer distance, metres.
    pub distance_m: f64,
}

/// Upper bound on the distance of a detected point from its true match, metres.
#[must_use]
pub fn distance_bound_m(point_vehicle: &Point3<f64>, pose: &PoseUncertainty, params: &AssociationParams) -> f64 {
    let turned = 2.0 * point_vehicle.coords.norm() * pose.yaw_rad.sin();
    (turned + 2.0 * pose.along_m.max(pose.across_m) + 2.0 * params.bound_noise_m).max(params.least_bound_m)
}

/// Bounded Chamfer distance from a detection to a lane, or `None` where it exceeds `sqrt(2) mean(delta)`.
#[must_use]
pub fn bounded_chamfer_m(detection: &LaneShape, lane: &LaneShape, bounds_m: &[f64]) -> Option<f64> {
    let (mut sum, mut near) = (0.0, 0u32);
    let mut start = lane.nearest(detection.points.first()?);
    for (point, bound) in detection.points.iter().zip(bounds_m) {
        start = lane.nearest_from(point, start);
        let distance = (lane.points[start] - point).norm();
        if distance < *bound {
            sum += distance;
            near += 1;
        }
    }
    if near == 0 {
        return None;
    }
    let count = detection.points.len() as f64;
    let distance = (count / f64::from(near)).sqrt() * sum / f64::from(near);
    let mean_bound = bounds_m.iter().sum::<f64>() / count;
    (distance < std::f64::consts::SQRT_2 * mean_bound).then_some(distance)
}

/// Every edge between detections and lanes of equal category.
#[must_use]
pub fn edges(
    detections: &[LaneShape],
    lanes: &[LaneShape],
    pose: &PoseUncertainty,
    params: &AssociationParams,
) -> Vec<Edge> {
    let mut edges = Vec::new();
    for (i, detection) in detections.iter().enumerate() {
        let bounds: Vec<f64> = detection.points.iter().map(|point| distance_bound_m(point, pose, params)).collect();
        for (j, lane) in lanes.iter().enumerate().filter(|(_, lane)| lane.category == detection.category) {
            if let Some(distance_m) = bounded_chamfer_m(detection, lane, &bounds) {
                edges.push(Edge { detection: i, lane: j, distance_m });
            }
        }
    }
    edges
}

/// The paper's association: for each detection the index of its lane.
///
/// Shapes are in the vehicle frame at the predicted pose. `with_consistency` false is the paper's CD ablation.
#[must_use]
pub fn associate_by_chamfer(
    detections: &[LaneShape],
    lanes: &[LaneShape],
    pose: &PoseUncertainty,
    params: &AssociationParams,
    with_consistency: bool,
) -> Vec<Option<usize>> {
    associate_edges(&edges(detections, lanes, pose, params), detections, lanes, with_consistency)
}

/// Assignment over given edges; the baselines bring edges of their own distance.
#[must_use]
pub fn associate_edges(
    edges: &[Edge],
    detections: &[LaneShape],
    lanes: &[LaneShape],
    with_consistency: bool,
) -> Vec<Option<usize>> {
    // With two lanes or fewer there is no order to speak of.
    let scores = if with_consistency && lanes.len() > 2 && detections.len() > 2 {
        consistency_scores(edges, detections, lanes)
    } else {
        vec![1.0; edges.len()]
    };
    let mut weights = vec![None; detections.len() * lanes.len()];
    for (edge, score) in edges.iter().zip(&scores) {
        weights[edge.detection * lanes.len() + edge.lane] = Some(score / edge.distance_m.max(1e-3));
    }
    assign(detections.len(), lanes.len(), |i, j| weights[i * lanes.len() + j])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        category::Category,
        params::{Params, Preset},
    };

    fn line(y: f64, category: Category) -> LaneShape {
        LaneShape::seen_once(category, (0..80).map(|k| Point3::new(3.0 + 0.5 * f64::from(k), y, 0.0)).collect(), 0.1)
    }

    #[test]
    fn the_distance_of_parallel_lines_is_their_distance() {
        let (a, b) = (line(0.0, Category::WhiteSolid), line(0.7, Category::WhiteSolid));
        assert!((bounded_chamfer_m(&a, &b, &[1.0; 80]).unwrap() - 0.7).abs() < 1e-9);
        assert_eq!(bounded_chamfer_m(&a, &b, &[0.5; 80]), None);
    }

    #[test]
    fn a_half_match_is_penalised_by_the_root_of_two() {
        let mut half = line(0.5, Category::WhiteSolid);
        half.points.truncate(40);
        let distance = bounded_chamfer_m(&line(0.0, Category::WhiteSolid), &half, &[0.6; 80]).unwrap();
        assert!((0.70..0.73).contains(&distance), "{distance}");
    }

    #[test]
    fn lines_of_other_categories_are_never_matched() {
        let params = Params::preset(Preset::Paper).association;
        let pose = PoseUncertainty { yaw_rad: 0.03, along_m: 1.0, across_m: 1.0 };
        let lanes = [line(0.0, Category::WhiteDashed), line(3.5, Category::WhiteSolid)];
        let matched = associate_by_chamfer(&[line(0.4, Category::WhiteSolid)], &lanes, &pose, &params, true);
        assert_eq!(matched, vec![Some(1)]);
    }
}
