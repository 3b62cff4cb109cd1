//! What fusion promises, on roads whose truth is known in closed form.

mod chains;
mod roads;

use lanemap_core::{
    Category,
    fleet::{
        Base, ChangeKind, Contribution, DriveId, FleetParams, FusedMap, Keep, by_seniority, fold, fuse, fuse_from,
        fuse_onto,
    },
};
use nalgebra::Vector2;
use proptest::prelude::*;
use roads::{Road, Survey, anchor, stretch, with_bias};

/// Distances of every fused knot from the nearest true line, across, after a shift of the whole map.
fn misfits_m(map: &FusedMap, road: &Road, shift: Vector2<f64>) -> Vec<f64> {
    let points = map.lanes.iter().flat_map(|lane| &lane.points);
    let mut misfits: Vec<f64> = points
        .map(|point| {
            let (station_m, left_m) = road.locate(point.position.coords.xy() + shift);
            road.nearest_line_m(station_m, left_m)
        })
        .collect();
    misfits.sort_by(f64::total_cmp);
    misfits
}

fn quantile(sorted: &[f64], share: f64) -> f64 {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an index")]
    sorted[((sorted.len() - 1) as f64 * share) as usize]
}

/// The shift that lays the map best on the truth, by a search.
fn best_shift(map: &FusedMap, road: &Road) -> Vector2<f64> {
    let mut best = Vector2::zeros();
    let mut step = 0.5;
    let cost = |shift: Vector2<f64>| misfits_m(map, road, shift).iter().map(|misfit| misfit.min(1.0)).sum::<f64>();
    while step > 0.01 {
        let around = (-3..=3).flat_map(|x| (-3..=3).map(move |y| Vector2::new(f64::from(x), f64::from(y))));
        let next = around.map(|offset| best + offset * step).min_by(|a, b| cost(*a).total_cmp(&cost(*b)));
        best = next.unwrap_or(best);
        step *= 0.5;
    }
    best
}

fn fused(contributions: &[Contribution]) -> FusedMap {
    fuse(contributions, &anchor(), &FleetParams::default())
}

fn assert_same(a: &FusedMap, b: &FusedMap) {
    let ids = |map: &FusedMap| map.lanes.iter().map(|lane| lane.id).collect::<Vec<_>>();
    assert_eq!(ids(a), ids(b));
    for (a, b) in a.lanes.iter().zip(&b.lanes) {
        assert_eq!(a.points.len(), b.points.len());
        for (a, b) in a.points.iter().zip(&b.points) {
            assert!((a.position - b.position).norm() <= 1e-3);
        }
    }
}

#[test]
fn ten_drives_with_gnss_biases_of_a_metre_and_a_half_agree_to_decimetres() {
    let road = Road::bend(600.0);
    let drives = Survey::of(&road, 7).drives(10);
    let map = fused(&drives);
    assert_eq!(map.drives.iter().filter(|drive| drive.correction.is_some()).count(), 10);
    assert_eq!(map.lanes.len(), road.lines.len());
    let misfits = misfits_m(&map, &road, best_shift(&map, &road));
    assert!(quantile(&misfits, 0.5) <= 0.06 && quantile(&misfits, 0.95) <= 0.15, "{:?}", quantile(&misfits, 0.95));
}

/// Mean square of how far the knots lie to the left of the line that their name tells.
fn absolute_square_m2(map: &FusedMap, road: &Road) -> f64 {
    let squares = map.lanes.iter().flat_map(|lane| {
        let (line_m, _) = road.lines[usize::try_from(lane.id.lane.0).unwrap_or(1) - 1];
        lane.points.iter().map(move |point| (road.locate(point.position.coords.xy()).1 - line_m).powi(2))
    });
    let squares: Vec<f64> = squares.collect();
    squares.iter().sum::<f64>() / squares.len() as f64
}

#[test]
fn the_absolute_error_falls_with_the_square_root_of_the_number_of_drives() {
    const SEEDS: u64 = 40;
    let road = Road::bend(200.0);
    let rms_m = |count: usize| {
        let squares =
            (0..SEEDS).map(|seed| absolute_square_m2(&fused(&Survey::of(&road, 100 + seed).drives(count)), &road));
        (squares.sum::<f64>() / SEEDS as f64).sqrt()
    };
    let (one, nine) = (rms_m(1), rms_m(9));
    assert!((nine * 3.0 / one - 1.0).abs() < 0.25, "{one} m with one drive, {nine} m with nine");
}

#[test]
fn folding_older_drives_moves_no_line_by_more_than_a_few_centimetres() {
    let road = Road::bend(300.0);
    let drives = Survey::of(&road, 3).drives(20);
    let ordered = by_seniority(&drives);
    let params = FleetParams::default();
    let apart = fuse_onto(&Base::default(), &ordered, &anchor(), &params);
    let base = fold(&Base::default(), &ordered[..10], &anchor(), &params);
    assert_eq!(base.drives(), 10);
    let folded = fuse_onto(&base, &ordered[10..], &anchor(), &params);
    assert_eq!(apart.lanes.len(), folded.lanes.len());
    let (before, after) = (best_shift(&apart, &road), best_shift(&folded, &road));
    assert!((before - after).norm() < 0.15, "{before} {after}");
    let misfits = misfits_m(&folded, &road, after);
    assert!(quantile(&misfits, 0.95) <= 0.15);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 16, ..ProptestConfig::default() })]
    #[test]
    fn fusing_on_from_a_beginning_gives_the_map_of_all_to_the_bit(
        seed in 0..1000_u64,
        folded in prop_oneof![Just(0_usize), Just(3)],
        (kept, so_far_m, arrive) in (0..5_usize, 60.0..140.0_f64, 0..2_usize),
    ) {
        let road = Road::bend(140.0);
        let mut drives = Survey::of(&road, seed).drives(9);
        // One that fits nowhere is laid once more at the end.
        drives[4] = with_bias(drives[4].clone(), Vector2::new(0.0, 9.0));
        let (params, anchor) = (FleetParams::default(), anchor());
        let base = fold(&Base::default(), &by_seniority(&drives[..folded]), &anchor, &params);
        let mut live: Vec<Contribution> = drives[folded..8].to_vec();
        let last = live.len() - 1;
        live[last] = stretch(&live[last], 0.0, so_far_m);
        let before = |drive: usize| Keep { beginning_before: Some(drive), settled: false };
        let beginning = fuse_from(None, &base, &by_seniority(&live), &anchor, &params, before(kept)).beginning.unwrap();
        prop_assert_eq!(beginning.drives(), kept);
        // The live one has grown, and another may have come.
        live[last] = drives[7].clone();
        live.extend(drives[8..8 + arrive].iter().cloned());
        let now = by_seniority(&live);
        let fused = fuse_from(Some(&beginning), &base, &now, &anchor, &params, before(kept + 1));
        prop_assert_eq!(&fused.map, &fuse_onto(&base, &now, &anchor, &params));
        let again = fuse_from(fused.beginning.as_ref(), &base, &now, &anchor, &params, Keep::default());
        prop_assert_eq!(&fused.map, &again.map);
    }
}

#[test]
fn a_map_of_folded_and_younger_drives_is_no_worse_than_one_of_the_younger_alone() {
    let road = Road::bend(300.0);
    let drives = Survey::of(&road, 4).drives(36);
    let p95 = |drives: &[Contribution]| {
        let map = fused(drives);
        quantile(&misfits_m(&map, &road, best_shift(&map, &road)), 0.95)
    };
    let (younger, all) = (p95(&drives[16..]), p95(&drives));
    assert!(all <= younger, "{all} m with the folded, {younger} m without");
}

#[test]
fn the_first_drive_from_one_part_of_the_map_to_another_joins_them_though_their_receivers_are_metres_apart() {
    let lines = [5.3, 1.8, -1.7, -5.2].map(|left_m| (left_m, Category::WhiteDashed));
    let road = Road { radius_m: 2_000.0, lines: lines.to_vec(), ..Road::bend(700.0) };
    let drives = Survey { bias_sigma_m: 0.0, ..Survey::of(&road, 8) }.drives(5);
    // A lane apart, across the road: what either says of its part is as likely a lane over on the other.
    let across = |station_m: f64| road.place(station_m, 1.0) - road.place(station_m, 0.0);
    let mut contributions = vec![
        with_bias(stretch(&drives[0], 0.0, 480.0), 1.75 * across(240.0)),
        with_bias(stretch(&drives[1], 550.0, 700.0), -1.75 * across(625.0)),
    ];
    let whole = drives[2..].iter().map(|drive| with_bias(drive.clone(), 1.75 * across(240.0)));
    contributions.extend(whole);
    let map = fused(&contributions);
    assert!(map.drives.iter().all(|drive| drive.correction.is_some()));
    assert_eq!(map.lanes.len(), road.lines.len());
    let misfits = misfits_m(&map, &road, best_shift(&map, &road));
    assert!(quantile(&misfits, 0.95) <= 0.2, "{}", quantile(&misfits, 0.95));
    let points = map.lanes.iter().flat_map(|lane| &lane.points);
    let drives_on_other_part: Vec<u32> = points
        .filter(|point| (575.0..675.0).contains(&road.locate(point.position.coords.xy()).0))
        .map(|point| point.drives)
        .collect();
    assert!(drives_on_other_part.iter().all(|drives| *drives == 4), "{drives_on_other_part:?}");
}

#[test]
fn a_drive_that_is_taken_out_leaves_the_map_of_the_others() {
    let road = Road::bend(200.0);
    let drives = Survey::of(&road, 5).drives(5);
    let mut without = drives.clone();
    without.remove(2);
    let map = fused(&without);
    assert!(map.drives.iter().all(|drive| drive.drive != drives[2].drive));
    assert_same(&map, &fused(&without.iter().rev().cloned().collect::<Vec<_>>()));
}

#[test]
fn a_drive_far_off_or_warped_does_not_spoil_the_map_of_the_others() {
    let road = Road::bend(400.0);
    let mut drives = Survey::of(&road, 11).drives(14);
    let poisoned = Survey { bias_sigma_m: 40.0, ..Survey::of(&road, 12) }.drives(6);
    drives.extend(
        poisoned
            .into_iter()
            .enumerate()
            .map(|(index, drive)| Contribution { drive: DriveId(1000 + index as u64), ..drive }),
    );
    // What only drives tens of metres off say is another road to all that can be known.
    let of_many = |drives: &[Contribution]| {
        let map = fused(drives);
        FusedMap { lanes: map.lanes.into_iter().filter(|lane| lane.drives > 3).collect(), ..FusedMap::default() }
    };
    let (clean, map) = (of_many(&Survey::of(&road, 11).drives(14)), of_many(&drives));
    assert_eq!(map.lanes.len(), clean.lanes.len());
    let p95 = |map: &FusedMap| quantile(&misfits_m(map, &road, best_shift(map, &road)), 0.95);
    assert!(p95(&map) <= 1.2 * p95(&clean).max(0.05), "{} {}", p95(&map), p95(&clean));
}

/// The drives, the first few of them by receivers that are so many degrees off, north and east.
fn first_aside(drives: &[Contribution], count: usize, [north_deg, east_deg]: [f64; 2]) -> FusedMap {
    let mut drives = drives.to_vec();
    let fixes =
        drives[..count].iter_mut().flat_map(|drive| &mut drive.trajectory).filter_map(|point| point.fix.as_mut());
    for fix in fixes {
        fix.latitude_deg += north_deg;
        fix.longitude_deg += east_deg;
    }
    fused(&drives)
}

fn drives_apart(map: &FusedMap) -> Vec<usize> {
    let drives = map.drives.iter().enumerate().filter(|(_, drive)| drive.correction.is_none());
    drives.map(|(index, _)| index).collect()
}

#[test]
fn two_drives_that_are_wrong_alike_make_no_second_road_beside_a_known_one_and_three_do() {
    let drives = Survey::of(&Road::bend(400.0), 11).drives(12);
    // 45 m across the middle of the road: nowhere do the two roads meet.
    let aside = |count: usize| drives_apart(&first_aside(&drives, count, [3.6e-4, -2.8e-4]));
    assert_eq!([aside(0), aside(1), aside(2), aside(3)], [vec![], vec![0], vec![0, 1], vec![]]);
}

#[test]
fn a_first_drive_whose_wrong_road_crosses_the_true_one_keeps_nobody_else_apart() {
    let drives = Survey::of(&Road::bend(400.0), 11).drives(12);
    // 45 m to the north-east: the wrong road runs over the end of the true one.
    let aside = |count: usize| drives_apart(&first_aside(&drives, count, [3e-4, 4e-4]));
    assert_eq!([aside(1), aside(3)], [vec![0], vec![0, 1, 2]]);
}

/// A drive whose camera is turned, or that saw badly: its lanes wave from side to side.
fn waving(mut drive: Contribution, amplitude_m: f64, start: f64) -> Contribution {
    for point in drive.lanes.iter_mut().flat_map(|lane| &mut lane.control_points) {
        point.position.y += amplitude_m * (point.position.x / 9.0 + start).sin();
    }
    drive
}

#[test]
fn drives_whose_lanes_wave_are_believed_less_than_others() {
    let road = Road::bend(400.0);
    let drives = Survey::of(&road, 11).drives(14);
    // All that are wrong wave alike: no mean of them comes out right.
    let spoil = |(index, drive): (usize, Contribution)| if index < 5 { waving(drive, 0.4, 0.0) } else { drive };
    let spoilt: Vec<Contribution> = drives.iter().cloned().enumerate().map(spoil).collect();
    let (clean, map) = (fused(&drives[5..]), fused(&spoilt));
    let p95 = |map: &FusedMap| quantile(&misfits_m(map, &road, best_shift(map, &road)), 0.95);
    assert!(p95(&map) <= 1.2 * p95(&clean), "{} {}", p95(&map), p95(&clean));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]
    #[test]
    fn any_order_and_any_duplication_give_the_same_map(
        seed in 0..1000_u64,
        order in Just((0..5).collect::<Vec<usize>>()).prop_shuffle(),
        again in proptest::collection::vec(0..5_usize, 0..4),
    ) {
        let road = Road::bend(120.0);
        let drives = Survey::of(&road, seed).drives(5);
        let expected = fused(&drives);
        let shuffled: Vec<Contribution> = order.iter().chain(&again).map(|index| drives[*index].clone()).collect();
        assert_same(&fused(&shuffled), &expected);
    }
}

/// Drives of a road before and after its line `index` changes to `after`, metres to the left; `None`: it goes.
fn before_and_after(index: usize, after: Option<f64>) -> FusedMap {
    let before = Road::bend(150.0);
    let mut lines = before.lines.clone();
    match after {
        Some(left_m) => lines[index].0 = left_m,
        None => drop(lines.remove(index)),
    }
    let changed = Road { lines, ..Road::bend(150.0) };
    let mut drives = Survey::of(&before, 21).drives(12);
    let later = Survey::of(&changed, 21).drives(16);
    drives.truncate(8);
    drives.extend_from_slice(&later[8..12]);
    fused(&drives)
}

#[test]
fn a_line_that_vanishes_is_noticed_and_is_no_longer_in_the_map() {
    let map = before_and_after(2, None);
    assert_eq!(map.lanes.len(), 3);
    assert_eq!(map.changes.len(), 1, "{:?}", map.changes);
    let change = &map.changes[0];
    assert!(matches!(change.kind, ChangeKind::Vanished) && change.probability > 0.5);
    assert!(change.points.len() >= 40);
    assert!(change.noticed_by.0 <= 8 + 3, "by the third drive that missed it: {:?}", change.noticed_by);
}

#[test]
fn a_line_that_is_moved_is_one_event_and_lies_in_its_new_place() {
    let map = before_and_after(2, Some(-0.5));
    assert_eq!(map.lanes.len(), 4);
    let [change] = map.changes.as_slice() else { panic!("{:?}", map.changes) };
    let ChangeKind::Moved { by_m } = change.kind else { panic!("{change:?}") };
    assert!((by_m - 1.2).abs() < 0.4, "{by_m}");
}

#[test]
fn a_road_that_stays_as_it_is_has_no_changes() {
    assert_eq!(fused(&Survey::of(&Road::bend(200.0), 31).drives(12)).changes, Vec::new());
}

/// A drive that lost one of its lines for some metres.
fn interrupted(mut drive: Contribution, lane: usize, gap: std::ops::Range<usize>) -> Contribution {
    let mut onward = drive.lanes[lane].clone();
    onward.control_points.drain(..gap.end);
    onward.id = lanemap_core::LaneId(drive.lanes.len() as u64 + 1);
    drive.lanes[lane].control_points.truncate(gap.start);
    for piece in [&mut onward, &mut drive.lanes[lane]] {
        piece.drawn_to = (piece.control_points.len() - 1) as f64;
    }
    drive.lanes.push(onward);
    drive
}

#[test]
fn a_line_that_one_drive_lost_for_some_metres_is_one_line_when_another_sees_it_whole() {
    let road = Road::bend(200.0);
    let mut drives = Survey::of(&road, 41).drives(3);
    let whole = fused(&drives);
    drives[0] = interrupted(drives[0].clone(), 2, 30..33);
    assert_eq!(fused(&drives[..1]).lanes.len(), road.lines.len() + 1, "nobody else was there yet");
    let joined = fused(&drives);
    let ids = |map: &FusedMap| map.lanes.iter().map(|lane| lane.id).collect::<Vec<_>>();
    assert_eq!(ids(&joined), ids(&whole), "the older name stays");
    let lines = joined.lanes.iter().zip(&whole.lanes);
    for (joined, whole) in lines {
        assert!(joined.points.len().abs_diff(whole.points.len()) <= 1);
    }
    let misfits = misfits_m(&joined, &road, best_shift(&joined, &road));
    assert!(quantile(&misfits, 1.0) <= 0.35, "{:?}", misfits.last());
}

#[test]
fn a_dashed_line_that_goes_on_solid_stays_two() {
    let road = Road::bend(200.0);
    let mut drives = Survey::of(&road, 42).drives(3);
    drives[0] = interrupted(drives[0].clone(), 2, 30..31);
    let solid = Category::WhiteSolid;
    let last = drives[0].lanes.len() - 1;
    let onward = &mut drives[0].lanes[last];
    onward.category = solid;
    onward.category_posterior = vec![0.02 / 14.0; 15];
    onward.category_posterior[solid.index()] = 0.98;
    assert_eq!(fused(&drives[..1]).lanes.len(), road.lines.len() + 1);
    assert_eq!(fused(&drives[..2]).lanes.len(), road.lines.len() + 1);
}

#[test]
fn a_drive_whose_receiver_is_two_lanes_off_is_laid_on_its_own_lanes() {
    // Lines a lane apart all over the road: only its edges tell which is which.
    let dashed = |left_m: f64| (left_m, Category::WhiteDashed);
    let lines = vec![
        (10.5, Category::LeftCurb),
        dashed(7.0),
        dashed(3.5),
        (0.0, Category::DoubleYellowSolid),
        dashed(-3.5),
        dashed(-7.0),
        (-10.5, Category::RightCurb),
    ];
    let road = Road { lines, radius_m: 5_000.0, ..Road::bend(400.0) };
    let drives = |bias_sigma_m: f64| Survey { bias_sigma_m, ..Survey::of(&road, 44) }.drives(4);
    let mut together = drives(0.3);
    let shift = |fix: &mut lanemap_core::GnssFix, north_m: f64| fix.latitude_deg += north_m / 111_195.0;
    // The receiver says 1.5 m and is off by 6.4 m: four standard deviations of what it and three others are off by.
    for fix in together[3].trajectory.iter_mut().filter_map(|point| point.fix.as_mut()) {
        shift(fix, 6.4);
    }
    let map = fused(&together);
    assert_eq!(map.lanes.len(), road.lines.len(), "none is drawn beside the road");
    let seen_by_all = map.lanes.iter().filter(|lane| lane.drives == 4).count();
    assert_eq!(seen_by_all, road.lines.len());
}
