//! Roads: what lies between the lines. Lanes are found across a road, and cut all at once where the road changes.
//!
//! Ours; the outline is that of OpenDRIVE's lane sections. The longest line that no road has yet is a road's reference. At
//! every metre of it the plane across it is laid through all lines beside it: those that run its way or against it, at its
//! height, each no farther than [`WIDEST_LANE_M`] from the one before, are the road's borders there. Where the borders change
//! (a line begins, ends, or comes too near another) a section ends and the next begins, at the place itself: found by
//! bisection, to a millimetre. Lines are cut there together, so that lanes side by side begin and end side by side, and what
//! of a line a road has is taken: no place is covered twice.
//!
//! Between two borders lies a lane, where they are [`NARROWEST_LANE_M`] to [`WIDEST_LANE_M`] apart and it is no
//! [median](super::direction). Not guaranteed: lanes where lines are missing, as in most junctions.

mod survey;

use self::survey::Survey;
pub use self::survey::abreast;
use super::{
    LaneOptions,
    direction::decide,
    map_line::{MapLine, MapLines},
};

/// Narrowest lane, metres.
pub const NARROWEST_LANE_M: f64 = 2.2;
/// Widest lane, metres.
pub const WIDEST_LANE_M: f64 = 5.5;
/// Shortest stretch of lanes at the end of a road, metres: lines rarely end side by side.
const SHORTEST_END_M: f64 = 4.0;
/// Least share of a lane's width that it must have in common with the one that it goes on in.
const LEAST_OVERLAP: f64 = 0.5;
/// Lines that are less likely there bound no lane.
const LEAST_EXISTENCE: f64 = 0.6;

/// Which way a lane is driven, seen along its road's reference line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Travel {
    /// Along it.
    Along,
    /// Against it.
    Against,
}

/// What lies between two borders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GapKind {
    /// A lane.
    Lane,
    /// Too narrow for one: between the lines of a double line, or an edge and its curb.
    Narrow,
    /// As wide as a lane, but nobody drives there.
    Median,
}

/// A line within a section.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Border {
    /// Index of the line.
    pub line: usize,
    /// Whether the line runs along the reference.
    pub along: bool,
    /// The line's parameter where the section begins.
    pub from: f64,
    /// The line's parameter where it ends; below `from` where the line runs against the reference.
    pub to: f64,
    /// How far to the left of the reference it lies where the section begins, metres.
    pub from_left_m: f64,
    /// The same where the section ends, metres.
    pub to_left_m: f64,
}

/// What lies between a border and the next to its right.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// What it is.
    pub kind: GapKind,
    /// Which way it is driven, for a lane.
    pub travel: Travel,
    /// The gap of the next section in which this lane goes on.
    pub goes_on_in: Option<usize>,
}

/// A stretch of a road on which its borders stay the same.
#[derive(Clone, Debug, PartialEq)]
pub struct Section {
    /// The reference's parameter where it begins.
    pub from: f64,
    /// The reference's parameter where it ends.
    pub to: f64,
    /// The lines, from left to right.
    pub borders: Vec<Border>,
    /// What lies between them, one fewer.
    pub gaps: Vec<Gap>,
    /// Which border is the reference.
    pub reference: usize,
}

/// A road: sections end to end along a reference line.
#[derive(Clone, Debug, PartialEq)]
pub struct Road {
    /// Index of the reference line.
    pub line: usize,
    /// Its sections, in the direction of the reference; never none.
    pub sections: Vec<Section>,
}

impl Section {
    /// Number of its lanes.
    #[must_use]
    pub fn lanes(&self) -> usize {
        self.gaps.iter().filter(|gap| gap.kind == GapKind::Lane).count()
    }
}

/// Finds the roads of a map. Every stretch of every line is a border in one section, or a reference alone.
#[must_use]
pub fn roads(map: &MapLines, options: LaneOptions) -> Vec<Road> {
    let mut survey = Survey::of(&map.lines);
    let mut order: Vec<(usize, f64)> =
        map.lines.iter().enumerate().map(|(index, line)| (index, line.length_m())).collect();
    // Lines that may bound no lane come last, so that they take nothing from others; before them those with gaps, which
    // follow others.
    let last = |index: usize| (map.lines[index].existence() < LEAST_EXISTENCE, map.lines[index].guessed_m > 0.0);
    order.sort_by(|a, b| last(a.0).cmp(&last(b.0)).then(b.1.total_cmp(&a.1)).then(a.0.cmp(&b.0)));
    let mut roads = Vec::new();
    for (line, _) in order {
        for (from, to) in survey.free(line) {
            let mut road = Road { line, sections: survey.sections(line, from, to) };
            if road.sections.is_empty() {
                continue;
            }
            survey.take(&road);
            connect(&mut road);
            decide(&map.lines, &mut road, options.traffic);
            forget_short_ends(&map.lines, &mut road);
            connect(&mut road);
            roads.extend(parted(road));
        }
    }
    roads
}

/// Parts a road where its lanes begin and end: lanes lead on from the end of a road.
fn parted(road: Road) -> Vec<Road> {
    let mut roads: Vec<Road> = Vec::new();
    for section in road.sections {
        let has_lanes = section.lanes() > 0;
        match roads.last_mut() {
            Some(last) if last.sections.last().is_some_and(|before| (before.lanes() > 0) == has_lanes) => {
                last.sections.push(section);
            }
            _ => roads.push(Road { line: road.line, sections: vec![section] }),
        }
    }
    roads
}

/// Finds for each lane the one of the next section in which it goes on: the one with which it has most of its width in common.
fn connect(road: &mut Road) {
    for index in 1..road.sections.len() {
        let (before, after) = road.sections.split_at_mut(index);
        let Some(here) = before.last_mut() else { continue };
        let next = &after[0];
        let mut used = vec![false; next.gaps.len()];
        for gap in 0..here.gaps.len() {
            here.gaps[gap].goes_on_in = None;
            if here.gaps[gap].kind != GapKind::Lane {
                continue;
            }
            let (left, right) = (here.borders[gap].to_left_m, here.borders[gap + 1].to_left_m);
            let shared = |other: &usize| {
                let (other_left, other_right) =
                    (next.borders[*other].from_left_m, next.borders[*other + 1].from_left_m);
                let common = left.min(other_left) - right.max(other_right);
                common / (left - right).max(other_left - other_right).max(1e-6)
            };
            let candidates = (0..next.gaps.len())
                .filter(|other| next.gaps[*other].kind == GapKind::Lane && !used[*other])
                .map(|other| (shared(&other), other))
                .filter(|(share, _)| *share > LEAST_OVERLAP);
            if let Some((_, other)) = candidates.max_by(|a, b| a.0.total_cmp(&b.0)) {
                used[other] = true;
                here.gaps[gap].goes_on_in = Some(other);
            }
        }
    }
}

/// Takes the lanes out of short sections at the ends of a road: slivers, because lines rarely end side by side.
fn forget_short_ends(lines: &[MapLine], road: &mut Road) {
    let length_m = |section: &Section| lines[road.line].length_between_m(section.from, section.to);
    let short: Vec<bool> = road.sections.iter().map(|section| length_m(section) < SHORTEST_END_M).collect();
    let ends_alone = |index: usize, gap: usize, sections: &[Section]| {
        let goes_on = sections[index].gaps[gap].goes_on_in.is_some();
        let comes = index > 0 && sections[index - 1].gaps.iter().any(|before| before.goes_on_in == Some(gap));
        !(goes_on && comes)
    };
    let mut changed = true;
    while changed {
        changed = false;
        for (index, _) in short.iter().enumerate().filter(|(_, short)| **short) {
            for gap in 0..road.sections[index].gaps.len() {
                let is_lane = road.sections[index].gaps[gap].kind == GapKind::Lane;
                if is_lane && ends_alone(index, gap, &road.sections) {
                    road.sections[index].gaps[gap] =
                        Gap { kind: GapKind::Narrow, travel: Travel::Along, goes_on_in: None };
                    if let Some(before) = index.checked_sub(1) {
                        for other in &mut road.sections[before].gaps {
                            if other.goes_on_in == Some(gap) {
                                other.goes_on_in = None;
                            }
                        }
                    }
                    changed = true;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
