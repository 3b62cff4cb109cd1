//! A chain along a line: each knot is in one of a few states, and neighbours are mostly in the same.
//!
//! `P(h' | h) = (1 - e) [h' = h] + e pi(h')`, a Potts prior with the probabilities `pi` of the states themselves. Marginals are exact,
//! by one pass forward and one backward (forward-backward algorithm), linear in the number of states.

/// Calls `take` with every knot, the last first, and its marginal probabilities up to a factor. `another` is `e`;
/// `likelihoods(knot, of)` fills in those of a knot, up to a factor.
pub(super) fn marginals(
    knots: usize,
    prior: &[f64],
    another: f64,
    likelihoods: impl Fn(usize, &mut Vec<f64>),
    mut take: impl FnMut(usize, &[f64]),
) {
    let mut forward: Vec<Vec<f64>> = Vec::with_capacity(knots);
    let mut likelihood = Vec::with_capacity(prior.len());
    for knot in 0..knots {
        likelihoods(knot, &mut likelihood);
        let mut here: Vec<f64> = match knot.checked_sub(1) {
            None => prior.iter().zip(&likelihood).map(|(prior, own)| prior * own).collect(),
            Some(before) => {
                let onward = forward[before].iter().zip(prior).zip(&likelihood);
                onward.map(|((before, prior), own)| ((1.0 - another) * before + another * prior) * own).collect()
            }
        };
        normalise(&mut here);
        forward.push(here);
    }
    let mut backward = vec![1.0; prior.len()];
    let mut joint = vec![0.0; prior.len()];
    for knot in (0..knots).rev() {
        for ((joint, forward), backward) in joint.iter_mut().zip(&forward[knot]).zip(&backward) {
            *joint = forward * backward;
        }
        take(knot, &joint);
        likelihoods(knot, &mut likelihood);
        for (backward, own) in backward.iter_mut().zip(&likelihood) {
            *backward *= own;
        }
        let mean: f64 = prior.iter().zip(&backward).map(|(prior, backward)| prior * backward).sum();
        // Of the scale 1 at the mean: what matters is the ratio.
        for backward in &mut backward {
            *backward = (1.0 - another) * *backward / mean + another;
        }
    }
}

fn normalise(probabilities: &mut [f64]) {
    let total: f64 = probabilities.iter().sum();
    for probability in probabilities {
        *probability /= total;
    }
}
