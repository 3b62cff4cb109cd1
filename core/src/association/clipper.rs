//! Baseline: a densest clique of consistent associations, for the row CLIPPER of the paper's table.
//!
//! Lusk, Fathian and How, *CLIPPER: A Graph-Theoretic Framework for Robust Data Association* (ICRA 2021). Every pair of a
//! detection and a lane of equal category is a vertex; two vertices agree when the distance between their detections is
//! that between their lanes, `M_uv = exp(-(|c_i - c_k| - |c_j - c_l|)^2 / (2 sigma^2))` below a bound, with a lane standing
//! for its centroid; they contradict each other above the bound and where they share a detection or a lane. Then
//!
//! `maximise u^T (M - d C) u` over `|u| = 1, u >= 0`, `C` marking contradictions,
//!
//! by projected gradient ascent with backtracking, the penalty `d` growing until no contradiction is left, and the
//! `round(u^T M u)` largest entries of `u` are kept. The start is all ones, not random. Not guaranteed: the densest clique.

use nalgebra::{DMatrix, DVector, Point3, Vector3};

use super::LaneShape;

/// Difference of distances above which two associations contradict each other, metres.
const BOUND_M: f64 = 2.0;
/// Difference of distances at which agreement has fallen to `exp(-1 / 2)`, metres.
const SIGMA_M: f64 = 0.7;

const ZERO: f64 = 1e-9;
const MOST_PENALTIES: usize = 1000;
const MOST_STEPS: usize = 200;
const MOST_BACKTRACKS: usize = 99;
const BACKTRACK: f64 = 0.25;

/// Associates detections with lanes of equal category by the densest clique.
///
/// Needs no pose uncertainty: distances between lanes do not depend on the pose. A single candidate is taken as it is.
///
/// ```
/// use lanemap_core::{
///     Category,
///     association::{LaneShape, clipper::associate_by_clipper},
/// };
/// use nalgebra::Point3;
///
/// let line = |y: f64| {
///     let points = (3..50).map(|x| Point3::new(f64::from(x), y, 0.0)).collect();
///     LaneShape::seen_once(Category::WhiteSolid, points, 0.1)
/// };
/// // Shifted by almost a lane, the distances between the lines still tell which is which.
/// let matched = associate_by_clipper(&[line(3.0), line(5.0), line(9.0)], &[line(0.0), line(2.0), line(6.0)]);
/// assert_eq!(matched, vec![Some(0), Some(1), Some(2)]);
/// ```
#[must_use]
pub fn associate_by_clipper(detections: &[LaneShape], lanes: &[LaneShape]) -> Vec<Option<usize>> {
    let seen: Vec<Point3<f64>> = detections.iter().map(centroid).collect();
    let mapped: Vec<Point3<f64>> = lanes.iter().map(centroid).collect();
    let mut candidates = Vec::new();
    for (i, detection) in detections.iter().enumerate() {
        let same = lanes.iter().enumerate().filter(|(_, lane)| lane.category == detection.category);
        candidates.extend(same.map(|(j, _)| (i, j)));
    }
    let graph = Graph::new(&candidates, |(i, j), (k, l)| {
        let difference_m = (seen[i] - seen[k]).norm() - (mapped[j] - mapped[l]).norm();
        (i != k && j != l && difference_m.abs() < BOUND_M).then(|| (-0.5 * (difference_m / SIGMA_M).powi(2)).exp())
    });
    let mut lane_of = vec![None; detections.len()];
    let mut taken = vec![false; lanes.len()];
    for vertex in graph.densest_clique() {
        let (i, j) = candidates[vertex];
        if lane_of[i].is_none() && !taken[j] {
            lane_of[i] = Some(j);
            taken[j] = true;
        }
    }
    lane_of
}

fn centroid(shape: &LaneShape) -> Point3<f64> {
    let sum: Vector3<f64> = shape.points.iter().map(|point| point.coords).sum();
    Point3::from(sum / shape.points.len() as f64)
}

/// Agreement `M` (with a unit diagonal) and contradiction `C` of the vertices.
struct Graph {
    agreement: DMatrix<f64>,
    contradiction: DMatrix<f64>,
}

impl Graph {
    fn new<V: Copy>(vertices: &[V], agreement: impl Fn(V, V) -> Option<f64>) -> Self {
        let count = vertices.len();
        let mut graph =
            Self { agreement: DMatrix::identity(count, count), contradiction: DMatrix::zeros(count, count) };
        for a in 0..count {
            for b in (a + 1)..count {
                match agreement(vertices[a], vertices[b]) {
                    Some(value) => graph.set(a, b, value, 0.0),
                    None => graph.set(a, b, 0.0, 1.0),
                }
            }
        }
        graph
    }

    fn set(&mut self, a: usize, b: usize, agreement: f64, contradiction: f64) {
        for (row, column) in [(a, b), (b, a)] {
            self.agreement[(row, column)] = agreement;
            self.contradiction[(row, column)] = contradiction;
        }
    }

    /// Vertices of a dense clique, the surest first.
    fn densest_clique(&self) -> Vec<usize> {
        let count = self.agreement.nrows();
        if count == 0 {
            return Vec::new();
        }
        let mut weights = (&self.agreement * DVector::repeat(count, 1.0)).normalize();
        let mut penalty =
            self.penalties(&weights).map_or(0.0, |ratios| ratios.iter().sum::<f64>() / ratios.len() as f64);
        for _ in 0..MOST_PENALTIES {
            weights = self.ascend(weights, penalty);
            match self.penalties(&weights) {
                Some(ratios) => penalty += ratios.into_iter().fold(f64::INFINITY, f64::min),
                None => break,
            }
        }
        let density = weights.dot(&(&self.agreement * &weights));
        let mut order: Vec<usize> = (0..count).collect();
        order.sort_by(|a, b| weights[*b].total_cmp(&weights[*a]).then(a.cmp(b)));
        // The density of a clique is at most the number of its vertices.
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        order.truncate(density.round() as usize);
        order
    }

    /// For each vertex in use that others in use contradict: the penalty that outweighs its agreement. `None`: no such vertex.
    fn penalties(&self, weights: &DVector<f64>) -> Option<Vec<f64>> {
        let against = &self.contradiction * weights;
        let in_favour = &self.agreement * weights;
        let contradicted = (0..weights.len()).filter(|index| against[*index] > ZERO && weights[*index] > ZERO);
        let ratios: Vec<f64> = contradicted.map(|index| in_favour[index] / against[index]).collect();
        (!ratios.is_empty()).then_some(ratios)
    }

    /// Projected gradient ascent of `u^T (M - d C) u` at one penalty `d`.
    fn ascend(&self, mut weights: DVector<f64>, penalty: f64) -> DVector<f64> {
        let matrix = &self.agreement - &self.contradiction * penalty;
        let mut gradient = &matrix * &weights;
        let mut objective = weights.dot(&gradient);
        for _ in 0..MOST_STEPS {
            let mut step = 1.0;
            let mut next = project(&weights, &gradient, step);
            let mut next_gradient = &matrix * &next;
            for _ in 0..MOST_BACKTRACKS {
                if next.dot(&next_gradient) >= objective - ZERO {
                    break;
                }
                step *= BACKTRACK;
                next = project(&weights, &gradient, step);
                next_gradient = &matrix * &next;
            }
            let (moved, next_objective) = ((&next - &weights).norm(), next.dot(&next_gradient));
            let settled = moved < 1e-8 || (next_objective - objective).abs() < 1e-9;
            (weights, gradient, objective) = (next, next_gradient, next_objective);
            if settled {
                break;
            }
        }
        weights
    }
}

/// A step along the gradient, back onto the unit sphere's positive part.
fn project(weights: &DVector<f64>, gradient: &DVector<f64>, step: f64) -> DVector<f64> {
    let moved = (weights + gradient * step).map(|value| value.max(0.0));
    let norm = moved.norm();
    if norm > ZERO { moved / norm } else { weights.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_larger_of_two_cliques_is_found() {
        // 0, 1, 2 agree with one another, 3 and 4 with each other, and the two groups contradict each other.
        let graph = Graph::new(&[0, 1, 2, 3, 4], |a: i32, b: i32| ((a < 3) == (b < 3)).then_some(1.0));
        let mut clique = graph.densest_clique();
        clique.sort_unstable();
        assert_eq!(clique, vec![0, 1, 2]);
    }

    #[test]
    fn an_outlier_is_left_out_of_a_clique() {
        let graph = Graph::new(&[0, 1, 2, 9], |a: i32, b: i32| (a < 9 && b < 9).then_some(0.9));
        let mut clique = graph.densest_clique();
        clique.sort_unstable();
        assert_eq!(clique, vec![0, 1, 2]);
    }

    #[test]
    fn nothing_gives_nothing_and_a_single_candidate_is_taken() {
        assert!(associate_by_clipper(&[], &[]).is_empty());
        let point = LaneShape::seen_once(crate::Category::WhiteSolid, vec![Point3::origin()], 0.1);
        assert_eq!(associate_by_clipper(std::slice::from_ref(&point), std::slice::from_ref(&point)), vec![Some(0)]);
    }
}
