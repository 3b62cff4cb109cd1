//! Lineage: what became of lines whose names go from one version of a cell to the next.
//!
//! A line is named after its oldest witness. Where an older drive comes late, where lines join or part, names go and come
//! while the paint stays. Each point of a line whose name went is looked for on the lines of the next version: where a
//! share of [`LEAST_SHARE`] of them lies within [`NEAR_M`] of a line, that line is an heir. One heir that is new makes it
//! *renamed*, one that was there before, or that others went into, too, *merged*, several *split*. A line that goes on
//! under its name while a new one lies where part of it was has been split as well.
//!
//! Not guaranteed: which of two lines closer than [`NEAR_M`] (the two of a double line) is the heir of which.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use lanemap_proto::v1;
use nalgebra::Point2;

use super::wire::positions;

/// Distance within which two lines are the same paint, metres.
const NEAR_M: f64 = 0.75;
/// Share of a line that must lie on another, for that to be its heir.
const LEAST_SHARE: f64 = 0.3;
/// Width of a square of the index, metres; no less than twice the distance that is looked for.
const SQUARE_M: f64 = 4.0;

/// What became of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fate {
    /// It has another name.
    Renamed,
    /// It is part of a line with others.
    Merged,
    /// It is several lines.
    Split,
}

/// A line and its heirs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Descent {
    /// Name of the line in the version before.
    pub(super) lane: String,
    pub(super) fate: Fate,
    /// Names of its heirs in the next version, in their order.
    pub(super) into: Vec<String>,
}

/// What became of the lines of `before` whose paint bears other names in `after`, in the order of their names.
pub(super) fn descents(before: &[v1::FusedLane], after: &[v1::FusedLane]) -> Vec<Descent> {
    let (old, new) = (by_name(before), by_name(after));
    let gone: Vec<&str> = old.keys().filter(|name| !new.contains_key(*name)).copied().collect();
    let came: Vec<&str> = new.keys().filter(|name| !old.contains_key(*name)).copied().collect();
    if came.is_empty() && gone.is_empty() {
        return Vec::new();
    }
    let (on_old, on_new) = (Index::new(&old), Index::new(&new));
    // Of each line of before, the lines of after that it went into.
    let mut heirs: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for name in &gone {
        heirs.entry(name).or_default().extend(on_new.under(&old[name]));
    }
    for name in &came {
        for ancestor in on_old.under(&new[name]) {
            // One that goes on has parted with this stretch only where it lies there no more.
            let still_there = new.contains_key(ancestor) && on_new.under(&new[name]).contains(ancestor);
            if !still_there {
                heirs.entry(ancestor).or_default().insert(name);
            }
        }
    }
    let mut ancestors: BTreeMap<&str, usize> = BTreeMap::new();
    for heir in heirs.values().flatten() {
        *ancestors.entry(heir).or_default() += 1;
    }
    let descents = heirs.iter().filter_map(|(lane, into)| {
        let mut into = into.clone();
        if new.contains_key(lane) && !into.is_empty() {
            into.insert(lane);
        }
        let fate = match into.first() {
            None => return None,
            Some(_) if into.len() > 1 => Fate::Split,
            Some(heir) if old.contains_key(heir) || ancestors.get(heir).is_some_and(|count| *count > 1) => Fate::Merged,
            Some(_) => Fate::Renamed,
        };
        Some(Descent { lane: (*lane).to_owned(), fate, into: into.into_iter().map(str::to_owned).collect() })
    });
    descents.collect()
}

/// The pieces of each line in plan, by its name.
fn by_name(lanes: &[v1::FusedLane]) -> BTreeMap<&str, Vec<Vec<Point2<f64>>>> {
    let mut named: BTreeMap<&str, Vec<Vec<Point2<f64>>>> = BTreeMap::new();
    for lane in lanes {
        let points = positions(lane).into_iter().map(|point| point.xy()).collect();
        named.entry(&lane.id).or_default().push(points);
    }
    named
}

/// A chord of a line.
type Chord<'a> = (&'a str, [Point2<f64>; 2]);

/// Chords of lines by the squares that they touch.
struct Index<'a> {
    squares: HashMap<(i64, i64), Vec<Chord<'a>>>,
}

impl<'a> Index<'a> {
    fn new(lines: &BTreeMap<&'a str, Vec<Vec<Point2<f64>>>>) -> Self {
        let mut squares: HashMap<_, Vec<_>> = HashMap::new();
        for (name, pieces) in lines {
            for chord in pieces.iter().flat_map(|piece| piece.windows(2)) {
                let low = square(&(chord[0].inf(&chord[1]) - nalgebra::Vector2::repeat(NEAR_M)));
                let high = square(&(chord[0].sup(&chord[1]) + nalgebra::Vector2::repeat(NEAR_M)));
                for at in (low.0..=high.0).flat_map(|x| (low.1..=high.1).map(move |y| (x, y))) {
                    squares.entry(at).or_default().push((*name, [chord[0], chord[1]]));
                }
            }
        }
        Self { squares }
    }

    /// The lines on which a share of the pieces lies, in the order of their names.
    fn under(&self, pieces: &[Vec<Point2<f64>>]) -> BTreeSet<&'a str> {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        let mut all = 0;
        for point in pieces.iter().flatten() {
            all += 1;
            let near = self.squares.get(&square(point)).into_iter().flatten();
            let near = near.filter(|(_, chord)| distance_m(point, chord) <= NEAR_M).map(|(name, _)| *name);
            for name in near.collect::<BTreeSet<_>>() {
                *counts.entry(name).or_default() += 1;
            }
        }
        counts
            .into_iter()
            .filter(|(_, count)| *count as f64 >= LEAST_SHARE * f64::from(all))
            .map(|(name, _)| name)
            .collect()
    }
}

#[expect(clippy::cast_possible_truncation, reason = "a cell is some kilometres wide; the cast saturates")]
fn square(point: &Point2<f64>) -> (i64, i64) {
    ((point.x / SQUARE_M).floor() as i64, (point.y / SQUARE_M).floor() as i64)
}

fn distance_m(point: &Point2<f64>, [start, end]: &[Point2<f64>; 2]) -> f64 {
    let chord = end - start;
    let share = ((point - start).dot(&chord) / chord.norm_squared().max(1e-12)).clamp(0.0, 1.0);
    (point - (start + chord * share)).norm()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line to the east from `from_m` to `to_m`, `north_m` to the north.
    fn lane(id: &str, from_m: i32, to_m: i32, north_m: f64) -> v1::FusedLane {
        #[expect(clippy::cast_possible_truncation, reason = "some metres")]
        let mut xyz_mm = vec![from_m * 1000, (north_m * 1e3) as i32, 0];
        for _ in 0..(to_m - from_m) / 3 {
            xyz_mm.extend([3000, 0, 0]);
        }
        v1::FusedLane { id: id.to_owned(), xyz_mm, ..v1::FusedLane::default() }
    }

    fn descent(lane: &str, fate: Fate, into: &[&str]) -> Descent {
        Descent { lane: lane.to_owned(), fate, into: into.iter().map(|name| (*name).to_owned()).collect() }
    }

    #[test]
    fn a_line_that_lies_where_it_lay_under_another_name_was_renamed() {
        let before = [lane("b", 0, 300, 0.0), lane("c", 0, 300, 3.5)];
        let after = [lane("a", 0, 300, 0.2), lane("c", 0, 300, 3.5)];
        assert_eq!(descents(&before, &after), [descent("b", Fate::Renamed, &["a"])]);
    }

    #[test]
    fn a_line_that_goes_into_one_that_was_there_was_merged() {
        let before = [lane("a", 0, 150, 0.0), lane("b", 150, 300, 0.0)];
        let after = [lane("a", 0, 300, 0.0)];
        assert_eq!(descents(&before, &after), [descent("b", Fate::Merged, &["a"])]);
    }

    #[test]
    fn two_lines_that_go_into_a_new_one_were_merged() {
        let before = [lane("b", 0, 150, 0.0), lane("c", 150, 300, 0.0)];
        let after = [lane("a", 0, 300, 0.0)];
        let merged = |name| descent(name, Fate::Merged, &["a"]);
        assert_eq!(descents(&before, &after), [merged("b"), merged("c")]);
    }

    #[test]
    fn a_line_that_goes_on_in_two_was_split_whether_it_keeps_its_name_or_not() {
        let before = [lane("a", 0, 300, 0.0)];
        let kept = [lane("a", 0, 150, 0.0), lane("b", 150, 300, 0.0)];
        assert_eq!(descents(&before, &kept), [descent("a", Fate::Split, &["a", "b"])]);
        let lost = [lane("c", 0, 150, 0.0), lane("d", 150, 300, 0.0)];
        assert_eq!(descents(&before, &lost), [descent("a", Fate::Split, &["c", "d"])]);
    }

    #[test]
    fn lines_that_come_or_go_where_no_other_lies_have_no_lineage() {
        let before = [lane("a", 0, 300, 0.0), lane("b", 0, 300, 3.5)];
        let after = [lane("a", 0, 330, 0.0), lane("c", 0, 300, 7.0)];
        assert_eq!(descents(&before, &after), []);
        assert_eq!(descents(&before, &before), []);
    }
}
