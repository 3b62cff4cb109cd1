//! Continuity: how a line runs on where its witnesses change.
//!
//! Where a drive's lane begins or ends, the mean of all witnesses jumps by what that drive was off. Nobody saw such a jog. A
//! drive's errors along a line are correlated over [`lane_correlation_m`](FleetParams::lane_correlation_m), so from knot to knot it tells the
//! shape far better than the place: with `m_k` the mean of the witnesses of knot `k` and `d_k` that of the steps which witnesses of
//! both `k` and `k + 1` saw, the knots are moved by the `x` that minimise
//!
//! `sum_k I_k (x_k - m_k)^2 + sum_k J_k (x_(k+1) - x_k - d_k)^2`,
//!
//! across the line and in height apart: a tridiagonal system, solved in one sweep (Thomas). `I_k` is the information of the mean,
//! `J_k = n_k / s^2` that of the `n_k` steps, `s^2 = 2 sigma^2 (1 - exp(-knot / correlation))`. Where all knots have the same witnesses `x = m`.
//!
//! Not guaranteed: that a line which many drives saw stays where they put it to the millimetre; beside a change of witnesses it
//! moves by a share of the jog that falls to a third over about 8 m.

use nalgebra::Vector3;

use super::{
    alignment::robust_weight,
    line::{Line, Witness},
    params::FleetParams,
    prepared::normal_of,
};

/// Where a witness lies from the knot that it speaks of.
struct Offset {
    pass: usize,
    lane: usize,
    across_m: f64,
    height_m: f64,
    /// Information of each, 1/m^2.
    across_weight: f64,
    height_weight: f64,
}

/// Moves the knots of a line that was settled so that it runs on where witnesses come and go.
pub(super) fn run_on(line: &mut Line, params: &FleetParams) {
    if line.points.len() < 3 {
        return;
    }
    let offsets: Vec<Vec<Offset>> = (0..line.points.len()).map(|knot| offsets_at(line, knot)).collect();
    let variance =
        |sigma_m: f64| 2.0 * sigma_m * sigma_m * (1.0 - (-params.line_knot_m / params.lane_correlation_m).exp());
    let scale_m = params.robust_scale_m;
    let across = moves(&offsets, |at| (at.across_m, at.across_weight), variance(params.lane_sigma_m), scale_m);
    let height =
        moves(&offsets, |at| (at.height_m, at.height_weight), variance(params.lane_sigma_height_m), 2.0 * scale_m);
    let moved = (0..line.points.len()).map(|knot| {
        let normal = normal_of(&line.tangent(knot));
        line.points[knot] + Vector3::new(normal.x * across[knot], normal.y * across[knot], height[knot])
    });
    line.points = moved.collect();
}

fn offsets_at(line: &Line, knot: usize) -> Vec<Offset> {
    let (place, normal) = (line.points[knot], normal_of(&line.tangent(knot)));
    let offset = |witness: &Witness| {
        let offset = witness.shared - place;
        Offset {
            pass: witness.pass,
            lane: witness.lane,
            across_m: offset.xy().dot(&normal),
            height_m: offset.z,
            across_weight: witness.share / witness.lateral_variance_m2,
            height_weight: witness.share / witness.height_variance_m2,
        }
    };
    line.knots[knot].witnesses.iter().map(offset).collect()
}

/// How far each knot moves in one direction, from where the mean of its witnesses is.
fn moves(
    offsets: &[Vec<Offset>],
    of: impl Fn(&Offset) -> (f64, f64),
    step_variance_m2: f64,
    robust_scale_m: f64,
) -> Vec<f64> {
    let robust = |at: &Offset| {
        let (offset_m, weight) = of(at);
        weight * robust_weight(offset_m, robust_scale_m)
    };
    let information: Vec<f64> = offsets.iter().map(|at| at.iter().map(robust).sum::<f64>().max(1e-3)).collect();
    let steps: Vec<(f64, f64)> = offsets
        .windows(2)
        .map(|pair| {
            let (mut sum, mut weights, mut count) = (0.0, 0.0, 0.0);
            for from in &pair[0] {
                let Some(to) = pair[1].iter().find(|to| (to.pass, to.lane) == (from.pass, from.lane)) else { continue };
                // The witness that tapers off at one of the two tells the step as well as the others.
                let weight = robust(from).max(robust(to));
                sum += weight * (of(to).0 - of(from).0);
                weights += weight;
                count += 1.0;
            }
            if weights > 0.0 { (sum / weights, count / step_variance_m2) } else { (0.0, 0.0) }
        })
        .collect();
    solve(&information, &steps)
}

/// The `x` that minimises `sum I_k x_k^2 + sum J_k (x_(k+1) - x_k - d_k)^2`, of the `I_k` and the `(d_k, J_k)`.
fn solve(information: &[f64], steps: &[(f64, f64)]) -> Vec<f64> {
    let count = information.len();
    let (mut diagonal, mut right) = (information.to_vec(), vec![0.0; count]);
    for (knot, (step, weight)) in steps.iter().enumerate() {
        diagonal[knot] += weight;
        diagonal[knot + 1] += weight;
        right[knot] -= weight * step;
        right[knot + 1] += weight * step;
    }
    for knot in 1..count {
        let weight = steps[knot - 1].1;
        let factor = weight / diagonal[knot - 1];
        diagonal[knot] -= factor * weight;
        right[knot] += factor * right[knot - 1];
    }
    for knot in (0..count).rev() {
        let beyond = if knot + 1 < count { steps[knot].1 * right[knot + 1] } else { 0.0 };
        right[knot] = (right[knot] + beyond) / diagonal[knot];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_solution_is_where_the_gradient_is_none() {
        let information = [2.0, 5.0, 1.0, 7.0];
        let steps = [(0.3, 4.0), (-0.2, 0.0), (0.1, 9.0)];
        let x = solve(&information, &steps);
        for knot in 0..4 {
            let mut gradient = information[knot] * x[knot];
            if knot > 0 {
                gradient += steps[knot - 1].1 * (x[knot] - x[knot - 1] - steps[knot - 1].0);
            }
            if knot < 3 {
                gradient -= steps[knot].1 * (x[knot + 1] - x[knot] - steps[knot].0);
            }
            assert!(gradient.abs() < 1e-12, "{knot}: {gradient}");
        }
    }

    #[test]
    fn a_line_whose_knots_have_the_same_witnesses_stays() {
        let steps: Vec<(f64, f64)> = vec![(0.0, 500.0); 9];
        assert!(solve(&[40.0; 10], &steps).iter().all(|x| x.abs() < 1e-12));
    }

    #[test]
    fn a_jog_where_a_witness_ends_becomes_a_ramp() {
        // Two witnesses, 0.6 m apart, of which one ends between the fifth knot and the sixth: the means jump by 0.3 m.
        let information: Vec<f64> = (0..10).map(|knot| if knot < 5 { 100.0 } else { 50.0 }).collect();
        let steps: Vec<(f64, f64)> = (0..9)
            .map(|knot| if knot == 4 { (-0.3, 500.0) } else { (0.0, if knot < 4 { 1_000.0 } else { 500.0 }) })
            .collect();
        let x = solve(&information, &steps);
        let means = |knot: usize| if knot < 5 { 0.0 } else { 0.3 };
        let line: Vec<f64> = (0..10).map(|knot| means(knot) + x[knot]).collect();
        let steepest = line.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
        assert!(steepest < 0.07, "{line:?}");
        assert!(line.windows(2).all(|pair| pair[1] >= pair[0] - 1e-9), "{line:?}");
    }
}
