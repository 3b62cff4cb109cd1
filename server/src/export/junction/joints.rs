//! Which lanes lead where in a whole map, and what makes one junction.

use std::collections::{BTreeMap, HashMap};

use super::{Connection, FARTHEST_M, LaneEnd, RoadEnd, driven, lane_ends, without_detours};
use crate::export::{map_line::MapLines, road::Road};

/// How the roads of a map are joined.
#[derive(Clone, Debug, Default)]
pub struct Joints {
    /// Lanes that meet end to end.
    pub touching: Vec<Connection>,
    /// The junctions, in the order of their first roads.
    pub junctions: Vec<Junction>,
}

/// Roads that lanes lead between.
#[derive(Clone, Debug)]
pub struct Junction {
    /// The ways over it, never none; in the order of the roads that they come from.
    pub connections: Vec<Connection>,
}

/// Finds where the lanes of a map lead on.
#[must_use]
pub fn joints(map: &MapLines, roads: &[Road]) -> Joints {
    let (leaving, entering): (Vec<LaneEnd>, Vec<LaneEnd>) =
        lane_ends(map, roads).into_iter().partition(|end| end.leaves);
    let mut squares: HashMap<[i64; 2], Vec<usize>> = HashMap::new();
    for (index, end) in entering.iter().enumerate() {
        squares.entry(square(end)).or_default().push(index);
    }
    let mut touching: Vec<Connection> = Vec::new();
    let mut pairs: BTreeMap<(RoadEnd, RoadEnd), Vec<Connection>> = BTreeMap::new();
    for from in &leaving {
        let [x, y] = square(from);
        let around = (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| [x, y]));
        let near = around.filter_map(|square| squares.get(&square)).flatten().map(|index| &entering[*index]);
        let near: Vec<Connection> =
            near.filter(|to| to.at != from.at).map(|to| Connection { from: from.clone(), to: to.clone() }).collect();
        if let Some(next) = near.iter().find(|connection| connection.touches()) {
            touching.push(next.clone());
            continue;
        }
        for connection in near.into_iter().filter(Connection::is_drivable) {
            pairs.entry((from.at, connection.to.at)).or_default().push(connection);
        }
    }
    let is_reached = |end: &LaneEnd| touching.iter().any(|other| other.to.at == end.at && other.to.gap == end.gap);
    for found in pairs.values_mut() {
        found.retain(|connection| !is_reached(&connection.to));
    }
    let found = pairs.into_values().filter(|found| !found.is_empty()).flat_map(driven).collect();
    Joints { touching, junctions: grouped(without_detours(found)) }
}

#[expect(clippy::cast_possible_truncation, reason = "coordinates of a map are far below 2^63 metres")]
fn square(end: &LaneEnd) -> [i64; 2] {
    [end.left.x, end.left.y].map(|metres| (metres / (FARTHEST_M + 10.0)).floor() as i64)
}

/// The end that stands for all that are joined with it.
fn root(first: &BTreeMap<RoadEnd, RoadEnd>, mut end: RoadEnd) -> RoadEnd {
    while let Some(next) = first.get(&end).filter(|next| **next != end) {
        end = *next;
    }
    end
}

/// Connections that share an end of a road, directly or through others, are of one junction.
fn grouped(connections: Vec<Connection>) -> Vec<Junction> {
    let mut first: BTreeMap<RoadEnd, RoadEnd> = BTreeMap::new();
    for connection in &connections {
        let (one, other) = (root(&first, connection.from.at), root(&first, connection.to.at));
        first.insert(one.max(other), one.min(other));
    }
    let mut groups: BTreeMap<RoadEnd, Vec<Connection>> = BTreeMap::new();
    for connection in connections {
        groups.entry(root(&first, connection.from.at)).or_default().push(connection);
    }
    let in_order = |mut connections: Vec<Connection>| {
        connections
            .sort_by_key(|connection| (connection.from.at, connection.from.gap, connection.to.at, connection.to.gap));
        Junction { connections }
    };
    groups.into_values().map(in_order).collect()
}

#[cfg(test)]
mod tests {
    use lanemap_core::Category;
    use nalgebra::{Point3, Vector2};

    use super::*;
    use crate::export::{
        LaneOptions,
        junction::turn,
        map_line::{MapLine, tests::line_through},
        plane::Plane,
        road::roads,
    };

    /// Lines of a two-way street from a distance to the middle of a crossing outwards, in a direction.
    fn arm(name: &str, toward: Vector2<f64>, from_m: f64) -> Vec<MapLine> {
        let left = Vector2::new(-toward.y, toward.x);
        let lines =
            [("a", 3.5, Category::WhiteSolid), ("b", 0.0, Category::YellowDashed), ("c", -3.5, Category::WhiteSolid)];
        let line = |(line, aside_m, category): (&str, f64, Category)| {
            let points: Vec<_> = (0..30)
                .map(|index| toward * (from_m + 3.0 * f64::from(index)) + left * aside_m)
                .map(|at| Point3::new(at.x, at.y, 0.0))
                .collect();
            line_through(&format!("{name} {line}"), category, &points)
        };
        lines.map(line).into()
    }

    fn joined(lines: Vec<MapLine>) -> (Vec<Road>, Joints) {
        let map = MapLines { plane: Plane::at(48.0, 11.0), pieces: lines.len() as u64, lines };
        let roads = roads(&map, LaneOptions::default());
        let joints = joints(&map, &roads);
        (roads, joints)
    }

    const EAST: Vector2<f64> = Vector2::new(1.0, 0.0);
    const NORTH: Vector2<f64> = Vector2::new(0.0, 1.0);

    #[test]
    fn a_crossing_leads_from_each_street_into_the_three_others() {
        let arms = [("n", NORTH), ("e", EAST), ("s", -NORTH), ("w", -EAST)];
        let (roads, joints) = joined(arms.into_iter().flat_map(|(name, toward)| arm(name, toward, 17.0)).collect());
        assert_eq!((roads.len(), joints.junctions.len(), joints.touching.len()), (4, 1, 0));
        let connections = &joints.junctions[0].connections;
        assert_eq!(connections.len(), 12);
        for road in 0..4 {
            let from = connections.iter().filter(|connection| connection.from.at.road == road);
            let to: std::collections::BTreeSet<usize> = from.map(|connection| connection.to.at.road).collect();
            assert_eq!(to.len(), 3);
            assert!(!to.contains(&road), "no way leads back");
        }
    }

    #[test]
    fn streets_that_a_gap_parts_are_joined_and_those_beside_it_are_not() {
        let far = |aside_m: f64| {
            let mut lines = arm("b", EAST, 30.0);
            for line in &mut lines {
                line.segments.iter_mut().for_each(|cubic| cubic.0[0].y += aside_m);
            }
            joined([arm("a", -EAST, 0.0), lines].concat()).1
        };
        let joints = far(0.0);
        assert_eq!(joints.junctions.len(), 1);
        // One way there, and one back.
        assert_eq!(joints.junctions[0].connections.len(), 2);
        assert!(far(20.0).junctions.is_empty());
    }

    #[test]
    fn a_way_past_the_end_of_a_nearer_lane_is_left_to_that_lane() {
        // A stub of a street lies between both others.
        let stub: Vec<MapLine> = arm("c", EAST, 10.0)
            .into_iter()
            .map(|mut line| {
                line.segments.truncate(5);
                line.pieces[0].segments = 5;
                line
            })
            .collect();
        let (_, joints) = joined([arm("a", -EAST, 0.0), stub, arm("b", EAST, 35.0)].concat());
        let ways: usize = joints.junctions.iter().map(|junction| junction.connections.len()).sum();
        assert_eq!((joints.junctions.len(), ways), (2, 4), "two gaps, each with a way in both directions");
    }

    #[test]
    fn a_turn_of_a_right_angle_is_nearly_an_arc() {
        let way = turn(Point3::new(20.0, 0.0, 0.0), &NORTH, Point3::new(0.0, 20.0, 1.0), &-EAST);
        for step in 0..=10 {
            let at = way.point(f64::from(step) / 10.0);
            assert!((at.xy().coords.norm() - 20.0).abs() < 0.01, "{at}");
            assert!((at.z - 0.1 * f64::from(step)).abs() < 0.02);
        }
    }
}
