//! True positives among truths and predictions, and the ratios that follow.

use std::ops::AddAssign;

use serde::Serialize;

/// Counts over any number of frames; they add up.
///
/// ```
/// use lanemap_core::evaluation::Counts;
///
/// let mut total = Counts { true_positives: 1, truths: 2, predictions: 1 };
/// total += Counts { true_positives: 2, truths: 2, predictions: 3 };
/// assert_eq!((total.recall(), total.precision()), (0.75, 0.75));
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Predictions taken for right.
    pub true_positives: u64,
    /// Lines that are there.
    pub truths: u64,
    /// Lines that were predicted.
    pub predictions: u64,
}

impl Counts {
    /// True positives over truths; 0 where there is no truth.
    #[must_use]
    pub fn recall(&self) -> f64 {
        self.true_positives as f64 / self.truths.max(1) as f64
    }

    /// True positives over predictions; 0 where there is no prediction.
    #[must_use]
    pub fn precision(&self) -> f64 {
        self.true_positives as f64 / self.predictions.max(1) as f64
    }

    /// Harmonic mean of recall and precision; 0 where both are.
    #[must_use]
    pub fn f1(&self) -> f64 {
        let (recall, precision) = (self.recall(), self.precision());
        2.0 * recall * precision / (recall + precision).max(1e-9)
    }
}

impl AddAssign for Counts {
    fn add_assign(&mut self, other: Self) {
        self.true_positives += other.true_positives;
        self.truths += other.truths;
        self.predictions += other.predictions;
    }
}
