//! Promises of changes.

use super::*;
use crate::{
    Seed,
    fleet::{Fleet, FleetRoutes, FleetScenario},
};

const FIRST: u32 = 4;
const LAST: u32 = 8;

fn fleet(changes: ChangePlan) -> Fleet {
    let routes = FleetRoutes::Shared { length_m: 1_000.0, both_directions: false };
    let road = crate::road::SingleRoad::new(crate::road::Course::Winding, 3_000.0);
    let roads = crate::fleet::FleetRoads::Single(road);
    FleetScenario { drives: 12, changes, routes, roads, ..FleetScenario::winding_road() }.fleet(Seed(3))
}

/// Whether the truth at a time has a line of this number and category along a stretch.
fn is_there(truth: &FleetTruth, line: RoadLineId, category: Option<Category>, stretch: &[Point3<f64>]) -> bool {
    let middle = stretch[stretch.len() / 2];
    let right = |other: &&FleetTrueLine| other.line == line && category.is_none_or(|wanted| wanted == other.category);
    truth.lines.iter().filter(right).flat_map(|line| &line.points).any(|point| (point - middle).norm() < 0.05)
}

#[test]
fn every_change_is_there_from_its_time_on_and_not_before() {
    let fleet = fleet(ChangePlan::some(FIRST, LAST));
    let (mut kinds, step) = ([0; 4], 1);
    for change in fleet.changes() {
        assert!(change.time > fleet.start_of(FIRST - 1));
        let truth = |offset| fleet.truth_at(TimestampNs(change.time.0 + offset));
        let (before, after) = (truth(-step), truth(0));
        let there = |truth, category, stretch: &[_]| is_there(truth, change.line, category, stretch);
        match change.kind {
            ChangeKind::Vanished => {
                kinds[0] += 1;
                assert!(there(&before, None, &change.before) && !there(&after, None, &change.before));
            }
            ChangeKind::Appeared => {
                kinds[1] += 1;
                assert!(!there(&before, None, &change.after) && there(&after, None, &change.after));
            }
            ChangeKind::Moved { left_m } => {
                kinds[2] += 1;
                assert!((0.5..=1.5).contains(&left_m.abs()));
                assert!(there(&before, None, &change.before) && !there(&before, None, &change.after));
                assert!(!there(&after, None, &change.before) && there(&after, None, &change.after));
            }
            ChangeKind::Repainted { from, to } => {
                kinds[3] += 1;
                assert!(there(&before, Some(from), &change.before) && there(&after, Some(to), &change.after));
                assert!(!there(&after, Some(from), &change.before));
            }
        }
    }
    assert!(kinds[0] >= 10 && kinds[1] >= 10, "with those of the zones: {kinds:?}");
    assert_eq!(&kinds[2..], [4, 4]);
}

#[test]
fn a_construction_zone_leaves_the_road_as_it_was() {
    let plan = ChangePlan { zones: 2, zone_drives: 2, ..ChangePlan { vanished: 0, ..ChangePlan::none() } };
    let fleet = fleet(ChangePlan { first_drive: FIRST, last_drive: FIRST, ..plan });
    let at = |drive| fleet.truth_at(fleet.start_of(drive));
    assert!(!fleet.changes().is_empty());
    assert_eq!(at(FIRST - 1), at(FIRST + 2));
    assert_ne!(at(FIRST - 1), at(FIRST));
    assert_eq!(at(FIRST), at(FIRST + 1));
    let yellow = at(FIRST).lines.iter().filter(|line| line.line.0 as usize >= fleet.network().lines().len()).count();
    assert_eq!(yellow, 2 * 5, "a temporary line beside each line of both zones");
}

#[test]
fn drives_see_the_road_as_it_is_when_they_begin() {
    let plan = ChangePlan { vanished: 12, first_drive: FIRST, last_drive: FIRST, ..ChangePlan::none() };
    let (changed, unchanged) = (fleet(plan), fleet(ChangePlan::none()));
    let points = |fleet: &Fleet, drive| {
        fleet
            .drive(drive)
            .frames()
            .flat_map(|frame| frame.detections().to_vec())
            .map(|line| line.points_vehicle.len())
            .sum::<usize>()
    };
    assert_eq!(points(&changed, FIRST - 1), points(&unchanged, FIRST - 1));
    let (fewer, all) = (points(&changed, FIRST), points(&unchanged, FIRST));
    assert!(fewer * 100 < all * 98, "{fewer} of {all}");
}

#[test]
fn a_gap_in_a_closed_line_leaves_one_piece() {
    let points: Vec<Point3<f64>> = (0..=100)
        .map(|k| f64::from(k % 100) / 100.0 * std::f64::consts::TAU)
        .map(|angle| Point3::new(angle.cos(), angle.sin(), 0.0))
        .collect();
    let line = RoadLine { id: RoadLineId(5), category: Category::WhiteSolid, points };
    let edit = Edit { line: line.id, stretch: 40..60, time: i64::MIN..i64::MAX, effect: Effect::Gone };
    let pieces = pieces_of(&line, vec![&edit]);
    assert_eq!(pieces.len(), 1);
    assert_eq!(pieces[0].points.len(), 80);
    assert_eq!((pieces[0].points[0], pieces[0].points[79]), (line.points[60], line.points[39]));
}
