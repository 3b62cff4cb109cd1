//! Events of a cell: what happened to its road, and to the names of its lines, kept with the version that told it first.
//!
//! Fusing gives every change of the road that is believed (`lanemap_core::fleet::change`), each time anew. One that was not
//! believed before is an event; one that is believed no more is withdrawn, and stands there as such. What became of lines
//! whose names went ([`super::lineage`]) are events, too. The newest [`MOST_EVENTS`] of a cell are kept. Once a drive
//! is deleted, what was known before goes, and what is believed without it is told anew.

use std::collections::{BTreeMap, BTreeSet};

use lanemap_core::fleet::{CellId, ChangeKind, FusedLaneId, FusedMap, MapChange};
use lanemap_proto::{encode, v1};
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::Xxh3;

use super::{
    CellVersion, MapRevision,
    lineage::{Descent, Fate, descents},
    wire::{lane_id_text, steps_mm},
};

/// Most events of a cell that are kept.
pub(super) const MOST_EVENTS: usize = 256;

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
}

/// Something that happened in a cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellEvent {
    /// Its number within the cell, from 1.
    pub number: u64,
    /// The same for the same event of the road each time that it is believed.
    identity: u64,
    /// The revision of the map that told of it, or of its withdrawal.
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
    /// Code of the line's category.
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

/// What a version tells of: events that are new or were withdrawn, without number, revision and time.
pub(super) fn told(
    cell: CellId,
    known: &[CellEvent],
    fused: &FusedMap,
    before: &[v1::FusedLane],
    after: &[v1::FusedLane],
) -> Vec<CellEvent> {
    let known_by: BTreeMap<u64, &CellEvent> =
        known.iter().filter(|event| event.noticed_unix_ns.is_some()).map(|event| (event.identity, event)).collect();
    let mut believed = BTreeSet::new();
    let mut told = Vec::new();
    for change in fused.changes.iter().filter(|change| is_of(cell, change)) {
        let event = of_road(change, fused, before);
        if !believed.insert(event.identity) {
            continue;
        }
        match known_by.get(&event.identity) {
            Some(known) if !known.withdrawn => {}
            Some(known) => told.push(CellEvent { number: known.number, ..event }),
            None => told.push(event),
        }
    }
    let withdrawn = known_by.values().filter(|event| !event.withdrawn && !believed.contains(&event.identity));
    told.extend(withdrawn.map(|event| CellEvent { withdrawn: true, ..(*event).clone() }));
    told.extend(descents(before, after).into_iter().map(|descent| of_names(descent, before)));
    told
}

/// Gives events their numbers, of new ones the newest [`MOST_EVENTS`], and the version that tells of them.
pub(super) fn number(
    told: Vec<CellEvent>,
    known: &[CellEvent],
    revision: MapRevision,
    version: CellVersion,
    published_ms: u64,
) -> Vec<CellEvent> {
    let excess = told.len().saturating_sub(MOST_EVENTS);
    let mut last = known.iter().map(|event| event.number).max().unwrap_or(0);
    let numbered = told.into_iter().skip(excess).map(|event| {
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

/// Numbers of the events that are kept no longer: the oldest beyond the most, and all of them once a drive was deleted.
pub(super) fn outdated(known: &[CellEvent], told: &[CellEvent], purged: bool) -> Vec<u64> {
    let told: BTreeSet<u64> = told.iter().map(|event| event.number).collect();
    let kept: BTreeSet<u64> = known.iter().map(|event| event.number).filter(|number| !told.contains(number)).collect();
    let excess = if purged { kept.len() } else { (kept.len() + told.len()).saturating_sub(MOST_EVENTS) };
    kept.into_iter().take(excess).collect()
}

/// Whether the middle of a change lies in the cell: its neighbours, which see beyond their borders, know it as well.
fn is_of(cell: CellId, change: &MapChange) -> bool {
    let middle = change.points.get(change.points.len() / 2);
    middle.is_some_and(|middle| cell.contains(&cell.anchor().wgs84_from_enu(middle)))
}

fn of_road(change: &MapChange, fused: &FusedMap, before: &[v1::FusedLane]) -> CellEvent {
    let is_same_line = |id: &FusedLaneId| FusedLaneId { stretch: change.lane.stretch, ..*id } == change.lane;
    let lane = fused.lanes.iter().find(|lane| is_same_line(&lane.id));
    let text = lane_id_text(&change.lane);
    let earlier = before.iter().find(|lane| lane.id == text);
    CellEvent {
        number: 0,
        identity: identity(change),
        revision: MapRevision(0),
        version: CellVersion(0),
        published_ms: 0,
        kind: match change.kind {
            ChangeKind::Appeared => EventKind::Appeared,
            ChangeKind::Vanished => EventKind::Vanished,
            ChangeKind::Moved { by_m } => EventKind::Moved { by_mm: thousandths(by_m) },
        },
        withdrawn: false,
        category: lane
            .map(|lane| encode::category(lane.category).into())
            .or(earlier.map(|lane| lane.category))
            .unwrap_or_default(),
        drives: lane.map(|lane| lane.drives).or(earlier.map(|lane| lane.drives)).unwrap_or_default(),
        lane: text,
        into: Vec::new(),
        probability_permille: thousandths(change.probability),
        noticed_unix_ns: Some(change.noticed.0),
        xyz_mm: steps_mm(change.points.iter().copied()),
    }
}

fn of_names(descent: Descent, before: &[v1::FusedLane]) -> CellEvent {
    let Descent { lane, fate, into } = descent;
    let earlier = before.iter().find(|earlier| earlier.id == lane);
    CellEvent {
        number: 0,
        identity: 0,
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

/// The line without its stretch, whose number shifts with what is shown of it, the kind, and the drive that noticed.
fn identity(change: &MapChange) -> u64 {
    let kind = match change.kind {
        ChangeKind::Appeared => 0_u8,
        ChangeKind::Vanished => 1,
        ChangeKind::Moved { .. } => 2,
    };
    let mut hasher = Xxh3::new();
    hasher.update(&[kind]);
    hasher.update(&change.lane.started.0.to_le_bytes());
    hasher.update(&change.lane.drive.0.to_le_bytes());
    hasher.update(&change.lane.lane.0.to_le_bytes());
    hasher.update(&change.lane.piece.to_le_bytes());
    hasher.update(&change.noticed.0.to_le_bytes());
    hasher.update(&change.noticed_by.0.to_le_bytes());
    hasher.digest()
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "not negative; the cast saturates")]
fn thousandths(value: f64) -> u32 {
    (value * 1e3).round() as u32
}

#[cfg(test)]
mod tests {
    use lanemap_core::{LaneId, TimestampNs, fleet::DriveId};
    use nalgebra::Point3;

    use super::*;

    fn cell() -> CellId {
        CellId::new(8_718, 5_685).unwrap()
    }

    fn change(drive: u64, east_m: f64) -> MapChange {
        let lane =
            FusedLaneId { started: TimestampNs(1), drive: DriveId(drive), lane: LaneId(3), piece: 0, stretch: 0 };
        MapChange {
            kind: ChangeKind::Vanished,
            lane,
            points: (0..5).map(|i| Point3::new(east_m + 3.0 * f64::from(i), 0.0, 0.0)).collect(),
            noticed: TimestampNs(77),
            noticed_by: DriveId(9),
            probability: 0.9,
        }
    }

    fn map(changes: Vec<MapChange>) -> FusedMap {
        FusedMap { lanes: vec![], changes, drives: vec![], folded_drives: 0 }
    }

    fn numbered(told: Vec<CellEvent>, known: &[CellEvent], revision: u64) -> Vec<CellEvent> {
        number(told, known, MapRevision(revision), CellVersion(revision), 5)
    }

    #[test]
    fn a_change_is_told_once_withdrawn_once_and_told_again_under_its_number() {
        let fused = map(vec![change(1, 0.0)]);
        let first = numbered(told(cell(), &[], &fused, &[], &[]), &[], 4);
        assert_eq!((first.len(), first[0].number, first[0].revision), (1, 1, MapRevision(4)));
        assert_eq!(told(cell(), &first, &fused, &[], &[]), []);

        let withdrawn = numbered(told(cell(), &first, &map(vec![]), &[], &[]), &first, 5);
        assert_eq!((withdrawn.len(), withdrawn[0].number, withdrawn[0].withdrawn), (1, 1, true));
        assert_eq!(told(cell(), &withdrawn, &map(vec![]), &[], &[]), []);

        let both =
            numbered(told(cell(), &withdrawn, &map(vec![change(1, 0.0), change(2, 0.0)]), &[], &[]), &withdrawn, 6);
        assert_eq!(
            both.iter().map(|event| (event.number, event.withdrawn)).collect::<Vec<_>>(),
            [(1, false), (2, false)]
        );
    }

    #[test]
    fn a_change_beyond_the_border_is_the_neighbours_to_tell() {
        assert_eq!(told(cell(), &[], &map(vec![change(1, 5_000.0)]), &[], &[]), []);
    }
}
