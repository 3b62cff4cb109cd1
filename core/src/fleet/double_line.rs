//! Double lines: two lines so near each other that a drive's lane could be either, of which drives have both at once.
//!
//! Two lines are two, and not one that a drive has twice, where [`LEAST_WITH_BOTH`] passes have a lane on each of them. What a
//! pass has of one of them then says nothing of the other: that it has one alone is a miss of the other one.
//!
//! Which of the two it is that a pass has alone is hard to say of one pass: they lie as near each other as a drive lies true.
//! But where one of them went, or had not come yet, all passes have the same one. So passes that have one alone, one after
//! the other in the order of time, become witnesses of the one beside which their mean lies.
//!
//! Not guaranteed: that a double line is known for one of which only folded drives had both, or fewer than so many passes.

use std::{collections::BTreeMap, ops::Range};

use super::{
    fusion::Fusion,
    line::{BASE, Knot, Line, Lines, Witness},
    prepared::normal_of,
};

/// Passes that must have both.
const LEAST_WITH_BOTH: usize = 3;
/// Least and greatest distance across of the two, metres: what a drive has twice lies nearer itself.
const ACROSS_M: Range<f64> = 0.12..0.8;
/// Farthest distance along of knots at the same place, metres.
const ALONG_M: f64 = 2.6;
/// Farthest distance in height, metres.
const HEIGHT_M: f64 = 3.0;
/// Knots to each side of one that tell of it.
const AROUND_KNOTS: usize = 10;
/// Passes that have one alone, one after the other, that are taken together.
const LEAST_ALONE: usize = 2;
/// Farthest that a pass counts to one side of the middle between the two, metres.
const MOST_ASIDE_M: f64 = 0.4;

/// Two lines that run beside each other: knots of the first, in their order, each with that of the second there.
struct Pair {
    lines: [usize; 2],
    knots: Vec<[usize; 2]>,
}

/// Which lines make a double line with each knot of each line.
pub(super) struct DoubleLines {
    /// Each with its nearest knot.
    partners: Vec<Vec<Vec<(usize, usize)>>>,
}

/// A line beside a knot.
struct Beside {
    line: usize,
    /// Its nearest knot.
    knot: usize,
    /// Passes that have both.
    with_both: usize,
}

impl DoubleLines {
    /// Those of a map.
    pub(super) fn of(lines: &Lines) -> Self {
        Self { partners: (0..lines.lines.len()).map(|line| partners(lines, line)).collect() }
    }

    /// Whether a knot is of a double line.
    pub(super) fn contain(&self, line: usize, knot: usize) -> bool {
        !self.partners[line][knot].is_empty()
    }

    /// Whether another line makes a double line with a knot.
    pub(super) fn are_two(&self, line: usize, knot: usize, other: usize) -> bool {
        self.partners[line][knot].iter().any(|(partner, _)| *partner == other)
    }

    /// Each of them once, in the order of the lines.
    fn pairs(&self) -> Vec<Pair> {
        let mut pairs: BTreeMap<[usize; 2], Vec<[usize; 2]>> = BTreeMap::new();
        for (line, knots) in self.partners.iter().enumerate() {
            for (knot, partners) in knots.iter().enumerate() {
                for (other, at) in partners.iter().filter(|(other, _)| *other > line) {
                    pairs.entry([line, *other]).or_default().push([knot, *at]);
                }
            }
        }
        pairs.into_iter().map(|(lines, knots)| Pair { lines, knots }).collect()
    }
}

/// Of each knot of a line, the lines beside it that passes have besides it, there or at the knots around.
fn partners(lines: &Lines, line: usize) -> Vec<Vec<(usize, usize)>> {
    let beside: Vec<Vec<Beside>> = (0..lines.lines[line].points.len()).map(|knot| beside(lines, line, knot)).collect();
    let of_knot = |(knot, at): (usize, &Vec<Beside>)| {
        let around = &beside[knot.saturating_sub(AROUND_KNOTS)..(knot + AROUND_KNOTS + 1).min(beside.len())];
        let are_two = |other: &&Beside| {
            let same = around.iter().flatten().filter(|around| around.line == other.line);
            same.map(|around| around.with_both).max() >= Some(LEAST_WITH_BOTH)
        };
        at.iter().filter(are_two).map(|other| (other.line, other.knot)).collect()
    };
    beside.iter().enumerate().map(of_knot).collect()
}

/// The lines beside a knot.
fn beside(lines: &Lines, line: usize, knot: usize) -> Vec<Beside> {
    let of: &Line = &lines.lines[line];
    let (place, tangent) = (of.points[knot], of.tangent(knot));
    let normal = normal_of(&tangent);
    let mut nearest: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
    lines.for_each_knot_near(&place, ACROSS_M.end.hypot(ALONG_M), |other, at, there| {
        let offset = there - place;
        let (along_m, across_m) = (offset.dot(&tangent).abs(), offset.xy().dot(&normal).abs());
        let is_there = along_m <= ALONG_M && ACROSS_M.contains(&across_m) && offset.z.abs() < HEIGHT_M;
        if other != line && is_there {
            let best = nearest.entry(other).or_insert((along_m, at));
            if along_m < best.0 {
                *best = (along_m, at);
            }
        }
    });
    let with_both = |other: usize, at: usize| with_both(&of.knots[knot], &lines.lines[other].knots[at]);
    let beside = |(line, (_, knot)): (usize, (f64, usize))| Beside { line, knot, with_both: with_both(line, knot) };
    nearest.into_iter().map(beside).collect()
}

/// Passes that have both. Folded drives do not tell: a line that some of them had twice is in the base as two.
fn with_both(one: &Knot, other: &Knot) -> usize {
    one.witnesses.iter().filter(|witness| witness.pass != BASE && has(other, witness.pass)).count()
}

fn has(knot: &Knot, pass: usize) -> bool {
    knot.witnesses.iter().any(|witness| witness.pass == pass)
}

/// What a pass has of the two.
#[derive(Clone, Copy, Debug, Default)]
struct Sight {
    /// Knots at which it has both.
    both: u32,
    /// Knots at which it has one alone.
    alone: u32,
    /// Sum over these of how far it lies from the middle between the two, towards the second, metres.
    aside_m: f64,
}

impl Sight {
    fn is_alone(&self) -> bool {
        self.alone > self.both
    }
}

/// What passes have of the two at one place, in the order of time.
type Sights = BTreeMap<usize, Sight>;

impl Fusion<'_> {
    /// Makes passes that have one of a double line alone, one after the other, witnesses of the same one.
    pub(super) fn gather_lone_sightings(&mut self) {
        for pair in DoubleLines::of(&self.lines).pairs() {
            let sights: Vec<Sights> = pair.knots.iter().map(|at| sights(&self.lines, pair.lines, *at)).collect();
            for (index, at) in pair.knots.iter().enumerate() {
                for (pass, to) in lone(&sights, &pair.knots, index) {
                    let (from, to) = ((pair.lines[1 - to], at[1 - to]), (pair.lines[to], at[to]));
                    move_witness(&mut self.lines, pass, from, to);
                }
            }
            for line in pair.lines {
                self.lines.lines[line].settle(self.params);
            }
        }
    }
}

/// Makes a witness of one knot, if it is one, a witness of another.
fn move_witness(lines: &mut Lines, pass: usize, from: (usize, usize), to: (usize, usize)) {
    let witnesses = &mut lines.lines[from.0].knots[from.1].witnesses;
    if let Some(at) = witnesses.iter().position(|witness| witness.pass == pass) {
        let witness = witnesses.remove(at);
        lines.lines[to.0].testify(to.1, witness);
    }
}

/// What each pass has of two lines at a knot of each.
fn sights(lines: &Lines, of: [usize; 2], at: [usize; 2]) -> Sights {
    let [one, other] = [0, 1].map(|side| &lines.lines[of[side]].knots[at[side]]);
    let place = lines.lines[of[0]].points[at[0]];
    let normal = normal_of(&lines.lines[of[0]].tangent(at[0]));
    let across_m = (lines.lines[of[1]].points[at[1]] - place).xy().dot(&normal);
    let aside_m = |witness: &Witness| {
        let from_middle_m = (witness.shared - place).xy().dot(&normal) - 0.5 * across_m;
        (from_middle_m * across_m.signum()).clamp(-MOST_ASIDE_M, MOST_ASIDE_M)
    };
    let mut sights = Sights::new();
    for (own, beside) in [(one, other), (other, one)] {
        for witness in own.witnesses.iter().filter(|witness| witness.pass != BASE) {
            let sight = sights.entry(witness.pass).or_default();
            if has(beside, witness.pass) {
                sight.both += 1;
            } else {
                sight.alone += 1;
                sight.aside_m += aside_m(witness);
            }
        }
    }
    sights
}

/// The passes that have one of the two alone at a knot, before or after others that do, each with which it is: 0 or 1.
fn lone(sights: &[Sights], knots: &[[usize; 2]], index: usize) -> Vec<(usize, usize)> {
    let here = knots[index][0];
    let from = knots.partition_point(|[knot, _]| knot + AROUND_KNOTS < here);
    let to = knots.partition_point(|[knot, _]| *knot <= here + AROUND_KNOTS);
    let mut around = Sights::new();
    for (pass, sight) in sights[from..to].iter().flatten().filter(|(pass, _)| sights[index].contains_key(pass)) {
        let sum = around.entry(*pass).or_default();
        sum.both += sight.both;
        sum.alone += sight.alone;
        sum.aside_m += sight.aside_m;
    }
    let passes: Vec<(usize, Sight)> = around.into_iter().collect();
    let runs = passes.chunk_by(|(_, one), (_, other)| one.is_alone() == other.is_alone());
    let alone = runs.filter(|run| run.len() >= LEAST_ALONE && run[0].1.is_alone()).flat_map(|run| {
        let aside_m: f64 = run.iter().map(|(_, sight)| sight.aside_m / f64::from(sight.alone)).sum();
        run.iter().map(move |(pass, _)| (*pass, usize::from(aside_m > 0.0)))
    });
    alone.filter(|(pass, _)| sights[index].get(pass).is_some_and(|sight| sight.both == 0)).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::{
        fleet::{DriveId, FusedLaneId},
        frame::TimestampNs,
        lane_map::LaneId,
    };

    /// A line of thirty knots to the east, `north_m` of the origin, of which passes have a lane so far north of it.
    fn line(number: u64, north_m: f64, passes: &[(usize, f64)]) -> Line {
        let id = FusedLaneId { started: TimestampNs(0), drive: DriveId(number), lane: LaneId(1), piece: 0, stretch: 0 };
        let mut line = Line::new(id);
        for knot in 0..30_i32 {
            let place = Point3::new(3.0 * f64::from(knot), north_m, 0.0);
            let witness = |(pass, off_m): &(usize, f64)| Witness {
                drive: *pass,
                pass: *pass,
                lane: 0,
                parameter: f64::from(knot),
                map: place,
                arc_m: place.x,
                shared: place + nalgebra::Vector3::y() * *off_m,
                lateral_variance_m2: 0.01,
                height_variance_m2: 0.01,
                share: 1.0,
            };
            line.push(place, Knot { witnesses: passes.iter().map(witness).collect(), ..Knot::default() });
        }
        line
    }

    fn lines(of: Vec<Line>) -> Lines {
        let mut lines = Lines::default();
        lines.lines = of;
        lines.index();
        lines
    }

    fn seen_by(passes: &[usize]) -> Vec<(usize, f64)> {
        passes.iter().map(|pass| (*pass, 0.0)).collect()
    }

    #[test]
    fn lines_of_which_three_passes_have_both_are_two_and_others_are_not() {
        let are_two = |apart_m: f64, one: &[usize], other: &[usize]| {
            let lines = lines(vec![line(1, 0.0, &seen_by(one)), line(2, apart_m, &seen_by(other))]);
            let double_lines = DoubleLines::of(&lines);
            assert_eq!(double_lines.contain(0, 15), double_lines.are_two(0, 15, 1));
            assert_eq!(double_lines.are_two(0, 15, 1), double_lines.are_two(1, 15, 0));
            double_lines.are_two(0, 15, 1)
        };
        assert!(are_two(0.25, &[0, 1, 2, 3], &[1, 2, 3, 4]));
        assert!(!are_two(0.25, &[0, 1, 2, 3], &[2, 3, 4, 5]), "two passes have both");
        assert!(!are_two(0.05, &[0, 1, 2, 3], &[0, 1, 2, 3]), "passes have one line twice");
        assert!(!are_two(0.25, &[0, BASE], &[1, BASE]), "what was folded does not tell");
    }

    /// Which of two lines 0.3 m apart each pass is given that has one alone, in the middle of them.
    fn given(one: &[(usize, f64)], other: &[(usize, f64)]) -> Vec<(usize, usize)> {
        let lines = lines(vec![line(1, 0.0, one), line(2, 0.3, other)]);
        let pairs = DoubleLines::of(&lines).pairs();
        let [pair] = pairs.as_slice() else { panic!("{} pairs", pairs.len()) };
        let sights: Vec<Sights> = pair.knots.iter().map(|at| sights(&lines, pair.lines, *at)).collect();
        lone(&sights, &pair.knots, 15)
    }

    #[test]
    fn passes_since_one_went_are_given_the_one_beside_which_their_mean_lies() {
        let both = seen_by(&[0, 1, 2]);
        // Where 3 to 6 have it: 0.04, 0.10, 0.02 m off the first, and 0.08 m off the second, all of them north of the first.
        let one = [both.as_slice(), &[(3, 0.04), (4, 0.1), (6, 0.02)]].concat();
        let other = [both.as_slice(), &[(5, -0.08)]].concat();
        assert_eq!(given(&one, &other), [(3, 0), (4, 0), (5, 0), (6, 0)]);
    }

    #[test]
    fn a_pass_that_has_one_alone_between_others_that_have_both_stays_where_it_is() {
        let (one, other) = (seen_by(&[0, 1, 2, 4]), seen_by(&[0, 1, 2, 3, 4]));
        assert_eq!(given(&one, &other), []);
    }
}
