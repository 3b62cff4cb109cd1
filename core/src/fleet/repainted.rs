//! Repainted: where a line is painted otherwise than it was, and since which drive.
//!
//! As with existence ([`history`](super::history)), a knot has a history: it bears one category all the time, or another one from some
//! pass on. What a drive's map believes of the category of its lane is what that pass says, `L(c) = (1 - e) p(c) + w`, for a detector
//! takes one sort of paint for another all along a drive. Where a stretch was repainted, a drive's own map may run the lane before it
//! on over it: since a change from `a` to `b` a pass says `(1 - o) L(b) + o L(a)`. Of one knot it counts for a share of a sight;
//! neighbouring knots have mostly the same history ([`potts`]). A change is believed once a few passes told the old category, and
//! two, and a third of all since, the new one.
//!
//! A pass is asked only where most passes do not agree: of nearly all lines there is nothing to find out.
//!
//! Not guaranteed: a line that was repainted twice within the drives that are kept apart is told by the change that
//! explains most; and a stretch shorter than a drive's own map tells apart.

use serde::{Deserialize, Serialize};

use super::{fusion::Fusion, line::BASE, persistence::Speaker, potts, prepared::PreparedPass};
use crate::category::Category;

/// Probability that a drive has a wrong category all along, and that it is a certain one.
const CONFUSED: f64 = 0.1;
const WRONG: f64 = 0.03;
/// Probability that a drive's map has the paint before a repainted stretch on it, too.
const RUN_OVER: f64 = 0.3;
/// Share of a sight that one knot counts for.
const SHARE_OF_SIGHT: f64 = 0.125;
/// Probability that the history of the next knot is another.
const ANOTHER: f64 = 0.01;
/// Probability of a history with a change.
const CHANGED: f64 = 0.05;
/// Probability from which on a change is believed.
const BELIEVED: f64 = 0.8;
/// Passes that must tell the old category, and the new.
const LEAST_TELLING_OLD: usize = 3;
const LEAST_TELLING_NEW: usize = 2;
/// Categories of one line that are told apart, at most: those that most passes name.
const MOST_CATEGORIES: usize = 4;
/// Greatest belief in the category that folded drives left.
const FOLDED: f64 = 0.98;
const CATEGORIES: usize = Category::ALL.len();

/// What is believed of the paint of a knot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Paint {
    /// Its category now.
    pub(super) category: Category,
    /// Probability of that.
    probability: f64,
    /// How it came to be so.
    pub(super) change: Option<Repaint>,
}

/// A change of the category of a knot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Repaint {
    pub(super) from: Category,
    pub(super) to: Category,
    /// The drive that made it believed.
    pub(super) noticed: Speaker,
    pub(super) probability: f64,
}

/// What a pass says of the category of a knot.
#[derive(Clone, Debug)]
struct Naming {
    pass: u32,
    best: usize,
    /// Of each category.
    likelihoods: [f64; CATEGORIES],
}

impl Fusion<'_> {
    /// What is believed of the paint of each knot of each line.
    pub(super) fn paints(&self) -> Vec<Vec<Paint>> {
        let mut speakers: Vec<Speaker> = Vec::new();
        let mut passes: Vec<Option<&PreparedPass<'_>>> = Vec::new();
        for (drive, number, pass) in self.passes() {
            speakers.resize(number + 1, self.drives[drive].contribution.seniority());
            passes.resize(number + 1, None);
            passes[number] = Some(pass);
        }
        let of_line = self.lines.lines.iter().map(|line| {
            let names = line.knots.iter().map(|knot| {
                let apart = knot.witnesses.iter().filter(|witness| witness.pass != BASE);
                let mut names: Vec<Naming> = apart
                    .filter_map(|witness| {
                        let pass = passes.get(witness.pass).copied().flatten()?;
                        let lane = pass.lanes[witness.lane].lane;
                        Naming::new(witness.pass, lane.category_posterior_at(witness.parameter))
                    })
                    .collect();
                names.sort_unstable_by_key(|naming| naming.pass);
                names
            });
            let before: Vec<Option<Paint>> = line.knots.iter().map(|knot| knot.record.paint).collect();
            paints(&before, &names.collect::<Vec<_>>(), &speakers, Category::ALL[line.paint()])
        });
        of_line.collect()
    }
}

impl Naming {
    fn new(pass: usize, posterior: &[f64]) -> Option<Self> {
        let posterior: &[f64; CATEGORIES] = posterior.try_into().ok()?;
        let posterior = &either_way(posterior);
        let likelihoods = posterior.map(|own| (1.0 - CONFUSED) * own + WRONG);
        let best = (0..CATEGORIES).max_by(|a, b| posterior[*a].total_cmp(&posterior[*b]))?;
        Some(Self { pass: u32::try_from(pass).ok()?, best, likelihoods })
    }
}

/// A belief over categories as drives of both directions share it: what is left to the one is right to the other.
fn either_way(posterior: &[f64; CATEGORIES]) -> [f64; CATEGORIES] {
    use Category as C;
    const MIRRORED: [(Category, Category); 3] = [
        (C::RightCurb, C::LeftCurb),
        (C::WhiteLeftSolidRightDashed, C::WhiteLeftDashedRightSolid),
        (C::YellowLeftSolidRightDashed, C::YellowLeftDashedRightSolid),
    ];
    let mut posterior = *posterior;
    for (mirrored, kept) in MIRRORED {
        posterior[kept.index()] += std::mem::take(&mut posterior[mirrored.index()]);
    }
    posterior
}

/// What is believed of the paint of each knot of a line, whose witnesses together take it for `usual`.
fn paints(before: &[Option<Paint>], names: &[Vec<Naming>], speakers: &[Speaker], usual: Category) -> Vec<Paint> {
    let categories = disputed(before, names);
    if categories.len() < 2 {
        let only = categories.first().map_or(usual, |category| Category::ALL[*category]);
        let known = |paint: &Option<Paint>| Paint {
            category: only,
            probability: FOLDED,
            change: paint.and_then(|paint| paint.change),
        };
        return before.iter().map(known).collect();
    }
    let mut passes: Vec<u32> = names.iter().flatten().map(|naming| naming.pass).collect();
    passes.sort_unstable();
    passes.dedup();
    let disputes: Vec<Dispute<'_>> =
        before.iter().zip(names).map(|(before, names)| Dispute::new(*before, names, &passes, &categories)).collect();
    let now = verdicts(&disputes, categories.len(), passes.len());
    let changes: Vec<Option<(usize, usize)>> =
        now.iter().zip(&disputes).map(|(verdict, dispute)| dispute.believed(verdict, passes.len())).collect();
    let noticed = noticed(&disputes, &changes, categories.len(), passes.len());
    let each = now.iter().zip(&disputes).zip(&changes).zip(noticed);
    each.map(|(((verdict, dispute), change), noticed)| {
        let change = change.map(|(from, to)| Repaint {
            from: Category::ALL[categories[from]],
            to: Category::ALL[categories[to]],
            noticed: speakers[passes[noticed] as usize],
            probability: verdict.changed,
        });
        Paint {
            category: Category::ALL[categories[verdict.now]],
            probability: verdict.sure.min(FOLDED),
            change: change.or(dispute.before.and_then(|before| before.change)),
        }
    })
    .collect()
}

/// The categories that a knot's passes or those before them name, in their order: one, unless at some knot at least two passes
/// name another than the others do.
fn disputed(before: &[Option<Paint>], names: &[Vec<Naming>]) -> Vec<usize> {
    let mut most = [0_usize; CATEGORIES];
    let mut sums = [0_usize; CATEGORIES];
    for (before, names) in before.iter().zip(names) {
        let mut counts = [0_usize; CATEGORIES];
        if let Some(before) = before {
            counts[before.category.index()] += LEAST_TELLING_OLD;
        }
        for naming in names {
            counts[naming.best] += 1;
        }
        for category in 0..CATEGORIES {
            most[category] = most[category].max(counts[category]);
            sums[category] += counts[category];
        }
    }
    let mut named: Vec<usize> = (0..CATEGORIES).filter(|category| most[*category] >= LEAST_TELLING_NEW).collect();
    named.sort_by_key(|category| std::cmp::Reverse(sums[*category]));
    named.truncate(MOST_CATEGORIES);
    named.sort_unstable();
    named
}

/// What is said of one knot.
struct Dispute<'a> {
    before: Option<Paint>,
    names: &'a [Naming],
    /// Which of the categories is a curb's.
    curb: Option<usize>,
    /// Of each pass, which of the categories it names.
    best: Vec<Option<usize>>,
    /// Logarithm of the likelihood that folded drives leave each category.
    left: Vec<f64>,
    /// Of each category the logarithm of the likelihood of the first `m` passes.
    sums: Vec<Vec<f64>>,
    /// The same of each pair of categories, since one became the other.
    since: Vec<Vec<f64>>,
}

/// What follows of it.
#[derive(Clone, Copy, Debug, Default)]
struct Verdict {
    /// The most probable category now, and its probability.
    now: usize,
    sure: f64,
    /// Probability that it is so since a change, from which, and since which pass most likely.
    changed: f64,
    from: usize,
    since: usize,
}

impl<'a> Dispute<'a> {
    fn new(before: Option<Paint>, names: &'a [Naming], passes: &[u32], categories: &[usize]) -> Self {
        let mut best = vec![None; passes.len()];
        for naming in names {
            if let Ok(pass) = passes.binary_search(&naming.pass) {
                best[pass] = categories.iter().position(|category| *category == naming.best);
            }
        }
        let summed = |likelihood: &dyn Fn(&Naming) -> f64| {
            let mut sums = vec![0.0; passes.len() + 1];
            for naming in names {
                if let Ok(pass) = passes.binary_search(&naming.pass) {
                    sums[pass + 1] = SHARE_OF_SIGHT * likelihood(naming).ln();
                }
            }
            for pass in 0..passes.len() {
                sums[pass + 1] += sums[pass];
            }
            sums
        };
        let sums = categories.iter().map(|category| summed(&|naming| naming.likelihoods[*category]));
        let sums: Vec<Vec<f64>> = sums.collect();
        let since = pairs(categories.len()).map(|(from, to)| {
            let of = |naming: &Naming, category: usize| naming.likelihoods[categories[category]];
            summed(&|naming| (1.0 - RUN_OVER) * of(naming, to) + RUN_OVER * of(naming, from))
        });
        let since = since.collect();
        let left = categories.iter().map(|category| match before {
            None => 0.0,
            Some(before) if before.category.index() == *category => before.probability.max(0.5).ln(),
            Some(before) => ((1.0 - before.probability.max(0.5)) / categories.len() as f64).ln(),
        });
        let curb = categories.iter().position(|category| *category == Category::LeftCurb.index());
        Self { before, names, curb, best, left: left.collect(), sums, since }
    }

    /// Whether a curb would have become paint, or paint a curb, which it never is: a line and the curb beside it were taken
    /// for one.
    fn is_curb(&self, verdict: &Verdict) -> bool {
        [verdict.from, verdict.now].into_iter().any(|category| self.curb == Some(category))
    }

    /// The change that is believed after so many passes: from which category to which.
    fn believed(&self, verdict: &Verdict, passes: usize) -> Option<(usize, usize)> {
        let tell = |of: &[Option<usize>], category: usize| of.iter().filter(|best| **best == Some(category)).count();
        let (old, new) = self.best[..passes].split_at(verdict.since.min(passes));
        let told_before = self.left.len() > 1 && self.before.is_some() && self.left[verdict.from] > -1.0;
        let is_told = told_before || tell(old, verdict.from) >= LEAST_TELLING_OLD;
        let told_new = tell(new, verdict.now);
        let is_new = told_new >= LEAST_TELLING_NEW && 2 * told_new >= tell(new, verdict.from);
        (verdict.changed >= BELIEVED && !self.is_curb(verdict) && is_told && is_new && !self.names.is_empty())
            .then_some((verdict.from, verdict.now))
    }
}

/// The histories of so many categories and passes: each category all the time; then from one to another before pass `t`.
#[derive(Clone, Copy)]
struct Histories {
    categories: usize,
    passes: usize,
}

/// Ordered pairs of so many categories.
fn pairs(categories: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..categories).flat_map(move |from| (0..categories).filter(move |to| *to != from).map(move |to| (from, to)))
}

impl Histories {
    fn prior(self) -> Vec<f64> {
        let changes = (self.categories * (self.categories - 1) * self.passes).max(1) as f64;
        let mut prior = vec![(1.0 - CHANGED) / self.categories as f64; self.categories];
        prior.extend(pairs(self.categories).flat_map(|_| (0..self.passes).map(move |_| CHANGED / changes)));
        prior
    }

    fn likelihoods(self, dispute: &Dispute<'_>, of: &mut Vec<f64>) {
        of.clear();
        let all = |category: usize| dispute.sums[category][self.passes];
        of.extend((0..self.categories).map(|category| dispute.left[category] + all(category)));
        for ((from, _), since) in pairs(self.categories).zip(&dispute.since) {
            let before = &dispute.sums[from];
            of.extend((0..self.passes).map(|pass| {
                // Without drives before, a change before the first pass is none.
                let possible = pass > 0 || dispute.before.is_some();
                if possible {
                    dispute.left[from] + before[pass] + since[self.passes] - since[pass]
                } else {
                    f64::NEG_INFINITY
                }
            }));
        }
        let most = of.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        for log in of {
            *log = (*log - most).exp();
        }
    }

    fn verdict(self, probabilities: &[f64]) -> Verdict {
        let total: f64 = probabilities.iter().sum();
        let (constant, changed) = probabilities.split_at(self.categories);
        let mut now = constant.to_vec();
        let (mut best, mut verdict) = (0.0, Verdict::default());
        for ((from, to), of_pair) in pairs(self.categories).zip(changed.chunks(self.passes.max(1))) {
            let sum: f64 = of_pair.iter().sum();
            now[to] += sum;
            if sum > best {
                let since = (0..of_pair.len()).max_by(|a, b| of_pair[*a].total_cmp(&of_pair[*b])).unwrap_or(0);
                best = sum;
                verdict = Verdict { now: to, sure: 0.0, changed: sum / total, from, since };
            }
        }
        let likeliest = (0..self.categories).max_by(|a, b| now[*a].total_cmp(&now[*b])).unwrap_or(0);
        let changed = if likeliest == verdict.now { verdict.changed } else { 0.0 };
        Verdict { now: likeliest, sure: now[likeliest] / total, changed, ..verdict }
    }
}

/// What follows of what the first `passes` passes say.
fn verdicts(disputes: &[Dispute<'_>], categories: usize, passes: usize) -> Vec<Verdict> {
    let histories = Histories { categories, passes };
    let mut verdicts = vec![Verdict::default(); disputes.len()];
    potts::marginals(
        disputes.len(),
        &histories.prior(),
        ANOTHER,
        |knot, of| histories.likelihoods(&disputes[knot], of),
        |knot, joint| verdicts[knot] = histories.verdict(joint),
    );
    verdicts
}

/// The first pass from which on each change has been believed.
fn noticed(
    disputes: &[Dispute<'_>],
    changes: &[Option<(usize, usize)>],
    categories: usize,
    passes: usize,
) -> Vec<usize> {
    let mut noticed = vec![passes.saturating_sub(1); disputes.len()];
    let mut open: Vec<usize> = (0..changes.len()).filter(|knot| changes[*knot].is_some()).collect();
    for known in (1..passes).rev() {
        if open.is_empty() {
            break;
        }
        let verdicts = verdicts(disputes, categories, known);
        open.retain(|knot| {
            let same = disputes[*knot].believed(&verdicts[*knot], known) == changes[*knot];
            if same {
                noticed[*knot] = known - 1;
            }
            same
        });
    }
    noticed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{fleet::contribution::DriveId, frame::TimestampNs};

    const A: Category = Category::WhiteDashed;
    const B: Category = Category::WhiteSolid;

    fn naming(pass: usize, category: Category) -> Naming {
        let mut posterior = [0.0; CATEGORIES];
        posterior[category.index()] = 1.0;
        Naming::new(pass, &posterior).unwrap()
    }

    /// What passes say of a line of so many knots, of which those within `stretch` are told apart: `a`, `b`, or nothing.
    fn after(knots: usize, passes: &str, elsewhere: &str, stretch: std::ops::Range<usize>) -> Vec<Paint> {
        let said = |told: &str| -> Vec<Naming> {
            let named = told.chars().enumerate().filter(|(_, what)| *what != '.');
            named.map(|(pass, what)| naming(pass, if what == 'a' { A } else { B })).collect()
        };
        let names: Vec<Vec<Naming>> =
            (0..knots).map(|knot| said(if stretch.contains(&knot) { passes } else { elsewhere })).collect();
        let speakers: Vec<Speaker> = (0..).take(passes.len()).map(|pass| (TimestampNs(pass), DriveId(0))).collect();
        paints(&vec![None; knots], &names, &speakers, A)
    }

    #[test]
    fn a_line_that_is_another_category_since_two_drives_was_repainted() {
        let paints = after(20, "aaaaaabbb", "aaaaaabbb", 0..20);
        let change = paints[10].change.unwrap();
        assert_eq!((change.from, change.to, paints[10].category), (A, B, B));
        assert!(change.noticed.0 <= TimestampNs(8) && change.probability > 0.8, "{change:?}");
    }

    #[test]
    fn a_stretch_of_a_line_is_repainted_and_the_rest_is_not() {
        let paints = after(100, "aaaaaabbbb", "aaaaaaaaaa", 40..70);
        let changed: Vec<usize> = (0..100).filter(|knot| paints[*knot].change.is_some()).collect();
        assert!(changed.first().unwrap().abs_diff(40) <= 2 && changed.last().unwrap().abs_diff(69) <= 2, "{changed:?}");
        assert_eq!(paints[10].category, A);
    }

    #[test]
    fn drives_that_now_and_then_take_it_for_another_change_nothing() {
        for told in ["aabaaabaaaabaa", "aaaaaaaaaab", "bbaaaaaaaaa"] {
            let paints = after(40, told, told, 0..40);
            assert!(paints.iter().all(|paint| paint.change.is_none()), "{told}: {:?}", paints[20]);
        }
    }

    #[test]
    fn drives_that_run_the_old_paint_on_over_it_do_not_hide_a_repainted_stretch() {
        let paints = after(100, "aaaaaaaaabababbab", "aaaaaaaaaaaaaaaaa", 40..70);
        let change = paints[55].change.unwrap();
        assert_eq!((change.from, change.to, paints[10].change), (A, B, None));
    }

    #[test]
    fn a_curb_that_lies_left_of_some_drives_and_right_of_others_is_one() {
        let (left, right) = (Category::LeftCurb, Category::RightCurb);
        let names = |pass| naming(pass, if pass < 6 { left } else { right });
        let speakers: Vec<Speaker> = (0..).take(12).map(|pass| (TimestampNs(pass), DriveId(0))).collect();
        let told = paints(&[None; 20], &vec![(0..12).map(names).collect(); 20], &speakers, left);
        assert!(told.iter().all(|paint| paint.change.is_none()), "{:?}", told[10]);
    }

    #[test]
    fn what_folded_drives_left_is_the_old_category() {
        let left = Paint { category: A, probability: 0.98, change: None };
        let names: Vec<Vec<Naming>> = vec![(0..3).map(|pass| naming(pass, B)).collect(); 20];
        let speakers: Vec<Speaker> = (0..3).map(|pass| (TimestampNs(100 + pass), DriveId(1))).collect();
        let told = paints(&[Some(left); 20], &names, &speakers, A);
        assert!(matches!(told[10].change, Some(Repaint { from: A, to: B, .. })), "{:?}", told[10]);
        let again = paints(&told.iter().copied().map(Some).collect::<Vec<_>>(), &vec![Vec::new(); 20], &[], B);
        assert_eq!(again[10].change, told[10].change, "it is remembered");
    }
}
