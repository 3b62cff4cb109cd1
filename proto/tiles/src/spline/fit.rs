//! A line through fewer control points: the steps of a spline tile, as long as they can be.
//!
//! The map's control points lie 3 m apart; a road needs one every ten. From each control point the longest step is
//! taken whose curve stays within [`MOST_OFF_M`] of the line on both sides of the control point before it. What the curve does
//! there also depends on the step after, which is guessed to be as long; where a guess was wrong and no step at all will
//! do, the step before is made shorter (Ramer's idea of subdivision, run forwards, with that one way back). Every distance is
//! taken from the rounded control points that readers see, so the limit holds for what they draw.
//!
//! Not guaranteed: the fewest control points.

use lanemap_core::{EndRule, spline::Curve};
use nalgebra::Point3;

use super::{
    curve::{Piece, end_tangent, tangent},
    steps::{Heading, LENGTHS_MM, Millimetres, metres, millimetres, rounded},
};

/// Greatest distance between the line and the curve, metres: with room for what lies between the points that are looked at.
const MOST_OFF_M: f64 = 0.0095;
/// Distance between those points, metres, at most.
const SAMPLE_M: f64 = 0.4;
/// Greatest distance between the line and chords of those points, metres.
const CHORD_M: f64 = 0.001;
/// Longest step to the end of a line, metres.
const LONGEST_TO_END_M: f64 = 35.0;
/// Steps that are tried from the first control point, metres; the short ones also where the line turns back on itself.
const FREE_STEPS_M: [f64; 12] = [24.0, 16.0, 11.0, 7.5, 5.0, 3.0, 2.0, 1.0, 0.5, 0.25, 0.1, 0.05];
/// How far aside a control point may be put where the line itself does not do, millimetres.
const ASIDE_MM: [i64; 3] = [0, 4, -4];
/// Steps that are possible among which the one is taken that lets the next reach farthest.
const CHOICES: usize = 4;
/// Ways back that are tried per control point of the map, before a curve that is a little off is taken.
const WAYS_BACK: usize = 4;

/// How a control point is reached from the one before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// Along the chord before, and so far to the left and upwards. Cheapest where the length is one of [`LENGTHS_MM`].
    Along { length_mm: i32, left_mm: i64, up_mm: i64 },
    /// By so much in each axis.
    Free(Millimetres),
}

/// A control point of the curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Knot {
    pub(super) point: Millimetres,
    /// Where it lies on the map's line: a parameter of that spline.
    pub(super) parameter: f64,
    /// How it is reached; the first by its whole position.
    pub(super) step: Step,
}

/// A line as points close to each other.
struct Source<'a> {
    curve: Curve<'a, [Point3<f64>]>,
    points: Vec<Point3<f64>>,
    /// Way up to each point, metres.
    way_m: Vec<f64>,
    /// Parameter of each on the map's spline.
    parameters: Vec<f64>,
}

/// A place on it: between two points.
#[derive(Clone, Copy, Debug)]
struct Place {
    /// The point before, and how far to the next one.
    index: usize,
    share: f64,
}

impl<'a> Source<'a> {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a count of points of one chord")]
    fn new(line: &'a [Point3<f64>]) -> Option<Self> {
        let curve = Curve::new(line, EndRule::Reflected)?;
        let mut source = Self { curve, points: vec![line[0]], way_m: vec![0.0], parameters: vec![0.0] };
        for segment in 0..line.len() - 1 {
            let chord_m = nalgebra::distance(&line[segment], &line[segment + 1]);
            let bend = [0.0, 0.999].map(|u| curve.second_derivative(segment as f64 + u).norm());
            let bent = (bend[0].max(bend[1]) / (8.0 * CHORD_M)).sqrt();
            let samples = (1.25 * chord_m / SAMPLE_M).max(bent).ceil().clamp(2.0, 1_000.0) as usize;
            for sample in 1..=samples {
                let parameter = segment as f64 + sample as f64 / samples as f64;
                let point = curve.point(parameter);
                let last = source.points.len() - 1;
                source.way_m.push(source.way_m[last] + nalgebra::distance(&source.points[last], &point));
                source.points.push(point);
                source.parameters.push(parameter);
            }
        }
        Some(source)
    }

    fn is_end(&self, place: Place) -> bool {
        place.index + 1 == self.points.len()
    }

    fn last(&self) -> Place {
        Place { index: self.points.len() - 1, share: 0.0 }
    }

    fn point(&self, place: Place) -> Point3<f64> {
        self.curve.point(self.parameter(place))
    }

    fn way_m(&self, place: Place) -> f64 {
        between(&self.way_m, place)
    }

    fn parameter(&self, place: Place) -> f64 {
        between(&self.parameters, place)
    }

    /// The place so far along the line; its end where the line is shorter.
    fn after(&self, from: Place, step_m: f64) -> Place {
        let way_m = self.way_m(from) + step_m;
        let next = self.way_m.partition_point(|way| *way <= way_m);
        if next == self.points.len() {
            return self.last();
        }
        let (before, after) = (self.way_m[next - 1], self.way_m[next]);
        Place { index: next - 1, share: (way_m - before) / (after - before) }
    }

    /// The first place beyond another that lies so far along a heading, if the line gets there.
    fn crossing(&self, from: Place, heading: &Heading, length_mm: i32) -> Option<Place> {
        let length = f64::from(length_mm);
        let mut before = heading.along_mm(&self.point(from));
        let mut start = from.share;
        for index in from.index..self.points.len() - 1 {
            let after = heading.along_mm(&self.points[index + 1]);
            if after >= length && after > before {
                let share = start + (1.0 - start) * ((length - before) / (after - before)).max(0.0);
                return Some(Place { index, share });
            }
            (before, start) = (after, 0.0);
        }
        None
    }

    /// Whether the points between two places lie close to a piece of the curve between the control points there.
    fn is_close(&self, from: Place, to: Place, piece: &Piece) -> bool {
        let (start_m, end_m) = (self.way_m(from), self.way_m(to));
        let within = from.index + 1..to.index + usize::from(to.share > 0.0);
        within.clone().all(|index| {
            let share = (self.way_m[index] - start_m) / (end_m - start_m);
            piece.distance_squared(&self.points[index], share) <= MOST_OFF_M * MOST_OFF_M
        })
    }
}

/// The value at a place, of those at the points.
fn between(values: &[f64], place: Place) -> f64 {
    let here = values[place.index];
    values.get(place.index + 1).map_or(here, |next| here + (next - here) * place.share)
}

/// A control point that is set, with the step that may have to be made shorter.
#[derive(Clone, Copy)]
struct Set {
    knot: Knot,
    place: Place,
    /// Which of the steps that were possible it was; they become shorter.
    choice: usize,
}

/// The control points of a line of at least two of the map's.
pub(super) fn fitted(line: &[Point3<f64>]) -> Vec<Knot> {
    let Some(source) = Source::new(line) else { return Vec::new() };
    let first = millimetres(&line[0]);
    let start = Place { index: 0, share: 0.0 };
    let mut set =
        vec![Set { knot: Knot { point: first, parameter: 0.0, step: Step::Free(first) }, place: start, choice: 0 }];
    let mut from_choice = 0;
    let mut ways_back = WAYS_BACK * line.len();
    while !source.is_end(set[set.len() - 1].place) {
        match next(&source, &set, from_choice) {
            Some(found) => {
                set.push(found);
                from_choice = 0;
            }
            None if set.len() > 1 && ways_back > 0 => {
                ways_back -= 1;
                from_choice = set.pop().map_or(0, |shorter| shorter.choice + 1);
            }
            // The shortest step is taken, whatever the curve does.
            None => {
                let shortest = candidates(&source, &set).pop();
                set.extend(shortest);
                from_choice = 0;
            }
        }
    }
    set.into_iter().map(|set| set.knot).collect()
}

/// The best step that keeps to the line, of those that may still be taken: of the longest few the one after which the next
/// reaches farthest.
fn next(source: &Source<'_>, set: &[Set], from_choice: usize) -> Option<Set> {
    let possible = candidates(source, set).into_iter().skip(from_choice);
    let mut possible = possible.filter(|candidate| keeps_to_the_line(source, set, candidate)).take(CHOICES);
    let longest = possible.next()?;
    if source.is_end(longest.place) {
        return Some(longest);
    }
    let mut ahead = set.to_vec();
    let mut reach_m = |candidate: &Set| {
        ahead.push(*candidate);
        let mut then = candidates(source, &ahead).into_iter();
        let then = then.find(|then| keeps_to_the_line(source, &ahead, then));
        ahead.pop();
        then.map_or(0.0, |then| source.way_m(then.place))
    };
    let mut best = (reach_m(&longest), longest);
    for candidate in possible {
        let reach_m = reach_m(&candidate);
        if reach_m > best.0 {
            best = (reach_m, candidate);
        }
    }
    Some(best.1)
}

/// The steps that lead on from the last control point, the longest first.
fn candidates(source: &Source<'_>, set: &[Set]) -> Vec<Set> {
    let here = set[set.len() - 1];
    let mut found: Vec<Set> = Vec::with_capacity(ASIDE_MM.len() * LENGTHS_MM.len() + FREE_STEPS_M.len() + 1);
    let mut push = |place: Place, step: Step, point: Millimetres| {
        let choice = found.len();
        let knot = Knot { point, parameter: source.parameter(place), step };
        found.push(Set { knot, place, choice });
    };
    let free = |place: Place| {
        let point = millimetres(&source.point(place));
        (Step::Free([0, 1, 2].map(|axis| point[axis] - here.knot.point[axis])), point)
    };
    let heading = set.len().checked_sub(2).map(|before| Heading::new(set[before].knot.point, here.knot.point));
    let left_m = source.way_m(source.last()) - source.way_m(here.place);
    if left_m <= LONGEST_TO_END_M {
        let end = source.point(source.last());
        let ahead = heading.filter(|heading| heading.along_mm(&end) >= 1.0);
        let (step, point) = ahead.map_or_else(
            || free(source.last()),
            |heading| {
                let length_mm = i32::try_from(rounded(heading.along_mm(&end))).unwrap_or(i32::MAX);
                along(&heading, length_mm, &end, 0)
            },
        );
        push(source.last(), step, point);
    }
    if let Some(heading) = heading {
        for length_mm in LENGTHS_MM.into_iter().rev() {
            let Some(place) = source.crossing(here.place, &heading, length_mm) else { continue };
            // A line that doubles back gets there late.
            if source.way_m(place) - source.way_m(here.place) <= 2e-3 * f64::from(length_mm) {
                for aside_mm in ASIDE_MM {
                    let (step, point) = along(&heading, length_mm, &source.point(place), aside_mm);
                    push(place, step, point);
                }
            }
        }
    }
    for step_m in FREE_STEPS_M.into_iter().filter(|step_m| *step_m < left_m) {
        if set.len() == 1 || step_m <= 1.0 {
            let place = source.after(here.place, step_m);
            let (step, point) = free(place);
            push(place, step, point);
        }
    }
    found
}

/// The step that leads along a heading to the side of a point.
fn along(heading: &Heading, length_mm: i32, to: &Point3<f64>, aside_mm: i64) -> (Step, Millimetres) {
    let (left_mm, up_mm) = heading.offsets_mm(length_mm, to);
    let left_mm = left_mm + aside_mm;
    (Step::Along { length_mm, left_mm, up_mm }, heading.step(length_mm, left_mm, up_mm))
}

/// Whether the curve keeps to the line on both sides of the last control point, if this one comes next.
fn keeps_to_the_line(source: &Source<'_>, set: &[Set], next: &Set) -> bool {
    let last = set.len() - 1;
    let (here, there) = (metres(set[last].knot.point), metres(next.knot.point));
    let chord = there - here;
    let beyond = (!source.is_end(next.place))
        .then(|| source.point(source.after(next.place, chord.norm())))
        .filter(|beyond| *beyond != there);
    let arrives = beyond.map(|beyond| tangent(&here, &there, &beyond));
    let leaves = match (last.checked_sub(1), arrives) {
        (Some(before), _) => tangent(&metres(set[before].knot.point), &here, &there),
        (None, Some(arrives)) => end_tangent(&chord, &arrives),
        (None, None) => chord.try_normalize(0.0).unwrap_or_default(),
    };
    let arrives = arrives.unwrap_or_else(|| end_tangent(&chord, &leaves));
    if !source.is_close(set[last].place, next.place, &Piece::new(here, there, leaves, arrives)) {
        return false;
    }
    // The piece before now has the tangent that it will keep.
    let Some(before) = last.checked_sub(1) else { return true };
    let from = metres(set[before].knot.point);
    let left = match before.checked_sub(1) {
        Some(earlier) => tangent(&metres(set[earlier].knot.point), &from, &here),
        None => end_tangent(&(here - from), &leaves),
    };
    source.is_close(set[before].place, set[last].place, &Piece::new(from, here, left, leaves))
}
