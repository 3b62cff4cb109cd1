//! Joining: two lines become one where a drive saw them as one.
//!
//! A drive that lost a line for some metres leaves two in the map. The next one whose lane runs off the end of one and, a few
//! metres on, onto the beginning of the other shows that they are one: the younger is appended to the older, whose name and
//! direction stay. What the drive itself saw between them has extended one of them before.
//!
//! Lines of different paint stay two (a dashed line that becomes solid at a stop line is told apart by its name), and so do
//! lines that overlap by more than [`MOST_OVERLAP`] knots: they are two lines beside each other.

use super::{
    line::{Knot, Line, LineRecord, Lines},
    matching::Run,
    params::FleetParams,
};
use crate::frame::TimestampNs;

/// Samples of a lane between the two lines, at most.
const MOST_BETWEEN: usize = 5;
/// Knots by which they may overlap.
const MOST_OVERLAP: usize = 3;
/// Distance between their ends, knots, at most.
const MOST_APART: f64 = 6.0;

/// An end of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct End {
    line: usize,
    is_tail: bool,
}

/// Two ends that a drive's lane ran over, one after the other.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    left: End,
    entered: End,
}

impl Link {
    /// The link of two runs of one lane, one after the other, if both are at ends of their lines.
    pub(super) fn of(lines: &Lines, before: &Run, after: &Run) -> Option<Self> {
        let between = *after.samples.start() - *before.samples.end() - 1;
        let same_paint = lines.lines[before.line].paint() == lines.lines[after.line].paint();
        let meets = before.line != after.line && between <= MOST_BETWEEN && same_paint;
        (meets && leaves_at_end(lines, before, true) && leaves_at_end(lines, after, false)).then(|| Self {
            left: End { line: before.line, is_tail: before.is_forward() },
            entered: End { line: after.line, is_tail: !after.is_forward() },
        })
    }
}

/// Whether a run ends (`onward`) or begins where its line does.
pub(super) fn leaves_at_end(lines: &Lines, run: &Run, onward: bool) -> bool {
    const NEAR_END: f64 = 1.5;
    let last = (lines.lines[run.line].points.len() - 1) as f64;
    let at = if onward { run.parameters[run.parameters.len() - 1] } else { run.parameters[0] };
    if run.is_forward() == onward { at > last - NEAR_END } else { at < NEAR_END }
}

/// Joins lines; each takes part in one link at most. Whether any were joined.
pub(super) fn join(lines: &mut Lines, links: &[Link], params: &FleetParams) -> bool {
    let mut taken: Vec<usize> = Vec::new();
    let mut any = false;
    for link in links {
        if taken.contains(&link.left.line) || taken.contains(&link.entered.line) {
            continue;
        }
        let (older, younger) = if lines.lines[link.left.line].id <= lines.lines[link.entered.line].id {
            (link.left, link.entered)
        } else {
            (link.entered, link.left)
        };
        let Some(onward) = continuation(&lines.lines[older.line], older, &lines.lines[younger.line], younger, params)
        else {
            continue;
        };
        let empty = Line::new(lines.lines[younger.line].id);
        let gone = std::mem::replace(&mut lines.lines[younger.line], empty);
        append(&mut lines.lines[older.line], older.is_tail, gone, &onward);
        taken.extend([older.line, younger.line]);
        any = true;
    }
    if any {
        lines.lines.retain(|line| !line.points.is_empty());
    }
    any
}

/// The younger line's knots that lie beyond the older one's end, from there on; `None` where it does not go on from there.
fn continuation(older: &Line, end: End, younger: &Line, entered: End, params: &FleetParams) -> Option<Vec<usize>> {
    let last = if end.is_tail { older.points.len() - 1 } else { 0 };
    let tangent = older.tangent(last);
    let outward = if end.is_tail { tangent } else { -tangent };
    let count = younger.points.len();
    let order: Vec<usize> = if entered.is_tail { (0..count).rev().collect() } else { (0..count).collect() };
    let is_beyond =
        |knot: &usize| (younger.points[*knot] - older.points[last]).dot(&outward) > 0.5 * params.line_knot_m;
    let overlap = order.iter().position(is_beyond)?;
    let onward = order[overlap..].to_vec();
    let apart_m = nalgebra::distance(&older.points[last], &younger.points[onward[0]]);
    (overlap <= MOST_OVERLAP && apart_m <= MOST_APART * params.line_knot_m).then_some(onward)
}

fn append(older: &mut Line, at_tail: bool, mut younger: Line, onward: &[usize]) {
    for knot in onward {
        let (point, at) = (younger.points[*knot], std::mem::take::<Knot>(&mut younger.knots[*knot]));
        if at_tail { older.push(point, at) } else { older.push_front(point, at) }
    }
    older.take_votes(&younger);
    older.record = both(&older.record, &younger.record);
}

/// What drives that were folded said of two lines that are one.
fn both(one: &LineRecord, other: &LineRecord) -> LineRecord {
    let of = |pick: fn(TimestampNs, TimestampNs) -> TimestampNs, a: Option<TimestampNs>, b: Option<TimestampNs>| match (
        a, b,
    ) {
        (Some(a), Some(b)) => Some(pick(a, b)),
        (a, b) => a.or(b),
    };
    LineRecord {
        // Which of them saw both is no longer known.
        drives: one.drives.max(other.drives),
        observations: one.observations + other.observations,
        first_seen: of(std::cmp::min, one.first_seen, other.first_seen),
        last_seen: of(std::cmp::max, one.last_seen, other.last_seen),
    }
}
