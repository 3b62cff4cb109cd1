//! What a lane is painted as: a vote of all frames, not a gate.
//!
//! Ours; the paper demands equal categories, so that a detector that flips dashed and solid splits a lane in two. Here every
//! sighting multiplies the belief by `p(seen | true)`: `1 - epsilon` for the right category, the rest shared by all others.
//! Sightings of one burst of confusion are not independent, so each counts for less than one (`VOTE`).
//!
//! A lane may go on where its paint changes: beside what it is as a whole, each of its knots counts what it was seen as. A frame
//! sees about `SEEN_KNOTS` knots at once, so at each it counts for that share of a vote. Stretches of one category are the
//! best sequence of categories along the lane with a price for each change (Viterbi).

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::information::Knot;
use crate::{category::Category, lane_map::CategoryStretch};

/// Weight of one frame's vote: bursts of confusion last a few frames.
const VOTE: f64 = 0.3;
/// Knots that one frame votes on together.
const SEEN_KNOTS: f64 = 10.0;
/// Price of a change of category along a lane, as a logarithm of a probability.
const ANOTHER: f64 = 7.0;
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
        let step = step(confusion);
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

/// What each knot of a lane was seen as.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CategoryAlong {
    first: Knot,
    /// Frames that saw it as each category.
    knots: VecDeque<[u16; CATEGORIES]>,
}

impl CategoryAlong {
    /// Counts one frame's sighting of the knots between two, both included.
    pub fn vote(&mut self, seen: Category, from: Knot, to: Knot) {
        for knot in from..=to {
            let votes = &mut self.at_mut(knot)[seen.index()];
            *votes = votes.saturating_add(1);
        }
    }

    /// Adds the sightings of another lane, whose knot `k` is `to_mine(k)` of this one.
    pub fn absorb(&mut self, other: &Self, to_mine: impl Fn(Knot) -> Knot) {
        for (knot, theirs) in (other.first..).zip(&other.knots) {
            for (mine, votes) in self.at_mut(to_mine(knot)).iter_mut().zip(theirs) {
                *mine = mine.saturating_add(*votes);
            }
        }
    }

    fn at_mut(&mut self, knot: Knot) -> &mut [u16; CATEGORIES] {
        if self.knots.is_empty() {
            self.first = knot;
        }
        while knot < self.first {
            self.knots.push_front([0; CATEGORIES]);
            self.first -= 1;
        }
        let index = usize::try_from(knot - self.first).unwrap_or(0);
        if index >= self.knots.len() {
            self.knots.resize(index + 1, [0; CATEGORIES]);
        }
        &mut self.knots[index]
    }

    /// Stretches of one category, in their order, as parameters counted from knot `head`; none where it is the same all along.
    #[must_use]
    pub fn stretches(&self, head: Knot, confusion: f64) -> Vec<CategoryStretch> {
        let seen: Vec<usize> =
            (0..CATEGORIES).filter(|category| self.knots.iter().any(|votes| votes[*category] > 0)).collect();
        if seen.len() < 2 {
            return Vec::new();
        }
        let path = self.best_path(&seen, confusion);
        let mut stretches: Vec<CategoryStretch> = Vec::new();
        let mut next = 0;
        for run in path.chunk_by(|a, b| a == b) {
            let mut belief = CategoryBelief::default();
            for votes in self.knots.range(next..next + run.len()) {
                for (sum, own) in belief.votes.iter_mut().zip(votes) {
                    *sum += VOTE / SEEN_KNOTS * f64::from(*own);
                }
            }
            next += run.len();
            // Half way between its last knot and the next.
            let to = (self.first - head) as f64 + next as f64 - 0.5;
            stretches.push(CategoryStretch { to, posterior: belief.posterior(confusion).to_vec() });
        }
        if stretches.len() < 2 { Vec::new() } else { stretches }
    }

    /// Of each knot the category, as a number among all, by the likeliest sequence of some.
    fn best_path(&self, categories: &[usize], confusion: f64) -> Vec<usize> {
        let vote = VOTE / SEEN_KNOTS * step(confusion);
        let mut scores = vec![0.0; categories.len()];
        let mut from: Vec<Vec<usize>> = Vec::with_capacity(self.knots.len());
        for votes in &self.knots {
            let best = most(&scores);
            let came_from = |state: usize| if scores[state] >= scores[best] - ANOTHER { state } else { best };
            let came: Vec<usize> = (0..categories.len()).map(came_from).collect();
            let score = |state: usize| {
                let price = if came[state] == state { 0.0 } else { ANOTHER };
                scores[came[state]] - price + vote * f64::from(votes[categories[state]])
            };
            scores = (0..categories.len()).map(score).collect();
            from.push(came);
        }
        let mut state = most(&scores);
        let mut path = vec![0; from.len()];
        for (own, came) in path.iter_mut().zip(&from).rev() {
            *own = categories[state];
            state = came[state];
        }
        path
    }
}

/// Index of the greatest; the first of equals.
fn most(values: &[f64]) -> usize {
    let mut most = 0;
    for (index, value) in values.iter().enumerate() {
        if *value > values[most] {
            most = index;
        }
    }
    most
}

/// By how much a vote raises the logarithm of a category's probability against another's.
fn step(confusion: f64) -> f64 {
    ((1.0 - confusion) * (CATEGORIES - 1) as f64 / confusion).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Twenty frames see each knot of a lane of 60, as one category up to a knot and as another from there on.
    fn seen_along(change: Knot) -> CategoryAlong {
        let mut along = CategoryAlong::default();
        for frame in 0..20 {
            let as_it_is = |knot| if knot < change { Category::WhiteDashed } else { Category::WhiteSolid };
            // A burst of confusion.
            let seen = |knot| if (7..10).contains(&frame) { Category::YellowDashed } else { as_it_is(knot) };
            (0..60).for_each(|knot| along.vote(seen(knot), knot, knot));
        }
        along
    }

    #[test]
    fn a_lane_whose_paint_changes_is_told_in_stretches_and_one_that_does_not_is_not() {
        let stretches = seen_along(25).stretches(-2, 0.1);
        assert_eq!(stretches.iter().map(|stretch| stretch.to).collect::<Vec<_>>(), [26.5, 61.5]);
        assert!(stretches[0].posterior[Category::WhiteDashed.index()] > 0.9);
        assert!(stretches[1].posterior[Category::WhiteSolid.index()] > 0.9);
        assert_eq!(seen_along(0).stretches(0, 0.1), []);
        assert_eq!(seen_along(59).stretches(0, 0.1), [], "one knot is no stretch");
    }

    #[test]
    fn sightings_of_a_lane_that_was_the_same_are_added_where_it_lies() {
        let mut along = seen_along(60);
        let mut other = CategoryAlong::default();
        (0..30).for_each(|_| other.vote(Category::WhiteSolid, 0, 19));
        along.absorb(&other, |knot| knot + 30);
        let stretches = along.stretches(0, 0.1);
        assert_eq!(stretches.iter().map(|stretch| stretch.to).collect::<Vec<_>>(), [29.5, 49.5, 59.5]);
    }

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
