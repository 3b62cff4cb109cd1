//! What a lane is painted as: a vote of all frames, not a gate.
//!
//! Ours; the paper demands equal categories, so that a detector that flips dashed and solid splits a lane in two. Here every
//! sighting multiplies the belief by `p(seen | true)`: `1 - epsilon` for the right category, the rest shared by all others.
//! Sightings of one burst of confusion are not independent, so each counts for less than one (`VOTE`).

use serde::{Deserialize, Serialize};

use crate::category::Category;

/// Weight of one frame's vote: bursts of confusion last a few frames.
const VOTE: f64 = 0.3;
const CATEGORIES: usize = Category::ALL.len();

/// Belief over the categories of a lane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CategoryBelief {
    votes: [f64; CATEGORIES],
}

impl CategoryBelief {
    /// Takes one sighting into account.
    pub fn vote(&mut self, seen: Category) {
        self.votes[seen.index()] += VOTE;
    }

    /// Adds the sightings of another lane that turned out to be this one.
    pub fn absorb(&mut self, other: &Self) {
        self.votes.iter_mut().zip(other.votes).for_each(|(mine, theirs)| *mine += theirs);
    }

    /// Most probable category; the first of equals.
    #[must_use]
    pub fn best(&self) -> Category {
        let mut best = 0;
        for (index, votes) in self.votes.iter().enumerate() {
            if *votes > self.votes[best] {
                best = index;
            }
        }
        Category::ALL[best]
    }

    /// Probability of each category, in the order of [`Category::ALL`], for a detector that errs with `confusion`.
    #[must_use]
    pub fn posterior(&self, confusion: f64) -> [f64; CATEGORIES] {
        let step = ((1.0 - confusion) * (CATEGORIES - 1) as f64 / confusion).ln();
        let most = self.votes.iter().copied().fold(0.0, f64::max);
        let mut posterior = self.votes.map(|votes| ((votes - most) * step).exp());
        let sum: f64 = posterior.iter().sum();
        for probability in &mut posterior {
            *probability /= sum;
        }
        posterior
    }

    /// Log-likelihood of seeing each category next.
    #[must_use]
    pub fn log_likelihood(&self, confusion: f64) -> [f64; CATEGORIES] {
        let other = confusion / (CATEGORIES - 1) as f64;
        self.posterior(confusion)
            .map(|probability| (probability * (1.0 - confusion) + (1.0 - probability) * other).ln())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_of_confusion_does_not_overturn_a_long_history() {
        let mut belief = CategoryBelief::default();
        (0..20).for_each(|_| belief.vote(Category::WhiteSolid));
        (0..5).for_each(|_| belief.vote(Category::WhiteDashed));
        assert_eq!(belief.best(), Category::WhiteSolid);
        let posterior = belief.posterior(0.1);
        assert!((posterior.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!(posterior[Category::WhiteSolid.index()] > 0.99);
    }

    #[test]
    fn the_likelihood_of_all_sightings_sums_to_one() {
        let mut belief = CategoryBelief::default();
        belief.vote(Category::RightCurb);
        let sum: f64 = belief.log_likelihood(0.1).iter().map(|log| log.exp()).sum();
        assert!((sum - 1.0).abs() < 1e-12);
    }
}
