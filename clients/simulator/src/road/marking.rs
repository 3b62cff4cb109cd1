//! What is painted across a road of the fleets' worlds: edge lines, curbs, centre lines single and double, lane lines.

use lanemap_core::Category;

use crate::road::cross_section::{Carriageway, PaintedLine};

/// Distance between the two lines of a double line, metres.
pub const DOUBLE_LINE_M: f64 = 0.25;
/// How far behind an edge line its curb stands, metres.
const CURB_BEHIND_EDGE_M: f64 = 0.6;

/// The middle of a two-way road.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CentreLine {
    /// One line.
    Single(Category),
    /// Two yellow solid lines [`DOUBLE_LINE_M`] apart, each a line of its own.
    Double,
}

/// The edges of a road.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Edge {
    /// A white solid line.
    Line,
    /// A curb.
    Curb,
    /// A white solid line with a curb behind it.
    LineAndCurb,
}

/// What is painted on a road.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Marking {
    /// Its middle; a one-way road has a yellow solid line on its left instead.
    pub centre: CentreLine,
    /// Its edges.
    pub edge: Edge,
}

impl Default for Marking {
    fn default() -> Self {
        Self { centre: CentreLine::Single(Category::YellowDashed), edge: Edge::Line }
    }
}

/// Paints a road of a length, from left to right.
#[must_use]
pub fn mark(carriageway: Carriageway, lane_width_m: f64, length_m: f64, marking: &Marking) -> Vec<PaintedLine> {
    let line = |category, offset_m| PaintedLine::new(category, offset_m, 0.0, length_m);
    let lanes = carriageway.forward_lanes();
    let edge_m = lane_width_m * f64::from(lanes);
    let mut lines = Vec::new();
    if carriageway.is_two_way() {
        if marking.edge != Edge::Line {
            let behind_m = if marking.edge == Edge::Curb { 0.0 } else { CURB_BEHIND_EDGE_M };
            lines.push(line(Category::LeftCurb, edge_m + behind_m));
        }
        if marking.edge != Edge::Curb {
            lines.push(line(Category::WhiteSolid, edge_m));
        }
        for lane in (1..lanes).rev() {
            lines.push(line(Category::WhiteDashed, lane_width_m * f64::from(lane)));
        }
        match marking.centre {
            CentreLine::Single(category) => lines.push(line(category, 0.0)),
            CentreLine::Double => {
                lines.push(line(Category::YellowSolid, 0.5 * DOUBLE_LINE_M));
                lines.push(line(Category::YellowSolid, -0.5 * DOUBLE_LINE_M));
            }
        }
    } else {
        lines.push(line(Category::YellowSolid, 0.0));
    }
    for lane in 1..lanes {
        lines.push(line(Category::WhiteDashed, -lane_width_m * f64::from(lane)));
    }
    if marking.edge != Edge::Curb {
        lines.push(line(Category::WhiteSolid, -edge_m));
    }
    if marking.edge != Edge::Line {
        let behind_m = if marking.edge == Edge::Curb { 0.0 } else { CURB_BEHIND_EDGE_M };
        lines.push(line(Category::RightCurb, -edge_m - behind_m));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_road_is_painted_from_left_to_right_alike_on_both_sides() {
        let marking = Marking { centre: CentreLine::Double, edge: Edge::LineAndCurb };
        let lines = mark(Carriageway::TwoWay { lanes_each: 2 }, 3.5, 100.0, &marking);
        let offsets: Vec<f64> = lines.iter().filter_map(|line| line.offset_at_m(50.0)).collect();
        assert_eq!(offsets, [7.6, 7.0, 3.5, 0.125, -0.125, -3.5, -7.0, -7.6]);
    }
}
