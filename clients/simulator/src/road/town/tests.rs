//! Promises of towns.

use std::collections::{BTreeMap, BTreeSet};

use super::*;
use crate::{
    fleet::routes::onward,
    road::{LinkIndex, LinkKind},
};

fn towns() -> Vec<RoadNetwork> {
    (0..4).map(|seed| TownPlan::small().build(0.03, Seed(seed))).collect()
}

#[test]
fn every_street_is_reached_from_every_other() {
    let large = TownPlan::square_km(3.2).build(0.03, Seed(1));
    for network in towns().iter().chain([&large]) {
        for start in [0, network.links().len() / 2, network.links().len() - 1] {
            let mut reached = BTreeSet::from([(LinkIndex(start), true)]);
            let mut waiting = vec![(LinkIndex(start), true)];
            while let Some((link, forward)) = waiting.pop() {
                waiting.extend(onward(network, link, forward).into_iter().filter(|next| reached.insert(*next)));
            }
            let missing: Vec<_> = (0..network.links().len())
                .flat_map(|link| [(LinkIndex(link), true), (LinkIndex(link), false)])
                .filter(|(link, forward)| *forward || network.link(*link).carriageway.is_two_way())
                .filter(|way| !reached.contains(way))
                .collect();
            assert!(missing.is_empty(), "from {start}: {missing:?}");
        }
    }
}

#[test]
fn a_town_has_streets_roundabouts_and_a_motorway_with_ramps() {
    for network in towns() {
        let count = |is: fn(LinkKind) -> bool| network.links().iter().filter(|link| is(link.kind)).count();
        assert!(count(|kind| kind == LinkKind::Street) >= 20);
        assert!(count(|kind| kind == LinkKind::Ring) >= 3);
        assert!(count(|kind| kind == LinkKind::Ramp) >= 2);
        assert!(count(|kind| matches!(kind, LinkKind::Motorway { ramp_leaves: true, .. })) >= 1);
        assert!(count(|kind| matches!(kind, LinkKind::Motorway { ramp_joins: true, .. })) >= 1);
        let lanes: BTreeSet<u8> = network.links().iter().map(|link| link.carriageway.forward_lanes()).collect();
        assert_eq!(lanes, BTreeSet::from([1, 2, 3]));
    }
}

#[test]
fn lines_have_points_a_metre_apart_and_no_kinks() {
    for network in towns() {
        for line in network.lines() {
            assert!(line.points.len() >= 5, "{:?} has {} points", line.id, line.points.len());
            for triple in line.points.windows(3) {
                let (before, after) = ((triple[1] - triple[0]).xy(), (triple[2] - triple[1]).xy());
                assert!((0.5..1.5).contains(&before.norm()), "{:?}: {}", line.id, before.norm());
                let turn_rad = before.perp(&after).atan2(before.dot(&after)).abs();
                assert!(turn_rad < 0.15, "{:?} turns by {turn_rad} at {}", line.id, triple[1]);
            }
        }
    }
}

#[test]
fn the_two_lines_of_a_double_line_lie_a_quarter_of_a_metre_apart() {
    let plan = TownPlan { double_line_share: 1.0, ..TownPlan::small() };
    let network = plan.build(0.03, Seed(2));
    let mut pairs = 0;
    for link in network.links().iter().filter(|link| link.kind == LinkKind::Street) {
        for pair in link.lines.windows(2).map(|pair| [network.line(pair[0]), network.line(pair[1])]) {
            if pair.iter().all(|line| line.category == lanemap_core::Category::YellowSolid) {
                pairs += 1;
                for (a, b) in pair[0].points.iter().zip(&pair[1].points) {
                    assert!(((a - b).xy().norm() - 0.25).abs() < 0.01);
                }
            }
        }
    }
    assert!(pairs >= 20);
}

#[test]
fn no_stretch_of_a_line_is_painted_twice() {
    for network in towns().iter().chain([&TownPlan::square_km(3.2).build(0.03, Seed(1))]) {
        let mut lines_at: BTreeMap<[i64; 2], BTreeSet<u32>> = BTreeMap::new();
        for line in network.lines() {
            for point in &line.points {
                let cell = [point.x, point.y].map(|value| (value * 20.0).round().to_string().parse().unwrap());
                lines_at.entry(cell).or_default().insert(line.id.0);
            }
        }
        let mut shared: BTreeMap<(u32, u32), usize> = BTreeMap::new();
        for lines in lines_at.values().filter(|lines| lines.len() > 1) {
            let pair = (lines.first().copied().unwrap(), lines.last().copied().unwrap());
            *shared.entry(pair).or_default() += 1;
        }
        assert!(shared.values().all(|points| *points < 6), "{shared:?}");
    }
}

#[test]
fn every_road_has_a_line_on_each_of_its_sides() {
    for network in towns() {
        for link in network.links() {
            let middle = link.reference.len() / 2;
            let heading_rad = link.reference.headings_rad()[middle];
            let left = nalgebra::Vector2::new(-heading_rad.sin(), heading_rad.cos());
            let place = link.reference.points()[middle];
            let width_m = link.lane_width_m * f64::from(link.carriageway.forward_lanes());
            let reach_m = width_m + link.lane_width_m + 1.5;
            let sides: Vec<f64> = link
                .lines
                .iter()
                .flat_map(|line| &network.line(*line).points)
                .map(|point| point.xy() - place)
                .filter(|offset| offset.norm() < reach_m && offset.perp(&left).abs() < 1.1)
                .map(|offset| offset.dot(&left))
                .collect();
            let has = |from_m: f64, to_m: f64| sides.iter().any(|side_m| (from_m..to_m).contains(side_m));
            assert!(has(-reach_m, 0.1 - width_m), "no right edge at {place}: {:?} {sides:?}", link.kind);
            assert!(has(-0.7, reach_m), "no line on the left at {place}: {:?}", link.kind);
        }
    }
}
