//! Baseline: shells, for the row Shell of the paper's table.
//!
//! Kim et al., *HD map update with shell-based matching* (2021), as the authors of the paper use it: around the centroid of
//! each lane, space is parted into rings of 1.5 m and four quadrants, out to 100 m. A detected point is compared with the
//! nearest point of the lane in its own part; a part without a point of the lane is a miss. The score is
//! `mean distance * sqrt((matches + misses) / matches)`, gated at `2 mean(delta)`, and the assignment takes `1 / score`.
//!
//! Not invariant: the quadrants follow the axes of the frame, and a shift moves points into other parts.

use nalgebra::{Point3, Vector3};

use super::{
    LaneShape, PoseUncertainty,
    chamfer::{Edge, associate_edges, distance_bound_m},
};
use crate::params::AssociationParams;

const RING_M: f64 = 1.5;
const REACH_M: f64 = 100.0;

/// Associates detections with lanes of equal category by shells.
///
/// Shapes are in the vehicle frame at the predicted pose, metres.
///
/// ```
/// use lanemap_core::{
///     Category, Params, Preset,
///     association::{LaneShape, PoseUncertainty, shell::associate_by_shells},
/// };
/// use nalgebra::Point3;
///
/// let line = |y: f64| {
///     let points = (3..50).map(|x| Point3::new(f64::from(x), y, 0.0)).collect();
///     LaneShape::seen_once(Category::WhiteSolid, points, 0.1)
/// };
/// let pose = PoseUncertainty { yaw_rad: 0.03, along_m: 1.0, across_m: 1.0 };
/// let params = Params::preset(Preset::Paper).association;
/// let matched = associate_by_shells(&[line(0.3), line(3.8)], &[line(3.5), line(0.0)], &pose, &params);
/// assert_eq!(matched, vec![Some(1), Some(0)]);
/// ```
#[must_use]
pub fn associate_by_shells(
    detections: &[LaneShape],
    lanes: &[LaneShape],
    pose: &PoseUncertainty,
    params: &AssociationParams,
) -> Vec<Option<usize>> {
    let shells: Vec<Shells> = lanes.iter().map(Shells::around).collect();
    let mut edges = Vec::new();
    for (i, detection) in detections.iter().enumerate() {
        let bounds = detection.points.iter().map(|point| distance_bound_m(point, pose, params));
        let gate_m = 2.0 * bounds.sum::<f64>() / detection.points.len() as f64;
        for (j, lane) in lanes.iter().enumerate().filter(|(_, lane)| lane.category == detection.category) {
            if let Some(distance_m) = shells[j].score_m(lane, detection).filter(|score| *score < gate_m) {
                edges.push(Edge { detection: i, lane: j, distance_m });
            }
        }
    }
    associate_edges(&edges, detections, lanes, false)
}

/// The parts around one lane, each with the indices of the lane's points in it.
struct Shells {
    centroid: Point3<f64>,
    parts: Vec<Vec<usize>>,
}

impl Shells {
    fn around(lane: &LaneShape) -> Self {
        let sum: Vector3<f64> = lane.points.iter().map(|point| point.coords).sum();
        let centroid = Point3::from(sum / lane.points.len() as f64);
        // A ring more than fits, for the one that the reach cuts.
        let mut shells = Self { centroid, parts: vec![Vec::new(); 4 * ring_of(REACH_M) + 4] };
        for (index, point) in lane.points.iter().enumerate() {
            if let Some(part) = shells.part_of(point) {
                shells.parts[part].push(index);
            }
        }
        shells
    }

    fn part_of(&self, point: &Point3<f64>) -> Option<usize> {
        let offset = (point - self.centroid).xy();
        let distance_m = offset.norm();
        let quadrant = usize::from(offset.x < 0.0) + 2 * usize::from(offset.y < 0.0);
        (distance_m < REACH_M).then(|| 4 * ring_of(distance_m) + quadrant)
    }

    fn score_m(&self, lane: &LaneShape, detection: &LaneShape) -> Option<f64> {
        let nearest_m = |point: &Point3<f64>| {
            let part = &self.parts[self.part_of(point)?];
            part.iter().map(|index| (lane.points[*index] - point).norm()).min_by(f64::total_cmp)
        };
        let matches: Vec<f64> = detection.points.iter().filter_map(nearest_m).collect();
        if matches.is_empty() {
            return None;
        }
        let matched = matches.len() as f64;
        Some(matches.iter().sum::<f64>() / matched * (detection.points.len() as f64 / matched).sqrt())
    }
}

// Distances are at most `REACH_M`.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn ring_of(distance_m: f64) -> usize {
    (distance_m / RING_M) as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::category::Category;

    fn line(y: f64, from: u32, to: u32) -> LaneShape {
        let points = (from..to).map(|x| Point3::new(f64::from(x), y, 0.0)).collect();
        LaneShape::seen_once(Category::WhiteSolid, points, 0.1)
    }

    #[test]
    fn a_line_scores_nothing_against_itself() {
        let lane = line(1.0, 3, 50);
        assert!(Shells::around(&lane).score_m(&lane, &lane).unwrap() < 1e-12);
    }

    #[test]
    fn a_point_where_the_lane_has_none_in_the_same_part_is_a_miss() {
        let lane = line(0.0, 0, 11);
        // Points 5 m beyond the end lie in rings that the lane does not reach.
        let longer = line(0.0, 0, 16);
        let score = Shells::around(&lane).score_m(&lane, &longer).unwrap();
        assert!(score < 1e-12, "matches are exact, whatever was missed");
        let shifted = line(0.2, 0, 16);
        let with_misses = Shells::around(&lane).score_m(&lane, &shifted).unwrap();
        let without = Shells::around(&lane).score_m(&lane, &line(0.2, 0, 11)).unwrap();
        assert!(with_misses > 1.15 * without, "{with_misses} {without}");
    }
}
