//! Dashes: what is painted of a dashed line, cut out of its spline.
//!
//! A client that draws dashes by a pattern begins it anew in every tile. Cut here, a dash is the same in all tiles that show
//! it, and lies where it did while the line grows at its end. A period of [`PERIOD_M`] is half a gap, a dash, and half a gap.
//! Periods are counted from the first control point; from the last, where only that lies on the border of a cell; and are
//! stretched to a whole number of them between two borders. So a border lies in the middle of a gap, of the pieces on both of
//! its sides.
//!
//! Not known: where on the road the dashes really are. Vehicles tell of lines that they are dashed, not of each dash.

use nalgebra::Point2;

use crate::lattice::{Borders, PlaneCurve};

/// A dash, metres.
const DASH_M: f64 = 3.0;
/// A dash and the gap to the next, metres.
const PERIOD_M: f64 = 9.0;
/// Chords of a segment by which its length is measured: of the sharpest bend there is they miss a few millimetres.
const CHORDS: usize = 8;

/// The dashes of a line as parameters of its spline, in their order: 3.5 is half way from control point 3 to the next.
/// `metres` is the length on the ground of the plane's side, where the line is.
pub(crate) fn dashes(points: &[Point2<f64>], borders: Borders, metres: f64) -> Vec<[f64; 2]> {
    let curve = PlaneCurve { points, borders };
    let ends = chord_ends(&curve, metres);
    let length_m = ends.last().map_or(0.0, |(way_m, _)| *way_m);
    let (start_m, period_m) = match (borders.first, borders.last) {
        (true, true) => (0.0, length_m / (length_m / PERIOD_M).round().max(1.0)),
        (false, true) => ((length_m % PERIOD_M) - PERIOD_M, PERIOD_M),
        _ => (0.0, PERIOD_M),
    };
    let dash_m = DASH_M * period_m / PERIOD_M;
    let mut found = Vec::new();
    let (mut count, mut chord) = (0.0, 1);
    loop {
        let from_m = start_m + count * period_m + (period_m - dash_m) / 2.0;
        if from_m >= length_m {
            return found;
        }
        let [from_m, to_m] = [from_m.max(0.0), (from_m + dash_m).min(length_m)];
        if to_m > from_m {
            found.push([from_m, to_m].map(|way_m| parameter_at(&ends, &mut chord, way_m)));
        }
        count += 1.0;
    }
}

/// The way along the spline to the ends of its chords, metres, and their parameters.
fn chord_ends(curve: &PlaneCurve<'_>, metres: f64) -> Vec<(f64, f64)> {
    let mut ends = vec![(0.0, 0.0)];
    let (mut way_m, mut before) = (0.0, curve.points[0]);
    for chord in 1..=(curve.points.len() - 1) * CHORDS {
        let parameter = chord as f64 / CHORDS as f64;
        let at = curve.at(parameter);
        way_m += (at - before).norm() * metres;
        ends.push((way_m, parameter));
        before = at;
    }
    ends
}

/// The parameter a way along the spline; `chord` is that of the way before, and becomes that of this one.
fn parameter_at(ends: &[(f64, f64)], chord: &mut usize, way_m: f64) -> f64 {
    while *chord + 1 < ends.len() && ends[*chord].0 < way_m {
        *chord += 1;
    }
    let [(from_m, from), (to_m, to)] = [ends[*chord - 1], ends[*chord]];
    let share = if to_m > from_m { ((way_m - from_m) / (to_m - from_m)).clamp(0.0, 1.0) } else { 0.0 };
    from + (to - from) * share
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SIDE_M: f64 = 4e7;

    /// Control points on a bend, metres apart and of a radius.
    fn bend(count: usize, apart_m: f64, radius_m: f64) -> Vec<Point2<f64>> {
        let place = |index: usize| {
            let (sin, cos) = (index as f64 * apart_m / radius_m).sin_cos();
            Point2::new(sin, 1.0 - cos) * (radius_m / SIDE_M)
        };
        (0..count).map(place).collect()
    }

    /// From where to where dashes lie on a bend, metres from its first control point.
    fn ways_m(points: &[Point2<f64>], apart_m: f64, borders: Borders) -> Vec<[f64; 2]> {
        let found = dashes(points, borders, SIDE_M);
        found.into_iter().map(|dash| dash.map(|parameter| parameter * apart_m)).collect()
    }

    proptest! {
        #[test]
        fn dashes_of_three_metres_follow_each_other_after_nine(
            count in 5..200_usize, apart_m in 0.5..4.0f64, radius_m in 20.0..500.0f64,
        ) {
            let found = ways_m(&bend(count, apart_m, radius_m), apart_m, Borders::default());
            for (index, [from_m, to_m]) in found.iter().enumerate() {
                prop_assert!((from_m - 9.0 * index as f64 - 3.0).abs() < 0.05, "{index}: {from_m}");
                prop_assert!(to_m - from_m < 3.01 && (index + 1 == found.len() || to_m - from_m > 2.99));
            }
        }

        #[test]
        fn borders_of_cells_lie_in_the_middle_of_a_gap(
            count in 15..200_usize, apart_m in 1.0..4.0f64, first in any::<bool>(), last in any::<bool>(),
        ) {
            let (borders, length_m) = (Borders { first, last }, (count - 1) as f64 * apart_m);
            let found = ways_m(&bend(count, apart_m, 300.0), apart_m, borders);
            let period_m = if first && last { length_m / (length_m / 9.0).round() } else { 9.0 };
            if first || !last {
                prop_assert!((found[0][0] - period_m / 3.0).abs() < 0.05, "{:?}", found[0]);
            }
            if last {
                prop_assert!((length_m - found[found.len() - 1][1] - period_m / 3.0).abs() < 0.05, "{found:?}");
            }
        }
    }

    #[test]
    fn a_line_that_grows_keeps_its_dashes() {
        let points = bend(60, 3.0, 200.0);
        let before = dashes(&points[..40], Borders::default(), SIDE_M);
        let after = dashes(&points, Borders::default(), SIDE_M);
        // But for the last segment, whose shape the next control point changes.
        for ([from, to], [now_from, now_to]) in before.iter().zip(&after).filter(|(dash, _)| dash[1] < 38.0) {
            assert!((from - now_from).abs() < 1e-9 && (to - now_to).abs() < 1e-9);
        }
    }
}
