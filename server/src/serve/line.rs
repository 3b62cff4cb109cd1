//! The drawn line of a lane: chords of its spline, in metres or in degrees.
//!
//! A chord over a parameter step `h` leaves a curve by at most `h^2 / 8 max |p''|` (the error of linear interpolation). On one
//! Catmull-Rom segment `p''` is linear in the parameter, so its greatest length is at one of the two ends, and the number
//! of chords follows without trying. A straight stretch costs one chord per control point.
//!
//! ```
//! # use lanemap_core::{lane_map::*, Category, TimestampNs};
//! # use nalgebra::{Matrix3, Point3};
//! let control_points = (0..4)
//!     .map(|i| ControlPoint { position: Point3::new(3.0 * f64::from(i), 0.0, 0.0), covariance: Matrix3::zeros() })
//!     .collect();
//! let lane = MapLane {
//!     id: LaneId(1), category: Category::WhiteSolid, category_posterior: vec![],
//!     category_stretches: vec![], control_points,
//!     ends: EndRule::Reflected, drawn_from: 0.0, drawn_to: 2.5, existence: 1.0, observations: 9,
//!     first_seen: TimestampNs(0), last_seen: TimestampNs(0),
//! };
//! assert_eq!(lanemap_server::serve::line::drawn(&lane).len(), 4);
//! ```

use lanemap_core::{
    ControlPoint, EndRule, MapLane,
    geometry::georeference::{Georeference, Wgs84},
    spline::{ControlPolygon, Curve},
};
use nalgebra::Point3;

/// Greatest distance between a chord and the spline, metres; leaves room within 1 cm for rounded coordinates.
pub const CHORD_ERROR_M: f64 = 0.004;

/// Most chords of one segment, whatever its shape: bounds the answer where control points lie absurdly far apart.
const MOST_CHORDS: f64 = 64.0;

/// A coordinate as it is written: longitude, latitude (degrees) and height (metres), or x, y, z (metres).
pub type Coordinate = [f64; 3];

/// Points of a lane from its first to its last end, map frame, metres; empty where it has too few control points.
#[must_use]
pub fn drawn(lane: &MapLane) -> Vec<Point3<f64>> {
    let points: &[ControlPoint] = &lane.control_points;
    Curve::new(points, lane.ends).map(|curve| chords(&curve, lane.drawn_from, lane.drawn_to)).unwrap_or_default()
}

/// Points of a spline that reaches its first and last control point; empty where there are fewer than two.
#[must_use]
pub fn drawn_through(points: &[Point3<f64>]) -> Vec<Point3<f64>> {
    let curve = Curve::new(points, EndRule::Reflected);
    curve.map(|curve| chords(&curve, curve.first_parameter(), curve.last_parameter())).unwrap_or_default()
}

fn chords<P: ControlPolygon + ?Sized>(curve: &Curve<'_, P>, from: f64, to: f64) -> Vec<Point3<f64>> {
    let (from, to) = (from.max(curve.first_parameter()), to.min(curve.last_parameter()));
    if from >= to {
        return Vec::new();
    }
    let mut line = vec![curve.point(from)];
    let mut start = from;
    while start < to {
        let end = (start.floor() + 1.0).min(to);
        let chords = chords_of(curve, start, end);
        let mut chord = 1.0;
        while chord <= chords {
            line.push(curve.point(start + (end - start) * chord / chords));
            chord += 1.0;
        }
        start = end;
    }
    line
}

/// How many equal chords keep [`CHORD_ERROR_M`] between two parameters of one segment.
fn chords_of<P: ControlPolygon + ?Sized>(curve: &Curve<'_, P>, start: f64, end: f64) -> f64 {
    // The value at `end` belongs to the next segment, so it is continued from the middle of this one.
    let at_start = curve.second_derivative(start);
    let at_end = curve.second_derivative(0.5 * (start + end)) * 2.0 - at_start;
    let bend = at_start.norm().max(at_end.norm());
    ((end - start) * (bend / (8.0 * CHORD_ERROR_M)).sqrt()).ceil().clamp(1.0, MOST_CHORDS)
}

/// A point of the map frame on the earth.
#[must_use]
pub fn on_the_earth(georeference: &Georeference, point_map: &Point3<f64>) -> Coordinate {
    written(georeference.to_wgs84(point_map))
}

/// A place as GeoJSON writes it: degrees to 7 decimals (1 cm), the height to millimetres.
#[must_use]
pub fn written(place: Wgs84) -> Coordinate {
    [rounded(place.longitude_deg, 1e7), rounded(place.latitude_deg, 1e7), rounded(place.height_m, 1e3)]
}

/// A point of the map frame, to millimetres.
#[must_use]
pub fn in_metres(point_map: &Point3<f64>) -> Coordinate {
    [rounded(point_map.x, 1e3), rounded(point_map.y, 1e3), rounded(point_map.z, 1e3)]
}

/// A number to as many decimals as `scale`, a power of ten, has zeros.
pub(super) fn rounded(value: f64, scale: f64) -> f64 {
    // Adding zero turns -0.0 into 0.0.
    (value * scale).round() / scale + 0.0
}

/// Cuts a line in degrees where it crosses the antimeridian (RFC 7946, 3.1.9): each part stays on its own side.
#[must_use]
pub fn cut_at_antimeridian(mut line: Vec<Coordinate>) -> Vec<Vec<Coordinate>> {
    let mut parts = Vec::new();
    let mut part: Vec<Coordinate> = Vec::with_capacity(line.len());
    if let [first, second, ..] = line.as_mut_slice() {
        stay_beside(first, second[0]);
    }
    for mut next in line {
        if let Some(last) = part.last() {
            stay_beside(&mut next, last[0]);
        }
        if let Some(last) = part.last().copied()
            && (next[0] - last[0]).abs() > 180.0
        {
            let side = 180.0_f64.copysign(last[0]);
            let gap = next[0] + 2.0 * side - last[0];
            let along = if gap == 0.0 { 0.0 } else { (side - last[0]) / gap };
            let between = |axis: usize, scale| rounded(last[axis] + (next[axis] - last[axis]) * along, scale);
            let (latitude, height) = (between(1, 1e7), between(2, 1e3));
            if last[0].abs() < 180.0 {
                part.push([side, latitude, height]);
            }
            parts.push(std::mem::take(&mut part));
            part.push([-side, latitude, height]);
        }
        part.push(next);
    }
    parts.push(part);
    parts
}

/// A place on the antimeridian lies on the side of the one beside it.
fn stay_beside(place: &mut Coordinate, longitude: f64) {
    if place[0].abs() >= 180.0 && longitude != 0.0 {
        place[0] = place[0].copysign(longitude);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::sample::{bend, lane_of};
    use proptest::prelude::*;

    fn distance_to_line(point: &Point3<f64>, line: &[Point3<f64>]) -> f64 {
        line.windows(2)
            .map(|pair| {
                let chord = pair[1] - pair[0];
                let along = ((point - pair[0]).dot(&chord) / chord.norm_squared()).clamp(0.0, 1.0);
                (point - (pair[0] + chord * along)).norm()
            })
            .fold(f64::INFINITY, f64::min)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn no_point_of_the_spline_is_farther_than_the_chord_error_from_the_line(
            radius_m in 4.0..2000.0f64, count in 4usize..30, from in 0.0..1.0f64,
        ) {
            let mut lane = lane_of(1, bend(radius_m, count));
            lane.drawn_from = from;
            let line = drawn(&lane);
            let points = lane.control_points.as_slice();
            let curve = Curve::new(points, lane.ends).unwrap();
            for step in 0..=1000 {
                let parameter = from + (lane.drawn_to - from) * f64::from(step) / 1000.0;
                prop_assert!(distance_to_line(&curve.point(parameter), &line) <= CHORD_ERROR_M + 1e-9);
            }
        }
    }

    #[test]
    fn a_straight_lane_costs_one_chord_per_control_point() {
        assert_eq!(drawn(&lane_of(1, bend(1e9, 20))).len(), 20);
    }

    #[test]
    fn a_lane_with_one_control_point_draws_nothing() {
        assert!(drawn(&lane_of(1, bend(50.0, 1))).is_empty());
    }

    #[test]
    fn a_line_over_the_antimeridian_is_cut_in_two_that_meet_there() {
        let line = vec![[179.9999, 10.0, 1.0], [-179.9999, 10.002, 3.0], [-179.9998, 10.003, 3.0]];
        let parts = cut_at_antimeridian(line);
        assert_eq!(parts.len(), 2);
        assert_eq!(parts[0].last(), Some(&[180.0, 10.001, 2.0]));
        assert_eq!(parts[1].first(), Some(&[-180.0, 10.001, 2.0]));
        assert_eq!(parts[1].len(), 3);
    }

    #[test]
    fn a_line_that_ends_on_the_antimeridian_stays_on_its_side_and_one_through_a_point_there_is_cut_there() {
        for (end, other) in [(180.0, 180.0), (-180.0, 180.0)] {
            let parts = cut_at_antimeridian(vec![[179.9998, 10.0, 1.0], [179.9999, 10.0, 1.0], [end, 10.0, 1.0]]);
            assert_eq!(parts.len(), 1);
            assert_eq!(parts[0].last(), Some(&[other, 10.0, 1.0]));
        }
        let begun = cut_at_antimeridian(vec![[180.0, 10.0, 1.0], [-179.9999, 10.0, 1.0]]);
        assert_eq!(begun, [vec![[-180.0, 10.0, 1.0], [-179.9999, 10.0, 1.0]]]);
        let through = cut_at_antimeridian(vec![[179.9999, 10.0, 1.0], [-180.0, 10.0, 1.0], [-179.9999, 10.0, 1.0]]);
        let [before, after] = through.as_slice() else { panic!("{through:?}") };
        assert_eq!(before, &[[179.9999, 10.0, 1.0], [180.0, 10.0, 1.0]]);
        assert_eq!(after, &[[-180.0, 10.0, 1.0], [-179.9999, 10.0, 1.0]]);
    }

    #[test]
    fn coordinates_have_at_most_seven_decimals() {
        assert_eq!(serde_json::to_string(&rounded(11.123_456_789, 1e7)).unwrap(), "11.1234568");
        assert_eq!(serde_json::to_string(&rounded(-0.000_000_001, 1e7)).unwrap(), "0.0");
    }
}
