//! Borders: a cell's lines are cut where its tile ends, and joined with those of the next cell.
//!
//! Cells on both sides of a border are fused from the same drives around it, but each from others farther away, so that
//! their lines meet a little beside each other. The smaller of the two cells owns the border: where a line of each crosses
//! it within [`MOST_APART_M`], in the same direction or the opposite one, the two are one line. The larger cell then moves
//! the end of its piece to the owner's crossing, and the way there with it, tapering off over [`TAPER_M`]. What a cell
//! shows is a pure function of its own lines and of its neighbours' crossings: whoever is fused first, the result is the same.

use lanemap_core::{
    Category, EndRule, TimestampNs,
    fleet::{CellId, FusedLane, FusedLaneId, FusedPoint},
    geometry::georeference::{Anchor, Wgs84, ecef_from_wgs84},
    spline::Curve,
};
use nalgebra::{Point3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// Farthest that two crossings of one line lie apart, metres.
const MOST_APART_M: f64 = 0.5;
/// Way over which a piece is moved to meet the next one, metres.
const TAPER_M: f64 = 24.0;
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
            found.extend(next.map(|beyond| Crossing { piece: name, end, place, direction, beyond }));
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
        for (end, join) in [(End::First, begins_at), (End::Last, ends_at)] {
            if let Some(join) = join {
                move_end(&mut piece.points, end, anchor.enu_from_wgs84(&join.place));
            }
        }
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
        let theirs: Vec<&Crossing> = there.iter().filter(|crossing| crossing.beyond == cell).collect();
        let here: Vec<Crossing> = ours.iter().map(|index| joins[*index].0).collect();
        for (our, their) in pairs(&here, &theirs) {
            let join = &mut joins[ours[our]].1;
            join.continues_in = Some((neighbour, their.piece));
            if neighbour < cell {
                join.place = their.place;
            }
        }
    }
    joins
}

/// Crossings of one line, seen from both sides: the nearest two first, each in one pair at most. The same pairs whichever
/// side asks.
fn pairs<'a>(ours: &[Crossing], theirs: &[&'a Crossing]) -> Vec<(usize, &'a Crossing)> {
    let mut candidates = Vec::new();
    for (our, here) in ours.iter().enumerate() {
        for (their, there) in theirs.iter().enumerate() {
            let apart_m = nalgebra::distance(&ecef_from_wgs84(&here.place), &ecef_from_wgs84(&there.place));
            if apart_m <= MOST_APART_M && here.direction.dot(&there.direction).abs() >= LEAST_COS {
                let names = [(here.piece, here.end), (there.piece, there.end)];
                let names = if names[0] <= names[1] { names } else { [names[1], names[0]] };
                candidates.push((apart_m, names, our, their));
            }
        }
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let (mut taken_ours, mut taken_theirs) = (vec![false; ours.len()], vec![false; theirs.len()]);
    let mut pairs = Vec::new();
    for (_, _, our, their) in candidates {
        if !taken_ours[our] && !taken_theirs[their] {
            (taken_ours[our], taken_theirs[their]) = (true, true);
            pairs.push((our, theirs[their]));
        }
    }
    pairs
}

/// Moves an end of a piece to a place, and what lies before it by less and less.
fn move_end(points: &mut [FusedPoint], end: End, place: Point3<f64>) {
    let last = points.len() - 1;
    let at = |step: usize| if end == End::First { step } else { last - step };
    let offset: Vector3<f64> = place - points[at(0)].position;
    if offset.norm() == 0.0 {
        return;
    }
    let (mut way_m, mut before) = (0.0, points[at(0)].position);
    // The other end may lie on a border of its own: it stays.
    for step in 0..last {
        let point = &mut points[at(step)];
        way_m += nalgebra::distance(&before, &point.position);
        before = point.position;
        point.position += offset * (1.0 - way_m / TAPER_M).max(0.0);
    }
    points[at(0)].position = place;
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
        (a.piece, a.end) == (b.piece, b.end) && apart_m <= SAME_M
    };
    before.len() != after.len() || !before.iter().zip(&after).all(same)
}

#[cfg(test)]
mod tests {
    use lanemap_core::{LaneId, fleet::DriveId};

    use super::*;

    /// Two cells side by side in Munich.
    fn cells() -> (CellId, CellId) {
        (CellId::new(8_718, 5_685).unwrap(), CellId::new(8_719, 5_685).unwrap())
    }

    fn id(drive: u64) -> FusedLaneId {
        FusedLaneId { started: TimestampNs(1), drive: DriveId(drive), lane: LaneId(4), piece: 0, stretch: 0 }
    }

    /// A line to the east over the border of both cells, as the cell sees it, `aside_m` to the north.
    fn line(cell: CellId, drive: u64, aside_m: f64) -> FusedLane {
        let (here, anchor) = (cells().0.anchor(), cell.anchor());
        let points = (0..40).map(|i| {
            let place = here.wgs84_from_enu(&Point3::new(760.0 + 3.0 * f64::from(i), 20.0 + aside_m, 500.0));
            FusedPoint {
                position: anchor.enu_from_wgs84(&place),
                lateral_sigma_m: 0.1,
                height_sigma_m: 0.2,
                drives: 2,
                existence: 0.9,
                confirmed: TimestampNs(2),
            }
        });
        FusedLane {
            id: id(drive),
            category: Category::WhiteSolid,
            category_posterior: vec![],
            points: points.collect(),
            drives: 2,
            observations: 9,
            first_seen: TimestampNs(1),
            last_seen: TimestampNs(2),
        }
    }

    fn joined_both(here: &[FusedLane], there: &[FusedLane]) -> (Vec<JoinedPiece>, Vec<JoinedPiece>) {
        let (a, b) = cells();
        let ((pieces_a, crossings_a), (pieces_b, crossings_b)) = (cut(a, here), cut(b, there));
        let joined_a = join(a, pieces_a, &crossings_a, |cell| (cell == b).then_some(crossings_b.as_slice()));
        let joined_b = join(b, pieces_b, &crossings_b, |cell| (cell == a).then_some(crossings_a.as_slice()));
        (joined_a, joined_b)
    }

    #[test]
    fn both_pieces_of_a_line_name_each_other_and_share_the_owners_border_point() {
        let (a, b) = cells();
        let (here, there) = joined_both(&[line(a, 1, 0.0)], &[line(b, 1, 0.2)]);
        let (leaves, comes) = (here[0].ends_at.unwrap(), there[0].begins_at.unwrap());
        assert_eq!(leaves.place, comes.place);
        assert_eq!(leaves.continues_in, Some((b, there[0].piece.name)));
        assert_eq!(comes.continues_in, Some((a, here[0].piece.name)));
        assert_eq!((here[0].begins_at, there[0].ends_at), (None, None));
        let end = b.anchor().wgs84_from_enu(&there[0].piece.points[0].position);
        assert!((end.latitude_deg - comes.place.latitude_deg).abs() < 1e-12);
        // The owner's piece stays, the other bends to meet it and has its own course again 24 m on.
        let height = |piece: &JoinedPiece, index: usize| {
            cells().0.anchor().enu_from_wgs84(&b.anchor().wgs84_from_enu(&piece.piece.points[index].position)).y
        };
        assert!((height(&there[0], 0) - 20.0).abs() < 1e-6 && (height(&there[0], 12) - 20.2).abs() < 1e-3);
    }

    #[test]
    fn lines_that_meet_too_far_apart_do_not_continue_each_other() {
        let (a, b) = cells();
        let (here, there) = joined_both(&[line(a, 1, 0.0)], &[line(b, 1, 0.6)]);
        assert_eq!((here[0].ends_at.unwrap().continues_in, there[0].begins_at.unwrap().continues_in), (None, None));
    }

    #[test]
    fn of_two_lines_side_by_side_each_continues_in_its_own() {
        let (a, b) = cells();
        let (here, there) = joined_both(&[line(a, 1, 0.0), line(a, 2, 0.3)], &[line(b, 3, 0.1), line(b, 4, 0.4)]);
        let goes_on = |piece: &JoinedPiece| piece.ends_at.unwrap().continues_in.unwrap().1.lane.drive.0;
        assert_eq!(here.iter().map(goes_on).collect::<Vec<_>>(), [3, 4]);
        let comes_from = |piece: &JoinedPiece| piece.begins_at.unwrap().continues_in.unwrap().1.lane.drive.0;
        assert_eq!(there.iter().map(comes_from).collect::<Vec<_>>(), [1, 2]);
    }

    #[test]
    fn a_piece_ends_on_the_border_and_no_chord_of_it_is_short() {
        let (a, _) = cells();
        let (pieces, crossings) = cut(a, &[line(a, 1, 0.0)]);
        let east = a.bounds().east;
        assert!((crossings[0].place.longitude_deg - east).abs() < 1e-9 && crossings[0].place.longitude_deg < east);
        for pair in pieces[0].points.windows(2) {
            let chord_m = nalgebra::distance(&pair[0].position, &pair[1].position);
            assert!((1.5..=4.6).contains(&chord_m), "{chord_m}");
        }
    }
}
