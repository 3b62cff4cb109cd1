use lanemap_core::{LaneId, fleet::DriveId};
use proptest::prelude::*;

use super::*;

/// Two cells side by side in Munich.
fn cells() -> (CellId, CellId) {
    (CellId::new(8_718, 5_685).unwrap(), CellId::new(8_719, 5_685).unwrap())
}

fn id(drive: u64) -> FusedLaneId {
    FusedLaneId { started: TimestampNs(1), drive: DriveId(drive), lane: LaneId(4), piece: 0, stretch: 0 }
}

/// A line to the east over the border of both cells, as the cell sees it, `aside_m` to the north.
fn line(cell: CellId, drive: u64, aside_m: f64) -> FusedLane {
    let (here, anchor) = (cells().0.anchor(), cell.anchor());
    let points = (0..40).map(|i| {
        let place = here.wgs84_from_enu(&Point3::new(760.0 + 3.0 * f64::from(i), 20.0 + aside_m, 500.0));
        FusedPoint {
            position: anchor.enu_from_wgs84(&place),
            lateral_sigma_m: 0.1,
            height_sigma_m: 0.2,
            drives: 2,
            existence: 0.9,
            confirmed: TimestampNs(2),
        }
    });
    FusedLane {
        id: id(drive),
        category: Category::WhiteSolid,
        category_posterior: vec![],
        points: points.collect(),
        drives: 2,
        observations: 9,
        first_seen: TimestampNs(1),
        last_seen: TimestampNs(2),
    }
}

fn joined_both(here: &[FusedLane], there: &[FusedLane]) -> (Vec<JoinedPiece>, Vec<JoinedPiece>) {
    let (a, b) = cells();
    let ((pieces_a, crossings_a), (pieces_b, crossings_b)) = (cut(a, here), cut(b, there));
    let joined_a = join(a, pieces_a, &crossings_a, |cell| (cell == b).then_some(crossings_b.as_slice()));
    let joined_b = join(b, pieces_b, &crossings_b, |cell| (cell == a).then_some(crossings_a.as_slice()));
    (joined_a, joined_b)
}

/// How far north of the first of its cells a piece lies, point by point, metres.
fn norths(cell: CellId, piece: &JoinedPiece) -> Vec<f64> {
    let (here, anchor) = (cells().0.anchor(), cell.anchor());
    let place = |point: &FusedPoint| here.enu_from_wgs84(&anchor.wgs84_from_enu(&point.position));
    piece.piece.points.iter().map(|point| place(point).y - 20.0).collect()
}

/// In which line of the other cell each goes on.
fn goes_on(here: &[JoinedPiece]) -> Vec<Option<u64>> {
    let goes_on = |piece: &JoinedPiece| {
        let join = piece.ends_at.or(piece.begins_at).unwrap();
        join.continues_in.map(|(_, name)| name.lane.drive.0)
    };
    here.iter().map(goes_on).collect()
}

/// Lines side by side, numbered from `first` on.
fn road(cell: CellId, first: u64, asides_m: &[f64]) -> Vec<FusedLane> {
    (first..).zip(asides_m).map(|(drive, aside_m)| line(cell, drive, *aside_m)).collect()
}

#[test]
fn both_pieces_of_a_line_name_each_other_and_share_the_point_half_way_between_them() {
    let (a, b) = cells();
    let (here, there) = joined_both(&[line(a, 1, 0.0)], &[line(b, 1, 0.2)]);
    let (leaves, comes) = (here[0].ends_at.unwrap(), there[0].begins_at.unwrap());
    assert_eq!(leaves.place, comes.place);
    assert_eq!(leaves.continues_in, Some((b, there[0].piece.name)));
    assert_eq!(comes.continues_in, Some((a, here[0].piece.name)));
    assert_eq!((here[0].begins_at, there[0].ends_at), (None, None));
    let end = b.anchor().wgs84_from_enu(&there[0].piece.points[0].position);
    assert!((end.latitude_deg - comes.place.latitude_deg).abs() < 1e-12);
    // Both bend to meet and have their own course again 24 m on.
    let (west, east) = (norths(a, &here[0]), norths(b, &there[0]));
    assert!((east[0] - 0.1).abs() < 1e-6 && (east[12] - 0.2).abs() < 1e-3);
    assert!((west[west.len() - 1] - 0.1).abs() < 1e-6 && west[west.len() - 13].abs() < 1e-3);
}

#[test]
fn a_road_whose_cells_lie_a_metre_apart_goes_on_without_a_kink_and_says_how_well_it_is_known() {
    let (a, b) = cells();
    let asides_m = [0.0, 3.5, 7.1];
    let shifted_m = asides_m.map(|aside_m| aside_m + 1.0);
    let (here, there) = joined_both(&road(a, 1, &asides_m), &road(b, 4, &shifted_m));
    assert_eq!(goes_on(&here), [Some(4), Some(5), Some(6)]);
    assert_eq!(goes_on(&there), [Some(1), Some(2), Some(3)]);
    for ((west, east), aside_m) in here.iter().zip(&there).zip(asides_m) {
        let mut course = norths(a, west);
        let border = norths(b, east);
        assert!((course.pop().unwrap() - border[0]).abs() < 1e-6);
        course.extend(border);
        assert!((course[0] - aside_m).abs() < 1e-6 && (course[course.len() - 1] - aside_m - 1.0).abs() < 1e-3);
        for pair in course.windows(2) {
            assert!((-1e-6..=4.6 * MOST_BEND).contains(&(pair[1] - pair[0])), "{pair:?}");
        }
        let sigma_m = east.piece.points[0].lateral_sigma_m;
        assert!((sigma_m - 0.1_f64.hypot(0.5)).abs() < 1e-3, "{sigma_m}");
        assert!((east.piece.points[15].lateral_sigma_m - 0.1).abs() < 1e-9);
    }
}

#[test]
fn roads_that_lie_farther_apart_or_of_which_it_is_not_clear_how_they_go_on_do_not() {
    let (a, b) = cells();
    let other = |mut lane: FusedLane| {
        lane.category = Category::WhiteDashed;
        lane
    };
    let none = |here: &[FusedLane], there: &[FusedLane]| {
        let (here, there) = joined_both(here, there);
        goes_on(&here).iter().chain(&goes_on(&there)).all(Option::is_none)
    };
    assert!(none(&road(a, 1, &[0.0, 3.5]), &road(b, 4, &[7.0, 10.5])), "two lanes apart");
    assert!(none(&road(a, 1, &[0.0]), &road(b, 4, &[2.0])), "a line farther away than half a lane");
    assert!(none(&road(a, 1, &[0.0]), &[other(line(b, 4, 1.0))]), "a line of another category");
    assert!(none(&road(a, 1, &[0.0, 3.5]), &road(b, 4, &[1.0])), "one line alone");
    // Four lines 3 m apart and three half way between them: nobody knows to which side, unless the categories say it.
    let (four, three) = (road(a, 1, &[0.0, 3.0, 6.0, 9.0]), road(b, 5, &[1.5, 4.5, 7.5]));
    assert!(none(&four, &three));
    let (mut four, mut three) = (four, three);
    (four[1].category, three[0].category) = (Category::WhiteDashed, Category::WhiteDashed);
    let (here, _) = joined_both(&four, &three);
    assert_eq!(goes_on(&here), [None, Some(5), Some(6), Some(7)]);
}

#[test]
fn a_line_that_ends_at_the_border_stays_where_it_is_beside_those_that_go_on() {
    let (a, b) = cells();
    let (here, there) = joined_both(&road(a, 1, &[0.0, 3.5, 7.0]), &road(b, 4, &[1.0, 4.5]));
    assert_eq!((goes_on(&here), goes_on(&there)), (vec![Some(4), Some(5), None], vec![Some(1), Some(2)]));
    assert!(norths(a, &here[2]).iter().all(|north_m| (north_m - 7.0).abs() < 1e-6));
    assert!(here[2].piece.points.iter().all(|point| (point.lateral_sigma_m - 0.1).abs() < 1e-9));
}

#[test]
fn of_two_lines_side_by_side_each_continues_in_its_own() {
    let (a, b) = cells();
    let (here, there) = joined_both(&[line(a, 1, 0.0), line(a, 2, 0.3)], &[line(b, 3, 0.1), line(b, 4, 0.4)]);
    assert_eq!((goes_on(&here), goes_on(&there)), (vec![Some(3), Some(4)], vec![Some(1), Some(2)]));
}

#[test]
fn a_piece_ends_on_the_border_and_no_chord_of_it_is_short() {
    let (a, _) = cells();
    let (pieces, crossings) = cut(a, &[line(a, 1, 0.0)]);
    let east = a.bounds().east;
    assert!((crossings[0].place.longitude_deg - east).abs() < 1e-9 && crossings[0].place.longitude_deg < east);
    for pair in pieces[0].points.windows(2) {
        let chord_m = nalgebra::distance(&pair[0].position, &pair[1].position);
        assert!((1.5..=4.6).contains(&chord_m), "{chord_m}");
    }
}

proptest! {
    #[test]
    fn both_cells_say_the_same_of_every_join_and_lines_do_not_cross(
        here in prop::collection::vec((0.0..20.0, any::<bool>()), 1..6),
        there in prop::collection::vec((0.0..20.0, any::<bool>()), 1..6),
    ) {
        let (a, b) = cells();
        let road = |cell: CellId, first: u64, lanes: &[(f64, bool)]| -> Vec<FusedLane> {
            let lane = |(drive, (aside_m, is_dashed)): (u64, &(f64, bool))| FusedLane {
                category: if *is_dashed { Category::WhiteDashed } else { Category::WhiteSolid },
                ..line(cell, drive, *aside_m)
            };
            (first..).zip(lanes).map(lane).collect()
        };
        let (west, east) = joined_both(&road(a, 1, &here), &road(b, 100, &there));
        let mut joined = Vec::new();
        for piece in &west {
            let join = piece.ends_at.unwrap();
            let Some((_, name)) = join.continues_in else { continue };
            let other = east.iter().find(|other| other.piece.name == name).unwrap().begins_at.unwrap();
            prop_assert_eq!(other.place, join.place);
            prop_assert_eq!(other.continues_in, Some((a, piece.piece.name)));
            let aside_m = here[usize::try_from(piece.piece.name.lane.drive.0).unwrap() - 1].0;
            let aside_there_m = there[usize::try_from(name.lane.drive.0).unwrap() - 100].0;
            prop_assert!((aside_m - aside_there_m).abs() < 2.26);
            joined.push((aside_m, aside_there_m));
        }
        let back = east.iter().filter(|piece| piece.begins_at.unwrap().continues_in.is_some()).count();
        prop_assert_eq!(back, joined.len());
        joined.sort_by(|one, other| one.0.total_cmp(&other.0));
        prop_assert!(joined.windows(2).all(|pair| pair[0].1 <= pair[1].1));
    }
}
