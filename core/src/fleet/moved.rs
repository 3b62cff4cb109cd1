//! Moves: a line that was painted anew, up to a metre and a half from where it was.
//!
//! Where the new line lies within the gate of matching, drives are witnesses of the old line still, off by the same all of them; where it
//! lies farther off, they began a line of their own beside the old one, of which no drive has both. At each knot the passes say, in
//! the order of time, where the paint lies across, whichever of the two lines they are witnesses of: each by its mean over a window
//! along the line. They are split into those before and those since such that the least is left to errors: the sum of absolute
//! deviations from the two medians `m_a`, `m_b`. That it moved is by
//!
//! `sum_a l(x - m_a) + sum_b l(x - m_b) - sum l(x - m)`, `l(r) = ln((1 - e) N(r; s) + e / w)`,
//!
//! likelier than that it did not, with `s` from the median of absolute deviations, and `e` the share of passes that are wrong, anywhere within
//! `w`. It moved if that is large over a stretch; the stretch goes on, as far as the same split still tells, to where the
//! line leaves its old course. The witnesses since then become witnesses of the line beside it, or of one of their own, which came; the old one went.
//!
//! Where a line runs already that passes have besides the old one, nothing moved: drives that see the two as one are taken for
//! witnesses of either.
//!
//! Not guaranteed: moves by less than [`LEAST_MOVE_M`], which drives hardly tell from their own errors.

use std::{collections::BTreeMap, ops::Range};

use super::{
    fusion::Fusion,
    growth::Pieces,
    line::{BASE, FusedLaneId, Knot, Line, Lines, Witness},
    prepared::normal_of,
};

/// Least distance of a move, metres.
const LEAST_MOVE_M: f64 = 0.35;
/// The same at the ends of a stretch that moved, where the line leaves its old course, metres.
const LEAST_MOVE_AT_END_M: f64 = 0.25;
/// Least log-likelihood ratio of a move, and of its going on at the next knot.
const LEAST_RATIO: f64 = 10.0;
const LEAST_RATIO_AT_END: f64 = 3.0;
/// Least standard deviation of where a pass has a line, metres.
const LEAST_SCATTER_M: f64 = 0.1;
/// Share of passes that have a line somewhere else, and within which width, metres.
const WRONG: f64 = 0.05;
const WRONG_WITHIN_M: f64 = 3.0;
/// Passes before and since a move.
const LEAST_BEFORE: usize = 4;
const LEAST_SINCE: usize = 3;
/// Knots to each side that are looked at together.
const AROUND_KNOTS: usize = 3;
/// Least number of knots that moved.
const LEAST_KNOTS: usize = 8;
/// Knots of a stretch that moved that need not tell of it.
const BRIDGED_KNOTS: usize = 2;
/// Farthest distance across of a line that may be the same paint anew, metres.
const BESIDE_M: f64 = 1.6;
/// Farthest distance along of its knot that is at the same place, metres.
const SAME_KNOT_M: f64 = 2.0;
/// Greatest share of knots at which passes have both of two lines that are the same paint anew.
const MOST_WITH_BOTH: f64 = 0.1;

/// A knot whose passes agree that it moved.
#[derive(Clone, Copy, Debug)]
struct Step {
    /// The first pass that has it where it is now.
    since: usize,
    /// To the left of the line, metres.
    left_m: f64,
}

/// A stretch of a line that moved.
#[derive(Clone, Debug)]
struct Move {
    knots: Range<usize>,
    /// The first pass that has it where it is now.
    since: usize,
    /// Of each of its knots, to the left of the line, metres.
    left_m: Vec<f64>,
}

/// Where passes have the paint of a knot, in the order of time: pass and offset to the left, metres.
type Offsets = Vec<(usize, f64)>;

impl Fusion<'_> {
    /// Makes lines of their own of stretches that moved.
    pub(super) fn part_moved(&mut self, pieces: &mut Pieces) {
        let found = (0..self.lines.lines.len()).map(|old| {
            let beside = beside(&self.lines, old);
            let mut moves = moves(&offsets(&self.lines, old, &beside));
            moves.retain(|moved| !is_onto_its_neighbour(&self.lines, old, moved));
            (old, moves, beside)
        });
        for (old, moves, beside) in found.collect::<Vec<_>>() {
            for moved in moves {
                self.part(old, &moved, &beside, pieces);
            }
        }
    }

    /// Parts one stretch from its line.
    fn part(&mut self, old: usize, moved: &Move, beside: &[Beside], pieces: &mut Pieces) {
        let line = &mut self.lines.lines[old];
        let mut parted = Vec::new();
        for (knot, left_m) in moved.knots.clone().zip(&moved.left_m) {
            let normal = normal_of(&line.tangent(knot));
            let mut place = line.points[knot];
            place.x += normal.x * left_m;
            place.y += normal.y * left_m;
            let (later, before): (Vec<Witness>, Vec<Witness>) = std::mem::take(&mut line.knots[knot].witnesses)
                .into_iter()
                .partition(|witness| witness.pass != BASE && witness.pass >= moved.since);
            line.knots[knot].witnesses = before;
            parted.push((knot, place, later));
        }
        line.settle(self.params);
        let near = |beside: &&Beside| beside.knots.iter().any(|(knot, _)| moved.knots.contains(knot));
        let anew: Vec<&Beside> = beside.iter().filter(near).collect();
        if anew.is_empty() {
            let knots = parted.into_iter().map(|(_, place, witnesses)| (place, Knot { witnesses, ..Knot::default() }));
            self.add_moved(old, knots.collect(), pieces);
        } else {
            for beside in &anew {
                self.lines.lines[beside.line].moved_from.insert(old);
            }
            for (knot, place, witnesses) in parted {
                let nearest = anew.iter().min_by_key(|beside| beside.knots_from(knot));
                if let Some(beside) = nearest.filter(|_| !witnesses.is_empty()) {
                    give(&mut self.lines.lines[beside.line], place, witnesses);
                }
            }
            for beside in anew {
                self.lines.lines[beside.line].settle(self.params);
            }
        }
    }

    fn add_moved(&mut self, from: usize, moved: Vec<(nalgebra::Point3<f64>, Knot)>, pieces: &mut Pieces) {
        let witnesses = moved.iter().flat_map(|(_, knot)| &knot.witnesses);
        let Some(oldest) = witnesses.min_by_key(|witness| (witness.pass, witness.lane)).copied() else { return };
        let Some((_, _, pass)) = self.passes().find(|(_, number, _)| *number == oldest.pass) else { return };
        let contribution = self.drives[oldest.drive].contribution;
        let lane = pass.lanes[oldest.lane].lane.id;
        let piece = pieces.entry((oldest.drive, lane)).or_insert(0);
        let id =
            FusedLaneId { started: contribution.started, drive: contribution.drive, lane, piece: *piece, stretch: 0 };
        *piece += 1;
        let mut line = Line::new(id);
        line.moved_from.insert(from);
        let votes = self.lines.lines[from].posterior().to_vec();
        line.vote(&votes, moved.len() as f64 * self.params.line_knot_m);
        for (place, knot) in moved {
            line.push(place, knot);
        }
        line.settle(self.params);
        self.lines.lines.push(line);
    }
}

/// A younger line that runs beside another, and may be the same paint anew.
struct Beside {
    line: usize,
    /// Knots of the older line, in their order, each with that of this one there.
    knots: Vec<(usize, usize)>,
}

impl Beside {
    /// How many knots of the older line this one lies from one of them.
    fn knots_from(&self, knot: usize) -> usize {
        self.knots.iter().map(|(own, _)| own.abs_diff(knot)).min().unwrap_or(usize::MAX)
    }
}

/// The younger lines beside a line that no pass has besides it.
fn beside(lines: &Lines, old: usize) -> Vec<Beside> {
    let line = &lines.lines[old];
    let first = first_pass(line);
    let mut found: BTreeMap<usize, Vec<(usize, usize)>> = BTreeMap::new();
    for (knot, place) in line.points.iter().enumerate() {
        let tangent = line.tangent(knot);
        let normal = normal_of(&tangent);
        let mut nearest: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
        lines.for_each_knot_near(place, BESIDE_M.hypot(SAME_KNOT_M), |other, at, there| {
            let offset = there - place;
            let along_m = offset.dot(&tangent).abs();
            let is_there = along_m <= SAME_KNOT_M && offset.xy().dot(&normal).abs() <= BESIDE_M && offset.z.abs() < 3.0;
            if other != old && is_there {
                let best = nearest.entry(other).or_insert((along_m, at));
                if along_m < best.0 {
                    *best = (along_m, at);
                }
            }
        });
        for (other, (_, at)) in nearest {
            found.entry(other).or_default().push((knot, at));
        }
    }
    let younger = found.into_iter().filter(|(other, _)| first_pass(&lines.lines[*other]) > first);
    let beside = younger.map(|(line, knots)| Beside { line, knots });
    beside.filter(|beside| !are_two(line, &lines.lines[beside.line], &beside.knots)).collect()
}

/// The first pass that saw a line; folded drives come before all.
fn first_pass(line: &Line) -> Option<usize> {
    line.knots.iter().flat_map(|knot| &knot.witnesses).map(|witness| order(witness.pass)).min()
}

/// Whether passes have two lines at once.
fn are_two(a: &Line, b: &Line, knots: &[(usize, usize)]) -> bool {
    let (mut both, mut either) = (0_usize, 0_usize);
    for (at_a, at_b) in knots {
        let (of_a, of_b) = (&a.knots[*at_a].witnesses, &b.knots[*at_b].witnesses);
        let with_both = of_b.iter().filter(|own| of_a.iter().any(|other| other.pass == own.pass)).count();
        both += with_both;
        either += of_b.len();
    }
    both as f64 > MOST_WITH_BOTH * either as f64
}

/// Whether a stretch seems to have moved to where a line runs that passes have besides it: some take the one for the other.
fn is_onto_its_neighbour(lines: &Lines, old: usize, moved: &Move) -> bool {
    let line = &lines.lines[old];
    let lies_on_one = |(knot, left_m): (usize, &f64)| {
        let tangent = line.tangent(knot);
        let normal = normal_of(&tangent);
        let place = line.points[knot];
        let mut found = false;
        lines.for_each_knot_near(&place, BESIDE_M.hypot(SAME_KNOT_M), |other, at, there| {
            let offset = there - place;
            let is_there = offset.dot(&tangent).abs() <= SAME_KNOT_M
                && (offset.xy().dot(&normal) - left_m).abs() <= LEAST_MOVE_M
                && offset.z.abs() < 3.0;
            if !found && other != old && is_there {
                found = are_two(line, &lines.lines[other], &[(knot, at)]);
            }
        });
        found
    };
    let onto = moved.knots.clone().zip(&moved.left_m).filter(|pair| lies_on_one(*pair)).count();
    2 * onto > moved.knots.len()
}

/// Gives a line witnesses of a place on it or beyond its ends.
fn give(line: &mut Line, place: nalgebra::Point3<f64>, witnesses: Vec<Witness>) {
    let distance = |at: &nalgebra::Point3<f64>| (at - place).xy().norm();
    let nearest =
        (0..line.points.len()).min_by(|a, b| distance(&line.points[*a]).total_cmp(&distance(&line.points[*b])));
    let Some(knot) = nearest else { return };
    let ahead_m = (place - line.points[knot]).dot(&line.tangent(knot));
    let knots = line.points.len();
    if knot + 1 == knots && ahead_m > SAME_KNOT_M {
        line.push(place, Knot { witnesses, ..Knot::default() });
    } else if knot == 0 && ahead_m < -SAME_KNOT_M {
        line.push_front(place, Knot { witnesses, ..Knot::default() });
    } else {
        for witness in witnesses {
            line.testify(knot, witness);
        }
    }
}

/// Of each knot of a line, where passes have its paint, each by its mean over a window along the line.
fn offsets(lines: &Lines, old: usize, beside: &[Beside]) -> Vec<Offsets> {
    let line = &lines.lines[old];
    let mut single: Vec<Offsets> = (0..line.points.len())
        .map(|knot| {
            let normal = normal_of(&line.tangent(knot));
            let witnesses = line.knots[knot].witnesses.iter().filter(|witness| witness.share > 0.5);
            let offset = |witness: &Witness| (witness.shared - line.points[knot]).xy().dot(&normal);
            witnesses.map(|witness| (order(witness.pass), offset(witness))).collect()
        })
        .collect();
    for (anew, (knot, at)) in beside.iter().flat_map(|beside| beside.knots.iter().map(move |pair| (beside.line, pair)))
    {
        let normal = normal_of(&line.tangent(*knot));
        for witness in lines.lines[anew].knots[*at].witnesses.iter().filter(|witness| witness.share > 0.5) {
            let has_own = line.knots[*knot].witnesses.iter().any(|own| own.pass == witness.pass);
            if !has_own {
                single[*knot].push((order(witness.pass), (witness.shared - line.points[*knot]).xy().dot(&normal)));
            }
        }
    }
    (0..single.len())
        .map(|knot| {
            let window = knot.saturating_sub(AROUND_KNOTS)..(knot + AROUND_KNOTS + 1).min(single.len());
            let mut sums: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
            for (pass, offset) in single[window].iter().flatten() {
                let (sum, count) = sums.entry(*pass).or_default();
                *sum += offset;
                *count += 1.0;
            }
            sums.into_iter().map(|(pass, (sum, count))| (pass, sum / count)).collect()
        })
        .collect()
}

/// Folded drives come before all others.
fn order(pass: usize) -> usize {
    if pass == BASE { 0 } else { pass + 1 }
}

/// The stretches of a line that moved.
fn moves(offsets: &[Offsets]) -> Vec<Move> {
    let steps: Vec<(usize, Step)> = (0..).zip(offsets).filter_map(|(knot, at)| Some((knot, step(at)?))).collect();
    let runs = steps.chunk_by(|(a_knot, a), (b_knot, b)| b_knot - a_knot <= BRIDGED_KNOTS + 1 && goes_on(*a, *b));
    let mut moves: Vec<Move> = Vec::new();
    for run in runs.filter(|run| run.len() >= LEAST_KNOTS) {
        let mut passes: Vec<usize> = run.iter().map(|(_, step)| step.since).collect();
        passes.sort_unstable();
        let (since, left_m) = (passes[passes.len() / 2], run[run.len() / 2].1.left_m);
        let goes_on = |knot: &usize| continued(&offsets[*knot], since).is_some_and(|own_m| own_m * left_m > 0.0);
        let free = moves.last().map_or(0, |before| before.knots.end);
        let first = (free..run[0].0).rev().take_while(goes_on).last().unwrap_or(run[0].0);
        let last = run[run.len() - 1].0;
        let last = (last + 1..offsets.len()).take_while(goes_on).last().unwrap_or(last);
        let mut at_knot = left_m;
        let left_m = (first..=last).map(|knot| {
            at_knot = medians(&offsets[knot], since).map_or(at_knot, |(from_m, to_m)| to_m - from_m);
            at_knot
        });
        moves.push(Move { left_m: left_m.collect(), knots: first..last + 1, since });
    }
    moves
}

/// Whether a move at one knot is that at the next.
fn goes_on(a: Step, b: Step) -> bool {
    a.left_m * b.left_m > 0.0 && a.since.abs_diff(b.since) <= 2
}

/// The move that the offsets of passes tell, in the order of time.
fn step(passes: &[(usize, f64)]) -> Option<Step> {
    let means = |split: usize| {
        let mean = |part: &[(usize, f64)]| part.iter().map(|(_, offset)| offset).sum::<f64>() / part.len() as f64;
        let (before, since) = passes.split_at(split);
        mean(since) - mean(before)
    };
    // The base stands for many.
    let least_before = if passes.first().is_some_and(|(order, _)| *order == 0) { 1 } else { LEAST_BEFORE };
    let splits = least_before..(passes.len() + 1).saturating_sub(LEAST_SINCE);
    // Most knots have no split worth a median.
    let splits = splits.filter(|split| means(*split).abs() > 0.7 * LEAST_MOVE_M);
    // The likeliest split is that which leaves least to errors.
    let split = splits.min_by(|a, b| {
        let left = |split: usize| Parted::at(passes, split).apart.iter().sum::<f64>();
        left(*a).total_cmp(&left(*b))
    })?;
    let parted = Parted::at(passes, split);
    let clear = parted.by_m().abs() >= LEAST_MOVE_M && parted.ratio(passes) >= LEAST_RATIO;
    clear.then(|| Step { since: passes[split].0 - 1, left_m: parted.by_m() })
}

/// By how much a knot moved at a pass, if it did.
fn continued(passes: &[(usize, f64)], since: usize) -> Option<f64> {
    let split = passes.partition_point(|(order, _)| *order <= since);
    if split == 0 || split == passes.len() {
        return None;
    }
    let parted = Parted::at(passes, split);
    let clear = parted.by_m().abs() >= LEAST_MOVE_AT_END_M && parted.ratio(passes) >= LEAST_RATIO_AT_END;
    clear.then(|| parted.by_m())
}

/// Where passes have a knot before a pass, and since.
fn medians(passes: &[(usize, f64)], since: usize) -> Option<(f64, f64)> {
    let split = passes.partition_point(|(order, _)| *order <= since);
    let parted = (split > 0 && split < passes.len()).then(|| Parted::at(passes, split))?;
    Some((parted.from_m, parted.to_m))
}

/// Passes parted into those before and those since.
struct Parted {
    from_m: f64,
    to_m: f64,
    /// How far each pass lies from the median of its part, metres.
    apart: Vec<f64>,
}

impl Parted {
    fn at(passes: &[(usize, f64)], split: usize) -> Self {
        let of = |part: &[(usize, f64)]| median(&mut part.iter().map(|(_, offset)| *offset).collect::<Vec<_>>());
        let (before, since) = passes.split_at(split);
        let (from_m, to_m) = (of(before), of(since));
        let apart = before.iter().map(|(_, offset)| (offset - from_m).abs());
        let apart = apart.chain(since.iter().map(|(_, offset)| (offset - to_m).abs()));
        Self { from_m, to_m, apart: apart.collect() }
    }

    /// How far it moved, metres.
    fn by_m(&self) -> f64 {
        self.to_m - self.from_m
    }

    /// Log-likelihood ratio of a move and none.
    fn ratio(&self, passes: &[(usize, f64)]) -> f64 {
        let scatter_m = (1.4826 * median(&mut self.apart.clone())).max(LEAST_SCATTER_M);
        let all_m = median(&mut passes.iter().map(|(_, offset)| *offset).collect::<Vec<_>>());
        let unmoved =
            |at_m: f64| passes.iter().map(|(_, offset)| log_likelihood(offset - at_m, scatter_m)).sum::<f64>();
        let moved: f64 = self.apart.iter().map(|apart_m| log_likelihood(*apart_m, scatter_m)).sum();
        // The best place for all of them is that of the one part or the other, or between.
        let places = [all_m, self.from_m, self.to_m, 0.5 * (self.from_m + self.to_m)];
        moved - places.into_iter().map(unmoved).fold(f64::NEG_INFINITY, f64::max)
    }
}

/// Logarithm of the density with which a pass has a line so far from where it is.
fn log_likelihood(offset_m: f64, sigma_m: f64) -> f64 {
    let z = offset_m / sigma_m;
    let normal = (-0.5 * z * z).exp() / (sigma_m * std::f64::consts::TAU.sqrt());
    ((1.0 - WRONG) * normal + WRONG / WRONG_WITHIN_M).ln()
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let half = values.len() / 2;
    if values.len() % 2 == 1 { values[half] } else { 0.5 * (values[half - 1] + values[half]) }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::{fleet::DriveId, frame::TimestampNs, lane_map::LaneId};

    fn offsets(of: &[f64]) -> Vec<(usize, f64)> {
        of.iter().enumerate().map(|(pass, offset)| (pass + 1, *offset)).collect()
    }

    #[test]
    fn a_line_that_lies_half_a_metre_off_since_three_drives_has_moved() {
        let step = step(&offsets(&[0.0, 0.05, -0.04, 0.02, -0.01, 0.5, 0.55, 0.52])).unwrap();
        assert_eq!(step.since, 5);
        assert!((step.left_m - 0.52).abs() < 0.05, "{step:?}");
    }

    #[test]
    fn drives_that_waver_or_one_that_is_off_are_no_move() {
        assert!(step(&offsets(&[0.2, -0.2, 0.25, -0.15, 0.1, -0.2, 0.3, 0.2])).is_none());
        assert!(step(&offsets(&[0.0, 0.05, -0.04, 0.02, -0.01, 0.03, 0.6])).is_none());
    }

    /// A line of ten knots to the east that some passes have.
    fn line(number: u64, north_m: f64, passes: Range<usize>) -> Line {
        let id = FusedLaneId { started: TimestampNs(0), drive: DriveId(number), lane: LaneId(1), piece: 0, stretch: 0 };
        let mut line = Line::new(id);
        for knot in 0..10_i32 {
            let place = Point3::new(3.0 * f64::from(knot), north_m, 0.0);
            let witness = |pass| Witness {
                drive: pass,
                pass,
                lane: 0,
                parameter: f64::from(knot),
                map: place,
                arc_m: place.x,
                shared: place,
                lateral_variance_m2: 0.01,
                height_variance_m2: 0.01,
                share: 1.0,
            };
            line.push(place, Knot { witnesses: passes.clone().map(witness).collect(), ..Knot::default() });
        }
        line
    }

    #[test]
    fn a_line_does_not_move_onto_one_that_passes_have_besides_it() {
        let moved = Move { knots: 2..8, since: 6, left_m: vec![0.5; 6] };
        let beside = |passes| {
            let mut lines = Lines::default();
            lines.lines = vec![line(1, 0.0, 0..6), line(2, 0.6, passes)];
            lines.index();
            is_onto_its_neighbour(&lines, 0, &moved)
        };
        assert!(beside(3..6), "some have both");
        assert!(!beside(6..9), "none has both: it is the same paint anew");
    }
}
