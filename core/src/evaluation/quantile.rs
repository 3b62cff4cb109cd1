//! Quantiles of a sample.

/// Quantile `share` (in `[0, 1]`) of a sample, linear between its ranks as numpy's `percentile`; 0 for an empty sample.
///
/// Sorts the sample.
///
/// ```
/// use lanemap_core::evaluation::quantile;
///
/// assert_eq!(quantile(&mut [4.0, 1.0, 2.0, 3.0], 0.5), 2.5);
/// ```
#[must_use]
pub fn quantile(sample: &mut [f64], share: f64) -> f64 {
    if sample.is_empty() {
        return 0.0;
    }
    sample.sort_unstable_by(f64::total_cmp);
    let rank = share.clamp(0.0, 1.0) * (sample.len() - 1) as f64;
    // Between 0 and the last index.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let below = rank.floor() as usize;
    let above = (below + 1).min(sample.len() - 1);
    sample[below] + (sample[above] - sample[below]) * (rank - below as f64)
}
