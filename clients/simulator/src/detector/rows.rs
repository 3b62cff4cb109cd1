//! A line as it truly lies at the detector's rows.

use nalgebra::{Point3, Vector3};

use crate::{detector::model::ROWS_M, view::LineView};

/// A line at one row of the ground frame, metres.
#[derive(Clone, Copy, Debug)]
#[expect(clippy::struct_field_names, reason = "the postfix is the unit")]
pub struct Row {
    /// Ahead, below the camera.
    pub range_m: f64,
    /// To the right.
    pub right_m: f64,
    /// Up.
    pub up_m: f64,
}

impl Row {
    /// This row moved to the right and up, metres.
    pub fn displaced(&self, [right_m, up_m]: [f64; 2]) -> Self {
        Self { right_m: self.right_m + right_m, up_m: self.up_m + up_m, ..*self }
    }
}

/// The rows at which a line is reported: from the one before its visible part to the one after it, within reach.
///
/// `ground_offset` is the camera's place in the vehicle, height left out. Where the line itself ends between rows,
/// its last metres are drawn on: that is why a detector's lines are longer than the paint.
pub fn rows_of(view: &LineView, ground_offset: Vector3<f64>, reach_m: f64) -> Vec<Row> {
    let visible = view.visible_points();
    let (Some(near), Some(far)) = (visible.first(), visible.last()) else { return Vec::new() };
    let (near_m, far_m) = (near.x - ground_offset.x, far.x - ground_offset.x);
    let first = ROWS_M.iter().rposition(|row| *row <= near_m).unwrap_or(0);
    let last = ROWS_M.iter().position(|row| *row >= far_m).unwrap_or(ROWS_M.len() - 1);
    ROWS_M[first..=last.max(first)]
        .iter()
        .filter(|row| **row <= reach_m)
        .map(|range_m| {
            let point = at_range(&view.points_vehicle, range_m + ground_offset.x) - ground_offset;
            Row { range_m: *range_m, right_m: -point.y, up_m: point.z }
        })
        .collect()
}

/// The point of a line that runs ahead at `x`; beyond its ends its last metres are drawn on.
fn at_range(points: &[Point3<f64>], x: f64) -> Point3<f64> {
    const DRAWN_ON: usize = 5;
    let last = points.len() - 1;
    let (a, b) = if x <= points[0].x {
        (0, DRAWN_ON.min(last))
    } else if x >= points[last].x {
        (last.saturating_sub(DRAWN_ON), last)
    } else {
        let after = points.partition_point(|point| point.x <= x).clamp(1, last);
        (after - 1, after)
    };
    let piece = points[b] - points[a];
    points[a] + piece * ((x - points[a].x) / piece.x.max(1e-9))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{road::RoadLineId, view::LineView};
    use lanemap_core::Category;

    #[test]
    fn a_line_is_reported_from_the_row_before_its_visible_part_to_the_row_after_it() {
        let points: Vec<_> = (0..34).map(|k| Point3::new(f64::from(k), 2.0 + 0.1 * f64::from(k), -0.35)).collect();
        let view = LineView {
            line: RoadLineId(0),
            category: Category::WhiteSolid,
            points_vehicle: points,
            visible: 8..34,
            stretch: 8..34,
        };
        let rows = rows_of(&view, Vector3::zeros(), 59.0);
        let ranges: Vec<f64> = rows.iter().map(|row| row.range_m).collect();
        assert_eq!(ranges, [5.0, 10.0, 15.0, 20.0, 30.0, 40.0]);
        for row in &rows {
            assert!((row.right_m + 2.0 + 0.1 * row.range_m).abs() < 1e-9, "drawn on along its own direction");
        }
    }
}
