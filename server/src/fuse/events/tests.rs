use lanemap_core::{LaneId, TimestampNs, fleet::DriveId};

use super::*;

const CELL: (u32, u32) = (8_718, 5_685);

fn line(drive: u64) -> FusedLaneId {
    FusedLaneId { started: TimestampNs(1), drive: DriveId(drive), lane: LaneId(3), piece: 0, stretch: 0 }
}

/// A change of a line of `drive` over so many knots, 3 m apart, from `east_m` on.
fn change(kind: ChangeKind, drive: u64, (east_m, north_m): (f64, f64), knots: i32, noticed: i64) -> MapChange {
    MapChange {
        kind,
        lane: line(drive),
        points: (0..knots).map(|i| Point3::new(east_m + 3.0 * f64::from(i), north_m, 0.0)).collect(),
        noticed: TimestampNs(noticed),
        noticed_by: DriveId(9),
        probability: 0.9,
    }
}

fn vanished(drive: u64, east_m: f64, knots: i32) -> MapChange {
    change(ChangeKind::Vanished, drive, (east_m, 0.0), knots, 77)
}

/// A cell that is told of one fusion after the other.
#[derive(Default)]
struct Teller {
    events: Vec<CellEvent>,
    left: Option<TimestampNs>,
    forgets: bool,
    version: u64,
    last: u64,
}

impl Teller {
    /// What is told of these changes.
    fn tell(&mut self, changes: Vec<MapChange>) -> Vec<CellEvent> {
        let fused = FusedMap { lanes: vec![], changes, drives: vec![], folded_drives: 0 };
        let cell = CellId::new(CELL.0, CELL.1).unwrap();
        let known = Known { cell, events: &self.events, left: self.left, forgets: self.forgets, lanes: &[] };
        let told = told(&known, Some(&fused), &[]);
        self.version += 1;
        let at = (MapRevision(self.version), CellVersion(self.version), self.version);
        let told = number(told, self.last, 256, at);
        self.last = told.iter().map(|event| event.number).fold(self.last, u64::max);
        self.events.retain(|event| told.iter().all(|told| told.number != event.number));
        self.events.extend(told.clone());
        self.events.sort_by_key(|event| event.number);
        told
    }
}

fn numbers(told: &[CellEvent]) -> Vec<(u64, bool)> {
    told.iter().map(|event| (event.number, event.withdrawn)).collect()
}

#[test]
fn a_change_is_told_once_withdrawn_once_and_told_again_under_its_number() {
    let mut teller = Teller::default();
    let first = teller.tell(vec![vanished(1, 0.0, 5)]);
    assert_eq!((numbers(&first), first[0].revision), (vec![(1, false)], MapRevision(1)));
    assert_eq!(teller.tell(vec![vanished(1, 0.0, 5)]), []);
    assert_eq!(numbers(&teller.tell(vec![])), [(1, true)]);
    assert_eq!(teller.tell(vec![]), []);
    let both = teller.tell(vec![vanished(1, 0.0, 5), vanished(2, 100.0, 5)]);
    assert_eq!(numbers(&both), [(1, false), (2, false)]);
}

#[test]
fn a_change_that_grows_is_told_again_under_its_number_and_one_on_a_line_beside_it_is_another() {
    let mut teller = Teller::default();
    teller.tell(vec![vanished(1, 0.0, 5)]);
    assert_eq!(teller.tell(vec![vanished(1, 0.0, 7)]), [], "6 m more are no news");
    let grown = teller.tell(vec![vanished(1, 0.0, 20)]);
    assert_eq!((numbers(&grown), grown[0].points().len()), (vec![(1, false)], 20));
    let coinciding = change(ChangeKind::Vanished, 3, (0.0, 0.3), 20, 78);
    assert_eq!(teller.tell(vec![vanished(1, 0.0, 20), coinciding]), [], "the other line of a double line");
    let beside = change(ChangeKind::Vanished, 2, (0.0, 1.2), 20, 78);
    assert_eq!(numbers(&teller.tell(vec![vanished(1, 0.0, 20), beside])), [(2, false)]);
}

#[test]
fn what_later_drives_speak_against_is_withdrawn() {
    let mut teller = Teller::default();
    teller.tell(vec![vanished(1, 0.0, 10)]);
    let doubted = MapChange { probability: 0.4, ..vanished(1, 0.0, 10) };
    assert_eq!(numbers(&teller.tell(vec![doubted])), [(1, true)]);
}

#[test]
fn what_vanished_and_turns_out_to_have_moved_is_one_event() {
    let mut teller = Teller::default();
    teller.tell(vec![vanished(1, 0.0, 10)]);
    let moved = teller.tell(vec![change(ChangeKind::Moved { by_m: 1.2 }, 5, (0.0, 1.2), 10, 79)]);
    assert_eq!(numbers(&moved), [(1, false)]);
    assert_eq!(moved[0].kind, EventKind::Moved { by_mm: 1_200 });
}

#[test]
fn a_line_that_went_and_came_again_did_both() {
    let mut teller = Teller::default();
    teller.tell(vec![vanished(1, 0.0, 10)]);
    let back = teller.tell(vec![change(ChangeKind::Appeared, 1, (0.0, 0.1), 10, 99)]);
    assert_eq!(numbers(&back), [(2, false)]);
    assert!(teller.events.iter().all(|event| !event.withdrawn));
}

#[test]
fn a_stretch_that_is_repainted_and_repainted_again_is_two_events() {
    let (dashed, solid) = (Category::WhiteDashed, Category::WhiteSolid);
    let repainted = |from, to, noticed| change(ChangeKind::Repainted { from, to }, 1, (0.0, 0.0), 10, noticed);
    let mut teller = Teller::default();
    let first = teller.tell(vec![repainted(dashed, solid, 77)]);
    let code = |category| i32::from(encode::category(category));
    assert_eq!((first[0].kind, first[0].category), (EventKind::Repainted { from: code(dashed) }, code(solid)));
    assert_eq!(teller.tell(vec![repainted(dashed, solid, 77)]), []);
    let again = teller.tell(vec![repainted(solid, dashed, 99)]);
    assert_eq!(numbers(&again), [(2, false)]);
    assert!(teller.events.iter().all(|event| !event.withdrawn));
}

#[test]
fn what_has_left_is_not_told_again_and_a_cell_that_forgets_withdraws_nothing() {
    let mut teller = Teller::default();
    teller.tell(vec![vanished(1, 0.0, 10)]);
    teller.forgets = true;
    assert_eq!(teller.tell(vec![]), []);
    let kept = Kept { most: 0, since_ms: 0 };
    let left: Vec<u64> = outdated(&teller.events, &[], kept, false).iter().map(|event| event.number).collect();
    assert_eq!(left, [1]);
    (teller.events, teller.left) = (vec![], Some(TimestampNs(77)));
    assert_eq!(teller.tell(vec![vanished(1, 0.0, 10)]), []);
    let later = change(ChangeKind::Vanished, 1, (200.0, 0.0), 10, 78);
    assert_eq!(numbers(&teller.tell(vec![vanished(1, 0.0, 10), later])), [(2, false)], "no number is given twice");
}

#[test]
fn names_take_no_place_from_what_happened_to_the_road() {
    let mut teller = Teller::default();
    let road = teller.tell(vec![vanished(1, 0.0, 10)]).remove(0);
    let name = |number| CellEvent { number, kind: EventKind::Renamed, noticed_unix_ns: None, ..road.clone() };
    let known: Vec<CellEvent> = std::iter::once(road.clone()).chain((2..7).map(name)).collect();
    let kept = Kept { most: 3, since_ms: 0 };
    let left: Vec<u64> = outdated(&known, &[name(7)], kept, false).iter().map(|event| event.number).collect();
    assert_eq!(left, [2, 3, 4]);
    assert_eq!(outdated(&known, &[], Kept { most: 9, since_ms: 2 }, false).len(), 6);
    assert_eq!(outdated(&known, &[], Kept { most: 9, since_ms: 0 }, true).len(), 6);
}

#[test]
fn a_change_beyond_the_border_is_the_neighbours_to_tell() {
    assert_eq!(Teller::default().tell(vec![vanished(1, 5_000.0, 5)]), []);
}
