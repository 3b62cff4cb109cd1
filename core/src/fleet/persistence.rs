//! Persistence: what each drive says of each stretch of line: that it saw it, that it missed it while it was in view, or nothing.
//!
//! A pass has a knot in view if its camera was within range and angle of it, unhidden, at [`LEAST_VIEWS`] places of its
//! way. How likely it then has the line among its lanes depends on how far to the side it was and from how many places it was in
//! view: this is learned from the drives themselves, by how often passes see what others saw before and after them. A line
//! that is worn, or painted on bad ground, is missed more often by all, which is learned too.
//!
//! A pass whose own lane lies beside the knot, nearer than two lines lie, saw the same paint on another line: it says nothing.
//! It misses the knot if the two are a double line ([`double_line`](super::double_line)).
//! What follows from it all is found in [`history`](super::history).

use nalgebra::{Point3, Vector3};

use super::{
    contribution::DriveId,
    correction::Correction,
    double_line::DoubleLines,
    fusion::Fusion,
    history::{Belief, histories},
    line::{BASE, Knot, Lines},
    prepared::{PreparedPass, normal_of},
};
use crate::{frame::TimestampNs, sensor::Sensor};

/// Nearest and farthest place ahead at which a line is expected to be seen, metres.
const AHEAD_M: std::ops::Range<f64> = 5.0..35.0;
/// Farthest place to the side at which a line is expected to be seen, metres.
const SIDE_M: f64 = 13.0;
/// Places of the way from which a knot must be in view.
const LEAST_VIEWS: u16 = 3;
/// Places of the way from which on a knot is well in view.
const MANY_VIEWS: u16 = 5;
/// Borders of the classes of distance to the side, metres.
const SIDES_M: [f64; 4] = [4.0, 8.0, 10.0, 11.5];
/// Probability that a pass has a line among its lanes, by the class of distance to the side, until the drives tell it.
const USUAL: [f64; SIDES_M.len() + 1] = [0.97, 0.95, 0.85, 0.6, 0.25];
/// By what factor it is less likely that it has one of a double line.
const OF_DOUBLE_LINE: f64 = 0.8;
/// Classes of views: by the distance to the side, whether of a double line, and from how many places.
const CLASSES: usize = 4 * USUAL.len();
/// Knots that the usual probabilities count for.
const USUAL_KNOTS: f64 = 150.0;
/// Knots that a line counts for as one like the others.
const LIKE_OTHERS_KNOTS: f64 = 60.0;
/// Knots to each side of one that tell how well it is seen there.
const AROUND_KNOTS: usize = 10;
/// Distance across within which a pass' own lane is the same paint, metres.
const SAME_PAINT_M: f64 = 0.6;
/// Distance along within which a knot of another line is the same place, with that across, metres.
const SAME_KNOT_M: f64 = 2.6;
/// Distance across within which there is hardly room for another line: detectors waver beside a line, metres.
const NO_ROOM_M: f64 = 2.3;
/// Probability that a pass has a lane where there is none.
const GHOST: f64 = 0.03;
/// The same beside a line that more drives saw, and of a double line.
const GHOST_BESIDE: f64 = 0.15;

/// Who says something of a knot, and when: a drive and its start.
pub(super) type Speaker = (TimestampNs, DriveId);

/// What one pass says of a knot that it had in view, or saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hearing {
    /// Number of the pass among those of all drives, which is their order in time.
    pub(super) pass: u32,
    /// Whether it has it among its lanes.
    pub(super) seen: bool,
    /// Probability that it has, if the line is there.
    pub(super) chance: f64,
    /// The same if it is not.
    pub(super) ghost: f64,
}

/// How a pass had a knot in view.
#[derive(Clone, Copy, Debug)]
struct View {
    /// From how many places of its way.
    places: u16,
    /// Least distance to the side, metres.
    side_m: f32,
}

impl View {
    const NONE: Self = Self { places: 0, side_m: f32::MAX };
}

/// A hearing before its chance is known.
#[derive(Clone, Copy, Debug)]
struct Sight {
    pass: u32,
    seen: bool,
    class: usize,
}

impl Fusion<'_> {
    /// What became of each knot of each line.
    pub(super) fn beliefs(&self) -> Vec<Vec<Belief>> {
        let mut speakers: Vec<Speaker> = Vec::new();
        let mut sights: Vec<Vec<Vec<Sight>>> =
            self.lines.lines.iter().map(|line| vec![Vec::new(); line.knots.len()]).collect();
        let mut elsewhere: Vec<Vec<usize>> = self.lines.lines.iter().map(|line| vec![0; line.knots.len()]).collect();
        let mut look = Look::new(&self.lines);
        let seen = seen_by_pass(&self.lines);
        for (drive, number, pass) in self.passes() {
            let contribution = self.drives[drive].contribution;
            speakers.resize(number + 1, contribution.seniority());
            let seen = seen.get(number).map(Vec::as_slice).unwrap_or_default();
            look.take(pass, &contribution.sensor, &self.corrections[drive], seen);
            look.tell(number, seen, &mut sights, &mut elsewhere);
        }
        let chances = learned_chances(&sights);
        let drives = self.lines.lines.iter().map(|line| line.knots.iter().map(Knot::drives).collect());
        let drives: Vec<Vec<u32>> = drives.collect();
        let beliefs = sights.iter().enumerate().map(|(index, sights)| {
            let line = &self.lines.lines[index];
            let worn = worn(sights, &chances);
            let hearings: Vec<Vec<Hearing>> = (0..sights.len())
                .map(|knot| {
                    let is_beside = self.is_beside_a_stronger_line(index, knot, &drives);
                    let is_doubtful = is_beside || look.double_lines.contain(index, knot);
                    let ghost = if is_doubtful { GHOST_BESIDE } else { GHOST };
                    let hearing = |sight: &Sight| Hearing {
                        pass: sight.pass,
                        seen: sight.seen,
                        chance: worn[knot] * chances[sight.class],
                        ghost,
                    };
                    sights[knot].iter().map(hearing).collect()
                })
                .collect();
            let before: Vec<Option<Belief>> = line.knots.iter().map(|knot| knot.record.belief).collect();
            let mut beliefs = histories(&before, &hearings, &speakers);
            for (knot, (belief, elsewhere)) in beliefs.iter_mut().zip(&elsewhere[index]).enumerate() {
                let seen = sights[knot].iter().filter(|sight| sight.seen).count();
                if elsewhere + seen > 0 {
                    belief.doubled = *elsewhere > seen;
                }
            }
            beliefs
        });
        beliefs.collect()
    }

    /// Whether more drives saw a line so near a knot that there is hardly room for two; by the drives that saw each knot.
    fn is_beside_a_stronger_line(&self, line: usize, knot: usize, drives: &[Vec<u32>]) -> bool {
        let place = self.lines.lines[line].points[knot];
        let normal = normal_of(&self.lines.lines[line].tangent(knot));
        let own = drives[line][knot];
        let mut beside = false;
        self.lines.for_each_knot_near(&place, NO_ROOM_M, |other, at, there| {
            let across_m = (there - place).xy().dot(&normal).abs();
            let is_near = (there - place).xy().norm() < NO_ROOM_M && across_m > SAME_PAINT_M;
            if !beside && is_near && other != line && !self.lines.are_old_and_new(line, other) {
                beside = drives[other][at] > own;
            }
        });
        beside
    }
}

fn class_of(view: View, is_double: bool) -> usize {
    let side = SIDES_M.iter().position(|limit_m| f64::from(view.side_m) < *limit_m).unwrap_or(SIDES_M.len());
    4 * side + 2 * usize::from(is_double) + usize::from(view.places >= MANY_VIEWS)
}

/// Passes that saw or missed a knot between the first and the last that saw it: there it surely was.
fn while_there(knot: &[Sight]) -> &[Sight] {
    let first = knot.iter().position(|sight| sight.seen);
    let last = knot.iter().rposition(|sight| sight.seen);
    match (first, last) {
        (Some(first), Some(last)) if first + 1 < last => &knot[first + 1..last],
        _ => &[],
    }
}

/// Probability of each class that a pass sees what is there.
fn learned_chances(sights: &[Vec<Vec<Sight>>]) -> Vec<f64> {
    /// Passes that must have seen a knot for it to be one to learn from.
    const LEAST_SEEN: usize = 4;
    let mut counts: Vec<(f64, f64)> = (0..CLASSES)
        .map(|class| {
            let (is_double, many_views) = (class / 2 % 2 == 1, class % 2 == 1);
            let of_double = if is_double { OF_DOUBLE_LINE } else { 1.0 };
            let usual = USUAL[class / 4] * of_double * if many_views { 1.0 } else { 0.9 };
            (usual * USUAL_KNOTS, USUAL_KNOTS)
        })
        .collect();
    let known = sights.iter().flatten().filter(|knot| knot.iter().filter(|sight| sight.seen).count() >= LEAST_SEEN);
    for sight in known.flat_map(|knot| while_there(knot)) {
        let (seen, all) = &mut counts[sight.class];
        *seen += f64::from(u8::from(sight.seen));
        *all += 1.0;
    }
    counts.into_iter().map(|(seen, all)| seen / all).collect()
}

/// By how much less often a line is seen about each of its knots than others are.
fn worn(sights: &[Vec<Sight>], chances: &[f64]) -> Vec<f64> {
    let mut sums = vec![(0.0, 0.0)];
    for knot in sights {
        let (mut seen, mut expected) = sums[sums.len() - 1];
        for sight in while_there(knot) {
            seen += f64::from(u8::from(sight.seen));
            expected += chances[sight.class];
        }
        sums.push((seen, expected));
    }
    let around = |knot: usize| {
        let (from, to) = (sums[knot.saturating_sub(AROUND_KNOTS)], sums[(knot + AROUND_KNOTS + 1).min(sights.len())]);
        ((LIKE_OTHERS_KNOTS + to.0 - from.0) / (LIKE_OTHERS_KNOTS + to.1 - from.1)).min(1.0)
    };
    (0..sights.len()).map(around).collect()
}

/// A knot that a pass saw, with the place of its witness among those of the knot.
#[derive(Clone, Copy, Debug)]
struct Seen {
    line: u32,
    knot: u32,
    witness: u32,
}

/// The knots that each pass saw.
#[expect(clippy::cast_possible_truncation, reason = "a map has fewer than 2^32 lines, knots and witnesses")]
fn seen_by_pass(lines: &Lines) -> Vec<Vec<Seen>> {
    let mut by_pass: Vec<Vec<Seen>> = Vec::new();
    for (number, line) in lines.lines.iter().enumerate() {
        for (knot, at) in line.knots.iter().enumerate() {
            for (index, witness) in at.witnesses.iter().enumerate().filter(|(_, witness)| witness.pass != BASE) {
                if by_pass.len() <= witness.pass {
                    by_pass.resize(witness.pass + 1, Vec::new());
                }
                let seen = Seen { line: number as u32, knot: knot as u32, witness: index as u32 };
                by_pass[witness.pass].push(seen);
            }
        }
    }
    by_pass
}

/// What one pass had in view and saw: a pass comes to few of the knots of a town, and only those are looked at.
struct Look<'a> {
    lines: &'a Lines,
    double_lines: DoubleLines,
    /// Number of the first knot of each line among all.
    first: Vec<usize>,
    /// Of each knot.
    views: Vec<View>,
    own: Vec<Option<u32>>,
    /// Knots in view.
    in_view: Vec<(usize, usize)>,
}

impl<'a> Look<'a> {
    fn new(lines: &'a Lines) -> Self {
        let mut knots = 0;
        let first = lines.lines.iter().map(|line| {
            knots += line.points.len();
            knots - line.points.len()
        });
        let first = first.collect();
        Self {
            lines,
            double_lines: DoubleLines::of(lines),
            first,
            views: vec![View::NONE; knots],
            own: vec![None; knots],
            in_view: Vec::new(),
        }
    }

    fn number(&self, line: usize, knot: usize) -> usize {
        self.first[line] + knot
    }

    /// Looks with the eyes of a pass.
    fn take(&mut self, pass: &PreparedPass<'_>, sensor: &Sensor, correction: &Correction, seen: &[Seen]) {
        for Seen { line, knot, witness } in seen {
            let number = self.number(*line as usize, *knot as usize);
            self.own[number] = Some(*witness);
        }
        for point in pass.way {
            let place = correction.apply(&point.position, point.arc_m);
            let (sin, cos) = (point.yaw_rad + correction.yaw_rad(point.arc_m)).sin_cos();
            let middle = place + Vector3::new(cos, sin, 0.0) * (0.5 * (AHEAD_M.start + AHEAD_M.end));
            self.lines.for_each_knot_near(&middle, 20.0, |line, knot, at: &Point3<f64>| {
                let offset = at - place;
                let ahead = cos * offset.x + sin * offset.y;
                let left = -sin * offset.x + cos * offset.y;
                if !AHEAD_M.contains(&ahead) || left.abs() > SIDE_M || offset.z.abs() > 3.0 {
                    return;
                }
                if sensor.sees(&Point3::new(ahead, left, offset.z)) && !point.hides(ahead, left, sensor) {
                    let view = &mut self.views[self.first[line] + knot];
                    if view.places == 0 {
                        self.in_view.push((line, knot));
                    }
                    view.places += 1;
                    #[expect(clippy::cast_possible_truncation, reason = "metres to the side")]
                    let left_m = left.abs() as f32;
                    view.side_m = view.side_m.min(left_m);
                }
            });
        }
    }

    /// Tells what the pass saw and missed, and what it has on another line, and forgets it.
    fn tell(&mut self, number: usize, seen: &[Seen], sights: &mut [Vec<Vec<Sight>>], elsewhere: &mut [Vec<usize>]) {
        let Ok(pass) = u32::try_from(number) else { return };
        for Seen { line, knot, .. } in seen {
            let (line, knot) = (*line as usize, *knot as usize);
            let class = self.class(line, knot);
            sights[line][knot].push(Sight { pass, seen: true, class });
        }
        for (line, knot) in &self.in_view {
            let number = self.number(*line, *knot);
            if self.own[number].is_some() || self.views[number].places < LEAST_VIEWS {
                continue;
            }
            if self.sees_paint_beside(*line, *knot) {
                elsewhere[*line][*knot] += 1;
            } else {
                sights[*line][*knot].push(Sight { pass, seen: false, class: self.class(*line, *knot) });
            }
        }
        for (line, knot) in self.in_view.drain(..) {
            self.views[self.first[line] + knot] = View::NONE;
        }
        for Seen { line, knot, .. } in seen {
            self.own[self.first[*line as usize] + *knot as usize] = None;
        }
    }

    /// The class of how the pass had a knot in view.
    fn class(&self, line: usize, knot: usize) -> usize {
        class_of(self.views[self.number(line, knot)], self.double_lines.contain(line, knot))
    }

    /// Whether the pass has the paint of a knot on another line.
    fn sees_paint_beside(&self, line: usize, knot: usize) -> bool {
        let place = self.lines.lines[line].points[knot];
        let normal = normal_of(&self.lines.lines[line].tangent(knot));
        let mut beside = false;
        self.lines.for_each_knot_near(&place, 3.0, |other, at, _| {
            let is_another = other == line
                || self.lines.are_old_and_new(line, other)
                || self.double_lines.are_two(line, knot, other);
            if beside || is_another {
                return;
            }
            let Some(witness) = self.own[self.number(other, at)] else { return };
            let offset = (self.lines.lines[other].knots[at].witnesses[witness as usize].shared - place).xy();
            beside = offset.dot(&normal).abs() < SAME_PAINT_M && offset.norm() < SAME_KNOT_M;
        });
        beside
    }
}
