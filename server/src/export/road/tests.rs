use lanemap_core::Category;
use nalgebra::Point3;

use super::*;
use crate::export::{
    map_line::{
        MapLine,
        tests::{arc, line_through},
    },
    plane::Plane,
};

fn map(lines: Vec<MapLine>) -> MapLines {
    MapLines { plane: Plane::at(48.0, 11.0), pieces: lines.len() as u64, lines }
}

fn reversed(mut points: Vec<Point3<f64>>) -> Vec<Point3<f64>> {
    points.reverse();
    points
}

/// A road of a lane each way, whose left edge was first seen from the other side.
fn two_way(radius_m: f64) -> MapLines {
    map(vec![
        line_through("a left", Category::WhiteSolid, &reversed(arc(radius_m, 3.5, 0.0, 90.0))),
        line_through("b middle", Category::YellowDashed, &arc(radius_m, 0.0, 0.0, 90.0)),
        line_through("c right", Category::WhiteSolid, &arc(radius_m, -3.5, 0.0, 90.0)),
    ])
}

/// Which way lanes of a section are driven on the earth: whether as `line` runs, from the left of that line to its right.
fn driven(roads: &[Road], map: &MapLines, line: usize) -> Vec<bool> {
    let mut sections = roads.iter().flat_map(|road| &road.sections);
    let section = sections.find(|section| section.lanes() > 0).expect("a road has lanes");
    let along = section.borders.iter().find(|border| border.line == line).unwrap().along;
    let lanes = section.gaps.iter().filter(|gap| gap.kind == GapKind::Lane);
    let mut driven: Vec<bool> = lanes.map(|gap| (gap.travel == Travel::Along) == along).collect();
    if !along {
        driven.reverse();
    }
    assert!(map.lines.len() > line);
    driven
}

/// The only road with lanes, and its sections with lanes. Beside it there are remnants: lines that end a little later.
fn with_lanes(roads: &[Road]) -> Vec<Section> {
    let mut found = roads.iter().filter(|road| road.sections.iter().any(|section| section.lanes() > 0));
    let road = found.next().expect("a road has lanes");
    assert!(found.next().is_none(), "one road has lanes");
    road.sections.iter().filter(|section| section.lanes() > 0).cloned().collect()
}

#[test]
fn a_road_of_a_lane_each_way_has_them_side_by_side_straight_and_in_a_bend() {
    for radius_m in [f64::INFINITY, 60.0, -45.0] {
        let map = two_way(radius_m);
        let roads = roads(&map, LaneOptions::default());
        let whole = with_lanes(&roads);
        assert_eq!(whole.len(), 1, "{whole:?}");
        assert_eq!((whole[0].borders.len(), whole[0].lanes()), (3, 2));
        // The middle has traffic to its right along, and to its left against.
        assert_eq!(driven(&roads, &map, 1), [false, true], "radius {radius_m}");
    }
}

#[test]
fn where_one_keeps_left_the_lanes_are_driven_the_other_way() {
    let map = two_way(f64::INFINITY);
    let roads = roads(&map, LaneOptions { traffic: super::super::TrafficSide::Left });
    assert_eq!(driven(&roads, &map, 1), [true, false]);
}

#[test]
fn lanes_without_a_line_between_the_ways_are_driven_as_their_lines_run() {
    let map = map(vec![
        line_through("a", Category::YellowSolid, &arc(f64::INFINITY, 3.5, 0.0, 90.0)),
        line_through("b", Category::WhiteDashed, &arc(f64::INFINITY, 0.0, 0.0, 90.0)),
        line_through("c", Category::WhiteSolid, &arc(f64::INFINITY, -3.5, 0.0, 90.0)),
    ]);
    assert_eq!(driven(&roads(&map, LaneOptions::default()), &map, 0), [true, true]);
}

#[test]
fn a_median_between_two_carriageways_is_no_lane() {
    let edge =
        |name: &str, aside_m: f64, category| line_through(name, category, &arc(f64::INFINITY, aside_m, 0.0, 90.0));
    let oncoming = |name: &str, aside_m: f64, category| {
        line_through(name, category, &reversed(arc(f64::INFINITY, aside_m, 0.0, 90.0)))
    };
    let map = map(vec![
        oncoming("a", 6.5, Category::WhiteSolid),
        oncoming("b", 3.0, Category::WhiteSolid),
        edge("c", 0.0, Category::WhiteSolid),
        edge("d", -3.5, Category::WhiteSolid),
    ]);
    let roads = roads(&map, LaneOptions::default());
    let section = &roads[0].sections[0];
    assert_eq!(
        section.gaps.iter().map(|gap| gap.kind).collect::<Vec<_>>(),
        [GapKind::Lane, GapKind::Median, GapKind::Lane]
    );
    assert_eq!(driven(&roads, &map, 2), [false, true]);
}

#[test]
fn a_lane_that_opens_on_the_right_adjoins_the_one_that_goes_on() {
    // The edge leaves over 45 m; a dashed line begins where it left.
    let opening = |at_m: f64| {
        let share = ((at_m - 60.0) / 45.0).clamp(0.0, 1.0);
        -3.5 - 3.5 * share * share * (3.0 - 2.0 * share)
    };
    let edge: Vec<Point3<f64>> =
        (0..70).map(|i| 3.0 * f64::from(i)).map(|at_m| Point3::new(at_m, opening(at_m), 0.01 * at_m)).collect();
    let map = map(vec![
        line_through("a left", Category::YellowSolid, &arc(f64::INFINITY, 0.0, 0.0, 207.0)),
        line_through("b dashed", Category::WhiteDashed, &arc(f64::INFINITY, -3.5, 66.0, 207.0)),
        line_through("c edge", Category::WhiteSolid, &edge),
    ]);
    let roads = roads(&map, LaneOptions::default());
    let sections = with_lanes(&roads);
    let lanes: Vec<usize> = sections.iter().map(Section::lanes).collect();
    assert_eq!(lanes, [1, 1, 2], "{sections:?}");
    // One lane from end to end, and one more beside it from where it is wide enough.
    let is_left = |section: &Section, gap: usize| section.borders[gap].line == 0 || section.borders[gap + 1].line == 0;
    for pair in sections.windows(2) {
        let gap = (0..pair[0].gaps.len()).find(|gap| is_left(&pair[0], *gap)).unwrap();
        let next = pair[0].gaps[gap].goes_on_in.expect("it goes on");
        assert!(is_left(&pair[1], next));
    }
    let last = &sections[2];
    assert!((last.borders[1].from_left_m - last.borders[2].from_left_m).abs() - NARROWEST_LANE_M < 0.01);
}

#[test]
fn every_stretch_of_every_line_is_in_exactly_one_section() {
    for map in [two_way(50.0), two_way(f64::INFINITY)] {
        let roads = roads(&map, LaneOptions::default());
        let mut covered = vec![Vec::new(); map.lines.len()];
        for border in roads.iter().flat_map(|road| road.sections.iter().flat_map(|section| &section.borders)) {
            covered[border.line].push((border.from.min(border.to), border.from.max(border.to)));
        }
        for (line, mut stretches) in covered.into_iter().enumerate() {
            stretches.sort_by(|a, b| a.0.total_cmp(&b.0));
            assert!(stretches[0].0.abs() < 1e-6);
            assert!((stretches[stretches.len() - 1].1 - map.lines[line].end()).abs() < 1e-6);
            for pair in stretches.windows(2) {
                assert!((pair[0].1 - pair[1].0).abs() < 1e-6, "line {line}: {pair:?}");
            }
        }
    }
}
