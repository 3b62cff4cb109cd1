//! The line of a tile: a spline as few whole-numbered vertices that lie within half a unit of it.
//!
//! The lattice of a zoom is the web-mercator plane with 4096 units along every tile. Vertices are a function of the
//! spline and the zoom alone, never of a tile, so that all tiles that show a stretch show the same vertices:
//!
//! 1. The control points are projected; the Catmull-Rom spline through their projections is within micrometres of the
//!    projected spline, since the plane is an affine image of the earth over the few metres between them.
//! 2. Chords of it ([`FLAT_UNITS`] off at most: `h^2 / 8 max |p''|`, as in [`crate::projected`]'s source, the drawn line).
//! 3. Vertices are wanted at breakpoints, and where the line enters or leaves the buffer of any tile: a tile cuts lines there,
//!    and never between two vertices.
//! 4. Between those, the farthest vertex is taken whose chord leaves no point by more than [`TUBE_UNITS`]: the cone of all
//!    chords that pass the points so far narrows with each (Sklansky and Gonzalez, *Fast polygonal approximation of digitized
//!    curves*, 1980).
//! 5. A vertex is where the line meets the nearest whole number of the axis along which it runs, rounded in the
//!    other: at most half a unit beside the line, and less where the line is not along an axis.
//!
//! Not guaranteed: the ends of a line, which are rounded in both axes, lie within half a unit in each of them.

use nalgebra::{Point2, Vector2};

use crate::{BUFFER, EXTENT};

/// A point of the lattice.
pub type Vertex = [i64; 2];

/// Greatest distance between the spline and the chords that vertices are chosen by, units.
const FLAT_UNITS: f64 = 0.01;
/// Greatest distance between those chords and the line of a tile, units: with the former half a unit.
const TUBE_UNITS: f64 = 0.49;
/// Most chords of one segment, whatever its shape.
const MOST_CHORDS: f64 = 256.0;

/// Units of a zoom's lattice along the side of the plane.
#[must_use]
pub fn units(zoom: u8) -> f64 {
    f64::from(EXTENT) * f64::from(1_u32 << zoom)
}

/// Which ends of a line lie on the border of its cell, where its next piece begins with the same place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Borders {
    /// The first.
    pub first: bool,
    /// The last.
    pub last: bool,
}

/// A spline over the plane: control points as [`crate::mercator`] projects them.
#[derive(Clone, Copy, Debug)]
pub struct PlaneCurve<'a> {
    /// The control points, at least two.
    pub points: &'a [Point2<f64>],
    /// Which ends lie on a border.
    pub borders: Borders,
}

/// A point of the spline in units, and the direction of the spline there.
#[derive(Clone, Copy, Debug)]
struct Place {
    at: Point2<f64>,
    along: Vector2<f64>,
    /// Whether a vertex is wanted here.
    wanted: bool,
}

impl PlaneCurve<'_> {
    /// Appends the vertices between two control points, both included, to those of the stretch before, whose last is the
    /// first of this one and is not repeated.
    pub fn append_vertices(&self, from: usize, to: usize, zoom: u8, vertices: &mut Vec<Vertex>) {
        let places = self.places(from as f64, to as f64, units(zoom));
        let ends = [self.breakpoint(from, &places[0]), self.breakpoint(to, &places[places.len() - 1])];
        through(&places, ends, vertices);
    }

    /// Appends the vertices of the part between two parameters: 3.5 is half way from control point 3 to the next.
    pub fn append_part(&self, [from, to]: [f64; 2], zoom: u8, vertices: &mut Vec<Vertex>) {
        let places = self.places(from, to, units(zoom));
        let ends = [snapped(&places[0]), snapped(&places[places.len() - 1])];
        through(&places, ends, vertices);
    }

    /// The point at a parameter, on the plane.
    #[must_use]
    pub fn at(&self, parameter: f64) -> Point2<f64> {
        let index = self.segment_of(parameter);
        let [p0, p1, p2, p3] = self.segment(index, 1.0);
        let u = parameter - index as f64;
        Point2::from(p0 + (p1 + (p2 + p3 * u) * u) * u)
    }

    /// The vertex at a control point: the same for the stretches on both sides of it.
    fn breakpoint(&self, index: usize, place: &Place) -> Vertex {
        let on_border = (index == 0 && self.borders.first) || (index + 1 == self.points.len() && self.borders.last);
        if on_border { rounded(place.at) } else { snapped(place) }
    }

    /// The ends of chords between two parameters, and the places between them where a vertex is wanted.
    fn places(&self, from: f64, to: f64, units: f64) -> Vec<Place> {
        let first = self.segment_of(from);
        let mut places = Vec::with_capacity(2 * (self.segment_of(to) - first) + 4);
        let mut index = first;
        while index == first || (index as f64) < to {
            let [p0, p1, p2, p3] = self.segment(index, units);
            let place = |u: f64, wanted: bool| Place {
                at: Point2::from(p0 + (p1 + (p2 + p3 * u) * u) * u),
                along: p1 + (2.0 * p2 + 3.0 * p3 * u) * u,
                wanted,
            };
            let [start, end] = [(from - index as f64).max(0.0), (to - index as f64).min(1.0)];
            if index == first {
                places.push(place(start, true));
            }
            let bend = (2.0 * p2).norm().max((2.0 * p2 + 6.0 * p3).norm());
            let chords = ((bend / (8.0 * FLAT_UNITS)).sqrt() * (end - start)).ceil().clamp(1.0, MOST_CHORDS);
            let is_last = (index + 1) as f64 >= to;
            let mut chord = 1.0;
            while chord <= chords {
                let next = place(start + (end - start) * (chord / chords), is_last && chord >= chords);
                let before = places[places.len() - 1].at;
                push_edges(&before, &next.at, &mut places);
                places.push(next);
                chord += 1.0;
            }
            index += 1;
        }
        places
    }

    /// The segment in which a parameter lies.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a parameter counts control points")]
    fn segment_of(&self, parameter: f64) -> usize {
        (parameter.max(0.0) as usize).min(self.points.len() - 2)
    }

    /// Coefficients of a segment by powers of its parameter, units.
    fn segment(&self, index: usize, units: f64) -> [Vector2<f64>; 4] {
        let points = self.points;
        let (start, end) = (points[index].coords, points[index + 1].coords);
        // Phantoms beyond the ends, as END_RULE_REFLECTED has them.
        let before = if index > 0 { points[index - 1].coords } else { start * 2.0 - end };
        let after = points.get(index + 2).map_or(end * 2.0 - start, |after| after.coords);
        [
            start * units,
            (end - before) * (0.5 * units),
            (before - start * 2.5 + end * 2.0 - after * 0.5) * units,
            ((start - end) * 1.5 + (after - before) * 0.5) * units,
        ]
    }
}

/// Appends the places where a chord crosses the edge of the buffer of some tile, in their order.
fn push_edges(from: &Point2<f64>, to: &Point2<f64>, places: &mut Vec<Place>) {
    let first = places.len();
    let along = to - from;
    for axis in 0..2 {
        for offset in [-f64::from(BUFFER), f64::from(BUFFER)] {
            let extent = f64::from(EXTENT);
            let [low, high] = [from[axis].min(to[axis]), from[axis].max(to[axis])];
            let mut edge = ((low - offset) / extent).floor() * extent + extent + offset;
            while edge < high {
                let share = (edge - from[axis]) / along[axis];
                places.push(Place { at: from + along * share, along, wanted: true });
                edge += extent;
            }
        }
    }
    if places.len() > first + 1 {
        places[first..].sort_by(|a, b| (a.at - from).dot(&along).total_cmp(&(b.at - from).dot(&along)));
    }
}

/// Appends the vertices of a line through some places, but for a first one that is the last there is; it begins and ends
/// with those given.
fn through(places: &[Place], ends: [Vertex; 2], vertices: &mut Vec<Vertex>) {
    let mut append = |vertex: Vertex| {
        if vertices.last() != Some(&vertex) {
            vertices.push(vertex);
        }
    };
    append(ends[0]);
    let (mut start, mut first) = (0, ends[0]);
    for end in 1..places.len() {
        if places[end].wanted {
            let last = if end + 1 == places.len() { ends[1] } else { snapped(&places[end]) };
            between(&places[start..=end], first, last, &mut append);
            append(last);
            (start, first) = (end, last);
        }
    }
}

/// Appends the vertices that are needed between the first and the last of some places.
fn between(places: &[Place], first: Vertex, last: Vertex, append: &mut impl FnMut(Vertex)) {
    let end = places.len() - 1;
    let (mut start, mut from) = (0, first);
    while start < end {
        let mut cone = Cone::new(from);
        let mut farthest = (start + 1, if start + 1 == end { last } else { snapped(&places[start + 1]) });
        for (index, place) in places.iter().enumerate().skip(start + 1) {
            let vertex = if index == end { last } else { snapped(place) };
            if cone.holds(vertex) {
                farthest = (index, vertex);
            }
            cone.narrow(&place.at);
            if cone.is_empty() {
                break;
            }
        }
        (start, from) = farthest;
        if start < end {
            append(from);
        }
    }
}

/// All directions from a vertex in which a chord passes some points within [`TUBE_UNITS`].
struct Cone {
    apex: Vertex,
    /// Its borders to the right and to the left; none before a point is farther than the tube is wide.
    borders: Option<[Vector2<f64>; 2]>,
    empty: bool,
}

impl Cone {
    fn new(apex: Vertex) -> Self {
        Self { apex, borders: None, empty: false }
    }

    fn is_empty(&self) -> bool {
        self.empty
    }

    fn holds(&self, vertex: Vertex) -> bool {
        let to = Vector2::new((vertex[0] - self.apex[0]) as f64, (vertex[1] - self.apex[1]) as f64);
        match self.borders {
            None => true,
            Some([right, left]) => !self.empty && right.perp(&to) >= 0.0 && to.perp(&left) >= 0.0,
        }
    }

    fn narrow(&mut self, point: &Point2<f64>) {
        let to = Vector2::new(point.x - self.apex[0] as f64, point.y - self.apex[1] as f64);
        let square = to.norm_squared();
        if square <= TUBE_UNITS * TUBE_UNITS {
            return;
        }
        // The two tangents from the apex to the circle around the point.
        let reach = (square - TUBE_UNITS * TUBE_UNITS).sqrt();
        let turned =
            |side: f64| Vector2::new(to.x * reach - side * to.y * TUBE_UNITS, to.y * reach + side * to.x * TUBE_UNITS);
        let [right, left] = [turned(-1.0), turned(1.0)];
        let Some([before_right, before_left]) = self.borders else {
            self.borders = Some([right, left]);
            return;
        };
        let narrowed = [
            if before_right.perp(&right) > 0.0 { right } else { before_right },
            if left.perp(&before_left) > 0.0 { left } else { before_left },
        ];
        self.empty |= narrowed[0].perp(&narrowed[1]) < 0.0 || to.dot(&(before_right + before_left)) < 0.0;
        self.borders = Some(narrowed);
    }
}

/// The vertex at a place: on the nearest whole number of the axis along which the line runs.
fn snapped(place: &Place) -> Vertex {
    let along = place.along;
    let main = usize::from(along.y.abs() > along.x.abs());
    let whole = place.at[main].round();
    let slope = if along[main] == 0.0 { 0.0 } else { along[1 - main] / along[main] };
    let other = place.at[1 - main] + (whole - place.at[main]) * slope;
    rounded(if main == 0 { Point2::new(whole, other) } else { Point2::new(other, whole) })
}

#[expect(clippy::cast_possible_truncation, reason = "units of a zoom are fewer than 2^34")]
fn rounded(at: Point2<f64>) -> Vertex {
    [at.x.round() as i64, at.y.round() as i64]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Control points about 3 m apart, some of them centimetres aside, on a bend of any radius; the plane is of zoom 20.
    fn any_line() -> impl Strategy<Value = Vec<Point2<f64>>> {
        let bend = (8.0..400.0f64, 0.0..6.3f64, prop::collection::vec(-0.02..0.02f64, 4..60));
        bend.prop_map(|(radius_m, heading, asides)| {
            let metre = 1.0 / 26.0 / f64::from(1 << 20);
            let place = asides.iter().enumerate().map(|(index, aside)| {
                let turned = 3.0 * index as f64 / radius_m;
                let (sin, cos) = (heading + turned).sin_cos();
                Point2::new(0.53, 0.34) + Vector2::new(sin, cos) * ((radius_m + aside) * metre)
            });
            place.collect()
        })
    }

    fn vertices(points: &[Point2<f64>], breakpoints: &[usize], zoom: u8) -> Vec<Vertex> {
        let curve = PlaneCurve { points, borders: Borders::default() };
        let mut vertices = Vec::new();
        for pair in breakpoints.windows(2) {
            curve.append_vertices(pair[0], pair[1], zoom, &mut vertices);
        }
        vertices
    }

    fn at(vertex: Vertex) -> Point2<f64> {
        Point2::new(vertex[0] as f64, vertex[1] as f64)
    }

    fn distance_to_chords(point: &Point2<f64>, line: &[Point2<f64>]) -> f64 {
        let chords = line.windows(2).filter(|pair| pair[0] != pair[1]).map(|pair| {
            let chord = pair[1] - pair[0];
            let along = ((point - pair[0]).dot(&chord) / chord.norm_squared()).clamp(0.0, 1.0);
            (point - (pair[0] + chord * along)).norm()
        });
        chords.fold(f64::INFINITY, f64::min)
    }

    fn on_the_spline(points: &[Point2<f64>], steps: usize, zoom: u8) -> Vec<Point2<f64>> {
        let curve = PlaneCurve { points, borders: Borders::default() };
        let segments = (0..points.len() - 1).flat_map(|index| {
            let [p0, p1, p2, p3] = curve.segment(index, units(zoom));
            (0..=steps).map(move |step| {
                let u = step as f64 / steps as f64;
                Point2::from(p0 + (p1 + (p2 + p3 * u) * u) * u)
            })
        });
        segments.collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn no_point_of_a_spline_is_farther_than_half_a_unit_from_its_line(points in any_line(), zoom in 12..=20_u8) {
            let line = vertices(&points, &[0, points.len() - 1], zoom);
            let spline = on_the_spline(&points, 40, zoom);
            let chords: Vec<_> = line.iter().copied().map(at).collect();
            prop_assume!(line.len() > 1);
            // But for the ends, which may be rounded along the line by half a unit too.
            let ends = [spline[0], spline[spline.len() - 1]];
            for point in spline.iter().filter(|point| ends.iter().all(|end| (*point - end).norm() > 1.0)) {
                let distance = distance_to_chords(point, &chords);
                prop_assert!(distance <= 0.5 + FLAT_UNITS, "{distance} at zoom {zoom}");
            }
        }

        #[test]
        fn every_vertex_lies_within_half_a_unit_of_the_spline(points in any_line(), zoom in 12..=20_u8) {
            let line = vertices(&points, &[0, points.len() - 1], zoom);
            // Chords of 5 units leave the sharpest bend by a few thousandths.
            let spline = on_the_spline(&points, 100, zoom);
            for vertex in &line[1..line.len().max(2) - 1] {
                let distance = distance_to_chords(&at(*vertex), &spline);
                prop_assert!(distance <= 0.5 + FLAT_UNITS, "{distance} at zoom {zoom}");
            }
        }

        #[test]
        fn stretches_of_a_line_meet_in_one_vertex(points in any_line(), zoom in 12..=20_u8) {
            let middle = points.len() / 2;
            let (before, after) = (vertices(&points, &[0, middle], zoom), vertices(&points, &[middle, points.len() - 1], zoom));
            prop_assert_eq!(before.last(), after.first());
        }
    }

    #[test]
    fn a_straight_line_has_no_vertex_but_its_ends_and_those_at_edges() {
        let metre = 1.0 / 26.0 / f64::from(1 << 20);
        let points: Vec<_> =
            (0..40).map(|i| Point2::new(0.53, 0.34) + Vector2::new(3.0, 1.2) * (f64::from(i) * metre)).collect();
        let edges = |line: &[Vertex]| {
            let crossed = |axis: usize| {
                let [from, to] = [line[0][axis], line[line.len() - 1][axis]];
                [-128, 128]
                    .map(|offset| (to - offset).div_euclid(4096) - (from - offset).div_euclid(4096))
                    .iter()
                    .sum::<i64>()
            };
            usize::try_from(crossed(0) + crossed(1)).unwrap()
        };
        for zoom in [14, 17, 20] {
            let line = vertices(&points, &[0, 39], zoom);
            assert!(line.len() <= 2 + edges(&line), "{} vertices at zoom {zoom}", line.len());
        }
    }
}
