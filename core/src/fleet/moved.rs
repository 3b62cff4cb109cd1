//! Moves that matching takes for the error of a drive: a line that was painted anew less than a metre from where it was.
//!
//! At each knot the passes say, in the order of time, where the line lies across: each by its mean over a window along the
//! line. They are split into those before and those since such that the least is left to errors: the sum of absolute
//! deviations from the two medians. The line moved if the medians lie far enough apart, for their scatter
//!
//! `z = |m_a - m_b| / (s sqrt(1 / n_a + 1 / n_b))`, `s` from the median of absolute deviations,
//!
//! too, hardly a pass lies on the wrong side of the middle, and this holds over a stretch. The witnesses since then
//! become a line of their own, which came, beside the old one, which went.
//!
//! Not guaranteed: moves by less than [`LEAST_MOVE_M`], which drives hardly tell from their own errors.

use std::collections::BTreeMap;

use super::{
    fusion::Fusion,
    growth::Pieces,
    line::{BASE, FusedLaneId, Knot, Line},
    prepared::normal_of,
};

/// Least distance of a move, metres.
const LEAST_MOVE_M: f64 = 0.35;
/// Least ratio of a move to its standard deviation.
const LEAST_RATIO: f64 = 5.0;
/// Least standard deviation of where a pass has a line, metres.
const LEAST_SCATTER_M: f64 = 0.1;
/// Passes before and since a move.
const LEAST_BEFORE: usize = 4;
const LEAST_SINCE: usize = 3;
/// Greatest share of passes that may lie on the wrong side of the middle.
const WRONG_SIDE: f64 = 0.05;
/// Knots to each side that are looked at together.
const AROUND_KNOTS: usize = 3;
/// Least number of knots that moved.
const LEAST_KNOTS: usize = 8;

/// A knot whose passes agree that it moved.
#[derive(Clone, Copy, Debug)]
struct Step {
    /// The first pass that has it where it is now.
    since: usize,
    /// To the left of the line, metres.
    left_m: f64,
}

impl Fusion<'_> {
    /// Makes lines of their own of stretches that moved.
    pub(super) fn part_moved(&mut self, pieces: &mut Pieces) {
        let mut parted = Vec::new();
        for (index, line) in self.lines.lines.iter_mut().enumerate() {
            let steps = steps(line);
            let mut first = 0;
            for run in steps.chunk_by(|a, b| goes_on(*a, *b)) {
                let knots = first..first + run.len();
                first = knots.end;
                let Some(since) = since(run) else { continue };
                if run.len() < LEAST_KNOTS {
                    continue;
                }
                let mut moved = Vec::new();
                for (knot, step) in knots.zip(run) {
                    let normal = normal_of(&line.tangent(knot));
                    let left_m = step.map_or(0.0, |step| step.left_m);
                    let mut place = line.points[knot];
                    place.x += normal.x * left_m;
                    place.y += normal.y * left_m;
                    let (later, before) = std::mem::take(&mut line.knots[knot].witnesses)
                        .into_iter()
                        .partition(|witness| witness.pass != BASE && witness.pass >= since);
                    line.knots[knot].witnesses = before;
                    moved.push((place, Knot { witnesses: later, ..Knot::default() }));
                }
                parted.push((index, moved));
            }
        }
        for (index, moved) in parted {
            self.lines.lines[index].settle(self.params);
            self.add_moved(index, moved, pieces);
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
        line.moved_from = Some(from);
        let votes = self.lines.lines[from].posterior().to_vec();
        line.vote(&votes, moved.len() as f64 * self.params.line_knot_m);
        for (place, knot) in moved {
            line.push(place, knot);
        }
        line.settle(self.params);
        self.lines.lines.push(line);
    }
}

/// Whether a move at one knot is that at the next.
fn goes_on(a: Option<Step>, b: Option<Step>) -> bool {
    match (a, b) {
        (Some(a), Some(b)) => a.left_m * b.left_m > 0.0 && a.since.abs_diff(b.since) <= 2,
        (None, None) => true,
        _ => false,
    }
}

/// The pass since which most knots of a run have moved; `None` of one that has not.
fn since(run: &[Option<Step>]) -> Option<usize> {
    let mut passes: Vec<usize> = run.iter().flatten().map(|step| step.since).collect();
    passes.sort_unstable();
    passes.get(passes.len() / 2).copied()
}

/// Of each knot, where it moved, if it did.
fn steps(line: &Line) -> Vec<Option<Step>> {
    let offsets: Vec<Vec<(usize, f64)>> = (0..line.points.len())
        .map(|knot| {
            let normal = normal_of(&line.tangent(knot));
            let witnesses = line.knots[knot].witnesses.iter().filter(|witness| witness.share > 0.5);
            witnesses
                .map(|witness| (order(witness.pass), (witness.shared - line.points[knot]).xy().dot(&normal)))
                .collect()
        })
        .collect();
    (0..offsets.len())
        .map(|knot| {
            let window = knot.saturating_sub(AROUND_KNOTS)..(knot + AROUND_KNOTS + 1).min(offsets.len());
            let mut sums: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
            for (pass, offset) in offsets[window].iter().flatten() {
                let (sum, count) = sums.entry(*pass).or_default();
                *sum += offset;
                *count += 1.0;
            }
            step(&sums.into_iter().map(|(pass, (sum, count))| (pass, sum / count)).collect::<Vec<_>>())
        })
        .collect()
}

/// Folded drives come before all others.
fn order(pass: usize) -> usize {
    if pass == BASE { 0 } else { pass + 1 }
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
    let parted = splits.map(|split| {
        let mut before: Vec<f64> = passes[..split].iter().map(|(_, offset)| *offset).collect();
        let mut since: Vec<f64> = passes[split..].iter().map(|(_, offset)| *offset).collect();
        let (from_m, to_m) = (median(&mut before), median(&mut since));
        let apart = before.iter().map(|offset| (offset - from_m).abs());
        let apart: Vec<f64> = apart.chain(since.iter().map(|offset| (offset - to_m).abs())).collect();
        (split, from_m, to_m, apart)
    });
    // The likeliest split is that which leaves least to errors.
    let (split, from_m, to_m, mut apart) =
        parted.min_by(|a, b| a.3.iter().sum::<f64>().total_cmp(&b.3.iter().sum::<f64>()))?;
    let scatter_m = (1.4826 * median(&mut apart)).max(LEAST_SCATTER_M);
    let (before, since) = passes.split_at(split);
    let ratio = (to_m - from_m).abs() / (scatter_m * (1.0 / before.len() as f64 + 1.0 / since.len() as f64).sqrt());
    let side = |offset: f64| (offset - 0.5 * (from_m + to_m)) * (to_m - from_m);
    let wrong = before.iter().filter(|(_, offset)| side(*offset) > 0.0).count()
        + since.iter().filter(|(_, offset)| side(*offset) < 0.0).count();
    let clear = (to_m - from_m).abs() >= LEAST_MOVE_M
        && ratio >= LEAST_RATIO
        && wrong as f64 <= WRONG_SIDE * passes.len() as f64;
    clear.then(|| Step { since: since[0].0 - 1, left_m: to_m - from_m })
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let half = values.len() / 2;
    if values.len() % 2 == 1 { values[half] } else { 0.5 * (values[half - 1] + values[half]) }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
