//! Association together with the error of the pose: which small motion of the vehicle makes the frame fit the map best?
//!
//! Ours. A wrong pose shifts *all* detections by the same motion `theta = (dx, dy, dpsi)`, so lanes are not matched one by
//! one, nor by order alone: for every pair the lateral residuals are summarised once as a quadratic in `theta`,
//! `E_ij(theta) = c - 2 g theta + theta^T H theta`, where `e_k = n_k (p_k - q_k)`, `J_k = (n_x, n_y, n_k . (z x p_k))`.
//! Hypotheses for `theta` come from the prior and from every pair that could be one lane; each is scored by
//!
//! `sum over matched pairs (E_ij / 2 + category cost) + unassigned + missed + theta^T P^-1 theta / 2`,
//!
//! refined by Gauss-Newton on its own matching, and the best one wins. A category is a likelihood here, not a gate. All
//! of it happens in the vehicle frame, so the compass heading does not matter.
//! Not guaranteed: the best matching of all; with lanes at equal distances and of one kind the prior decides.

use nalgebra::{Matrix3, Point3, Vector2, Vector3};

use super::{LaneShape, PoseUncertainty, assignment::assign};
use crate::params::AssociationParams;

/// Points of a detection that enter a pair's summary, at the most.
const POINTS: usize = 16;
/// Hypotheses that are refined, at the most.
const REFINED: usize = 12;

/// Result of a joint association.
#[derive(Clone, Debug, PartialEq)]
pub struct JointAssociation {
    /// For each detection the index of its lane.
    pub lane_of: Vec<Option<usize>>,
    /// Estimated error of the pose: `(x, y, yaw)` by which the detections lie off, vehicle frame, metres and radians.
    pub pose_error: Vector3<f64>,
}

/// Lateral residuals of one pair as a quadratic in the pose error.
#[derive(Clone, Copy, Debug)]
struct Pair {
    detection: usize,
    lane: usize,
    hessian: Matrix3<f64>,
    gradient: Vector3<f64>,
    constant: f64,
    /// Sum of weights: turns an error into a mean square.
    weight: f64,
    category_cost: f64,
}

impl Pair {
    fn error(&self, theta: &Vector3<f64>) -> f64 {
        (self.constant - 2.0 * self.gradient.dot(theta) + theta.dot(&(self.hessian * theta))).max(0.0)
    }
}

/// The scene of one association: all pairs, and the prior of the pose.
struct Scene<'a> {
    pairs: Vec<Pair>,
    detections: usize,
    expected: Vec<bool>,
    prior_information: Matrix3<f64>,
    params: &'a AssociationParams,
}

/// Associates detections with lanes, both in the vehicle frame at the predicted pose (x forward, y left), metres.
#[must_use]
pub fn associate_jointly(
    detections: &[LaneShape],
    lanes: &[LaneShape],
    pose: &PoseUncertainty,
    params: &AssociationParams,
) -> JointAssociation {
    let nothing = Vector3::zeros();
    let sigma = Vector3::new(
        pose.along_m.max(params.least_sigma_m),
        pose.across_m.max(params.least_sigma_m),
        pose.yaw_rad.max(params.least_sigma_rad),
    );
    // How far the pose may push a line at mid range; below a quarter of a lane there is only one hypothesis.
    let play_m = 2.0 * (sigma.y + params.play_range_m * sigma.z);
    let reach_m = params.gate_m + play_m;
    let mut scene = Scene {
        pairs: summarise(detections, lanes, &nothing, reach_m, params),
        detections: detections.len(),
        expected: lanes.iter().map(|lane| is_expected(lane, params)).collect(),
        prior_information: Matrix3::from_diagonal(&sigma.map(|s| 1.0 / (s * s))),
        params,
    };
    if play_m < params.single_hypothesis_m {
        let (theta, _) = scene.refine(nothing);
        return JointAssociation { lane_of: scene.matching(&theta, lanes.len()), pose_error: theta };
    }
    let mut best = (f64::INFINITY, nothing, vec![None; detections.len()]);
    for start in scene.hypotheses() {
        // A large motion moves the foot points: summarise anew where the hypothesis puts the frame.
        scene.pairs = summarise(detections, lanes, &start, params.gate_m + params.single_hypothesis_m, params);
        let (theta, _) = scene.refine(start);
        let lane_of = scene.matching(&theta, lanes.len());
        let cost = scene.cost_of(&theta, &lane_of);
        if cost < best.0 {
            best = (cost, theta, lane_of);
        }
    }
    JointAssociation { lane_of: best.2, pose_error: best.1 }
}

/// Whether a lane runs through the near part of the view, so that a frame should have seen it.
fn is_expected(lane: &LaneShape, params: &AssociationParams) -> bool {
    let inside = |point: &&Point3<f64>| {
        (params.expected_from_m..params.expected_to_m).contains(&point.x) && point.y.abs() < params.expected_side_m
    };
    lane.points.iter().filter(inside).count() >= 4
}

fn summarise(
    detections: &[LaneShape],
    lanes: &[LaneShape],
    theta: &Vector3<f64>,
    reach_m: f64,
    params: &AssociationParams,
) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for (i, detection) in detections.iter().enumerate() {
        let stride = detection.points.len().div_ceil(POINTS);
        let points: Vec<Point3<f64>> = detection.points.iter().step_by(stride).copied().collect();
        for (j, lane) in lanes.iter().enumerate() {
            let category_cost = category_cost(detection, lane, params);
            if let Some(pair) = summarise_pair(&points, lane, theta, reach_m, params) {
                pairs.push(Pair { detection: i, lane: j, category_cost, ..pair });
            }
        }
    }
    pairs
}

/// Log-likelihood ratio of the detection's category against the lane's most likely one.
fn category_cost(detection: &LaneShape, lane: &LaneShape, params: &AssociationParams) -> f64 {
    let surprise = (1.0 - params.category_confusion).ln() - lane.category_log_likelihood[detection.category.index()];
    surprise.max(0.0)
}

/// Sums the normal equations of one pair; `None` where the two hardly overlap or lie out of reach.
fn summarise_pair(
    points: &[Point3<f64>],
    lane: &LaneShape,
    theta: &Vector3<f64>,
    reach_m: f64,
    params: &AssociationParams,
) -> Option<Pair> {
    let last = lane.points.len() - 1;
    if last == 0 {
        return None;
    }
    let (mut hessian, mut gradient, mut constant, mut weight) = (Matrix3::zeros(), Vector3::zeros(), 0.0, 0.0);
    let (mut overlap, mut height_off, mut used) = (None, 0.0, 0u32);
    let mut index = lane.nearest(&moved(points.first()?, theta));
    for point in points {
        let placed = moved(point, theta);
        index = lane.nearest_from(&placed, index);
        let along = (lane.points[(index + 1).min(last)] - lane.points[index.saturating_sub(1)]).xy();
        // Points in one place have no direction, and a NaN would pass for a perfect fit.
        let Some(tangent) = along.try_normalize(1e-9) else { continue };
        let offset = placed - lane.points[index];
        let beyond = offset.xy().dot(&tangent);
        if (index == 0 && beyond < -params.end_slack_m) || (index == last && beyond > params.end_slack_m) {
            continue;
        }
        let normal = Vector2::new(-tangent.y, tangent.x);
        let residual = normal.dot(&offset.xy());
        // Residual as if the frame stood at theta = 0, so that the quadratic is in the whole pose error.
        let jacobian = Vector3::new(normal.x, normal.y, normal.dot(&Vector2::new(-point.y, point.x)));
        let residual_at_zero = residual + jacobian.dot(theta);
        let sigma = crate::observation::sigma_at(&params.noise, point.coords.xy().norm());
        let information = 1.0 / (sigma * sigma);
        hessian += jacobian * jacobian.transpose() * information;
        gradient += jacobian * (residual_at_zero * information);
        constant += residual_at_zero * residual_at_zero * information;
        weight += information;
        height_off += offset.z.abs();
        used += 1;
        let (from, _) = *overlap.get_or_insert((*point, *point));
        overlap = Some((from, *point));
    }
    let (from, to) = overlap?;
    let count = f64::from(used);
    let length_m = (to - from).norm();
    if length_m < params.least_overlap_m || height_off / count > params.gate_height_m {
        return None;
    }
    // A line is a few witnesses however many points it has; a short overlap is fewer.
    let share = (length_m / params.full_overlap_m).min(1.0);
    let scale = params.witnesses * share / count;
    let pair = Pair {
        detection: 0,
        lane: 0,
        hessian: hessian * scale,
        gradient: gradient * scale,
        constant: constant * scale,
        weight: weight * scale,
        category_cost: 0.0,
    };
    ((pair.error(theta) / pair.weight).sqrt() < reach_m).then_some(pair)
}

/// A detected point with a pose error taken away.
fn moved(point: &Point3<f64>, theta: &Vector3<f64>) -> Point3<f64> {
    Point3::new(point.x - theta.x + theta.z * point.y, point.y - theta.y - theta.z * point.x, point.z)
}

impl Scene<'_> {
    /// Cost of taking a pair at a pose error, relative to nothing; `None` beyond the gate.
    fn pair_cost(&self, pair: &Pair, theta: &Vector3<f64>) -> Option<f64> {
        let error = pair.error(theta);
        let inside = error < pair.weight * self.params.gate_m * self.params.gate_m;
        inside.then_some(0.5 * error + pair.category_cost)
    }

    /// What taking a pair saves against leaving its detection and its lane alone.
    fn saving(&self, pair: &Pair, theta: &Vector3<f64>) -> Option<f64> {
        let alone = self.params.unassigned_cost + if self.expected[pair.lane] { self.params.missed_cost } else { 0.0 };
        self.pair_cost(pair, theta).map(|cost| alone - cost).filter(|saving| *saving > 0.0)
    }

    /// Pose errors worth trying: none, and whatever each pair asks for; the most promising first.
    fn hypotheses(&self) -> Vec<Vector3<f64>> {
        let mut ranked: Vec<(f64, Vector3<f64>)> = std::iter::once(Vector3::zeros())
            .chain(self.pairs.iter().filter_map(|pair| self.best_motion(std::iter::once(pair))))
            .map(|theta| (self.greedy_cost(&theta), theta))
            .collect();
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut chosen: Vec<Vector3<f64>> = Vec::with_capacity(REFINED);
        for (_, theta) in ranked {
            let is_new = |other: &Vector3<f64>| (other.y - theta.y).abs() > 0.3 || (other.z - theta.z).abs() > 0.02;
            if chosen.len() < REFINED && chosen.iter().all(is_new) {
                chosen.push(theta);
            }
        }
        chosen
    }

    /// The pose error that suits some pairs and the prior best.
    fn best_motion<'p>(&self, pairs: impl Iterator<Item = &'p Pair>) -> Option<Vector3<f64>> {
        let (mut hessian, mut gradient) = (self.prior_information, Vector3::zeros());
        for pair in pairs {
            hessian += pair.hessian;
            gradient += pair.gradient;
        }
        hessian.cholesky().map(|factor| factor.solve(&gradient))
    }

    /// A quick score of a hypothesis: every detection takes its best lane, shared or not.
    fn greedy_cost(&self, theta: &Vector3<f64>) -> f64 {
        let mut savings = vec![0.0f64; self.detections];
        for pair in &self.pairs {
            if let Some(saving) = self.saving(pair, theta) {
                savings[pair.detection] = savings[pair.detection].max(saving);
            }
        }
        0.5 * theta.dot(&(self.prior_information * theta)) - savings.iter().sum::<f64>()
    }

    /// One-to-one matching of greatest saving at a pose error.
    fn matching(&self, theta: &Vector3<f64>, lanes: usize) -> Vec<Option<usize>> {
        let mut savings = vec![None; self.detections * lanes];
        for pair in &self.pairs {
            savings[pair.detection * lanes + pair.lane] = self.saving(pair, theta);
        }
        let best_of = |i: usize| {
            let row = &savings[i * lanes..(i + 1) * lanes];
            (0..lanes)
                .filter(|j| row[*j].is_some())
                .max_by(|a, b| row[*a].partial_cmp(&row[*b]).unwrap_or(std::cmp::Ordering::Equal))
        };
        let wishes: Vec<Option<usize>> = (0..self.detections).map(best_of).collect();
        let mut taken = vec![false; lanes];
        let disjoint = wishes.iter().flatten().all(|lane| !std::mem::replace(&mut taken[*lane], true));
        // Where nobody wants what another wants, everybody's wish is the optimum.
        if disjoint { wishes } else { assign(self.detections, lanes, |i, j| savings[i * lanes + j]) }
    }

    /// Alternates between matching and motion until the matching stays; returns the motion and its matching.
    fn refine(&self, start: Vector3<f64>) -> (Vector3<f64>, Vec<Option<usize>>) {
        let lanes = self.expected.len();
        let mut theta = start;
        let mut lane_of = self.matching(&theta, lanes);
        for _ in 0..3 {
            let matched = self.pairs.iter().filter(|pair| lane_of[pair.detection] == Some(pair.lane));
            theta = self.best_motion(matched).unwrap_or(theta);
            let next = self.matching(&theta, lanes);
            if next == lane_of {
                break;
            }
            lane_of = next;
        }
        (theta, lane_of)
    }

    /// Total cost of a matching at a pose error.
    fn cost_of(&self, theta: &Vector3<f64>, lane_of: &[Option<usize>]) -> f64 {
        let matched = self.pairs.iter().filter(|pair| lane_of[pair.detection] == Some(pair.lane));
        let saved: f64 = matched.filter_map(|pair| self.saving(pair, theta)).sum();
        0.5 * theta.dot(&(self.prior_information * theta)) - saved
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        category::Category,
        params::{Params, Preset},
    };
    use proptest::prelude::*;

    fn road() -> Vec<LaneShape> {
        [
            (-5.3, Category::RightCurb),
            (-1.8, Category::WhiteDashed),
            (1.7, Category::WhiteDashed),
            (5.4, Category::YellowSolid),
        ]
        .map(|(y, category)| {
            let points = (0..60)
                .map(|k| {
                    let x = f64::from(k);
                    Point3::new(x, y + 0.001 * x * x, 0.0)
                })
                .collect();
            LaneShape::seen_once(category, points, 0.1)
        })
        .to_vec()
    }

    fn displaced(shapes: &[LaneShape], theta: Vector3<f64>) -> Vec<LaneShape> {
        shapes
            .iter()
            .map(|shape| LaneShape {
                points: shape.points.iter().map(|p| moved(p, &-theta)).collect(),
                ..shape.clone()
            })
            .collect()
    }

    proptest! {
        #[test]
        fn a_frame_displaced_by_more_than_a_lane_is_matched_and_its_error_found(dy in -5.0..5.0f64, dpsi in -0.07..0.07f64) {
            let params = Params::preset(Preset::Default).association;
            let pose = PoseUncertainty { yaw_rad: 0.035, along_m: 3.0, across_m: 3.0 };
            let found = associate_jointly(&displaced(&road(), Vector3::new(0.0, dy, dpsi)), &road(), &pose, &params);
            prop_assert_eq!(found.lane_of, vec![Some(0), Some(1), Some(2), Some(3)]);
            prop_assert!((found.pose_error.y - dy).abs() < 0.5, "{} {}", found.pose_error.y, dy);
        }
    }

    #[test]
    fn a_flipped_category_does_not_split_a_lane() {
        let params = Params::preset(Preset::Default).association;
        let pose = PoseUncertainty { yaw_rad: 0.001, along_m: 0.05, across_m: 0.05 };
        let mut detections = displaced(&road(), Vector3::new(0.0, 0.2, 0.0));
        detections[1].category = Category::WhiteSolid;
        let found = associate_jointly(&detections, &road(), &pose, &params);
        assert_eq!(found.lane_of, vec![Some(0), Some(1), Some(2), Some(3)]);
    }

    #[test]
    fn a_lane_whose_points_lie_in_one_place_matches_nothing() {
        let params = Params::preset(Preset::Default).association;
        let pose = PoseUncertainty { yaw_rad: 0.001, along_m: 0.05, across_m: 0.05 };
        let nowhere = LaneShape { points: vec![Point3::new(20.0, -5.0, 0.0); 8], ..road()[0].clone() };
        assert_eq!(associate_jointly(&road()[..1], &[nowhere], &pose, &params).lane_of, vec![None]);
    }

    #[test]
    fn a_lane_between_two_lanes_is_new() {
        let params = Params::preset(Preset::Default).association;
        let pose = PoseUncertainty { yaw_rad: 0.001, along_m: 0.05, across_m: 0.05 };
        let between = displaced(&road()[1..2], Vector3::new(0.0, 1.8, 0.0));
        assert_eq!(associate_jointly(&between, &road(), &pose, &params).lane_of, vec![None]);
    }
}
