//! The terms of one line in one frame, whose samples err together.
//!
//! Ours; the paper takes all samples for independent. A monocular detector errs by whole lines: a sample at range `r` is off
//! by `e(r) = B(r) a + white`, `B = [1, r / r_0, (r / r_0)^2]`, and `a ~ N(0, S)` hardly changes from frame to frame,
//! `a_t = phi a_{t-1} + w`, `phi = exp(-dt / tau)`. Hundreds of samples are a few witnesses, and what the road near the vehicle shows
//! of `a` corrects the far samples. Both correlations are taken in exactly, in closed form:
//!
//! * in time by whitening (Cochrane and Orcutt): samples at the same range in successive frames enter as
//!   `p_t - phi p_{t-1} = h_t P - phi h_{t-1} P + B w`, `w ~ N(0, (1 - phi^2) S)`; those without a predecessor as they are;
//! * along the line by eliminating `w` (Woodbury): `H^T (W - W B (S^-1 + B^T W B)^-1 B^T W) H`.
//!
//! The result couples all control points in view, which is what the width of the band is for. `S` is taken the same sideways and
//! in height, so that one scalar matrix serves all three axes.

use nalgebra::{Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

use super::information::{DenseTerm, Knot, SUPPORT};
use crate::params::LineErrorParams;

/// A point of an observed line in the map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LineSample {
    /// Number of the sample in steps along the line from below the vehicle: the same range in every frame.
    pub station: i32,
    /// Range along the line, metres.
    pub range_m: f64,
    /// Position, map frame, metres.
    pub point: Point3<f64>,
}

/// A sample with the control points that make its foot point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlacedSample {
    /// The sample.
    pub sample: LineSample,
    /// First control point of its foot point.
    pub first: Knot,
    /// Weights of the control points from `first` on.
    pub weights: [f64; SUPPORT],
}

/// One row of the whitened observation: `y = h P + B w + white`.
struct ObservationRow {
    /// Up to two supports: the sample's, and its predecessor's times `-phi`.
    supports: [(Knot, [f64; SUPPORT]); 2],
    value: Vector3<f64>,
    basis: Vector3<f64>,
    weight: f64,
}

/// Control points as they are now, for residuals.
pub trait ControlPointAt {
    /// Position of a control point.
    fn position(&self, knot: Knot) -> Vector3<f64>;
}

/// The dense terms of one line in one frame: one of samples with a predecessor, one of samples without.
///
/// `white_share` below 1 says that the samples are interpolated from fewer measurements. Rows that reach past `width`
/// control points from the first are left out.
#[must_use]
pub fn line_terms(
    samples: &[PlacedSample],
    previous: &[PlacedSample],
    phi: f64,
    white_share: f64,
    width: usize,
    lane: &impl ControlPointAt,
    params: &LineErrorParams,
) -> [DenseTerm; 2] {
    let white = white_share / params.white_sigma_m.powi(2);
    let (mut with, mut without) = (Vec::new(), Vec::new());
    for placed in samples {
        let before = previous.iter().find(|before| before.sample.station == placed.sample.station);
        match before.filter(|_| phi > 0.0) {
            Some(before) => with.push(whitened(placed, before, phi, white / (1.0 + phi * phi), params)),
            None => without.push(plain(placed, white, params)),
        }
    }
    [eliminate(&with, 1.0 - phi * phi, width, lane, params), eliminate(&without, 1.0, width, lane, params)]
}

fn basis(range_m: f64, params: &LineErrorParams) -> Vector3<f64> {
    let share = range_m / params.reference_range_m;
    Vector3::new(1.0, share, share * share)
}

fn plain(placed: &PlacedSample, weight: f64, params: &LineErrorParams) -> ObservationRow {
    let nothing = (placed.first, [0.0; SUPPORT]);
    ObservationRow {
        supports: [(placed.first, placed.weights), nothing],
        value: placed.sample.point.coords,
        basis: basis(placed.sample.range_m, params),
        weight,
    }
}

fn whitened(
    placed: &PlacedSample,
    before: &PlacedSample,
    phi: f64,
    weight: f64,
    params: &LineErrorParams,
) -> ObservationRow {
    ObservationRow {
        supports: [(placed.first, placed.weights), (before.first, before.weights.map(|w| -phi * w))],
        value: placed.sample.point.coords - before.sample.point.coords * phi,
        ..plain(placed, weight, params)
    }
}

/// Sums rows and eliminates the line's error, whose covariance is `scale * S`.
fn eliminate(
    rows: &[ObservationRow],
    scale: f64,
    width: usize,
    lane: &impl ControlPointAt,
    params: &LineErrorParams,
) -> DenseTerm {
    let lowest = |row: &ObservationRow| row.supports.iter().map(|(first, _)| *first).min().unwrap_or(0);
    let Some(first) = rows.iter().map(lowest).min() else { return DenseTerm::default() };
    #[allow(clippy::cast_possible_wrap)] // a band width
    let inside = |row: &&ObservationRow| row.supports.iter().all(|(f, _)| f - first + SUPPORT as i64 <= width as i64);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // not below the first
    let offset = |knot: Knot| (knot - first) as usize;
    let count =
        rows.iter().filter(inside).flat_map(|row| row.supports.map(|(f, _)| offset(f) + SUPPORT)).max().unwrap_or(0);
    let mut term =
        DenseTerm { first, count, information: vec![0.0; count * count], right: vec![Vector3::zeros(); count] };
    let mut coupling = vec![Vector3::zeros(); count];
    let positions: Vec<Vector3<f64>> = (first..).take(count).map(|knot| lane.position(knot)).collect();
    let (mut normal, mut moments) = (prior(scale, params), Matrix3::zeros());
    let (mut residual_squared, mut residual_moments, mut used) = (0.0, Matrix3::zeros(), 0u32);
    for row in rows.iter().filter(inside) {
        let mut entries = [(0, 0.0); 2 * SUPPORT];
        let entries = gather(row, &mut entries, offset);
        let mut residual = row.value;
        for &(a, w) in entries {
            residual -= positions[a] * w;
            let scaled = row.weight * w;
            let line = &mut term.information[a * count..(a + 1) * count];
            for &(b, v) in entries {
                line[b] += scaled * v;
            }
            coupling[a] += row.basis * scaled;
            term.right[a] += row.value * scaled;
        }
        normal += row.basis * row.basis.transpose() * row.weight;
        moments += row.basis * row.value.transpose() * row.weight;
        residual_moments += row.basis * residual.transpose() * row.weight;
        residual_squared += row.weight * residual.norm_squared();
        used += 1;
    }
    let Some(factor) = normal.cholesky() else { return DenseTerm::default() };
    let explained = residual_moments.component_mul(&factor.solve(&residual_moments)).sum();
    // Two of the three axes lie across the line.
    let sigmas = ((residual_squared - explained).max(0.0) / (2.0 * f64::from(used.max(1)))).sqrt();
    let robust = if sigmas > params.huber_sigmas { params.huber_sigmas / sigmas } else { 1.0 };
    let solved: Vec<Vector3<f64>> = coupling.iter().map(|column| factor.solve(column)).collect();
    let moments = moments.transpose();
    for (right, solved) in term.right.iter_mut().zip(&solved) {
        *right = (*right - moments * solved) * robust;
    }
    for (line, coupling) in term.information.chunks_exact_mut(count.max(1)).zip(&coupling) {
        for (entry, solved) in line.iter_mut().zip(&solved) {
            *entry = (*entry - coupling.dot(solved)) * robust;
        }
    }
    term
}

fn prior(scale: f64, params: &LineErrorParams) -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::from(params.sigmas_m.map(|sigma| 1.0 / (scale * sigma * sigma).max(1e-12))))
}

/// Control points of a row with a weight that is not zero, by their offsets.
fn gather<'a>(
    row: &ObservationRow,
    entries: &'a mut [(usize, f64); 2 * SUPPORT],
    offset: impl Fn(Knot) -> usize,
) -> &'a [(usize, f64)] {
    let mut count = 0;
    for (first, weights) in &row.supports {
        for (knot, weight) in (*first..).zip(weights).filter(|(_, weight)| **weight != 0.0) {
            entries[count] = (offset(knot), *weight);
            count += 1;
        }
    }
    &entries[..count]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::{Params, Preset};
    use nalgebra::{DMatrix, DVector};

    struct Straight;
    impl ControlPointAt for Straight {
        fn position(&self, knot: Knot) -> Vector3<f64> {
            Vector3::new(3.0 * knot as f64, 0.0, 0.0)
        }
    }

    fn placed(station: i32, u: f64, y: f64) -> PlacedSample {
        let range_m = 3.0 * f64::from(station);
        let sample = LineSample { station, range_m, point: Point3::new(range_m + 3.0 * u, y, 0.0) };
        PlacedSample { sample, first: i64::from(station) - 1, weights: crate::spline::basis::weights(u) }
    }

    /// The information of the stacked frames by inverting their full covariance must equal the sum of the whitened terms.
    #[test]
    fn whitening_and_elimination_equal_the_full_covariance_of_two_frames() {
        // White noise is left out of the correlation in time; with little of it the two agree.
        let params = LineErrorParams {
            white_sigma_m: 0.02,
            sigmas_m: [0.1, 0.25, 0.4],
            huber_sigmas: f64::INFINITY,
            ..Params::preset(Preset::Default).line_error
        };
        let phi = 0.8;
        let first: Vec<_> = (2..9).map(|k| placed(k, 0.1, 0.1)).collect();
        let second: Vec<_> = (2..9).map(|k| placed(k, 0.4, 0.05 * f64::from(k))).collect();
        let n = 12;
        let mut sum = DMatrix::zeros(n, n);
        for term in line_terms(&first, &[], 0.0, 1.0, 28, &Straight, &params)
            .into_iter()
            .chain(line_terms(&second, &first, phi, 1.0, 28, &Straight, &params))
        {
            for a in 0..term.count {
                for b in 0..term.count {
                    let at = |k: usize| usize::try_from(term.first).unwrap() + k;
                    sum[(at(a), at(b))] += term.information[a * term.count + b];
                }
            }
        }
        let both: Vec<_> = first.iter().chain(&second).collect();
        let m = both.len();
        let h = DMatrix::from_fn(m, n, |r, c| {
            let k = i64::try_from(c).unwrap() - both[r].first;
            if (0..4).contains(&k) { both[r].weights[usize::try_from(k).unwrap()] } else { 0.0 }
        });
        let s = Matrix3::from_diagonal(&Vector3::from(params.sigmas_m.map(|x| x * x)));
        let covariance = DMatrix::from_fn(m, m, |a, b| {
            let (ba, bb) = (basis(both[a].sample.range_m, &params), basis(both[b].sample.range_m, &params));
            let in_time = if (a < first.len()) == (b < first.len()) { 1.0 } else { phi };
            // The whitened white noise has variance (1 + phi^2) and no memory; here: what that amounts to.
            let white = if a == b { params.white_sigma_m.powi(2) } else { 0.0 };
            in_time * ba.dot(&(s * bb)) + white
        });
        let expected = h.transpose() * covariance.try_inverse().unwrap() * &h;
        // Compare what the two say of smooth deviations: a shift, a turn, a bend.
        for shape in [|_: f64| 1.0, |x: f64| x, |x: f64| x * x] {
            let v = DVector::from_fn(n, |r, _| shape(r as f64 / 10.0));
            let (ours, full) = (v.dot(&(&sum * &v)), v.dot(&(&expected * &v)));
            assert!((ours / full - 1.0).abs() < 0.1, "{ours} {full}");
        }
    }

    #[test]
    fn a_line_that_is_off_as_lines_are_keeps_its_weight_and_a_wild_one_loses_it() {
        let params = Params::preset(Preset::Default).line_error;
        let sound: Vec<_> = (2..12).map(|k| placed(k, 0.2, 0.004 * f64::from(k * k))).collect();
        let wild: Vec<_> = (2..12).map(|k| placed(k, 0.2, if k % 2 == 0 { 1.5 } else { -1.5 })).collect();
        let total =
            |samples: &[PlacedSample]| line_terms(samples, &[], 0.0, 1.0, 28, &Straight, &params)[1].information[0];
        assert!(total(&wild) < 0.3 * total(&sound));
    }
}
