//! How well lanes of one frame were taken for lanes of another.
//!
//! Paper: "Evaluation on Lane association": F1, precision and recall per pair of frames, then their means over the pairs.

/// What an association method said of one pair of frames.
///
/// ```
/// use lanemap_core::evaluation::AssociationScore;
///
/// // Lanes 1 and 2 are in both frames; the method joined 1 with 1 and 3 with 4.
/// let score = AssociationScore::new(&[(1, 1), (3, 4)], &[1, 2]);
/// assert_eq!((score.precision(), score.recall(), score.f1()), (0.5, 0.5, 0.5));
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AssociationScore {
    correct: usize,
    claimed: usize,
    possible: usize,
}

impl AssociationScore {
    /// Scores claimed pairs of track ids against the ids that are in both frames.
    #[must_use]
    pub fn new(claimed: &[(i64, i64)], in_both: &[i64]) -> Self {
        let correct = claimed.iter().filter(|(a, b)| a == b && in_both.contains(a)).count();
        Self { correct, claimed: claimed.len(), possible: in_both.len() }
    }

    /// Share of the claims that are right; 0 without a claim where there was something to claim.
    #[must_use]
    pub fn precision(&self) -> f64 {
        self.share(self.correct, self.claimed)
    }

    /// Share of the common lanes that were found; 0 without common lanes where something was claimed.
    #[must_use]
    pub fn recall(&self) -> f64 {
        self.share(self.correct, self.possible)
    }

    /// Harmonic mean of precision and recall; 0 where both are.
    #[must_use]
    pub fn f1(&self) -> f64 {
        self.share(2 * self.correct, self.claimed + self.possible)
    }

    /// Nothing claimed where nothing was to be found is right, and counts as 1, as the authors count it.
    fn share(&self, part: usize, whole: usize) -> f64 {
        if self.claimed + self.possible == 0 { 1.0 } else { part as f64 / whole.max(1) as f64 }
    }
}

/// Mean of scores over pairs of frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AssociationMean {
    /// Number of pairs.
    pub pairs: u64,
    f1_sum: f64,
    precision_sum: f64,
    recall_sum: f64,
}

impl AssociationMean {
    /// Takes the score of one pair.
    pub fn add(&mut self, score: &AssociationScore) {
        self.pairs += 1;
        self.f1_sum += score.f1();
        self.precision_sum += score.precision();
        self.recall_sum += score.recall();
    }

    /// Mean F1; 0 without pairs.
    #[must_use]
    pub fn f1(&self) -> f64 {
        self.f1_sum / self.pairs.max(1) as f64
    }

    /// Mean precision; 0 without pairs.
    #[must_use]
    pub fn precision(&self) -> f64 {
        self.precision_sum / self.pairs.max(1) as f64
    }

    /// Mean recall; 0 without pairs.
    #[must_use]
    pub fn recall(&self) -> f64 {
        self.recall_sum / self.pairs.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silence_is_right_where_there_is_nothing_to_find_and_wrong_elsewhere() {
        let ratios = |score: &AssociationScore| format!("{} {} {}", score.f1(), score.precision(), score.recall());
        assert_eq!(ratios(&AssociationScore::new(&[], &[])), "1 1 1");
        assert_eq!(ratios(&AssociationScore::new(&[], &[1, 2])), "0 0 0");
        assert_eq!(ratios(&AssociationScore::new(&[(1, 1)], &[])), "0 0 0");
    }

    #[test]
    fn the_mean_is_over_pairs_of_frames_and_not_over_lanes() {
        let mut mean = AssociationMean::default();
        mean.add(&AssociationScore::new(&[(1, 1), (2, 2), (3, 3), (4, 4)], &[1, 2, 3, 4]));
        mean.add(&AssociationScore::new(&[(1, 2)], &[1]));
        assert_eq!(mean.pairs, 2);
        assert!((mean.f1() - 0.5).abs() < 1e-12);
    }
}
