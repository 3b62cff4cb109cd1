//! Events of a cell: what happened to its road, and to the names of its lines, kept with the version that told it first.
//!
//! Fusing gives every change of the road (`lanemap_core::fleet::change`), each time anew; one that is more probable than not
//! is believed. One that is at no place of a known event ([`place`]) is an event. A known one is told again, under its
//! number, where its stretch has become longer or shorter by [`RETOLD_M`], where what vanished or appeared turns out to have
//! moved, and, as withdrawn, where it is believed no more. What was followed by another change at its place (a construction
//! zone that came and went) stays as it was told, and so does everything of a cell that has let go of drives: they may have
//! been its witnesses. What became of lines whose names went ([`super::lineage`]) are events, too.
//!
//! Of each of the two sorts the newest of a cell are kept, as many and as long as the settings say. What has left is not
//! told again: a change that was noticed no later than the last one that left is passed over. Once a drive is deleted, what
//! was known before goes, and what is believed without it is told anew.

mod place;
#[cfg(test)]
mod tests;
mod wire;

use std::collections::BTreeSet;

use lanemap_core::{
    Category, TimestampNs,
    fleet::{CellId, ChangeKind, FusedLaneId, FusedMap, MapChange},
};
use lanemap_proto::{encode, v1};
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::{
    CellVersion, MapRevision,
    lineage::{Descent, Fate, descents},
    wire::{lane_id_text, parse_lane_id, positions, steps_mm},
};

/// Difference in length from which on a known event is told again, metres.
const RETOLD_M: f64 = 10.0;
/// Distance within which two stretches are the same place, metres: less than that of two lines of a road.
const NEAR_M: f64 = 1.5;
/// Distance within which two changes alike are one, metres: two lines that fusing holds apart where there is one, or the two of a
/// double line.
const COINCIDE_M: f64 = 0.75;
/// Probability below which a change is not believed: what drives said since speaks against it.
const LEAST_PROBABILITY: f64 = 0.5;
/// Distance within which a line that moved and where it vanished or appeared are the same place, metres: as far as lines move in one event.
const NEAR_MOVED_M: f64 = 2.7;

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum EventKind {
    /// A line is there, where drives before saw none.
    Appeared,
    /// A line is there no more.
    Vanished,
    /// A line lies elsewhere.
    Moved {
        /// How far, millimetres.
        by_mm: u32,
    },
    /// A line has another name.
    Renamed,
    /// A line is part of another.
    Merged,
    /// A line is several lines.
    Split,
    /// A line is painted otherwise.
    Repainted {
        /// Code of its category before.
        from: i32,
    },
}

/// The names of all kinds.
pub const EVENT_KINDS: [&str; 7] = ["appeared", "vanished", "moved", "repainted", "renamed", "merged", "split"];

impl EventKind {
    /// Whether it happened to the road, and not to names alone.
    #[must_use]
    pub fn is_of_road(self) -> bool {
        matches!(self, Self::Appeared | Self::Vanished | Self::Moved { .. } | Self::Repainted { .. })
    }

    /// Its name, as readers are told it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Appeared => "appeared",
            Self::Vanished => "vanished",
            Self::Moved { .. } => "moved",
            Self::Renamed => "renamed",
            Self::Merged => "merged",
            Self::Split => "split",
            Self::Repainted { .. } => "repainted",
        }
    }

    fn is_same_kind(self, other: Self) -> bool {
        match (self, other) {
            // Dashed that became solid, and solid that became dashed again, are two events.
            (Self::Repainted { from }, Self::Repainted { from: other }) => from == other,
            _ => std::mem::discriminant(&self) == std::mem::discriminant(&other),
        }
    }
}

/// Something that happened in a cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellEvent {
    /// Its number within the cell, from 1.
    pub number: u64,
    /// The revision of the map that told of it last.
    pub revision: MapRevision,
    /// The version of the cell that did.
    pub version: CellVersion,
    /// When that was published, milliseconds since the Unix epoch.
    pub published_ms: u64,
    /// What happened.
    pub kind: EventKind,
    /// Whether it is believed no more.
    pub withdrawn: bool,
    /// The line to which it happened, by its name; where it moved, the new one.
    pub lane: String,
    /// What bears its paint now, where its name went.
    pub into: Vec<String>,
    /// Code of the line's category; where it was repainted, that of the stretch since then.
    pub category: i32,
    /// Probability that it happened, thousandths.
    pub probability_permille: u32,
    /// Start of the drive with which it came to be believed, nanoseconds since the Unix epoch; `None` for names.
    pub noticed_unix_ns: Option<i64>,
    /// Drives that saw the line.
    pub drives: u32,
    /// Where: control points, cell frame, as in `FusedLane.xyz_mm`; empty for names.
    pub xyz_mm: Vec<i32>,
}

impl CellEvent {
    /// Where: control points, cell frame, metres.
    #[must_use]
    pub fn points(&self) -> Vec<Point3<f64>> {
        positions(&v1::FusedLane { xyz_mm: self.xyz_mm.clone(), ..v1::FusedLane::default() })
    }
}

/// How many events of a cell are kept, and how long.
#[derive(Clone, Copy, Debug)]
pub(super) struct Kept {
    /// Most of each sort: those of the road, and those of names.
    pub(super) most: usize,
    /// Those told before this have left, milliseconds since the Unix epoch.
    pub(super) since_ms: u64,
}

/// What is known of a cell, and what it was.
#[derive(Clone, Copy, Debug)]
pub(super) struct Known<'a> {
    pub(super) cell: CellId,
    /// Events that are kept.
    pub(super) events: &'a [CellEvent],
    /// Changes of the road that were noticed no later than this are not told any more.
    pub(super) left: Option<TimestampNs>,
    /// Whether drives of it have been let go of.
    pub(super) forgets: bool,
    /// Its lines in the version before.
    pub(super) lanes: &'a [v1::FusedLane],
}

/// What a version tells of: events that are new or differ from what is known, without revision and time; new ones without
/// number. Of the road by what was `fused`: a draft says nothing of it.
pub(super) fn told(known: &Known<'_>, fused: Option<&FusedMap>, after: &[v1::FusedLane]) -> Vec<CellEvent> {
    let mut told = fused.map_or_else(Vec::new, |fused| told_of_road(known, fused));
    told.extend(descents(known.lanes, after).into_iter().map(|descent| of_names(descent, known.lanes)));
    told
}

fn told_of_road(known: &Known<'_>, fused: &FusedMap) -> Vec<CellEvent> {
    let is_left = |change: &MapChange| known.left.is_some_and(|left| change.noticed <= left);
    let believed = believed(known.cell, fused);
    let of_road: Vec<Remembered<'_>> =
        known.events.iter().filter(|event| event.kind.is_of_road()).map(Remembered::new).collect();
    let goes_on: BTreeSet<FusedLaneId> =
        fused.lanes.iter().map(|lane| whole(lane.id)).chain(believed.iter().map(|it| it.line)).collect();

    let mut told = Vec::new();
    for old in &of_road {
        let same: Vec<&Believed<'_>> = believed.iter().filter(|it| it.is_told_by(old, &goes_on)).collect();
        told.extend(match same.as_slice() {
            [] => withdrawal(old, &believed, known.forgets),
            [only] => retelling(old, only, known, fused),
            [_, ..] => old.event.withdrawn.then(|| CellEvent { withdrawn: false, ..old.event.clone() }),
        });
    }
    let is_new = |it: &&Believed<'_>| !is_left(it.change) && !of_road.iter().any(|old| it.is_told_by(old, &goes_on));
    told.extend(believed.iter().filter(is_new).map(|it| it.event(known, fused)));
    told
}

/// The changes of a cell that are believed, each once.
fn believed(cell: CellId, fused: &FusedMap) -> Vec<Believed<'_>> {
    let changes = fused.changes.iter().filter(|change| change.probability >= LEAST_PROBABILITY && is_of(cell, change));
    let mut believed: Vec<Believed<'_>> = Vec::new();
    for change in changes.map(Believed::new) {
        let coincides = |other: &Believed<'_>| {
            other.kind.is_same_kind(change.kind)
                && place::is_same(&change.change.points, &other.change.points, COINCIDE_M)
        };
        if !believed.iter().any(coincides) {
            believed.push(change);
        }
    }
    believed
}

/// Gives events their numbers, those after `last` to new ones, of which the newest of each sort are told, and the version
/// that tells of them.
pub(super) fn number(
    told: Vec<CellEvent>,
    mut last: u64,
    most: usize,
    (revision, version, published_ms): (MapRevision, CellVersion, u64),
) -> Vec<CellEvent> {
    let (road, names): (Vec<_>, Vec<_>) = told.into_iter().partition(|event| event.kind.is_of_road());
    let newest = |events: Vec<CellEvent>| {
        let excess = events.len().saturating_sub(most);
        events.into_iter().skip(excess)
    };
    let numbered = newest(road).chain(newest(names)).map(|event| {
        let number = if event.number > 0 {
            event.number
        } else {
            last += 1;
            last
        };
        CellEvent { number, revision, version, published_ms, ..event }
    });
    numbered.collect()
}

/// The known events that leave: of each sort the oldest beyond the most, those told too long ago, and all of them once a
/// drive was deleted.
pub(super) fn outdated<'a>(known: &'a [CellEvent], told: &[CellEvent], kept: Kept, purged: bool) -> Vec<&'a CellEvent> {
    let told_again: BTreeSet<u64> = told.iter().map(|event| event.number).collect();
    let mut outdated = Vec::new();
    for of_road in [true, false] {
        let is_of_sort = |event: &&CellEvent| event.kind.is_of_road() == of_road;
        let new = told.iter().filter(is_of_sort).count();
        let old: Vec<&CellEvent> =
            known.iter().filter(is_of_sort).filter(|event| !told_again.contains(&event.number)).collect();
        let excess = (old.len() + new).saturating_sub(kept.most);
        let leaves =
            |(index, event): (usize, &&CellEvent)| purged || index < excess || event.published_ms < kept.since_ms;
        outdated
            .extend(old.iter().enumerate().filter(|(index, event)| leaves((*index, event))).map(|(_, event)| *event));
    }
    outdated
}

/// A change that is believed now.
struct Believed<'a> {
    change: &'a MapChange,
    kind: EventKind,
    line: FusedLaneId,
}

/// An event of the road that is known.
struct Remembered<'a> {
    event: &'a CellEvent,
    line: Option<FusedLaneId>,
    points: Vec<Point3<f64>>,
}

impl<'a> Remembered<'a> {
    fn new(event: &'a CellEvent) -> Self {
        Self { event, line: parse_lane_id(&event.lane).map(whole), points: event.points() }
    }
}

impl<'a> Believed<'a> {
    fn new(change: &'a MapChange) -> Self {
        let kind = match change.kind {
            ChangeKind::Appeared => EventKind::Appeared,
            ChangeKind::Vanished => EventKind::Vanished,
            ChangeKind::Moved { by_m } => EventKind::Moved { by_mm: thousandths(by_m) },
            ChangeKind::Repainted { from, .. } => EventKind::Repainted { from: encode::category(from).into() },
        };
        Self { change, kind, line: whole(change.lane) }
    }

    /// Whether a known event tells of it: the same thing at the same place, on the same line or on one that is gone.
    fn is_told_by(&self, old: &Remembered<'_>, goes_on: &BTreeSet<FusedLaneId>) -> bool {
        let is_its_line = old.line.is_none_or(|line| line == self.line || !goes_on.contains(&line));
        let is_same_kind = old.event.kind.is_same_kind(self.kind);
        // What vanished first may turn out to have moved.
        let may_be_same = matches!(self.kind, EventKind::Moved { .. });
        (is_same_kind && is_its_line && place::is_same(&self.change.points, &old.points, NEAR_M))
            || (!is_same_kind && may_be_same && place::is_same(&self.change.points, &old.points, NEAR_MOVED_M))
    }

    /// What its stretch is painted as since it was repainted.
    fn repainted_to(&self) -> Option<Category> {
        match self.change.kind {
            ChangeKind::Repainted { to, .. } => Some(to),
            _ => None,
        }
    }

    fn event(&self, known: &Known<'_>, fused: &FusedMap) -> CellEvent {
        let points = &self.change.points;
        let middle = points[points.len() / 2];
        let nearest = |lanes: &mut dyn Iterator<Item = (FusedLaneId, Vec<Point3<f64>>)>| {
            let distances = lanes.map(|(id, points)| (place::distance_m(&middle, &points), id));
            distances.min_by(|one, other| one.0.total_cmp(&other.0)).map(|(_, id)| id)
        };
        let mut earlier = known.lanes.iter().filter_map(|lane| Some((parse_lane_id(&lane.id)?, positions(lane))));
        let mut now =
            fused.lanes.iter().map(|lane| (lane.id, lane.points.iter().map(|point| point.position).collect()));
        let of_line = |(id, _): &(FusedLaneId, Vec<Point3<f64>>)| whole(*id) == self.line;
        let id = match self.kind {
            EventKind::Vanished => nearest(&mut earlier.by_ref().filter(of_line)),
            _ => nearest(&mut now.by_ref().filter(of_line)),
        };
        let text = lane_id_text(&id.unwrap_or(self.change.lane));
        let fused_lane = fused.lanes.iter().find(|lane| whole(lane.id) == self.line);
        let earlier_lane = known.lanes.iter().find(|lane| lane.id == text);
        CellEvent {
            number: 0,
            revision: MapRevision(0),
            version: CellVersion(0),
            published_ms: 0,
            kind: self.kind,
            withdrawn: false,
            category: self.repainted_to().map_or_else(
                || {
                    let now = fused_lane.map(|lane| encode::category(lane.category).into());
                    now.or(earlier_lane.map(|lane| lane.category)).unwrap_or_default()
                },
                |to| encode::category(to).into(),
            ),
            drives: fused_lane.map(|lane| lane.drives).or(earlier_lane.map(|lane| lane.drives)).unwrap_or_default(),
            lane: text,
            into: Vec::new(),
            probability_permille: thousandths(self.change.probability),
            noticed_unix_ns: Some(self.change.noticed.0),
            xyz_mm: steps_mm(points.iter().copied()),
        }
    }
}

/// What is told of a known event that is still believed: nothing, or how it is now.
fn retelling(old: &Remembered<'_>, now: &Believed<'_>, known: &Known<'_>, fused: &FusedMap) -> Option<CellEvent> {
    let longer_m = place::length_m(&now.change.points) - place::length_m(&old.points);
    let differs = !old.event.kind.is_same_kind(now.kind) || longer_m.abs() >= RETOLD_M;
    (old.event.withdrawn || differs).then(|| CellEvent { number: old.event.number, ..now.event(known, fused) })
}

/// What is told of a known event that is not among the changes: that it is withdrawn, or nothing, where another change
/// followed it at its place or its witnesses may have been let go of.
fn withdrawal(old: &Remembered<'_>, believed: &[Believed<'_>], forgets: bool) -> Option<CellEvent> {
    let followed = believed.iter().any(|later| {
        Some(later.change.noticed.0) > old.event.noticed_unix_ns
            && place::is_same(&later.change.points, &old.points, NEAR_MOVED_M)
    });
    let is_over = old.event.withdrawn || followed || forgets;
    (!is_over).then(|| CellEvent { withdrawn: true, ..old.event.clone() })
}

/// Whether the middle of a change lies in the cell: its neighbours, which see beyond their borders, know it as well.
fn is_of(cell: CellId, change: &MapChange) -> bool {
    let middle = change.points.get(change.points.len() / 2);
    middle.is_some_and(|middle| cell.contains(&cell.anchor().wgs84_from_enu(middle)))
}

/// The line without its stretch, whose number shifts with what is shown of it.
fn whole(id: FusedLaneId) -> FusedLaneId {
    FusedLaneId { stretch: 0, ..id }
}

fn of_names(descent: Descent, before: &[v1::FusedLane]) -> CellEvent {
    let Descent { lane, fate, into } = descent;
    let earlier = before.iter().find(|earlier| earlier.id == lane);
    CellEvent {
        number: 0,
        revision: MapRevision(0),
        version: CellVersion(0),
        published_ms: 0,
        kind: match fate {
            Fate::Renamed => EventKind::Renamed,
            Fate::Merged => EventKind::Merged,
            Fate::Split => EventKind::Split,
        },
        withdrawn: false,
        category: earlier.map(|lane| lane.category).unwrap_or_default(),
        drives: earlier.map(|lane| lane.drives).unwrap_or_default(),
        lane,
        into,
        probability_permille: 1_000,
        noticed_unix_ns: None,
        xyz_mm: Vec::new(),
    }
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "not negative; the cast saturates")]
fn thousandths(value: f64) -> u32 {
    (value * 1e3).round() as u32
}
