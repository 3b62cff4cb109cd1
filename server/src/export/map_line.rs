//! Lines of the map as cubics in one plane: what lanes are found between, and what they are drawn from.
//!
//! A piece's Catmull-Rom segments are polynomials already; here they are in metres of a [`Plane`], with heights above the
//! ellipsoid. The control points are carried over and the spline is taken anew: over one segment's 9 m the plane is a linear
//! map of the cell's frame but for a micrometre. Pieces that continue each other over the border of a cell become one line,
//! each with its own segments, so that nothing moves.

use lanemap_core::{
    Category, EndRule,
    fleet::CellId,
    geometry::georeference::{Anchor, Wgs84},
    spline::Curve,
};
use lanemap_proto::v1;
use nalgebra::{Point3, Vector2, Vector3};

use super::{ExportError, cell_of, chain::chains, plane::Plane};
use crate::fuse::wire::positions;

/// Farthest that a drawn chord leaves the curve, metres.
pub const CHORD_ERROR_M: f64 = 0.004;
/// Most chords of one segment.
const MOST_CHORDS: f64 = 64.0;

/// Name of a piece: cell, line and part.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PieceName {
    /// The cell.
    pub cell: String,
    /// The line.
    pub id: String,
    /// Which piece of the line within the cell.
    pub part: u32,
}

impl From<&v1::LaneName> for PieceName {
    fn from(name: &v1::LaneName) -> Self {
        Self { cell: name.cell.clone(), id: name.id.clone(), part: name.part }
    }
}

/// A polynomial `c0 + c1 u + c2 u^2 + c3 u^3` over `u` in `[0, 1]`, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cubic(pub [Vector3<f64>; 4]);

impl Cubic {
    /// Its point at `u`.
    #[must_use]
    pub fn point(&self, u: f64) -> Point3<f64> {
        let [c0, c1, c2, c3] = &self.0;
        Point3::from(c0 + (c1 + (c2 + c3 * u) * u) * u)
    }

    /// Its derivative at `u`, metres.
    #[must_use]
    pub fn derivative(&self, u: f64) -> Vector3<f64> {
        let [_, c1, c2, c3] = &self.0;
        c1 + (c2 * 2.0 + c3 * (3.0 * u)) * u
    }

    /// Its second derivative at `u`.
    #[must_use]
    pub fn second_derivative(&self, u: f64) -> Vector3<f64> {
        self.0[2] * 2.0 + self.0[3] * (6.0 * u)
    }

    /// The same curve from `from` to `to`, with a parameter of its own; backwards where `to` is the smaller.
    #[must_use]
    pub fn part(&self, from: f64, to: f64) -> Self {
        let size = to - from;
        Self([
            self.point(from).coords,
            self.derivative(from) * size,
            self.second_derivative(from) * (0.5 * size * size),
            self.0[3] * (size * size * size),
        ])
    }

    /// Length in plan, metres: Gauss and Legendre with five points, which for a segment of a lane is exact to micrometres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        const NODES: [(f64, f64); 5] = [
            (0.0, 0.568_888_888_888_888_9),
            (-0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
            (0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
            (-0.906_179_845_938_664, 0.236_926_885_056_189_1),
            (0.906_179_845_938_664, 0.236_926_885_056_189_1),
        ];
        NODES.iter().map(|(at, weight)| 0.5 * weight * self.derivative(0.5 + 0.5 * at).xy().norm()).sum()
    }

    /// How many equal chords keep [`CHORD_ERROR_M`]. The second derivative is linear: its greatest length is at an end.
    fn chords(&self) -> f64 {
        let bend = self.second_derivative(0.0).norm().max(self.second_derivative(1.0).norm());
        (bend / (8.0 * CHORD_ERROR_M)).sqrt().ceil().clamp(1.0, MOST_CHORDS)
    }
}

/// A piece of the served map within a line.
#[derive(Clone, Debug, PartialEq)]
pub struct Piece {
    /// Its name.
    pub name: PieceName,
    /// Its category, seen in the direction of the line.
    pub category: Category,
    /// Probability that it is there, mean over its control points.
    pub existence: f64,
    /// Index of its first segment.
    pub first_segment: usize,
    /// Number of its segments.
    pub segments: usize,
    /// Whether its own direction is against that of the line.
    pub reversed: bool,
}

/// A line: segments end to end. Its parameter is the number of a segment and the place on it.
#[derive(Clone, Debug, PartialEq)]
pub struct MapLine {
    /// Its segments.
    pub segments: Vec<Cubic>,
    /// The pieces that they come from, in their order.
    pub pieces: Vec<Piece>,
    /// Whether it ends where it begins.
    pub closed: bool,
    /// Length of the gaps in it that were closed, metres.
    pub guessed_m: f64,
}

/// Lines in one plane.
#[derive(Clone, Debug)]
pub struct MapLines {
    /// The plane.
    pub plane: Plane,
    /// The lines, in the order of the names of their first pieces.
    pub lines: Vec<MapLine>,
    /// Number of pieces in them.
    pub pieces: u64,
}

/// Reads cells into lines around the middle of them all.
///
/// # Errors
/// A cell cannot be read, or its name is none.
pub fn read(cells: impl Iterator<Item = Result<v1::CellMap, ExportError>>) -> Result<MapLines, ExportError> {
    let mut maps = Vec::new();
    for map in cells {
        let map = map?;
        maps.push((cell_of(&map)?, map));
    }
    let plane = plane_of(&maps);
    let mut pieces = Vec::new();
    for (cell, map) in &maps {
        let anchor = cell.anchor();
        pieces.extend(map.lanes.iter().filter_map(|lane| piece(&anchor, &plane, &map.cell, lane)));
    }
    let count = pieces.len() as u64;
    Ok(MapLines { plane, lines: chains(&pieces), pieces: count })
}

/// The plane around the middle of cells.
fn plane_of(maps: &[(CellId, v1::CellMap)]) -> Plane {
    let places: Vec<Wgs84> =
        maps.iter().filter(|(_, map)| !map.lanes.is_empty()).map(|(cell, _)| cell.anchor().place()).collect();
    let Some(first) = places.first() else { return Plane::at(0.0, 0.0) };
    // Beside the first one, even where the antimeridian lies between them.
    let east = |place: &Wgs84| (place.longitude_deg - first.longitude_deg + 180.0).rem_euclid(360.0) - 180.0;
    let middle = |of: &dyn Fn(&Wgs84) -> f64| {
        let (low, high) = places
            .iter()
            .map(of)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        0.5 * (low + high)
    };
    let longitude_deg = (first.longitude_deg + middle(&east) + 180.0).rem_euclid(360.0) - 180.0;
    Plane::at(middle(&|place| place.latitude_deg), longitude_deg)
}

/// A piece before it is chained.
pub(super) struct LoosePiece {
    pub(super) name: PieceName,
    pub(super) category: Category,
    pub(super) existence: f64,
    pub(super) segments: Vec<Cubic>,
    pub(super) comes_from: Option<PieceName>,
    pub(super) continues_in: Option<PieceName>,
}

/// One piece in the plane; `None` where it draws nothing.
fn piece(anchor: &Anchor, plane: &Plane, cell: &str, lane: &v1::FusedLane) -> Option<LoosePiece> {
    let mut points: Vec<Point3<f64>> =
        positions(lane).iter().map(|point| plane.project(&anchor.wgs84_from_enu(point))).collect();
    let place = |border: &Option<v1::LaneBorder>| {
        let place = border.as_ref()?.place.as_ref()?;
        Some(plane.project(&Wgs84 {
            latitude_deg: place.latitude_deg,
            longitude_deg: place.longitude_deg,
            height_m: place.height_m,
        }))
    };
    if points.len() < 2 || points.iter().any(|point| !point.coords.iter().all(|value| value.is_finite())) {
        return None;
    }
    if let (Some(place), Some(first)) = (place(&lane.begins_at), points.first_mut()) {
        *first = place;
    }
    if let (Some(place), Some(last)) = (place(&lane.ends_at), points.last_mut()) {
        *last = place;
    }
    let curve = Curve::new(points.as_slice(), EndRule::Reflected)?;
    let segments: Vec<Cubic> = (0..points.len() - 1)
        .map(|segment| Cubic(*curve.segment_at(segment as f64 + 0.5).coefficients()))
        .filter(|cubic| cubic.length_m() > 1e-3)
        .collect();
    let beyond = |border: &Option<v1::LaneBorder>| Some(border.as_ref()?.continues_in.as_ref()?.into());
    let existence = lane.existence_permille.iter().map(|share| f64::from(*share)).sum::<f64>()
        / (1e3 * lane.existence_permille.len().max(1) as f64);
    let code = u8::try_from(lane.category).unwrap_or_default();
    (!segments.is_empty()).then(|| LoosePiece {
        name: PieceName { cell: cell.to_owned(), id: lane.id.clone(), part: lane.part },
        category: Category::from_openlane_code(code).unwrap_or_default(),
        existence,
        segments,
        comes_from: beyond(&lane.begins_at),
        continues_in: beyond(&lane.ends_at),
    })
}

impl MapLine {
    /// The parameter at which it ends.
    #[must_use]
    pub fn end(&self) -> f64 {
        self.segments.len() as f64
    }

    /// The segment of a parameter, and the place on it; beyond the ends those of the first and the last segment.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the segments")]
    pub fn locate(&self, parameter: f64) -> (usize, f64) {
        let segment = (parameter.max(0.0) as usize).min(self.segments.len() - 1);
        (segment, (parameter - segment as f64).clamp(0.0, 1.0))
    }

    /// The point at a parameter.
    #[must_use]
    pub fn point(&self, parameter: f64) -> Point3<f64> {
        let (segment, u) = self.locate(parameter);
        self.segments[segment].point(u)
    }

    /// Unit vector along the line in plan.
    #[must_use]
    pub fn tangent(&self, parameter: f64) -> Vector2<f64> {
        let (segment, u) = self.locate(parameter);
        let cubic = &self.segments[segment];
        let chord = (cubic.point(1.0) - cubic.point(0.0)).xy();
        cubic.derivative(u).xy().try_normalize(1e-6).or_else(|| chord.try_normalize(1e-9)).unwrap_or_default()
    }

    /// Length in plan, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.segments.iter().map(Cubic::length_m).sum()
    }

    /// Length in plan between two parameters, metres.
    #[must_use]
    pub fn length_between_m(&self, from: f64, to: f64) -> f64 {
        self.cubics(from.min(to), from.max(to)).iter().map(|(_, cubic)| cubic.length_m()).sum()
    }

    /// The pieces of its segments between two parameters, each with the parameter at which it begins.
    #[must_use]
    pub fn cubics(&self, from: f64, to: f64) -> Vec<(f64, Cubic)> {
        let mut cubics = Vec::new();
        let mut start = from.max(0.0);
        while start < to.min(self.end()) - 1e-9 {
            let (segment, u) = self.locate(start);
            let end = (segment as f64 + 1.0).min(to);
            cubics.push((start, self.segments[segment].part(u, end - segment as f64)));
            start = end;
        }
        cubics
    }

    /// Parameters of the points of a polyline from one parameter to another, both included; backwards where `to` is the
    /// smaller. No chord leaves the curve by more than [`CHORD_ERROR_M`].
    #[must_use]
    pub fn drawn(&self, from: f64, to: f64) -> Vec<f64> {
        let (low, high) = (from.min(to), from.max(to));
        let mut parameters = vec![low];
        for (start, cubic) in self.cubics(low, high) {
            let (segment, _) = self.locate(start);
            let end = (segment as f64 + 1.0).min(high);
            let chords = cubic.chords();
            let mut chord = 1.0;
            while chord < chords {
                parameters.push(start + (end - start) * chord / chords);
                chord += 1.0;
            }
            parameters.push(end);
        }
        if let Some(last) = parameters.last_mut() {
            *last = high;
        }
        if parameters.len() == 1 {
            parameters.push(high);
        }
        if to < from {
            parameters.reverse();
        }
        parameters
    }

    /// The piece in which a parameter lies.
    #[must_use]
    pub fn piece_at(&self, parameter: f64) -> &Piece {
        let (segment, _) = self.locate(parameter);
        let next = self.pieces.partition_point(|piece| piece.first_segment <= segment);
        &self.pieces[next.saturating_sub(1)]
    }

    /// Probability that it is there, mean over its segments.
    #[must_use]
    pub fn existence(&self) -> f64 {
        let sum: f64 = self.pieces.iter().map(|piece| piece.existence * piece.segments as f64).sum();
        sum / self.segments.len().max(1) as f64
    }
}

/// A category as it is seen against the direction of its line.
#[must_use]
pub fn mirrored(category: Category) -> Category {
    match category {
        Category::WhiteLeftDashedRightSolid => Category::WhiteLeftSolidRightDashed,
        Category::WhiteLeftSolidRightDashed => Category::WhiteLeftDashedRightSolid,
        Category::YellowLeftDashedRightSolid => Category::YellowLeftSolidRightDashed,
        Category::YellowLeftSolidRightDashed => Category::YellowLeftDashedRightSolid,
        Category::LeftCurb => Category::RightCurb,
        Category::RightCurb => Category::LeftCurb,
        other => other,
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A line through points 3 m apart, with a name and a category.
    pub(in crate::export) fn line_through(name: &str, category: Category, points: &[Point3<f64>]) -> MapLine {
        let curve = Curve::new(points, EndRule::Reflected).unwrap();
        let segments: Vec<Cubic> =
            (0..points.len() - 1).map(|i| Cubic(*curve.segment_at(i as f64 + 0.5).coefficients())).collect();
        let name = PieceName { cell: "14-8718-5685".into(), id: name.into(), part: 0 };
        let piece =
            Piece { name, category, existence: 0.9, first_segment: 0, segments: segments.len(), reversed: false };
        MapLine { segments, pieces: vec![piece], closed: false, guessed_m: 0.0 }
    }

    /// Points 3 m apart on an arc to the left of a radius, `aside_m` to the left of it; straight where the radius is infinite.
    pub(in crate::export) fn arc(radius_m: f64, aside_m: f64, from_m: f64, to_m: f64) -> Vec<Point3<f64>> {
        let mut points = Vec::new();
        let mut at_m = from_m;
        while at_m <= to_m + 1e-9 {
            let (x, y) = if radius_m.is_finite() {
                let angle = at_m / radius_m;
                ((radius_m - aside_m) * angle.sin(), radius_m - (radius_m - aside_m) * angle.cos())
            } else {
                (at_m, aside_m)
            };
            points.push(Point3::new(x, y, 0.01 * at_m));
            at_m += 3.0;
        }
        points
    }

    #[test]
    fn a_part_of_a_cubic_is_the_same_curve_forwards_and_backwards() {
        let line = line_through("a", Category::WhiteSolid, &arc(30.0, 0.0, 0.0, 30.0));
        let cubic = line.segments[3];
        for (from, to) in [(0.2, 0.9), (1.0, 0.0)] {
            let part = cubic.part(from, to);
            for step in 0..=10 {
                let u = f64::from(step) / 10.0;
                assert!((part.point(u) - cubic.point(from + (to - from) * u)).norm() < 1e-12);
            }
        }
    }

    #[test]
    fn the_length_of_an_arc_is_that_of_the_circle() {
        let line = line_through("a", Category::WhiteSolid, &arc(30.0, 0.0, 0.0, 60.0));
        assert!((line.length_m() - 60.0).abs() < 0.02, "{}", line.length_m());
        assert!((line.length_between_m(4.0, 2.5) - 4.5).abs() < 0.01);
    }

    #[test]
    fn a_polyline_begins_and_ends_where_it_is_asked_to() {
        let line = line_through("a", Category::WhiteSolid, &arc(20.0, 0.0, 0.0, 30.0));
        let drawn = line.drawn(7.25, 2.5);
        assert_eq!((drawn[0], drawn[drawn.len() - 1]), (7.25, 2.5));
        assert!(drawn.windows(2).all(|pair| pair[0] > pair[1]));
        assert!(drawn.len() > 8, "an arc of 20 m radius needs more than one chord per segment");
    }
}
