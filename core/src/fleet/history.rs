//! History: what became of each stretch of line, from what drives said of its knots in the order of time.
//!
//! A knot has a history: it was there all the time, never, or it came or went once or twice, each time between two passes. Its
//! likelihood is the product of what every pass says, `P(seen | there)` or `P(seen | not there)`; and since what a pass
//! sees of one knot and of the next is mostly one sight, each counts for a share of one. Neighbouring knots have mostly the same
//! history: a chain with a Potts prior along the line ([`potts`]). Noise of single drives and single knots does not make a change; what a few drives say
//! of a whole stretch does. The idea of persistence as a probability is that of Rosen, Mason and Leonard, *Towards Lifelong
//! Feature-Based Mapping in Semi-Static Environments* (ICRA 2016); the chain over space is ours.
//!
//! Two-change histories make it quadratic in the number of passes, of which a fold leaves a few dozen.
//!
//! Not guaranteed: a stretch that came and went more than once within the drives that are kept apart is told by its last two turns.

use serde::{Deserialize, Serialize};

use super::{
    persistence::{Hearing, Speaker},
    potts,
};
use crate::frame::TimestampNs;

/// Least probability that a pass misses what is there: a pass may be wrong as a whole.
const LEAST_MISS: f64 = 0.1;
/// Share of a sight that one knot counts for: misses go on for about 24 m of a pass.
const SHARE_OF_SIGHT: f64 = 0.125;
/// Probability that the history of the next knot is another.
const ANOTHER: f64 = 0.01;
/// Probabilities of a history with one change, and with two.
const ONE_CHANGE: f64 = 0.05;
const TWO_CHANGES: f64 = 0.005;
/// Probability from which on a change is believed.
const BELIEVED: f64 = 0.8;
/// Passes that must tell the old state, and the new.
const LEAST_TELLING_OLD: usize = 3;
const LEAST_TELLING_NEW: usize = 2;
/// Bounds of what drives that were folded are believed.
const FOLDED: std::ops::RangeInclusive<f64> = 0.02..=0.98;

/// What is believed of a knot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Belief {
    /// Probability that it is there.
    pub(super) probability: f64,
    /// Whether it is held to be there, by the last change that was believed.
    stands: bool,
    /// Whether most drives have its paint on another line.
    pub(super) doubled: bool,
    /// Start of the last drive that saw it.
    pub(super) confirmed: Option<TimestampNs>,
    /// The last change, and the drive that made it believed.
    pub(super) change: Option<(Turn, Speaker)>,
}

impl Belief {
    /// Whether it is there, and its paint on no other line.
    pub(super) fn is_shown(&self) -> bool {
        self.probability >= 0.5 && !self.doubled
    }
}

/// What becomes of a knot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Turn {
    /// It is there, where it was not.
    Came,
    /// It is there no more.
    Went,
}

/// What the passes say of one knot: by how much likelier it is that it is there than not.
struct Saying {
    before: Option<Belief>,
    /// `exp` of the sum of log-ratios of the first `m` passes.
    odds: Vec<f64>,
    /// Of each pass: whether it saw the knot, if it says something.
    seen: Vec<Option<bool>>,
}

/// Marginal probabilities of one knot.
#[derive(Clone, Copy, Debug, Default)]
struct Marginal {
    there: f64,
    came: f64,
    went: f64,
    /// The pass from which on it has most likely been as it is since it came or went.
    since: usize,
}

/// What became of each knot of a line. `before` is what folded drives left, `hearings` what passes say of each knot, in
/// order; `speakers` names the passes.
pub(super) fn histories(before: &[Option<Belief>], hearings: &[Vec<Hearing>], speakers: &[Speaker]) -> Vec<Belief> {
    let mut passes: Vec<u32> = hearings.iter().flatten().map(|hearing| hearing.pass).collect();
    passes.sort_unstable();
    passes.dedup();
    let sayings: Vec<Saying> =
        before.iter().zip(hearings).map(|(before, hearings)| saying(*before, hearings, &passes)).collect();
    let now = marginals(&sayings, passes.len());
    let mut beliefs: Vec<Belief> = now
        .iter()
        .zip(&sayings)
        .zip(hearings)
        .map(|((marginal, saying), hearings)| {
            let confirmed = hearings.iter().rev().find(|hearing| hearing.seen);
            let confirmed = confirmed.map(|hearing| speakers[hearing.pass as usize].0);
            Belief {
                probability: there(marginal, saying, passes.len()).clamp(*FOLDED.start(), *FOLDED.end()),
                doubled: saying.before.is_some_and(|before| before.doubled),
                stands: saying.before.map_or(marginal.there >= 0.5, |before| before.stands),
                confirmed: confirmed.or(saying.before.and_then(|before| before.confirmed)),
                change: saying.before.and_then(|before| before.change),
            }
        })
        .collect();
    let turns: Vec<Option<Turn>> =
        now.iter().zip(&sayings).map(|(marginal, saying)| turn(marginal, saying, passes.len())).collect();
    let noticed = noticed(&sayings, &turns, passes.len());
    for ((belief, turn), noticed) in beliefs.iter_mut().zip(turns).zip(noticed) {
        if let Some(turn) = turn {
            belief.change = Some((turn, speakers[passes[noticed] as usize]));
            belief.stands = turn == Turn::Came;
        }
    }
    beliefs
}

fn saying(before: Option<Belief>, hearings: &[Hearing], passes: &[u32]) -> Saying {
    let mut seen = vec![None; passes.len()];
    let mut ratios = vec![0.0; passes.len()];
    for hearing in hearings {
        let Ok(pass) = passes.binary_search(&hearing.pass) else { continue };
        // That a pass sees it is never a sign that it is not there, nor the other way.
        let chance = hearing.chance.clamp(hearing.ghost, 1.0 - LEAST_MISS);
        let ratio = if hearing.seen { chance / hearing.ghost } else { (1.0 - chance) / (1.0 - hearing.ghost) };
        ratios[pass] = SHARE_OF_SIGHT * ratio.ln();
        seen[pass] = Some(hearing.seen);
    }
    let mut sum = 0.0;
    let mut odds = vec![1.0];
    odds.extend(ratios.iter().map(|ratio| {
        sum += ratio;
        sum.exp()
    }));
    Saying { before, odds, seen }
}

/// Probability that a knot is there; what one pass alone has otherwise does not count yet.
fn there(marginal: &Marginal, saying: &Saying, passes: usize) -> f64 {
    let (old, new) = saying.seen[..passes].split_at(marginal.since);
    let tell = |passes: &[Option<bool>], there: bool| passes.iter().filter(|seen| **seen == Some(there)).count();
    if marginal.went > marginal.came && tell(new, false) < LEAST_TELLING_NEW {
        marginal.there + marginal.went
    } else if marginal.came > marginal.went
        && tell(new, true) < LEAST_TELLING_NEW
        && tell(old, false) >= LEAST_TELLING_OLD
    {
        marginal.there - marginal.came
    } else {
        marginal.there
    }
}

/// The change that is believed of a knot after so many passes.
fn turn(marginal: &Marginal, saying: &Saying, passes: usize) -> Option<Turn> {
    let turn = if marginal.came >= BELIEVED {
        Turn::Came
    } else if marginal.went >= BELIEVED {
        Turn::Went
    } else {
        return None;
    };
    let tell = |passes: &[Option<bool>], there: bool| passes.iter().filter(|seen| **seen == Some(there)).count();
    let (old, new) = saying.seen[..passes].split_at(marginal.since);
    let there = turn == Turn::Came;
    let was_known = saying.before.is_some_and(|before| before.stands != there);
    let told_before = was_known || tell(old, !there) >= LEAST_TELLING_OLD;
    (told_before && tell(new, there) >= LEAST_TELLING_NEW).then_some(turn)
}

/// The first pass from which on each turn has been believed.
fn noticed(sayings: &[Saying], turns: &[Option<Turn>], passes: usize) -> Vec<usize> {
    let mut noticed = vec![passes.saturating_sub(1); sayings.len()];
    let mut open: Vec<usize> = (0..turns.len()).filter(|knot| turns[*knot].is_some()).collect();
    for known in (1..passes).rev() {
        if open.is_empty() {
            break;
        }
        let marginals = marginals(sayings, known);
        open.retain(|knot| {
            let same = turn(&marginals[*knot], &sayings[*knot], known) == turns[*knot];
            if same {
                noticed[*knot] = known - 1;
            }
            same
        });
    }
    noticed
}

/// The histories of a number of passes: always, never, went before pass `t`, came before pass `t`, and the pairs.
struct Histories {
    passes: usize,
}

impl Histories {
    fn count(&self) -> usize {
        2 + 2 * self.passes + self.passes * self.passes.saturating_sub(1)
    }

    /// Prior probability of each.
    fn prior(&self) -> Vec<f64> {
        let changes = self.passes.max(1) as f64;
        let pairs = (changes * (changes - 1.0)).max(1.0);
        let unchanged = 0.5 * (1.0 - ONE_CHANGE - TWO_CHANGES);
        let mut prior = vec![unchanged; 2];
        prior.resize(2 + 2 * self.passes, 0.5 * ONE_CHANGE / changes);
        prior.resize(self.count(), TWO_CHANGES / pairs);
        prior
    }

    /// Likelihood of each for one knot, up to a factor, in the order: always, never, went, came, went and came, came and went.
    fn likelihoods(&self, saying: &Saying, of: &mut Vec<f64>) {
        let odds = &saying.odds;
        let all = odds[self.passes];
        // Of a knot that folded drives left: it was there (or not) until now, and may have changed since the last of them.
        let (was_there, was_not, changed) = match saying.before {
            None => (1.0, 1.0, 0.0),
            Some(before) if before.stands => (before.probability, 0.0, 1.0 - before.probability),
            Some(before) => (0.0, 1.0 - before.probability, before.probability),
        };
        let went_at = |t: usize| {
            if t > 0 {
                was_there
            } else if was_there > 0.0 {
                changed
            } else {
                0.0
            }
        };
        let came_at = |t: usize| {
            if t > 0 {
                was_not
            } else if was_not > 0.0 {
                changed
            } else {
                0.0
            }
        };
        of.clear();
        of.extend([was_there * all, was_not]);
        of.extend((0..self.passes).map(|t| went_at(t) * odds[t]));
        of.extend((0..self.passes).map(|t| came_at(t) * all / odds[t]));
        for first in 0..self.passes {
            let start = went_at(first) * odds[first] * all;
            of.extend((first + 1..self.passes).map(|second| start / odds[second]));
        }
        for first in 0..self.passes {
            let start = came_at(first) / odds[first];
            of.extend((first + 1..self.passes).map(|second| start * odds[second]));
        }
    }

    /// Sums up the probabilities of the histories of one knot.
    fn marginal(&self, probabilities: &[f64]) -> Marginal {
        let passes = self.passes;
        let (single, pairs) = probabilities.split_at(2 + 2 * passes);
        let (went_came, came_went) = pairs.split_at(pairs.len() / 2);
        let mut went = single[2..2 + passes].to_vec();
        let mut came = single[2 + passes..].to_vec();
        let mut at = 0;
        for first in 0..passes {
            for second in first + 1..passes {
                came[second] += went_came[at];
                went[second] += came_went[at];
                at += 1;
            }
        }
        let total: f64 = probabilities.iter().sum();
        let (all_came, all_went): (f64, f64) = (came.iter().sum(), went.iter().sum());
        let last = if all_came >= all_went { &came } else { &went };
        let since = (0..passes).max_by(|a, b| last[*a].total_cmp(&last[*b])).unwrap_or(0);
        Marginal { there: (single[0] + all_came) / total, came: all_came / total, went: all_went / total, since }
    }
}

/// Marginal probabilities of every knot after the first `passes` passes.
fn marginals(sayings: &[Saying], passes: usize) -> Vec<Marginal> {
    let histories = Histories { passes };
    let mut marginals = vec![Marginal::default(); sayings.len()];
    potts::marginals(
        sayings.len(),
        &histories.prior(),
        ANOTHER,
        |knot, of| histories.likelihoods(&sayings[knot], of),
        |knot, joint| marginals[knot] = histories.marginal(joint),
    );
    marginals
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::contribution::DriveId;

    /// What passes say of a line of so many knots, all alike: `+` seen, `-` missed, `.` nothing.
    fn after(knots: usize, passes: &str) -> Belief {
        let hearings: Vec<Hearing> = (0..)
            .zip(passes.chars())
            .filter(|(_, what)| *what != '.')
            .map(|(pass, what)| Hearing { pass, seen: what == '+', chance: 0.9, ghost: 0.03 })
            .collect();
        let speakers: Vec<Speaker> = (0..).take(passes.len()).map(|pass| (TimestampNs(pass), DriveId(0))).collect();
        let beliefs = histories(&vec![None; knots], &vec![hearings; knots], &speakers);
        beliefs[knots / 2]
    }

    #[test]
    fn one_drive_suffices_until_others_miss_what_it_saw() {
        assert!(after(10, "+").probability > 0.9);
        assert!(after(10, "+---").probability < 0.5);
        assert!(after(10, "++-+").probability > 0.9);
        assert_eq!(after(10, "+--------").change, None, "a ghost is no change");
    }

    #[test]
    fn a_line_of_60_m_that_goes_is_given_up_within_three_drives_and_one_that_comes_is_noticed_within_three() {
        let went = after(20, "++++++++++++++++---");
        assert!(matches!(went.change, Some((Turn::Went, (TimestampNs(..=18), _)))), "{went:?}");
        assert!(went.probability < 0.1);
        let came = after(20, "----------------+++");
        assert!(matches!(came.change, Some((Turn::Came, (TimestampNs(..=18), _)))), "{came:?}");
        assert_eq!(after(20, "++++++++").change, None);
    }

    #[test]
    fn drives_that_miss_a_line_now_and_then_or_a_short_stretch_of_it_take_nothing_away() {
        assert_eq!(after(20, "+++-++++-+++++-++-++").change, None);
        assert_eq!(after(3, "++++++++++++++---").change, None);
        assert!(after(20, "+++++++++-").probability > 0.5);
    }

    #[test]
    fn a_stretch_that_comes_and_goes_is_followed() {
        let gone = after(20, "-----++++++----");
        assert!(matches!(gone.change, Some((Turn::Went, (TimestampNs(11..=13), _)))), "{gone:?}");
        let back = after(20, "+++++------++++");
        assert!(matches!(back.change, Some((Turn::Came, (TimestampNs(11..=13), _)))), "{back:?}");
    }

    #[test]
    fn what_folded_drives_left_goes_on() {
        let there = Belief { probability: 0.98, stands: true, doubled: false, confirmed: None, change: None };
        let hearing = |pass| Hearing { pass, seen: false, chance: 0.9, ghost: 0.03 };
        let speakers: Vec<Speaker> = (0..3).map(|pass| (TimestampNs(100 + pass), DriveId(1))).collect();
        let beliefs = histories(&[Some(there); 20], &vec![(0..3).map(hearing).collect(); 20], &speakers);
        assert!(matches!(beliefs[10].change, Some((Turn::Went, (TimestampNs(101..=102), _)))), "{:?}", beliefs[10]);
        let untouched = histories(&[Some(there); 20], &vec![Vec::new(); 20], &[]);
        assert!((untouched[10].probability - 0.98).abs() < 1e-9 && untouched[10].change.is_none());
    }
}
