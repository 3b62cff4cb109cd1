//! Which crossings of a border are of one line, seen from both sides.
//!
//! Each cell has other drives, and so another alignment: where the two meet, all lines of a road are shifted against each
//! other by about the same, `s`, along the border and in height. So the lines of a road, which are those without a gap of
//! more than [`ROAD_GAP_M`] to the next, are matched together: one to one, in the same order, and
//!
//! `s* = argmax_s sum_pairs c (1 - 0.9 |d - s|^2 / r^2) - 0.25 |s|^2 / s_max^2`
//!
//! over `s = 0` and the differences `d` of all pairs, with `|d - s| <= r`, `|s| <= s_max`, and `c` less than 1 where neither
//! their categories nor their names are the same. A shift of more than `r` is believed only where any other one, by more than
//! `2 r`, explains clearly less, and where at least two lines agree on it that are most of those of the cell with fewer; or
//! where each cell has one line only, of one category or name. Else lines are paired that lie within `r` as they are.
//!
//! The same pairs whichever cell asks: the sides are taken in the order of the cells. Not guaranteed: that a road is joined
//! whose cells lie more than half a lane apart.

use lanemap_core::geometry::georeference::Anchor;
use nalgebra::{Point3, Vector2};

use super::{Crossing, LEAST_COS};

/// Distance within which two crossings of one line lie, beside what the road is shifted by: `r`, metres.
const MOST_APART_M: f64 = 0.5;
/// Farthest that a road is shifted by, half a lane: `s_max`, metres.
const MOST_SHIFT_M: f64 = 1.75;
/// Way along the border without a line that parts two roads, metres.
const ROAD_GAP_M: f64 = 12.0;
/// What a pair of different categories says, of what one of the same says.
const OTHER_CATEGORY: f64 = 0.6;
/// By how much more lines a shift must explain than another does.
const CLEARLY: f64 = 0.5;

/// A crossing on a border.
#[derive(Clone, Copy, Debug)]
struct Place<'a> {
    /// Number among those of its side.
    number: usize,
    crossing: &'a Crossing,
    /// Along the border, and height, metres.
    at: Vector2<f64>,
}

/// A shift, and the pairs that it explains.
struct Explained {
    shift: Vector2<f64>,
    score: f64,
    pairs: Vec<(usize, usize)>,
}

/// Pairs of crossings of one line, by their numbers on each side; `first` are those of the smaller cell, at whose `anchor`
/// the border is measured.
pub(super) fn pairs(anchor: &Anchor, first: &[Crossing], second: &[Crossing]) -> Vec<(usize, usize)> {
    let position = |crossing: &Crossing| anchor.enu_from_wgs84(&crossing.place);
    let positions: Vec<Point3<f64>> = first.iter().chain(second).map(position).collect();
    let Some(along) = direction_of(&positions) else { return Vec::new() };
    let place = |(number, crossing)| {
        let position = position(crossing);
        Place { number, crossing, at: Vector2::new(position.coords.xy().dot(&along), position.z) }
    };
    let [first, second] = [first, second].map(|side| {
        let mut places: Vec<Place<'_>> = side.iter().enumerate().map(place).collect();
        places.sort_by(|a, b| a.at.x.total_cmp(&b.at.x).then(a.number.cmp(&b.number)));
        places
    });
    let mut pairs = Vec::new();
    for (here, there) in roads(&first, &second) {
        pairs.extend(matched(here, there).into_iter().map(|(i, j)| (here[i].number, there[j].number)));
    }
    pairs
}

/// The direction of the border: to the east or to the north, whichever the crossings lie along.
fn direction_of(positions: &[Point3<f64>]) -> Option<Vector2<f64>> {
    let reach = |axis: usize| {
        let values = || positions.iter().map(|position| position[axis]);
        values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min)
    };
    (positions.len() > 1).then(|| if reach(0) > reach(1) { Vector2::x() } else { Vector2::y() })
}

/// A stretch of both sides.
type Road<'a, 'c> = (&'a [Place<'c>], &'a [Place<'c>]);

/// Cuts both sides, which are sorted, where neither has a line over a gap.
fn roads<'a, 'c>(first: &'a [Place<'c>], second: &'a [Place<'c>]) -> Vec<Road<'a, 'c>> {
    let mut along: Vec<f64> = first.iter().chain(second).map(|place| place.at.x).collect();
    along.sort_by(f64::total_cmp);
    let ends = along.windows(2).filter(|pair| pair[1] - pair[0] > ROAD_GAP_M).map(|pair| pair[0]);
    let (mut here, mut there) = (first, second);
    let mut roads = Vec::new();
    for end in ends.chain([f64::INFINITY]) {
        let until = |side: &[Place<'_>]| side.partition_point(|place| place.at.x <= end);
        let ((road_here, rest_here), (road_there, rest_there)) =
            (here.split_at(until(here)), there.split_at(until(there)));
        (here, there) = (rest_here, rest_there);
        roads.push((road_here, road_there));
    }
    roads
}

/// Pairs of the lines of one road.
fn matched(here: &[Place<'_>], there: &[Place<'_>]) -> Vec<(usize, usize)> {
    let differences = here.iter().flat_map(|here| {
        let continues = |there: &&Place<'_>| are_parallel(here, there);
        there.iter().filter(continues).map(|there| there.at - here.at)
    });
    let shifts = differences.filter(|shift| shift.norm() <= MOST_SHIFT_M);
    let unshifted = explained(here, there, Vector2::zeros());
    let mut all: Vec<Explained> = shifts.map(|shift| explained(here, there, shift)).collect();
    all.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.shift.norm().total_cmp(&b.shift.norm())));
    let Some(best) = all.first() else { return unshifted.pairs };
    let fewer = here.len().min(there.len());
    let is_lone = |pairs: &[(usize, usize)]| {
        here.len() == 1 && there.len() == 1 && pairs.iter().all(|(i, j)| are_alike(&here[*i], &there[*j]))
    };
    let is_agreed = (best.pairs.len() >= 2 && 2 * best.pairs.len() > fewer) || is_lone(&best.pairs);
    let others = all.iter().chain([&unshifted]);
    let others = others.filter(|other| (other.shift - best.shift).norm() > 2.0 * MOST_APART_M);
    let is_clear = others.map(|other| other.score).all(|score| best.score >= score + CLEARLY);
    let is_small = best.shift.norm() <= MOST_APART_M;
    if best.score > unshifted.score && (is_small || (is_agreed && is_clear)) {
        return best.pairs.clone();
    }
    unshifted.pairs
}

fn are_parallel(here: &Place<'_>, there: &Place<'_>) -> bool {
    here.crossing.direction.dot(&there.crossing.direction).abs() >= LEAST_COS
}

/// Whether two crossings are of lines of one category, or of one name: the same drive is the oldest that saw them.
fn are_alike(here: &Place<'_>, there: &Place<'_>) -> bool {
    let (here, there) = (here.crossing, there.crossing);
    here.category == there.category || here.piece.lane == there.piece.lane
}

/// What a shift explains: the pairs, in the order of both sides, that say the most together.
fn explained(here: &[Place<'_>], there: &[Place<'_>], shift: Vector2<f64>) -> Explained {
    let says = |i: usize, j: usize| {
        let (here, there) = (&here[i], &there[j]);
        let apart = (there.at - here.at - shift).norm_squared() / MOST_APART_M.powi(2);
        let is_one = apart <= 1.0 && are_parallel(here, there);
        let weight = if are_alike(here, there) { 1.0 } else { OTHER_CATEGORY };
        // A pair that just lies within reach is one, too.
        is_one.then_some(weight * (1.0 - 0.9 * apart))
    };
    // Most that is said by the lines from `i` and from `j` on.
    let mut most = vec![vec![0.0_f64; there.len() + 1]; here.len() + 1];
    for i in (0..here.len()).rev() {
        for j in (0..there.len()).rev() {
            let paired = says(i, j).map_or(0.0, |says| says + most[i + 1][j + 1]);
            most[i][j] = paired.max(most[i + 1][j]).max(most[i][j + 1]);
        }
    }
    let (mut i, mut j, mut pairs) = (0, 0, Vec::new());
    while i < here.len() && j < there.len() {
        if most[i][j] <= most[i + 1][j] {
            i += 1;
        } else if most[i][j] <= most[i][j + 1] {
            j += 1;
        } else {
            pairs.push((i, j));
            (i, j) = (i + 1, j + 1);
        }
    }
    let score = most[0][0] - shift.norm_squared() / MOST_SHIFT_M.powi(2) * 0.25;
    Explained { shift, score, pairs }
}
