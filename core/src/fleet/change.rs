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
/// The same of what is left of a stretch that went, of which the rest moved: less is the end of the move.
const LEAST_KNOTS_BESIDE_MOVED: usize = 8;
/// Knots that may be missing from an event without cutting it in two.
const BRIDGED_KNOTS: usize = 2;

/// A knot of which something is believed, with the drive by which it came to be.
#[derive(Clone, Copy, Debug)]
struct Told {
    knot: usize,
    noticed: Speaker,
    probability: f64,
}

/// A run of knots of one line that changed alike.
#[derive(Clone, Debug)]
struct Stretch<K> {
    line: usize,
    kind: K,
    told: Vec<Told>,
}

impl Fusion<'_> {
    /// Every change that is believed, in the order in which they came to be.
    pub(super) fn changes(&self, beliefs: &[Vec<Belief>], paints: &[Vec<Paint>]) -> Vec<MapChange> {
        let turned = beliefs.iter().enumerate().flat_map(|(line, beliefs)| turned(line, beliefs));
        let mut changes = events(&self.lines, &turned.collect::<Vec<_>>());
        for (line, (beliefs, paints)) in beliefs.iter().zip(paints).enumerate() {
            changes.extend(
                repainted(line, beliefs, paints).iter().map(|stretch| stretch.change(&self.lines, stretch.kind)),
            );
        }
        changes.sort_by_key(|change| (change.noticed, change.noticed_by, change.lane));
        changes
    }
}

/// Stretches of a line that came or went.
fn turned(line: usize, beliefs: &[Belief]) -> Vec<Stretch<Turn>> {
    let told = beliefs.iter().enumerate().filter_map(|(knot, belief)| {
        let (turn, noticed) = belief.change?;
        let probability = if turn == Turn::Came { belief.probability } else { 1.0 - belief.probability };
        Some((turn, Told { knot, noticed, probability }))
    });
    stretches(line, told)
}

/// Stretches of a line that are there and were repainted.
fn repainted(line: usize, beliefs: &[Belief], paints: &[Paint]) -> Vec<Stretch<ChangeKind>> {
    let told = beliefs.iter().zip(paints).enumerate().filter_map(|(knot, (belief, paint))| {
        let repaint = paint.change.filter(|_| belief.is_shown())?;
        let kind = ChangeKind::Repainted { from: repaint.from, to: repaint.to };
        Some((kind, Told { knot, noticed: repaint.noticed, probability: repaint.probability }))
    });
    stretches(line, told)
}

/// Runs of knots, given in their order, that changed alike.
fn stretches<K: Copy + PartialEq>(line: usize, told: impl Iterator<Item = (K, Told)>) -> Vec<Stretch<K>> {
    let mut stretches: Vec<Stretch<K>> = Vec::new();
    for (kind, told) in told {
        match stretches.last_mut() {
            Some(open) if open.kind == kind && told.knot - open.last() <= BRIDGED_KNOTS + 1 => open.told.push(told),
            _ => stretches.push(Stretch { line, kind, told: vec![told] }),
        }
    }
    stretches.retain(|stretch| stretch.told.len() >= LEAST_KNOTS);
    stretches
}

/// Events of stretches that came or went. What went beside one that came is one event with it: it moved.
fn events(lines: &Lines, turned: &[Stretch<Turn>]) -> Vec<MapChange> {
    let (came, went): (Vec<&Stretch<Turn>>, Vec<&Stretch<Turn>>) =
        turned.iter().partition(|stretch| stretch.kind == Turn::Came);
    let mut changes = Vec::new();
    let mut moved: Vec<&Stretch<Turn>> = Vec::new();
    for stretch in came {
        let by_m = stretch.moved_by_m(lines, &went);
        changes.push(stretch.change(lines, by_m.map_or(ChangeKind::Appeared, |by_m| ChangeKind::Moved { by_m })));
        moved.extend(by_m.map(|_| stretch));
    }
    for stretch in went {
        let is_gone = |told: &&Told| {
            let place = &lines.lines[stretch.line].points[told.knot];
            moved.iter().all(|new| new.distance_m(lines, place) > MOVED_M)
        };
        let gone = stretch.told.iter().filter(is_gone).map(|told| (Turn::Went, *told));
        let gone = stretches(stretch.line, gone);
        let is_end = |gone: &&Stretch<Turn>| gone.told.len() < stretch.told.len().min(LEAST_KNOTS_BESIDE_MOVED);
        let gone = gone.iter().filter(|gone| !is_end(gone));
        changes.extend(gone.map(|gone| gone.change(lines, ChangeKind::Vanished)));
    }
    changes
}

impl<K> Stretch<K> {
    fn last(&self) -> usize {
        self.told[self.told.len() - 1].knot
    }

    fn points<'a>(&self, lines: &'a Lines) -> &'a [Point3<f64>] {
        &lines.lines[self.line].points[self.told[0].knot..=self.last()]
    }

    fn change(&self, lines: &Lines, kind: ChangeKind) -> MapChange {
        let mut speakers: Vec<Speaker> = self.told.iter().map(|told| told.noticed).collect();
        speakers.sort_unstable();
        // Its ends are told apart last: it is there once half of it is.
        let (noticed, noticed_by) = speakers[speakers.len() / 2];
        MapChange {
            kind,
            lane: lines.lines[self.line].id,
            points: self.points(lines).to_vec(),
            noticed,
            noticed_by,
            probability: self.told.iter().map(|told| told.probability).sum::<f64>() / self.told.len() as f64,
        }
    }

    /// Mean distance of its knots from stretches that went; `None` where less than half have one near.
    fn moved_by_m(&self, lines: &Lines, went: &[&Self]) -> Option<f64> {
        let nearest = |place| went.iter().map(|old| old.distance_m(lines, place)).fold(f64::INFINITY, f64::min);
        let near: Vec<f64> = self.points(lines).iter().map(nearest).filter(|by_m| *by_m <= MOVED_M).collect();
        (2 * near.len() >= self.told.len()).then(|| near.iter().sum::<f64>() / near.len() as f64)
    }

    /// Distance of a place from it, metres.
    fn distance_m(&self, lines: &Lines, place: &Point3<f64>) -> f64 {
        let chords = self.points(lines).windows(2);
        chords.map(|pair| from_chord_m(place, &pair[0], &pair[1])).fold(f64::INFINITY, f64::min)
    }
}

/// Distance of a place from a chord, horizontally.
fn from_chord_m(place: &Point3<f64>, from: &Point3<f64>, to: &Point3<f64>) -> f64 {
    let (along, offset) = ((to - from).xy(), (place - from).xy());
    let share = (offset.dot(&along) / along.norm_squared().max(1e-12)).clamp(0.0, 1.0);
    (offset - along * share).norm()
}
