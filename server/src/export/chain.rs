//! Pieces of one line end to end: what the borders of cells have cut is one line again, and what nobody saw for a few metres.
//!
//! Pieces that name each other over the border of a cell meet there. Besides, ends of lines of one kind that face each other
//! within [`LONGEST_GAP_M`], each straight ahead of the other, are one line with a gap in what was seen: it is closed by a cubic
//! that leaves the one and enters the other in their directions. Without it a lane would end there. Longer gaps are closed where
//! another line leads beside them ([`bridge`](super::bridge)).

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector3};

use super::{
    bridge::{Bridges, OpenEnd, bridges},
    map_line::{Cubic, LoosePiece, MapLine, Piece, PieceName, mirrored},
};

/// Longest gap that is closed, metres.
const LONGEST_GAP_M: f64 = 6.0;
/// How far beside the other's course an end may lie, metres: at least, and per metre of the gap.
const MOST_ASIDE_M: f64 = 0.3;
const MOST_ASIDE_PER_M: f64 = 0.05;
/// Least cosine of the angle between the two courses.
const LEAST_COS: f64 = 0.98;

/// An end of a piece: its index, and whether it is the last one.
pub(super) type PieceEnd = (usize, bool);

/// Chains pieces that name each other into lines; in the order of the names of their first pieces.
///
/// The direction of a line is that of most of its length. A piece whose neighbour is not among `pieces` ends its line.
pub(super) fn chains(pieces: &[LoosePiece]) -> Vec<MapLine> {
    let mut joined = joins(pieces);
    close_gaps(pieces, &mut joined);
    let bridges = bridges(pieces, &open_ends(pieces, &joined));
    joined.extend(bridges.iter().map(|(here, (there, _))| (*here, *there)));
    let mut taken = vec![false; pieces.len()];
    let mut lines = Vec::new();
    let mut order: Vec<usize> = (0..pieces.len()).collect();
    order.sort_by(|a, b| pieces[*a].name.cmp(&pieces[*b].name));
    for start in order {
        if taken[start] {
            continue;
        }
        let (first, closed) = first_of(start, &joined);
        let chain = follow(first, &joined, &mut taken);
        lines.push(line(pieces, &chain, &bridges, closed));
    }
    lines.sort_by(|a, b| a.pieces[0].name.cmp(&b.pieces[0].name));
    lines
}

/// Which ends meet; only where both pieces say so.
fn joins(pieces: &[LoosePiece]) -> BTreeMap<PieceEnd, PieceEnd> {
    let index: BTreeMap<&PieceName, usize> = pieces.iter().enumerate().map(|(at, piece)| (&piece.name, at)).collect();
    let mut joins = BTreeMap::new();
    for (at, piece) in pieces.iter().enumerate() {
        for (is_last, beyond) in [(false, &piece.comes_from), (true, &piece.continues_in)] {
            let Some(other) = beyond.as_ref().and_then(|name| index.get(name).copied()) else { continue };
            let back = |name: &Option<PieceName>| name.as_ref() == Some(&piece.name);
            // The end that is the nearer, where a piece comes back to its neighbour at both ends.
            let apart_m = |there_is_last: bool| {
                let ends = piece.end(is_last).zip(pieces[other].end(there_is_last));
                ends.map_or(f64::INFINITY, |((here, _), (there, _))| nalgebra::distance(&here, &there))
            };
            let candidates = [(false, &pieces[other].comes_from), (true, &pieces[other].continues_in)];
            let found = candidates
                .into_iter()
                .filter(|(_, name)| back(name))
                .map(|(there_is_last, _)| (apart_m(there_is_last), there_is_last))
                .filter(|(apart_m, _)| *apart_m < 0.01)
                .min_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((_, there_is_last)) = found {
                joins.insert((at, is_last), (other, there_is_last));
            }
        }
    }
    joins
}

impl LoosePiece {
    /// Where an end lies, and the direction in which the line would go on from it.
    fn end(&self, is_last: bool) -> Option<(Point3<f64>, Vector3<f64>)> {
        let (cubic, u) = if is_last { (self.segments.last()?, 1.0) } else { (self.segments.first()?, 0.0) };
        let onwards = cubic.derivative(u).try_normalize(1e-9)? * if is_last { 1.0 } else { -1.0 };
        Some((cubic.point(u), onwards))
    }
}

/// The ends that meet no other, from west to east.
fn open_ends(pieces: &[LoosePiece], joined: &BTreeMap<PieceEnd, PieceEnd>) -> Vec<OpenEnd> {
    let mut ends = Vec::new();
    for (at, piece) in pieces.iter().enumerate() {
        for is_last in [false, true] {
            if !joined.contains_key(&(at, is_last))
                && let Some((place, onwards)) = piece.end(is_last)
            {
                ends.push(((at, is_last), place, onwards));
            }
        }
    }
    ends.sort_by(|a, b| a.1.x.total_cmp(&b.1.x).then(a.0.cmp(&b.0)));
    ends
}

/// Whether two pieces are painted alike, seen in one direction: the one to its end, the other from there.
pub(super) fn is_one_kind(pieces: &[LoosePiece], here: &PieceEnd, there: &PieceEnd) -> bool {
    let category = |end: &PieceEnd, forwards: bool| {
        let category = pieces[end.0].category;
        if end.1 == forwards { category } else { mirrored(category) }
    };
    category(here, true) == category(there, false)
}

/// Joins ends that face each other over a short gap: the nearest two first, each once.
fn close_gaps(pieces: &[LoosePiece], joined: &mut BTreeMap<PieceEnd, PieceEnd>) {
    let ends = open_ends(pieces, joined);
    let mut candidates = Vec::new();
    for (index, (here, place, onwards)) in ends.iter().enumerate() {
        for (there, other_place, other_onwards) in
            ends[index + 1..].iter().take_while(|other| other.1.x - place.x <= LONGEST_GAP_M)
        {
            let gap = other_place - place;
            let most_aside_m = MOST_ASIDE_M + MOST_ASIDE_PER_M * gap.norm();
            let is_ahead = |gap: &Vector3<f64>, onwards: &Vector3<f64>| {
                gap.dot(onwards) >= 0.0 && (gap - onwards * gap.dot(onwards)).norm() <= most_aside_m
            };
            if here.0 != there.0
                && gap.norm() <= LONGEST_GAP_M
                && onwards.dot(other_onwards) <= -LEAST_COS
                && is_ahead(&gap, onwards)
                && is_ahead(&-gap, other_onwards)
                && is_one_kind(pieces, here, there)
            {
                candidates.push((gap.norm(), *here, *there));
            }
        }
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    for (_, here, there) in candidates {
        if !joined.contains_key(&here) && !joined.contains_key(&there) {
            joined.insert(here, there);
            joined.insert(there, here);
        }
    }
}

/// The cubic from the end of one segment to the beginning of another, in their directions.
fn connector(before: &Cubic, after: &Cubic) -> Option<Cubic> {
    let (start, end) = (before.point(1.0).coords, after.point(0.0).coords);
    let length_m = (end - start).norm();
    if length_m < 0.01 {
        return None;
    }
    let leaving = before.derivative(1.0).try_normalize(1e-9)? * length_m;
    let entering = after.derivative(0.0).try_normalize(1e-9)? * length_m;
    let way = end - start;
    Some(Cubic([start, leaving, way * 3.0 - leaving * 2.0 - entering, leaving + entering - way * 2.0]))
}

/// The piece at which a chain begins and whether it is passed backwards, and whether the chain comes back to it.
fn first_of(start: usize, joined: &BTreeMap<PieceEnd, PieceEnd>) -> ((usize, bool), bool) {
    let (mut at, mut backwards) = (start, false);
    // The end through which a chain enters a piece is its last one where it passes it backwards.
    while let Some((before, is_last)) = joined.get(&(at, backwards)) {
        (at, backwards) = (*before, !is_last);
        if at == start {
            return ((start, false), true);
        }
    }
    ((at, backwards), false)
}

fn follow(first: (usize, bool), joined: &BTreeMap<PieceEnd, PieceEnd>, taken: &mut [bool]) -> Vec<(usize, bool)> {
    let (mut at, mut backwards) = first;
    let mut chain = Vec::new();
    while !taken[at] {
        taken[at] = true;
        chain.push((at, backwards));
        let Some((next, is_last)) = joined.get(&(at, !backwards)) else { break };
        (at, backwards) = (*next, *is_last);
    }
    chain
}

fn line(pieces: &[LoosePiece], chain: &[(usize, bool)], bridges: &Bridges, closed: bool) -> MapLine {
    let against: f64 = chain
        .iter()
        .map(|(at, backwards)| pieces[*at].segments.len() as f64 * if *backwards { 1.0 } else { -1.0 })
        .sum();
    let chain: Vec<(usize, bool)> = if against > 0.0 {
        chain.iter().rev().map(|(at, backwards)| (*at, !backwards)).collect()
    } else {
        chain.to_vec()
    };
    let mut segments: Vec<Cubic> = Vec::new();
    let mut named: Vec<Piece> = Vec::new();
    let mut guessed_m = 0.0;
    for (at, reversed) in chain {
        let piece = &pieces[at];
        let own: Vec<Cubic> = if reversed {
            piece.segments.iter().rev().map(|cubic| cubic.part(1.0, 0.0)).collect()
        } else {
            piece.segments.clone()
        };
        if let (Some(before), Some(last)) = (named.last_mut(), segments.last()) {
            // From this piece back, as it was found from its end, or over a short gap.
            let back = bridges.get(&(at, reversed)).map(|(_, way)| way);
            let gap: Vec<Cubic> = match back {
                Some(way) => way.iter().rev().map(|cubic| cubic.part(1.0, 0.0)).collect(),
                None => connector(last, &own[0]).into_iter().collect(),
            };
            guessed_m += gap.iter().map(Cubic::length_m).sum::<f64>();
            before.segments += gap.len();
            segments.extend(gap);
        }
        named.push(Piece {
            name: piece.name.clone(),
            category: if reversed { mirrored(piece.category) } else { piece.category },
            existence: piece.existence,
            first_segment: segments.len(),
            segments: piece.segments.len(),
            reversed,
        });
        segments.extend(own);
    }
    let ends = segments.first().zip(segments.last()).map(|(first, last)| last.point(1.0) - first.point(0.0));
    let meets = ends.is_some_and(|gap| gap.norm() < 0.01) && segments.len() > 4;
    MapLine { segments, pieces: named, closed: closed || meets, guessed_m }
}

#[cfg(test)]
mod tests {
    use lanemap_core::Category;
    use nalgebra::Point3;

    use super::*;
    use crate::export::map_line::tests::line_through;

    fn piece(id: &str, from_m: f64, to_m: f64, comes_from: Option<&str>, continues_in: Option<&str>) -> LoosePiece {
        let step_m = (to_m - from_m) / 4.0;
        let points: Vec<_> = (0..5).map(|i| Point3::new(from_m + step_m * f64::from(i), 0.0, 0.0)).collect();
        let name = |id: &str| PieceName { cell: "14-1-1".into(), id: id.into(), part: 0 };
        LoosePiece {
            name: name(id),
            category: if continues_in.is_some() || comes_from.is_some() {
                Category::WhiteLeftDashedRightSolid
            } else {
                Category::WhiteSolid
            },
            existence: 1.0,
            segments: line_through(id, Category::Unknown, &points).segments,
            comes_from: comes_from.map(name),
            continues_in: continues_in.map(name),
        }
    }

    #[test]
    fn pieces_that_name_each_other_are_one_line_whatever_their_directions() {
        // The middle piece runs against the others.
        let pieces = vec![
            piece("a", 0.0, 12.0, None, Some("b")),
            piece("b", 20.0, 12.0, Some("c"), Some("a")),
            piece("c", 20.0, 32.0, Some("b"), None),
            piece("d", 50.0, 60.0, None, Some("gone")),
        ];
        let lines = chains(&pieces);
        assert_eq!(lines.len(), 2);
        let line = &lines[0];
        assert_eq!(line.pieces.iter().map(|piece| piece.name.id.as_str()).collect::<Vec<_>>(), ["a", "b", "c"]);
        assert_eq!(line.pieces.iter().map(|piece| piece.reversed).collect::<Vec<_>>(), [false, true, false]);
        assert_eq!(line.pieces[1].category, Category::WhiteLeftSolidRightDashed);
        for (index, cubic) in line.segments.windows(2).enumerate() {
            assert!((cubic[0].point(1.0) - cubic[1].point(0.0)).norm() < 1e-12, "after segment {index}");
        }
        assert!((line.point(line.end()).x - 32.0).abs() < 1e-12);
    }

    #[test]
    fn ends_that_face_each_other_over_a_short_gap_are_one_line_and_others_are_not() {
        let with = |second: LoosePiece| chains(&[piece("a", 0.0, 12.0, None, None), second]).len();
        assert_eq!(with(piece("b", 16.0, 28.0, None, None)), 1);
        assert_eq!(with(piece("b", 19.0, 31.0, None, None)), 2, "too far");
        let mut aside = piece("b", 16.0, 28.0, None, None);
        aside.segments.iter_mut().for_each(|cubic| cubic.0[0].y += 1.0);
        assert_eq!(with(aside), 2, "beside");
        let other = LoosePiece { category: Category::LeftCurb, ..piece("b", 16.0, 28.0, None, None) };
        assert_eq!(with(other), 2, "of another kind");
        let line = &chains(&[piece("a", 0.0, 12.0, None, None), piece("b", 16.0, 28.0, None, None)])[0];
        assert_eq!((line.segments.len(), line.pieces[0].segments, line.pieces[1].first_segment), (9, 5, 5));
    }
}
