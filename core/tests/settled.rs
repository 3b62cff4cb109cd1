//! What a draft promises: a live drive laid on the map of the others as it stands.

#![allow(clippy::unwrap_used)] // A test's helpers fail loudly too.

#[expect(dead_code, reason = "the tests of whole fusions measure by it")]
mod roads;

use lanemap_core::fleet::{
    Base, Contribution, DriveId, FleetParams, FusedLane, FusedMap, FusedPoint, Keep, Settled, by_seniority, draft,
    fuse, fuse_from,
};
use nalgebra::Vector2;
use roads::{Road, Survey, anchor, stretch, with_bias};

/// The map of drives, and what live ones may be laid on.
fn settled(drives: &[Contribution]) -> (FusedMap, Settled) {
    let keep = Keep { beginning_before: None, settled: true };
    let fused = fuse_from(None, &Base::default(), &by_seniority(drives), &anchor(), &FleetParams::default(), keep);
    (fused.map, fused.settled.unwrap())
}

fn drafted(settled: &Settled, live: &[Contribution]) -> FusedMap {
    draft(settled, &by_seniority(live), &anchor(), &FleetParams::default())
}

#[test]
fn without_a_live_drive_the_draft_is_the_map() {
    let road = Road::bend(200.0);
    let (map, settled) = settled(&Survey::of(&road, 3).drives(8));
    let draft = drafted(&settled, &[]);
    assert_eq!(draft.drives, map.drives);
    assert_eq!(draft.changes, map.changes);
    assert_eq!(draft.lanes.len(), map.lanes.len());
    for (draft, lane) in draft.lanes.iter().zip(&map.lanes) {
        let what = |lane: &FusedLane| {
            (lane.id, lane.category, lane.drives, lane.observations, lane.first_seen, lane.last_seen)
        };
        assert_eq!(what(draft), what(lane));
        assert_eq!(draft.points.len(), lane.points.len());
        for (draft, point) in draft.points.iter().zip(&lane.points) {
            assert!((draft.position - point.position).norm() < 1e-9);
            assert!((draft.lateral_sigma_m - point.lateral_sigma_m).abs() < 1e-9);
            assert!((draft.existence - point.existence).abs() < 1e-6, "{} {}", draft.existence, point.existence);
            assert_eq!((draft.drives, draft.confirmed), (point.drives, point.confirmed));
        }
    }
}

#[test]
fn a_live_drive_adds_the_road_ahead_of_the_others_and_moves_nothing_where_it_was_not() {
    let road = Road::bend(400.0);
    let all = Survey::of(&road, 5).drives(9);
    let mut others: Vec<Contribution> = all[..8].to_vec();
    for drive in &mut others {
        *drive = stretch(drive, 0.0, 250.0);
    }
    let (before, settled) = settled(&others);
    let live = stretch(&all[8], 150.0, 400.0);
    let draft = drafted(&settled, std::slice::from_ref(&live));
    assert!(draft.drives.iter().any(|drive| drive.drive == live.drive && drive.correction.is_some()));
    let length_m = |map: &FusedMap| -> f64 {
        let chords = map.lanes.iter().flat_map(|lane| lane.points.windows(2));
        chords.map(|pair| (pair[1].position - pair[0].position).norm()).sum()
    };
    assert!(length_m(&draft) > 1.3 * length_m(&before), "{} {}", length_m(&draft), length_m(&before));
    // To the millimetre, as readers are told it.
    let mut stayed = 0;
    for old in &before.lanes {
        let now = draft.lanes.iter().find(|lane| lane.id == old.id).unwrap();
        for point in &old.points {
            let away_m = |other: &FusedPoint| (other.position - point.position).norm();
            let nearest = now.points.iter().min_by(|a, b| away_m(a).total_cmp(&away_m(b))).unwrap();
            assert!(away_m(nearest) < 0.1);
            stayed += usize::from(away_m(nearest) < 1e-3 && nearest.drives == point.drives);
        }
    }
    let knots = before.lanes.iter().map(|lane| lane.points.len()).sum::<usize>();
    assert!(2 * stayed > knots, "{stayed} of {knots}");
    // Nor does it lie elsewhere than where solving for all puts it.
    let mut drives = others.clone();
    drives.push(live);
    let whole = fuse(&drives, &anchor(), &FleetParams::default());
    // Knots are 3 m apart.
    let is_beside = |point: &&FusedPoint| {
        let nearest = whole.lanes.iter().flat_map(|lane| &lane.points);
        nearest.into_iter().any(|other| (other.position - point.position).norm() < 1.6)
    };
    let points: Vec<&FusedPoint> = draft.lanes.iter().flat_map(|lane| &lane.points).collect();
    let beside = points.iter().copied().filter(is_beside).count();
    assert!(10 * beside >= 9 * points.len(), "{beside} of {}", points.len());
}

#[test]
fn a_live_drive_that_fits_nowhere_is_kept_apart_and_leaves_the_map_as_it_is() {
    let road = Road::bend(200.0);
    let all = Survey::of(&road, 9).drives(8);
    let (before, settled) = settled(&all[..7]);
    let astray = Contribution { drive: DriveId(99), ..with_bias(all[7].clone(), Vector2::new(0.0, 25.0)) };
    let draft = drafted(&settled, std::slice::from_ref(&astray));
    let apart = |map: &FusedMap| map.drives.iter().filter(|drive| drive.correction.is_none()).count();
    assert_eq!(apart(&draft), apart(&before) + 1);
    assert_eq!(draft.lanes.len(), before.lanes.len());
}
