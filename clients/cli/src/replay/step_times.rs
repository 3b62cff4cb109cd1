//! Times of `Mapper::step`, over a drive and along it.

use std::time::Duration;

use serde::Serialize;

/// Times of the steps of one drive, with the distance at which each was taken.
#[derive(Clone, Debug, Default)]
pub struct StepTimes {
    steps: Vec<(f64, Duration)>,
}

/// Figures of step times, microseconds. Percentiles by nearest rank.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StepFigures {
    /// Mean.
    pub mean: f64,
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Longest.
    pub max: f64,
}

impl StepTimes {
    /// Adds a step taken at a distance from the start of the drive.
    pub fn push(&mut self, driven_m: f64, took: Duration) {
        self.steps.push((driven_m, took));
    }

    /// Figures over these drives together; `None` where no step was taken.
    pub fn figures<'a>(drives: impl IntoIterator<Item = &'a Self>) -> Option<StepFigures> {
        let mut times_us: Vec<f64> =
            drives.into_iter().flat_map(|drive| &drive.steps).map(|(_, took)| took.as_secs_f64() * 1e6).collect();
        times_us.sort_by(f64::total_cmp);
        let count = times_us.len();
        let rank = |percent: usize| times_us[(count * percent).div_ceil(100).clamp(1, count) - 1];
        (count > 0).then(|| StepFigures {
            mean: times_us.iter().sum::<f64>() / count as f64,
            p50: rank(50),
            p99: rank(99),
            max: rank(100),
        })
    }

    /// Mean step of each kilometre driven, microseconds; `None` for a kilometre without a step.
    ///
    /// A rest of less than a tenth of a kilometre counts with the kilometre before it.
    pub fn means_per_km_us(&self) -> Vec<Option<f64>> {
        let length_m = self.steps.last().map_or(0.0, |(driven_m, _)| *driven_m);
        let last = kilometre_of(length_m - SHORT_REST_M);
        let mut kilometres: Vec<(f64, u32)> = Vec::new();
        for (driven_m, took) in &self.steps {
            let kilometre = kilometre_of(*driven_m).min(last);
            if kilometres.len() <= kilometre {
                kilometres.resize(kilometre + 1, (0.0, 0));
            }
            kilometres[kilometre].0 += took.as_secs_f64() * 1e6;
            kilometres[kilometre].1 += 1;
        }
        kilometres.into_iter().map(|(sum_us, steps)| (steps > 0).then(|| sum_us / f64::from(steps))).collect()
    }
}

/// A rest shorter than this is no kilometre of its own, metres.
const SHORT_REST_M: f64 = 100.0;

/// Farthest kilometre listed: a drive whose poses jump to the end of the world does not fill the memory.
const MAX_KILOMETRES: f64 = 10_000.0;

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to 0 ..= 10,000")]
fn kilometre_of(driven_m: f64) -> usize {
    (driven_m / 1e3).clamp(0.0, MAX_KILOMETRES) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_short_rest_counts_with_the_kilometre_before_it() {
        let mut drive = StepTimes::default();
        for driven_m in [0.0, 500.0, 1_500.0, 2_000.4] {
            drive.push(driven_m, Duration::from_micros(10));
        }
        assert_eq!(drive.means_per_km_us().len(), 2);
        drive.push(2_150.0, Duration::from_micros(10));
        assert_eq!(drive.means_per_km_us().len(), 3);
    }

    #[test]
    fn figures_are_over_all_drives_and_means_along_one() {
        let mut drive = StepTimes::default();
        for k in 0..100_u32 {
            drive.push(f64::from(k) * 30.0, Duration::from_micros(u64::from(k) + 1));
        }
        let figures = StepTimes::figures([&drive]).unwrap();
        assert!((figures.mean - 50.5).abs() < 1e-9);
        assert!((figures.p50 - 50.0).abs() < 1e-9 && (figures.p99 - 99.0).abs() < 1e-9);
        assert!((figures.max - 100.0).abs() < 1e-9);
        assert_eq!(drive.means_per_km_us().len(), 3);
        assert!((drive.means_per_km_us()[0].unwrap() - 17.5).abs() < 1e-9);
        assert_eq!(StepTimes::figures([&StepTimes::default()]), None);
    }
}
