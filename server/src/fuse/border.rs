//! Borders: a cell's lines are cut where its tile ends, and joined with those of the next cell.
//!
//! Cells on both sides of a border are fused from the same drives around it, but each from others farther away, so that
//! their lines meet a little beside each other. [`matching`] tells which crossings are of one line. Both pieces of it then
//! end half way between the two, and the way there is moved with its end, by less and less: over [`TAPER_M`], and over so much
//! more that no line bends by more than [`MOST_BEND`] for it. What a point is moved by is added to its variance. What a cell
//! shows is a pure function of its own lines and of its neighbours' crossings as they were fused: whoever is fused first, the
//! result is the same, and no cell follows another that follows it.

mod matching;
#[cfg(test)]
mod tests;

use lanemap_core::{
    Category, EndRule, TimestampNs,
    fleet::{CellId, FusedLane, FusedLaneId, FusedPoint},
    geometry::georeference::{Anchor, Wgs84, ecef_from_wgs84},
    spline::Curve,
};
use nalgebra::{Point3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// Least way over which a piece is moved to meet the next one, metres.
const TAPER_M: f64 = 24.0;
/// Most that a piece is turned by to meet the next one: metres to the side for each metre of way.
const MOST_BEND: f64 = 0.02;
/// A control point nearer to the end of its piece than this makes way for it, metres: half of what lies between two.
const NEAREST_M: f64 = 1.5;
/// Least cosine of the angle between two crossings of one line.
const LEAST_COS: f64 = 0.9;

/// Name of a piece of a line within a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub(crate) struct PieceName {
    pub(crate) lane: FusedLaneId,
    pub(crate) part: u32,
}

/// Which end of a piece.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum End {
    First,
    Last,
}

/// Where a piece crosses the border of its cell.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Crossing {
    pub(crate) piece: PieceName,
    pub(crate) end: End,
    pub(crate) place: Wgs84,
    /// Direction of the line there, east and north, of length 1.
    pub(crate) direction: Vector2<f64>,
    /// The cell on the other side.
    pub(crate) beyond: CellId,
    /// Category of the line.
    pub(crate) category: Category,
}

/// A piece of a line, as it was fused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Piece {
    pub(crate) name: PieceName,
    pub(crate) category: Category,
    pub(crate) category_posterior: Vec<f64>,
    /// East-north-up at the cell's anchor, metres.
    pub(crate) points: Vec<FusedPoint>,
    pub(crate) drives: u32,
    pub(crate) observations: u64,
    pub(crate) first_seen: TimestampNs,
    pub(crate) last_seen: TimestampNs,
}

/// The end of a piece on a border, as it is shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Join {
    pub(crate) place: Wgs84,
    pub(crate) continues_in: Option<(CellId, PieceName)>,
}

/// A piece as it is shown, joined with its neighbours.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct JoinedPiece {
    pub(crate) piece: Piece,
    pub(crate) begins_at: Option<Join>,
    pub(crate) ends_at: Option<Join>,
}

/// Cuts lines at the border of a cell; gives the pieces within it and where they cross.
pub(crate) fn cut(cell: CellId, lanes: &[FusedLane]) -> (Vec<Piece>, Vec<Crossing>) {
    let anchor = cell.anchor();
    let (mut pieces, mut crossings) = (Vec::new(), Vec::new());
    for lane in lanes {
        cut_lane(cell, &anchor, lane, &mut pieces, &mut crossings);
    }
    (pieces, crossings)
}

fn cut_lane(cell: CellId, anchor: &Anchor, lane: &FusedLane, pieces: &mut Vec<Piece>, crossings: &mut Vec<Crossing>) {
    let line: Vec<Point3<f64>> = lane.points.iter().map(|point| point.position).collect();
    let Some(curve) = Curve::new(line.as_slice(), EndRule::Reflected) else { return };
    let inside = |position: &Point3<f64>| cell.contains(&anchor.wgs84_from_enu(position));
    let within: Vec<bool> = line.iter().map(inside).collect();
    let (mut first, mut part) = (0, 0);
    for run in within.chunk_by(|a, b| a == b) {
        let (from, to) = (first, first + run.len());
        first = to;
        if !run[0] {
            continue;
        }
        let name = PieceName { lane: lane.id, part };
        let mut points = lane.points[from..to].to_vec();
        let mut found = Vec::new();
        for (end, beside, beyond) in
            [(End::First, from, from.checked_sub(1)), (End::Last, to - 1, Some(to).filter(|to| *to < line.len()))]
        {
            let Some(beyond) = beyond else { continue };
            let parameter = crossing_between(&curve, beside as f64, beyond as f64, &inside);
            let position = curve.point(parameter);
            let share = (parameter - beside as f64).abs();
            reach(&mut points, end, between(&lane.points[beside], &lane.points[beyond], share, position));
            let direction = curve.derivative(parameter).xy().try_normalize(1e-9).unwrap_or_default();
            let next = CellId::containing(&anchor.wgs84_from_enu(&line[beyond]));
            let place = anchor.wgs84_from_enu(&position);
            let category = lane.category;
            found.extend(next.map(|beyond| Crossing { piece: name, end, place, direction, beyond, category }));
        }
        if points.len() >= 2 {
            part += 1;
            crossings.extend(found);
            pieces.push(Piece {
                name,
                category: lane.category,
                category_posterior: lane.category_posterior.clone(),
                points,
                drives: lane.drives,
                observations: lane.observations,
                first_seen: lane.first_seen,
                last_seen: lane.last_seen,
            });
        }
    }
}

/// The parameter at which a curve leaves a cell, between one within it and one beyond.
fn crossing_between(
    curve: &Curve<'_, [Point3<f64>]>,
    mut within: f64,
    mut beyond: f64,
    inside: &impl Fn(&Point3<f64>) -> bool,
) -> f64 {
    for _ in 0..40 {
        let middle = 0.5 * (within + beyond);
        if inside(&curve.point(middle)) {
            within = middle;
        } else {
            beyond = middle;
        }
    }
    within
}

/// What is known at a position between two points.
fn between(here: &FusedPoint, there: &FusedPoint, share: f64, position: Point3<f64>) -> FusedPoint {
    let mixed = |here: f64, there: f64| here + (there - here) * share;
    FusedPoint {
        position,
        lateral_sigma_m: mixed(here.lateral_sigma_m, there.lateral_sigma_m),
        height_sigma_m: mixed(here.height_sigma_m, there.height_sigma_m),
        existence: mixed(here.existence, there.existence),
        ..*here
    }
}

/// Lets a piece reach its border; a control point close to it makes way, so that no chord is much shorter than others.
fn reach(points: &mut Vec<FusedPoint>, end: End, border: FusedPoint) {
    let beside = match end {
        End::First => points.first(),
        End::Last => points.last(),
    };
    let is_near = beside.is_some_and(|beside| nalgebra::distance(&beside.position, &border.position) < NEAREST_M);
    if is_near && points.len() > 1 {
        match end {
            End::First => drop(points.remove(0)),
            End::Last => drop(points.pop()),
        }
    }
    match end {
        End::First => points.insert(0, border),
        End::Last => points.push(border),
    }
}

/// Joins the pieces of a cell with those of its neighbours, of which `crossings_of` gives the crossings.
pub(crate) fn join<'a>(
    cell: CellId,
    pieces: Vec<Piece>,
    crossings: &[Crossing],
    crossings_of: impl Fn(CellId) -> Option<&'a [Crossing]>,
) -> Vec<JoinedPiece> {
    let anchor = cell.anchor();
    let joins = joins(cell, crossings, crossings_of);
    let join_of = |name: PieceName, end: End| {
        let found = joins.iter().find(|(crossing, _)| crossing.piece == name && crossing.end == end);
        found.map(|(_, join)| *join)
    };
    let joined = pieces.into_iter().map(|mut piece| {
        let (begins_at, ends_at) = (join_of(piece.name, End::First), join_of(piece.name, End::Last));
        let to = [begins_at, ends_at].map(|join| join.map(|join| anchor.enu_from_wgs84(&join.place)));
        move_ends(&mut piece.points, to);
        JoinedPiece { piece, begins_at, ends_at }
    });
    joined.collect()
}

/// The join at each crossing of a cell.
fn joins<'a>(
    cell: CellId,
    crossings: &[Crossing],
    crossings_of: impl Fn(CellId) -> Option<&'a [Crossing]>,
) -> Vec<(Crossing, Join)> {
    let mut joins: Vec<(Crossing, Join)> =
        crossings.iter().map(|crossing| (*crossing, Join { place: crossing.place, continues_in: None })).collect();
    let mut neighbours: Vec<CellId> = crossings.iter().map(|crossing| crossing.beyond).collect();
    neighbours.sort_unstable();
    neighbours.dedup();
    for neighbour in neighbours {
        let there = crossings_of(neighbour).unwrap_or_default();
        let ours: Vec<usize> = (0..joins.len()).filter(|index| joins[*index].0.beyond == neighbour).collect();
        let theirs: Vec<Crossing> = there.iter().filter(|crossing| crossing.beyond == cell).copied().collect();
        let here: Vec<Crossing> = ours.iter().map(|index| joins[*index].0).collect();
        // Both cells do the same sums.
        let is_first = cell < neighbour;
        let (first, second) = if is_first { (&here, &theirs) } else { (&theirs, &here) };
        for (one, other) in matching::pairs(&cell.min(neighbour).anchor(), first, second) {
            let (our, their) = if is_first { (one, other) } else { (other, one) };
            joins[ours[our]].1 = Join {
                place: half_way(&first[one].place, &second[other].place),
                continues_in: Some((neighbour, theirs[their].piece)),
            };
        }
    }
    joins
}

/// The place half way between two that are near each other.
fn half_way(one: &Wgs84, other: &Wgs84) -> Wgs84 {
    let middle = |one: f64, other: f64| 0.5 * (one + other);
    Wgs84 {
        latitude_deg: middle(one.latitude_deg, other.latitude_deg),
        longitude_deg: middle(one.longitude_deg, other.longitude_deg),
        height_m: middle(one.height_m, other.height_m),
    }
}

/// Moves the ends of a piece to their places, and what lies before them by less and less.
fn move_ends(points: &mut [FusedPoint], to: [Option<Point3<f64>>; 2]) {
    let last = points.len() - 1;
    let mut way_m = vec![0.0; points.len()];
    for step in 1..=last {
        way_m[step] = way_m[step - 1] + nalgebra::distance(&points[step - 1].position, &points[step].position);
    }
    let length_m = way_m[last];
    let moved =
        [(0, to[0]), (last, to[1])].map(|(end, to)| to.map_or_else(Vector3::zeros, |to| to - points[end].position));
    // An end on a border does not follow the other one; an end within the cell does.
    let most_m = if to[0].is_some() && to[1].is_some() { length_m } else { f64::INFINITY };
    let share = |moved: &Vector3<f64>, from_end_m: f64| {
        let taper_m = (moved.norm() / MOST_BEND).max(TAPER_M).min(most_m).max(f64::MIN_POSITIVE);
        (1.0 - from_end_m / taper_m).max(0.0)
    };
    for (point, way_m) in points.iter_mut().zip(way_m) {
        let by = moved[0] * share(&moved[0], way_m) + moved[1] * share(&moved[1], length_m - way_m);
        point.position += by;
        point.lateral_sigma_m = point.lateral_sigma_m.hypot(by.xy().norm());
        point.height_sigma_m = point.height_sigma_m.hypot(by.z);
    }
    for (end, to) in [(0, to[0]), (last, to[1])] {
        if let Some(to) = to {
            points[end].position = to;
        }
    }
}

/// Whether a neighbour must join its pieces anew: a crossing into it came, went, or moved by more than a millimetre.
pub(crate) fn differ(before: &[Crossing], after: &[Crossing], neighbour: CellId) -> bool {
    const SAME_M: f64 = 1e-3;
    let into = |crossings: &[Crossing]| -> Vec<Crossing> {
        crossings.iter().filter(|crossing| crossing.beyond == neighbour).copied().collect()
    };
    let (before, after) = (into(before), into(after));
    let same = |(a, b): (&Crossing, &Crossing)| {
        let apart_m = nalgebra::distance(&ecef_from_wgs84(&a.place), &ecef_from_wgs84(&b.place));
        (a.piece, a.end, a.category) == (b.piece, b.end, b.category) && apart_m <= SAME_M
    };
    before.len() != after.len() || !before.iter().zip(&after).all(same)
}
