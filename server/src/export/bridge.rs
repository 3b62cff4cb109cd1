//! Longer gaps in a line: closed where another line runs beside both ends, in parallel to that.
//!
//! An edge that nobody saw for some metres leaves a lane without a border, and what leads through the lane without a way.
//! Two ends of lines of one kind that face each other within [`LONGEST_M`] are joined where one other line, the guide, passes
//! beside both as far off as lanes are wide, and equally far to [`MOST_WIDENING_M`]. The gap follows the guide. Where any line
//! begins or ends in it, it stays open: there the road may be another one.

use std::collections::{BTreeMap, HashMap};

use lanemap_core::{EndRule, spline::Curve};
use nalgebra::{Point3, Vector2, Vector3};

use super::{
    chain::{PieceEnd, is_one_kind},
    map_line::{Cubic, LoosePiece},
    road::{NARROWEST_LANE_M, WIDEST_LANE_M},
};

/// Longest gap that is closed so, metres.
const LONGEST_M: f64 = 40.0;
/// How much farther the one end may lie from the guide than the other, metres.
const MOST_WIDENING_M: f64 = 0.5;
/// Greatest difference in height between an end and the guide, metres.
const MOST_HEIGHT_M: f64 = 1.0;
/// Least cosine of the angle between an end and the guide, and between both ends.
const LEAST_COS: f64 = 0.97;
const LEAST_FACING_COS: f64 = 0.8;
/// Way between the control points of a closed gap, metres.
const STEP_M: f64 = 3.0;
/// Side of the squares in which segments are looked up, metres.
const SQUARE_M: f64 = 12.0;

/// An end that waits for another: which one, where it lies, and the direction in which its line would go on.
pub(super) type OpenEnd = (PieceEnd, Point3<f64>, Vector3<f64>);

/// The segments from one end to another.
pub(super) type Bridges = BTreeMap<PieceEnd, (PieceEnd, Vec<Cubic>)>;

/// A guide beside an end: its piece, its parameter there, and how far to the left it lies.
#[derive(Clone, Copy, Debug)]
struct Beside {
    piece: usize,
    parameter: f64,
    left_m: f64,
}

/// Closes gaps between open ends: the nearest two first, each once; each gap is told from both of its ends.
pub(super) fn bridges(pieces: &[LoosePiece], ends: &[OpenEnd]) -> Bridges {
    let squares = squares(pieces);
    let besides: Vec<Vec<Beside>> = ends.iter().map(|end| beside(pieces, &squares, end)).collect();
    let mut candidates = Vec::new();
    for (index, (here, place, onwards)) in ends.iter().enumerate() {
        let near = ends[index + 1..].iter().take_while(|other| other.1.x - place.x <= LONGEST_M);
        for (other, (there, other_place, other_onwards)) in (index + 1..).zip(near) {
            let gap = other_place - place;
            let faces = onwards.dot(other_onwards) <= -LEAST_FACING_COS
                && gap.dot(onwards) > LEAST_FACING_COS * gap.norm()
                && -gap.dot(other_onwards) > LEAST_FACING_COS * gap.norm();
            if here.0 != there.0 && faces && gap.norm() <= LONGEST_M && is_one_kind(pieces, here, there) {
                candidates.push((gap.norm(), index, other));
            }
        }
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut bridges = Bridges::new();
    for (_, from, to) in candidates {
        let (here, there) = (ends[from].0, ends[to].0);
        if bridges.contains_key(&here) || bridges.contains_key(&there) {
            continue;
        }
        let guides = besides[from].iter().flat_map(|one| besides[to].iter().map(move |other| (one, other)));
        let way = guides
            .filter(|(one, other)| {
                // Seen from the other end, which faces it, the guide is on the other side.
                one.piece == other.piece && (one.left_m + other.left_m).abs() <= MOST_WIDENING_M
            })
            .filter_map(|(one, other)| along(pieces, [&ends[from], &ends[to]], [one, other]))
            .find(|way| is_open(pieces, &squares, way, [here.0, there.0]));
        if let Some(way) = way {
            let back = way.iter().rev().map(|cubic| cubic.part(1.0, 0.0)).collect();
            bridges.insert(here, (there, way));
            bridges.insert(there, (here, back));
        }
    }
    bridges
}

type Squares = HashMap<[i64; 2], Vec<(usize, usize)>>;

#[expect(clippy::cast_possible_truncation, reason = "coordinates of a map are far below 2^63 metres")]
fn square(place: &Point3<f64>) -> [i64; 2] {
    [place.x, place.y].map(|metres| (metres / SQUARE_M).floor() as i64)
}

fn squares(pieces: &[LoosePiece]) -> Squares {
    let mut squares = Squares::new();
    for (index, piece) in pieces.iter().enumerate() {
        for (segment, cubic) in piece.segments.iter().enumerate() {
            squares.entry(square(&cubic.point(0.5))).or_default().push((index, segment));
        }
    }
    squares
}

/// The segments within a square's side of a place, and some farther.
fn near<'a>(squares: &'a Squares, place: &Point3<f64>) -> impl Iterator<Item = (usize, usize)> + 'a {
    let [x, y] = square(place);
    let around = (x - 1..=x + 1).flat_map(move |x| (y - 1..=y + 1).map(move |y| [x, y]));
    around.filter_map(|square| squares.get(&square)).flatten().copied()
}

/// The lines that pass beside an end, as far off as lanes are wide.
fn beside(pieces: &[LoosePiece], squares: &Squares, (end, place, onwards): &OpenEnd) -> Vec<Beside> {
    let Some(course) = onwards.xy().try_normalize(1e-9) else { return Vec::new() };
    let mut found = Vec::new();
    for (piece, segment) in near(squares, place).filter(|(piece, _)| *piece != end.0) {
        let cubic = &pieces[piece].segments[segment];
        let ahead_m = |u: f64| (cubic.point(u) - place).xy().dot(&course);
        let (at_start, at_end) = (ahead_m(0.0), ahead_m(1.0));
        if at_start * at_end > 0.0 || (at_start - at_end).abs() < 1e-9 {
            continue;
        }
        let u = at_start / (at_start - at_end);
        let left_m = course.perp(&(cubic.point(u) - place).xy());
        let is_parallel = cubic.derivative(u).xy().normalize().dot(&course).abs() >= LEAST_COS;
        let is_level = (cubic.point(u).z - place.z).abs() <= MOST_HEIGHT_M;
        if is_parallel && is_level && (NARROWEST_LANE_M..=WIDEST_LANE_M).contains(&left_m.abs()) {
            found.push(Beside { piece, parameter: segment as f64 + u, left_m });
        }
    }
    found
}

/// The way from one end to the other, beside the guide.
fn along(pieces: &[LoosePiece], ends: [&OpenEnd; 2], [from, to]: [&Beside; 2]) -> Option<Vec<Cubic>> {
    let guide = &pieces[from.piece].segments;
    let span = to.parameter - from.parameter;
    let apart_m = nalgebra::distance(&ends[0].1, &ends[1].1);
    // A guide that takes another way round leads elsewhere.
    let length_m: f64 = span.abs() * guide.iter().map(Cubic::length_m).sum::<f64>() / guide.len() as f64;
    if length_m > 1.5 * apart_m + 3.0 {
        return None;
    }
    let steps = (apart_m / STEP_M).round().max(1.0);
    let mut points = vec![ends[0].1];
    let mut step = 1.0;
    while step < steps {
        let share = step / steps;
        let (place, left) = sideways(guide, from.parameter + span * share, span < 0.0)?;
        // To the right of the guide where that is to the left.
        let aside_m = -(from.left_m + (-to.left_m - from.left_m) * share);
        let rise_m = |end: &OpenEnd, at: f64| Some(end.1.z - sideways(guide, at, false)?.0.z);
        let above_m = rise_m(ends[0], from.parameter)? * (1.0 - share) + rise_m(ends[1], to.parameter)? * share;
        points.push(place + (left * aside_m).push(above_m));
        step += 1.0;
    }
    points.push(ends[1].1);
    let curve = Curve::new(points.as_slice(), EndRule::Reflected)?;
    Some((0..points.len() - 1).map(|index| Cubic(*curve.segment_at(index as f64 + 0.5).coefficients())).collect())
}

/// A place on a guide, and the unit vector to the left of it, seen the way it is followed.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a parameter counts segments")]
fn sideways(guide: &[Cubic], parameter: f64, backwards: bool) -> Option<(Point3<f64>, Vector2<f64>)> {
    let segment = (parameter.max(0.0) as usize).min(guide.len() - 1);
    let u = (parameter - segment as f64).clamp(0.0, 1.0);
    let along = guide[segment].derivative(u).xy().try_normalize(1e-9)?;
    let along = if backwards { -along } else { along };
    Some((guide[segment].point(u), Vector2::new(-along.y, along.x)))
}

/// Whether nothing else lies on a way, or begins or ends beside it.
fn is_open(pieces: &[LoosePiece], squares: &Squares, way: &[Cubic], own: [usize; 2]) -> bool {
    way.iter().all(|cubic| {
        let place = cubic.point(0.5);
        near(squares, &place).filter(|(piece, _)| !own.contains(piece)).all(|(piece, segment)| {
            let other = &pieces[piece].segments[segment];
            let is_end = segment == 0 || segment + 1 == pieces[piece].segments.len();
            let apart_m = (other.point(0.5) - place).xy().norm();
            apart_m > if is_end { WIDEST_LANE_M } else { NARROWEST_LANE_M }
        })
    })
}

#[cfg(test)]
mod tests {
    use lanemap_core::Category;

    use super::*;
    use crate::export::{
        chain::chains,
        map_line::{
            PieceName,
            tests::{arc, line_through},
        },
    };

    fn piece(id: &str, category: Category, points: &[Point3<f64>]) -> LoosePiece {
        let name = PieceName { cell: "14-1-1".into(), id: id.into(), part: 0 };
        let segments = line_through(id, category, points).segments;
        LoosePiece { name, category, existence: 1.0, segments, comes_from: None, continues_in: None }
    }

    /// The edge of a road, unseen between two ways, and the middle line beside it, which runs the other way where `reversed`.
    fn road(radius_m: f64, unseen: [f64; 2], reversed: bool) -> Vec<LoosePiece> {
        let mut middle = arc(radius_m, 3.5, 0.0, 120.0);
        if reversed {
            middle.reverse();
        }
        let edge = |from_m, to_m| arc(radius_m, 0.0, from_m, to_m);
        vec![
            piece("a", Category::WhiteSolid, &edge(0.0, unseen[0])),
            piece("b", Category::WhiteSolid, &edge(unseen[1], 120.0)),
            piece("c", Category::YellowDashed, &middle),
        ]
    }

    #[test]
    fn a_gap_beside_another_line_is_closed_in_parallel_to_it() {
        for radius_m in [f64::INFINITY, 80.0, -60.0] {
            for reversed in [false, true] {
                let lines = chains(&road(radius_m, [45.0, 72.0], reversed));
                assert_eq!(lines.len(), 2, "radius {radius_m}");
                let line = &lines[0];
                assert!((line.guessed_m - 27.0).abs() < 0.3, "{}", line.guessed_m);
                let true_edge = line_through("true", Category::WhiteSolid, &arc(radius_m, 0.0, 0.0, 120.0));
                for (own, truth) in line.segments.iter().zip(&true_edge.segments) {
                    assert!((own.point(0.5) - truth.point(0.5)).norm() < 0.15, "radius {radius_m}, {reversed}");
                }
            }
        }
    }

    #[test]
    fn gaps_that_are_too_long_or_have_something_in_them_stay_open() {
        assert_eq!(chains(&road(f64::INFINITY, [30.0, 75.0], false)).len(), 3);
        let mut with_ramp = road(f64::INFINITY, [45.0, 72.0], false);
        let ramp: Vec<_> =
            (0..8).map(|step| Point3::new(57.0 + 3.0 * f64::from(step), -1.5 * f64::from(step), 0.6)).collect();
        with_ramp.push(piece("d", Category::WhiteDashed, &ramp));
        assert_eq!(chains(&with_ramp).len(), 4);
        let alone = &road(f64::INFINITY, [45.0, 72.0], false)[..2];
        assert_eq!(chains(alone).len(), 2, "no line beside it");
    }
}
