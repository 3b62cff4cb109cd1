//! What is known at a control point, as small numbers.

use lanemap_proto::v1;

/// A control point's standard deviations and existence, as `spline_tile.proto` codes them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Codes {
    /// Standard deviation across the line.
    pub(super) lateral: i64,
    /// Standard deviation of the height.
    pub(super) height: i64,
    /// Existence.
    pub(super) existence: i64,
}

impl Codes {
    /// The codes at a parameter of the map's line, which stay as they were where they may.
    pub(super) fn at(lane: &v1::FusedLane, parameter: f64, before: Option<Self>) -> Self {
        let kept = |code: i64, exact: f64, before: Option<i64>| {
            // Within a step of what is exact, a code stays.
            before.filter(|before| *before > 0 && (*before as f64 - exact).abs() <= 1.0).unwrap_or(code)
        };
        let sigma = |values: &[u32], before: Option<i64>| {
            let exact = exact_sigma_code(between(values, parameter));
            kept(super::steps::rounded(exact), exact, before)
        };
        let percent = between(&lane.existence_permille, parameter) / 10.0;
        Self {
            lateral: sigma(&lane.lateral_sigma_mm, before.map(|before| before.lateral)),
            height: sigma(&lane.height_sigma_mm, before.map(|before| before.height)),
            existence: kept(super::steps::rounded(percent), percent, before.map(|before| before.existence)),
        }
    }
}

/// The value at a parameter, between those of the control points.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a parameter is not negative; the cast saturates"
)]
fn between(values: &[u32], parameter: f64) -> f64 {
    let index = parameter as usize;
    let Some(here) = values.get(index).or(values.last()) else { return 0.0 };
    let next = values.get(index + 1).unwrap_or(here);
    f64::from(*here) + (f64::from(*next) - f64::from(*here)) * (parameter - index as f64)
}

fn exact_sigma_code(sigma_mm: f64) -> f64 {
    if sigma_mm <= 0.0 { 0.0 } else { 1.0 + (4.0 * sigma_mm.log2()).max(0.0) }
}

/// The standard deviation of a code, metres.
pub(super) fn sigma_m(code: i64) -> f64 {
    if code <= 0 { 0.0 } else { ((code - 1) as f64 / 4.0).exp2() * 1e-3 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_standard_deviation_comes_back_to_a_tenth() {
        for sigma_mm in [1_u32, 7, 50, 333, 2_000, 40_000] {
            let lane = v1::FusedLane { lateral_sigma_mm: vec![sigma_mm; 2], ..v1::FusedLane::default() };
            let code = Codes::at(&lane, 0.5, None).lateral;
            let error = sigma_m(code) / (f64::from(sigma_mm) * 1e-3);
            assert!((0.91..1.1).contains(&error), "{sigma_mm} mm: {error}");
        }
        assert!(sigma_m(0).abs() < f64::EPSILON);
    }

    #[test]
    fn a_code_stays_while_it_is_nearly_right() {
        let lane = v1::FusedLane { existence_permille: vec![900, 908, 950], ..v1::FusedLane::default() };
        let first = Codes::at(&lane, 0.0, None);
        let second = Codes::at(&lane, 1.0, Some(first));
        assert_eq!((first.existence, second.existence), (90, 90));
        assert_eq!(Codes::at(&lane, 2.0, Some(second)).existence, 95);
    }
}
