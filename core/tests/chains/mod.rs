//! What fusion promises of long chains of drives, each of which shares a stretch of road with the next only.

use lanemap_core::{
    Category,
    fleet::{Base, Beginning, Contribution, FleetParams, Keep, by_seniority, fold, fuse, fuse_from, fuse_onto},
};
use nalgebra::Vector2;

use crate::roads::{Road, Survey, anchor, stretch, with_bias};

/// A road on which nothing but its edges tells the lines from each other.
fn road() -> Road {
    let lines = [5.3, 1.8, -1.7, -5.2].map(|left_m| (left_m, Category::WhiteDashed));
    Road { radius_m: 2_000.0, lines: lines.to_vec(), ..Road::bend(600.0) }
}

/// Eight drives along a road, each over the last part of the one before and further on; the receiver of the first puts it to the right.
fn chain(drives: &[Contribution], road: &Road) -> Vec<Contribution> {
    let across = road.place(300.0, 1.0) - road.place(300.0, 0.0);
    let from_m = [0.0, 60.0, 120.0, 180.0, 240.0, 300.0, 360.0, 420.0];
    let mut chain: Vec<Contribution> =
        drives.iter().zip(from_m).map(|(drive, from_m)| stretch(drive, from_m, from_m + 160.0)).collect();
    chain[0] = with_bias(chain[0].clone(), -1.6 * across);
    chain
}

/// How far to the left of the axis the ninth drive lies, which saw the middle lines only, and whose receiver puts it so far to the left;
/// of each survey in which it was laid.
fn lefts_of_ninth_m(bias_m: f64) -> Vec<f64> {
    let road = road();
    let across = road.place(300.0, 1.0) - road.place(300.0, 0.0);
    let left_m = |seed| {
        let drives = Survey { bias_sigma_m: 0.0, ..Survey::of(&road, seed) }.drives(9);
        let mut contributions = chain(&drives, &road);
        let mut ninth = with_bias(stretch(&drives[8], 200.0, 500.0), bias_m * across);
        ninth.lanes = ninth.lanes[1..3].to_vec();
        let middle = ninth.trajectory[ninth.trajectory.len() / 2].clone();
        contributions.push(ninth);
        let map = fuse(&contributions, &anchor(), &FleetParams::default());
        assert!(map.drives[..8].iter().all(|drive| drive.correction.is_some()));
        let correction = map.drives[8].correction.as_ref()?;
        Some(road.locate(correction.apply(&middle.position, middle.arc_m).coords.xy()).1)
    };
    (1..=8).filter_map(left_m).collect()
}

#[test]
fn a_drive_is_laid_by_what_all_receivers_of_a_chain_of_drives_say_and_not_by_the_oldest_alone() {
    // By the oldest, the chain lies 1.6 m to the right, and 1.9 m to the left is the next lane.
    let right_by_all = lefts_of_ninth_m(0.3);
    assert!(right_by_all.len() >= 2 && right_by_all.iter().all(|left_m| left_m.abs() < 1.0), "{right_by_all:?}");
    let a_lane_off_by_the_oldest = lefts_of_ninth_m(1.6);
    assert!(a_lane_off_by_the_oldest.iter().all(|left_m| left_m.abs() < 1.0), "{a_lane_off_by_the_oldest:?}");
}

#[test]
fn a_chain_of_drives_is_fused_on_from_any_beginning_to_the_bit_before_and_after_it_is_spread() {
    let (road, params, anchor) = (road(), FleetParams::default(), anchor());
    let drives = Survey::of(&road, 3).drives(20);
    let mut drives: Vec<Contribution> = drives.chunks(8).flat_map(|eight| chain(eight, &road)).collect();
    // One that fits nowhere is laid once more at the end.
    drives[5] = with_bias(drives[5].clone(), Vector2::new(0.0, 40.0));
    for folded in [0, 3] {
        let base = fold(&Base::default(), &by_seniority(&drives[..folded]), &anchor, &params);
        let all = by_seniority(&drives[folded..]);
        for kept in [7, 8, 9, 15, 16] {
            let keep = Keep { beginning_before: Some(kept), settled: false };
            let beginning = fuse_from(None, &base, &all[..=kept], &anchor, &params, keep).beginning;
            assert_eq!(beginning.as_ref().map(Beginning::drives), Some(kept));
            // Of as many drives as lie already, of one more, and of all.
            for count in [kept, kept + 1, all.len()] {
                let map = fuse_from(beginning.as_ref(), &base, &all[..count], &anchor, &params, Keep::default()).map;
                assert_eq!(map, fuse_onto(&base, &all[..count], &anchor, &params), "{folded} {kept} {count}");
            }
        }
    }
}
