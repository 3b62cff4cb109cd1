//! Baseline: nearest neighbours by LMR features, for the rows CD-LMR and Ours-LMR of the paper's table.
//!
//! Munoz-Banon et al., *Robust Lane Marking Registration* (2022), as the authors of the paper use it: a fourth coordinate, five
//! times the turning angle of the line at the point (0 at its ends), enters the search for the nearest point only; the
//! distance that is then averaged stays metric. The bounds are those of [`chamfer`](super::chamfer).
//!
//! Looks at every point of every lane: slower than the walk of [`chamfer`](super::chamfer), as in the paper.

use nalgebra::{Point3, Vector4};

use super::{
    LaneShape, PoseUncertainty,
    chamfer::{Edge, associate_edges, distance_bound_m},
};
use crate::params::AssociationParams;

/// Metres that a radian of turning counts for.
const METRES_PER_RADIAN: f64 = 5.0;

/// Associates as [`associate_by_chamfer`](super::associate_by_chamfer), with nearest points by LMR features.
///
/// Shapes are in the vehicle frame at the predicted pose, metres.
///
/// ```
/// use lanemap_core::{
///     Category, Params, Preset,
///     association::{LaneShape, PoseUncertainty, lmr::associate_by_lmr},
/// };
/// use nalgebra::Point3;
///
/// let line = |y: f64| {
///     let points = (3..50).map(|x| Point3::new(f64::from(x), y, 0.0)).collect();
///     LaneShape::seen_once(Category::WhiteSolid, points, 0.1)
/// };
/// let pose = PoseUncertainty { yaw_rad: 0.03, along_m: 1.0, across_m: 1.0 };
/// let params = Params::preset(Preset::Paper).association;
/// let matched = associate_by_lmr(&[line(0.3), line(3.8)], &[line(3.5), line(0.0)], &pose, &params, true);
/// assert_eq!(matched, vec![Some(1), Some(0)]);
/// ```
#[must_use]
pub fn associate_by_lmr(
    detections: &[LaneShape],
    lanes: &[LaneShape],
    pose: &PoseUncertainty,
    params: &AssociationParams,
    with_consistency: bool,
) -> Vec<Option<usize>> {
    associate_edges(&edges(detections, lanes, pose, params), detections, lanes, with_consistency)
}

fn edges(
    detections: &[LaneShape],
    lanes: &[LaneShape],
    pose: &PoseUncertainty,
    params: &AssociationParams,
) -> Vec<Edge> {
    let features: Vec<Vec<Vector4<f64>>> = lanes.iter().map(|lane| lmr_features(&lane.points)).collect();
    let mut edges = Vec::new();
    for (i, detection) in detections.iter().enumerate() {
        let bounds: Vec<f64> = detection.points.iter().map(|point| distance_bound_m(point, pose, params)).collect();
        let seen = lmr_features(&detection.points);
        for (j, lane) in lanes.iter().enumerate().filter(|(_, lane)| lane.category == detection.category) {
            let nearest = seen.iter().map(|feature| lane.points[nearest(&features[j], feature)]);
            if let Some(distance_m) = bounded_mean_m(&detection.points, nearest, &bounds) {
                edges.push(Edge { detection: i, lane: j, distance_m });
            }
        }
    }
    edges
}

/// Position (metres) and scaled turning angle of each point.
fn lmr_features(points: &[Point3<f64>]) -> Vec<Vector4<f64>> {
    (0..points.len())
        .map(|index| {
            let turn_rad = match (index.checked_sub(1).map(|before| &points[before]), points.get(index + 1)) {
                (Some(before), Some(after)) => (points[index] - before).angle(&(after - points[index])),
                _ => 0.0,
            };
            points[index].coords.push(METRES_PER_RADIAN * turn_rad)
        })
        .collect()
}

fn nearest(features: &[Vector4<f64>], query: &Vector4<f64>) -> usize {
    let squared = |feature: &Vector4<f64>| (feature - query).norm_squared();
    let compare = |a: &(usize, &Vector4<f64>), b: &(usize, &Vector4<f64>)| squared(a.1).total_cmp(&squared(b.1));
    features.iter().enumerate().min_by(compare).map_or(0, |(index, _)| index)
}

/// The paper's `d_ji` over given nearest points, or `None` where it exceeds `sqrt(2) mean(delta)`.
fn bounded_mean_m(points: &[Point3<f64>], nearest: impl Iterator<Item = Point3<f64>>, bounds_m: &[f64]) -> Option<f64> {
    let distances = points.iter().zip(nearest).map(|(point, nearest)| (nearest - point).norm());
    let near: Vec<f64> =
        distances.zip(bounds_m).filter(|(distance, bound)| distance < *bound).map(|(distance, _)| distance).collect();
    if near.is_empty() {
        return None;
    }
    let (count, matched) = (points.len() as f64, near.len() as f64);
    let distance_m = (count / matched).sqrt() * near.iter().sum::<f64>() / matched;
    let mean_bound_m = bounds_m.iter().sum::<f64>() / count;
    (distance_m < std::f64::consts::SQRT_2 * mean_bound_m).then_some(distance_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_corner_is_found_by_its_turn_and_not_by_its_place() {
        // An L: its corner turns by a right angle, which weighs 7.9 m.
        let corner = |x: f64| vec![Point3::new(x - 2.0, 0.0, 0.0), Point3::new(x, 0.0, 0.0), Point3::new(x, 2.0, 0.0)];
        let features = lmr_features(&corner(0.0));
        assert!((features[1].w - 5.0 * std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert!(features[0].w == 0.0 && features[2].w == 0.0);
        let moved = lmr_features(&corner(1.5));
        assert_eq!(nearest(&features, &moved[1]), 1);
        // By place alone the end (0, 2) of the first is nearer to (0.8, 1.2) than its corner.
        assert_eq!(nearest(&features, &Vector4::new(0.8, 1.2, 0.0, 0.0)), 2);
    }
}
