//! Change: what is on the road now that was not, and what was and is no more.
//!
//! Every knot of every line has a most likely history (`history`). Neighbouring knots that came, or went, are one event, noticed
//! with the drive by which half of them were believed. A stretch that went beside one that came, at most 2.5 m
//! across, was moved. Neighbouring knots that are there and whose category changed alike were repainted (`repainted`). The
//! probability of an event is the mean of its knots'.
//!
//! Not guaranteed: a move by less than about half a metre.

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::{
    contribution::DriveId,
    fusion::Fusion,
    history::{Belief, Turn},
    line::{FusedLaneId, Lines},
    persistence::Speaker,
    repainted::Paint,
};
use crate::{category::Category, frame::TimestampNs};

/// What happened to a stretch of road.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum ChangeKind {
    /// A line is there, where drives before saw none.
    Appeared,
    /// A line is there no more.
    Vanished,
    /// A line lies elsewhere.
    Moved {
        /// How far, metres.
        by_m: f64,
    },
    /// A line lies where it was, painted otherwise.
    Repainted {
        /// What it was.
        from: Category,
        /// What it is.
        to: Category,
    },
}

/// Something that happened to a stretch of road.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MapChange {
    /// What.
    pub kind: ChangeKind,
    /// The line that it happened to; where it moved, the new one.
    pub lane: FusedLaneId,
    /// The stretch, shared frame, metres: where the line is now, or was.
    pub points: Vec<Point3<f64>>,
    /// Start of the drive with which it came to be believed.
    pub noticed: TimestampNs,
    /// That drive.
    pub noticed_by: DriveId,
    /// Probability that it happened.
    pub probability: f64,
}

/// Farthest distance between the old and the new place of a line that was moved, metres.
const MOVED_M: f64 = 2.5;
/// Least number of knots of an event.
const LEAST_KNOTS: usize = 4;
/// Knots that may be missing from an event without cutting it in two.
const BRIDGED_KNOTS: usize = 2;

/// A run of knots of one line that turned alike.
struct Stretch {
    line: usize,
    turn: Turn,
    first: usize,
    last: usize,
    /// With whom each of its knots came to be believed.
    noticed: Vec<Speaker>,
    probability_sum: f64,
}

impl Fusion<'_> {
    /// Every change that is believed, in the order in which they came to be.
    pub(super) fn changes(&self, beliefs: &[Vec<Belief>], paints: &[Vec<Paint>]) -> Vec<MapChange> {
        let mut stretches = Vec::new();
        for (line, beliefs) in beliefs.iter().enumerate() {
            stretches.extend(stretches_of(line, beliefs));
        }
        stretches.retain(|stretch| stretch.noticed.len() >= LEAST_KNOTS);
        let mut changes = events(&self.lines, &stretches);
        for (line, (beliefs, paints)) in beliefs.iter().zip(paints).enumerate() {
            changes.extend(repaints(&self.lines, line, beliefs, paints));
        }
        changes.sort_by_key(|change| (change.noticed, change.noticed_by, change.lane));
        changes
    }
}

fn stretches_of(line: usize, beliefs: &[Belief]) -> Vec<Stretch> {
    let mut stretches: Vec<Stretch> = Vec::new();
    for (knot, belief) in beliefs.iter().enumerate() {
        let Some((turn, noticed)) = belief.change else { continue };
        let probability = if turn == Turn::Came { belief.probability } else { 1.0 - belief.probability };
        match stretches.last_mut() {
            Some(open) if open.turn == turn && knot - open.last <= BRIDGED_KNOTS + 1 => {
                open.last = knot;
                open.noticed.push(noticed);
                open.probability_sum += probability;
            }
            _ => stretches.push(Stretch {
                line,
                turn,
                first: knot,
                last: knot,
                noticed: vec![noticed],
                probability_sum: probability,
            }),
        }
    }
    stretches
}

/// Events of stretches; one that went beside one that came is one event.
fn events(lines: &Lines, stretches: &[Stretch]) -> Vec<MapChange> {
    let came: Vec<&Stretch> = stretches.iter().filter(|stretch| stretch.turn == Turn::Came).collect();
    let went: Vec<&Stretch> = stretches.iter().filter(|stretch| stretch.turn == Turn::Went).collect();
    let mut moved_from = vec![false; went.len()];
    let mut changes = Vec::new();
    for stretch in came {
        let beside = went.iter().enumerate().filter(|(index, _)| !moved_from[*index]);
        let beside = beside.filter_map(|(index, old)| Some((index, distance_m(lines, stretch, old)?)));
        let nearest = beside.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, by_m)| *by_m <= MOVED_M);
        changes.push(match nearest {
            Some((index, by_m)) => {
                moved_from[index] = true;
                change(lines, stretch, ChangeKind::Moved { by_m })
            }
            None => change(lines, stretch, ChangeKind::Appeared),
        });
    }
    let gone = went.iter().zip(&moved_from).filter(|(_, moved)| !**moved);
    changes.extend(gone.map(|(stretch, _)| change(lines, stretch, ChangeKind::Vanished)));
    changes
}

fn change(lines: &Lines, stretch: &Stretch, kind: ChangeKind) -> MapChange {
    let line = &lines.lines[stretch.line];
    let mut speakers = stretch.noticed.clone();
    speakers.sort_unstable();
    // Its ends are told apart last: it is there once half of it is.
    let (noticed, noticed_by) = speakers[speakers.len() / 2];
    MapChange {
        kind,
        lane: line.id,
        points: line.points[stretch.first..=stretch.last].to_vec(),
        noticed,
        noticed_by,
        probability: stretch.probability_sum / stretch.noticed.len() as f64,
    }
}

/// Where a line that is there was repainted.
fn repaints(lines: &Lines, line: usize, beliefs: &[Belief], paints: &[Paint]) -> Vec<MapChange> {
    let mut stretches: Vec<(ChangeKind, Stretch)> = Vec::new();
    for (knot, (belief, paint)) in beliefs.iter().zip(paints).enumerate() {
        let Some(repaint) = paint.change.filter(|_| belief.is_shown()) else { continue };
        let kind = ChangeKind::Repainted { from: repaint.from, to: repaint.to };
        match stretches.last_mut() {
            Some((open, stretch)) if *open == kind && knot - stretch.last <= BRIDGED_KNOTS + 1 => {
                stretch.last = knot;
                stretch.noticed.push(repaint.noticed);
                stretch.probability_sum += repaint.probability;
            }
            _ => stretches.push((
                kind,
                Stretch {
                    line,
                    turn: Turn::Came,
                    first: knot,
                    last: knot,
                    noticed: vec![repaint.noticed],
                    probability_sum: repaint.probability,
                },
            )),
        }
    }
    stretches.retain(|(_, stretch)| stretch.noticed.len() >= LEAST_KNOTS);
    stretches.iter().map(|(kind, stretch)| change(lines, stretch, *kind)).collect()
}

/// Mean distance of the knots of one stretch from another; `None` where less than half have it near.
fn distance_m(lines: &Lines, a: &Stretch, b: &Stretch) -> Option<f64> {
    let points = |stretch: &Stretch| &lines.lines[stretch.line].points[stretch.first..=stretch.last];
    let distances = points(a).iter().map(|point| {
        let chords = points(b).windows(2).map(|pair| from_chord_m(point, &pair[0], &pair[1]));
        chords.fold(f64::INFINITY, f64::min)
    });
    let near: Vec<f64> = distances.filter(|distance| *distance <= MOVED_M).collect();
    (2 * near.len() >= a.noticed.len()).then(|| near.iter().sum::<f64>() / near.len() as f64)
}

/// Distance of a place from a chord, horizontally.
fn from_chord_m(place: &Point3<f64>, from: &Point3<f64>, to: &Point3<f64>) -> f64 {
    let (along, offset) = ((to - from).xy(), (place - from).xy());
    let share = (offset.dot(&along) / along.norm_squared().max(1e-12)).clamp(0.0, 1.0);
    (offset - along * share).norm()
}
