//! Which way lanes are driven, and what between two lines is none.
//!
//! A line runs the way in which the oldest drive travelled that saw it, which may have been in the lanes that come the other
//! way. So the markings speak first: traffic keeps a yellow line on the side of what comes towards it (on its left, where one
//! keeps right), and so a double line with lanes on both sides. Where no line separates, a lane is driven as its lines run; where they differ, as the one runs that no
//! other lane has. Lanes that go on in each other are decided together, by the length of their sections.
//!
//! Not guaranteed: a white dashed line between two lanes reads as one between lanes of one direction, as it does for a driver.

use lanemap_core::Category;

use super::{
    TrafficSide,
    map_line::{MapLine, mirrored},
    road::{Gap, GapKind, Road, Section, Travel},
};

/// How much more a separating line says than the direction of lines.
const SEPARATOR_WEIGHT: f64 = 8.0;
/// What differing lines say.
const MIXED_WEIGHT: f64 = 0.3;

/// Decides the travel of every lane of a road, and which of them are medians.
pub(super) fn decide(lines: &[MapLine], road: &mut Road, traffic: TrafficSide) {
    for section in &mut road.sections {
        find_medians(lines, section, traffic);
    }
    // A median has no next lane, and is none.
    for index in 1..road.sections.len() {
        let kinds: Vec<GapKind> = road.sections[index].gaps.iter().map(|gap| gap.kind).collect();
        for gap in &mut road.sections[index - 1].gaps {
            let ends = gap.kind != GapKind::Lane || gap.goes_on_in.is_some_and(|next| kinds[next] != GapKind::Lane);
            if ends {
                gap.goes_on_in = None;
            }
        }
    }
    let votes: Vec<Vec<f64>> = road
        .sections
        .iter()
        .map(|section| {
            let length_m = lines[road.line].length_between_m(section.from, section.to);
            votes(lines, section, traffic).into_iter().map(|vote| vote * length_m).collect()
        })
        .collect();
    let mut decided: Vec<Vec<bool>> = road.sections.iter().map(|section| vec![false; section.gaps.len()]).collect();
    for start in 0..road.sections.len() {
        for gap in 0..road.sections[start].gaps.len() {
            if decided[start][gap] {
                continue;
            }
            let lane = lane_from(road, start, gap);
            let sum: f64 = lane.iter().map(|(section, gap)| votes[*section][*gap]).sum();
            for (section, gap) in lane {
                decided[section][gap] = true;
                road.sections[section].gaps[gap].travel = if sum >= 0.0 { Travel::Along } else { Travel::Against };
            }
        }
    }
}

/// A lane through the sections from the one in which it begins.
fn lane_from(road: &Road, start: usize, gap: usize) -> Vec<(usize, usize)> {
    let mut lane = vec![(start, gap)];
    let (mut section, mut gap) = (start, gap);
    while let Some(next) = road.sections[section].gaps[gap].goes_on_in {
        section += 1;
        gap = next;
        lane.push((section, gap));
    }
    lane
}

/// The category of a border, seen along the reference, in the middle of its section.
fn category(lines: &[MapLine], section: &Section, border: usize) -> Category {
    let border = &section.borders[border];
    let category = lines[border.line].piece_at(0.5 * (border.from + border.to)).category;
    if border.along { category } else { mirrored(category) }
}

/// A median lies between the left edges of two carriageways: lines that run against each other, each with the gap on the side
/// of the oncoming traffic, neither of them to be crossed and both painted alike.
fn find_medians(lines: &[MapLine], section: &mut Section, traffic: TrafficSide) {
    for gap in 0..section.gaps.len() {
        if section.gaps[gap].kind != GapKind::Lane {
            continue;
        }
        let (left, right) = (section.borders[gap], section.borders[gap + 1]);
        // Each carriageway's traffic runs away from the median's other side.
        let apart = match traffic {
            TrafficSide::Right => !left.along && right.along,
            TrafficSide::Left => left.along && !right.along,
        };
        let (left, right) = (category(lines, section, gap), category(lines, section, gap + 1));
        let outer_lanes = gap > 0 && gap + 1 < section.gaps.len();
        if apart && outer_lanes && is_edge(left) && is_edge(right) && is_yellow(left) == is_yellow(right) {
            section.gaps[gap].kind = GapKind::Median;
        }
    }
}

/// For each gap how much speaks for travel along the reference, in `[-SEPARATOR_WEIGHT, SEPARATOR_WEIGHT]`.
fn votes(lines: &[MapLine], section: &Section, traffic: TrafficSide) -> Vec<f64> {
    let is_lane = |gap: usize| section.gaps.get(gap).is_some_and(|gap| gap.kind == GapKind::Lane);
    let separators: Vec<usize> =
        (1..section.borders.len().saturating_sub(1)).filter(|border| separates(lines, section, *border)).collect();
    let bounds = separators.first().zip(separators.last());
    let keeps_right = if traffic == TrafficSide::Right { 1.0 } else { -1.0 };
    (0..section.gaps.len())
        .map(|gap| {
            if !is_lane(gap) {
                return 0.0;
            }
            if let Some((first, last)) = bounds {
                if gap >= *last {
                    return SEPARATOR_WEIGHT * keeps_right;
                }
                if gap < *first {
                    return -SEPARATOR_WEIGHT * keeps_right;
                }
            }
            let sign = |along: bool| if along { 1.0 } else { -1.0 };
            let (left, right) = (&section.borders[gap], &section.borders[gap + 1]);
            match (left.along == right.along, gap > 0 && is_lane(gap - 1), is_lane(gap + 1)) {
                (true, _, _) => sign(left.along),
                (false, true, false) => MIXED_WEIGHT * sign(right.along),
                (false, false, true) => MIXED_WEIGHT * sign(left.along),
                (false, _, _) => 0.1 * MIXED_WEIGHT * sign(left.along),
            }
        })
        .collect()
}

/// Whether a border keeps the ways of travel apart: a yellow line, which is in the middle of a road or at the left edge of a
/// carriageway, or a double line or one beside a median, with lanes on both sides.
fn separates(lines: &[MapLine], section: &Section, border: usize) -> bool {
    let own = category(lines, section, border);
    if is_yellow(own) {
        return true;
    }
    let (to_the_left, to_the_right) = section.gaps.split_at(border.min(section.gaps.len()));
    let has_lane = |gaps: &[Gap]| gaps.iter().any(|gap| gap.kind == GapKind::Lane);
    let beside_median = [border.checked_sub(1), Some(border)]
        .into_iter()
        .flatten()
        .any(|gap| section.gaps.get(gap).is_some_and(|gap| gap.kind == GapKind::Median));
    has_lane(to_the_left) && has_lane(to_the_right) && (beside_median || is_double(own))
}

fn is_yellow(category: Category) -> bool {
    matches!(
        category,
        Category::YellowDashed
            | Category::YellowSolid
            | Category::DoubleYellowDashed
            | Category::DoubleYellowSolid
            | Category::YellowLeftDashedRightSolid
            | Category::YellowLeftSolidRightDashed
    )
}

fn is_double(category: Category) -> bool {
    matches!(category, Category::DoubleWhiteSolid | Category::DoubleYellowSolid | Category::DoubleYellowDashed)
}

fn is_edge(category: Category) -> bool {
    matches!(category, Category::WhiteSolid | Category::YellowSolid | Category::LeftCurb | Category::RightCurb)
}
