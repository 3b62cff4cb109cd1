//! How well receivers tell the shape of a way, learned from the drives themselves.
//!
//! A receiver states one sigma for all that it is off by, but most of that is a bias that its fixes have in common; how
//! much the rest is, which bends the way, differs from receiver to receiver and from street to street. Once lanes hold the
//! drives together, each drive's fixes can be compared with where all drives put it: with `r` the mean offset of the fixes
//! of a window of way, less the median offset of the drive,
//!
//! `s = 1.4826 median |r| sqrt(N / (N - 1))`
//!
//! over all windows of `N` drives is the standard deviation of that rest: the variance component of shape, by the median, so
//! that drives among tall buildings do not spoil it for the others.
//!
//! Not guaranteed: an `s` for each receiver of its own. All drives of one place share it, in proportion to what they state.

use super::{
    correction::Correction,
    params::FleetParams,
    prepared::{Restraints, count_of},
};

/// Drives below which nothing is learned.
const LEAST_DRIVES: usize = 4;
/// Windows of all drives below which nothing is learned.
const LEAST_WINDOWS: usize = 16;
/// Smallest and greatest share of its stated sigma that a receiver's shape may be off by.
const SHARES: std::ops::RangeInclusive<f64> = 0.04..=1.0;
/// From a median of absolute values to a standard deviation, where values are normal.
const SIGMA_OF_MEDIAN: f64 = 1.4826;

/// The share of its stated sigma by which the shape of a receiver's way is off; `None` where too few drives tell.
pub(super) fn learned_shape_share(drives: &[(&Restraints, &Correction)], params: &FleetParams) -> Option<f64> {
    if drives.len() < LEAST_DRIVES {
        return None;
    }
    let mut shares: Vec<f64> =
        drives.iter().flat_map(|(restraints, correction)| window_shares(restraints, correction, params)).collect();
    if shares.len() < 2 * LEAST_WINDOWS {
        return None;
    }
    let count = drives.len() as f64;
    let share = SIGMA_OF_MEDIAN * middle(&mut shares) * (count / (count - 1.0)).sqrt();
    Some(share.clamp(*SHARES.start(), *SHARES.end()))
}

/// By how much the fixes of each window of a drive's way are off, east and north, as shares of the stated sigma.
fn window_shares(restraints: &Restraints, correction: &Correction, params: &FleetParams) -> Vec<f64> {
    let offsets: Vec<(f64, [f64; 2])> = restraints
        .fixes
        .iter()
        .map(|fix| {
            let offset = fix.shared - correction.apply(&fix.map, fix.arc_m);
            (fix.arc_m, [offset.x, offset.y])
        })
        .collect();
    let common = [0, 1].map(|axis| middle(&mut offsets.iter().map(|(_, offset)| offset[axis]).collect::<Vec<_>>()));
    let window = |arc_m: f64| count_of(arc_m / params.gnss_correlation_m);
    let windows = offsets.chunk_by(|a, b| window(a.0) == window(b.0));
    let shares = windows.flat_map(|fixes| {
        let mean = |axis: usize| fixes.iter().map(|(_, offset)| offset[axis]).sum::<f64>() / fixes.len() as f64;
        [0, 1].map(|axis| (mean(axis) - common[axis]).abs() / restraints.stated_sigma_m)
    });
    shares.collect()
}

/// The median; 0 of nothing.
fn middle(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector3};

    use super::*;
    use crate::fleet::{
        contribution::PlacedBy,
        prepared::{DriftSigma, SharedFix},
    };

    /// A drive whose fixes wander about its way by so much, and have a bias of their own.
    fn drive(number: u32, wander_m: f64) -> Restraints {
        let fixes = (0..250).map(|index| {
            let arc_m = 4.0 * f64::from(index);
            let map = Point3::new(arc_m, 0.0, 0.0);
            let phase = 9.7 * f64::from(number) + arc_m / 90.0;
            // Sums of many sines are nearly normal.
            let noise =
                |shift: f64| (1..=6).map(|k| (f64::from(k).sqrt() * phase + shift * f64::from(k)).sin()).sum::<f64>();
            let wander = Vector3::new(noise(0.7), noise(2.1), 0.0) * (wander_m / 3.0_f64.sqrt());
            SharedFix { arc_m, map, shared: map + wander + Vector3::new(1.0, -2.0, 0.0), sigma_m: [1.0, 1.0] }
        });
        let drift_sigma = DriftSigma { scale: 0.01, turn_rad_per_m: 1e-5 };
        Restraints {
            fixes: fixes.collect(),
            placed_by: PlacedBy::Receiver,
            bias_sigma_m: [1.5; 2],
            place_sigma_m: 1.5,
            stated_sigma_m: 1.5,
            drift_sigma,
            steps: Vec::new(),
        }
    }

    #[test]
    fn the_shape_is_learned_without_the_bias_and_nothing_is_learned_of_few() {
        let params = FleetParams::default();
        let drives: Vec<Restraints> = (0..12).map(|number| drive(number, 0.3)).collect();
        let correction = Correction::identity();
        let all: Vec<(&Restraints, &Correction)> = drives.iter().map(|drive| (drive, &correction)).collect();
        let share = learned_shape_share(&all, &params).unwrap();
        assert!((share * 1.5 - 0.3).abs() < 0.1, "{share}");
        assert_eq!(learned_shape_share(&all[..3], &params), None);
    }

    #[test]
    fn one_receiver_among_tall_buildings_does_not_spoil_it_for_the_others() {
        let params = FleetParams::default();
        let drives: Vec<Restraints> =
            (0..12).map(|number| drive(number, if number == 5 { 6.0 } else { 0.3 })).collect();
        let correction = Correction::identity();
        let all: Vec<(&Restraints, &Correction)> = drives.iter().map(|drive| (drive, &correction)).collect();
        let share = learned_shape_share(&all, &params).unwrap();
        assert!((share * 1.5 - 0.3).abs() < 0.12, "{share}");
    }
}
