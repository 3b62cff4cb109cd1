//! Where roads lead on: links between roads that touch, and junctions with a connecting road for every way over them.
//!
//! A connecting road has one lane, that of the way. Its reference line is the border on the side of lane 0: a cubic that leaves the
//! one road in its direction and enters the other in its own, at the heights of their reference lines. It has no paint.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::{self, Write},
};

use nalgebra::{Point3, Vector3};
use quick_xml::Writer;

use super::{
    DrawnRoad, Geometry, SHORTEST_ROAD_M, elevation,
    profile::Piece,
    written::{self, attribute, write_cubics},
};
use crate::export::{
    TrafficSide,
    junction::{Connection, Joints, LaneEnd, RoadEnd, turn},
    road::{Border, abreast},
};

/// Where every road and every lane leads on.
pub(super) struct Links {
    /// Numbers of roads in the file; none of what is too short to be one.
    ids: Vec<Option<usize>>,
    /// What is beyond the ends of roads.
    beyond: BTreeMap<RoadEnd, Beyond>,
    /// Lanes beyond the ends of lanes, where their roads touch.
    lanes: BTreeMap<(RoadEnd, usize), i64>,
    /// The junctions: each the ways over it, with the numbers of the roads and lanes that they join.
    junctions: Vec<Vec<Way>>,
    /// Number of the lane of every connecting road.
    connecting_lane: i64,
}

/// What a road leads to.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Beyond {
    /// The end of another road.
    Road(usize, RoadEnd),
    /// A junction.
    Junction(usize),
}

/// A way over a junction: a connecting road.
struct Way {
    id: usize,
    connection: Connection,
    from: (usize, i64),
    to: (usize, i64),
}

impl Links {
    pub(super) fn of(joints: &Joints, roads: &[DrawnRoad<'_>], traffic: TrafficSide) -> Self {
        let mut last = 0;
        let mut number = |road: &DrawnRoad<'_>| {
            let is_one = road.length_m() >= SHORTEST_ROAD_M;
            last += usize::from(is_one);
            is_one.then_some(last)
        };
        let ids: Vec<Option<usize>> = roads.iter().map(&mut number).collect();
        let connecting_lane = if traffic == TrafficSide::Right { -1 } else { 1 };
        let (beyond, lanes) = (BTreeMap::new(), BTreeMap::new());
        let mut links = Self { ids, beyond, lanes, junctions: Vec::new(), connecting_lane };
        for junction in &joints.junctions {
            let mut ways = Vec::new();
            for connection in &junction.connections {
                let (Some(from), Some(to)) = (links.named(roads, &connection.from), links.named(roads, &connection.to))
                else {
                    continue;
                };
                last += 1;
                ways.push(Way { id: last, connection: connection.clone(), from, to });
            }
            if !ways.is_empty() {
                for way in &ways {
                    for end in [way.connection.from.at, way.connection.to.at] {
                        links.beyond.insert(end, Beyond::Junction(links.junctions.len()));
                    }
                }
                links.junctions.push(ways);
            }
        }
        links.join_touching(&joints.touching, roads);
        links
    }

    /// Links roads that touch, where the end of each touches but one other, and no junction.
    fn join_touching(&mut self, touching: &[Connection], roads: &[DrawnRoad<'_>]) {
        let mut touched: BTreeMap<RoadEnd, BTreeSet<RoadEnd>> = BTreeMap::new();
        for connection in touching {
            touched.entry(connection.from.at).or_default().insert(connection.to.at);
            touched.entry(connection.to.at).or_default().insert(connection.from.at);
        }
        for connection in touching {
            let (from, to) = (&connection.from, &connection.to);
            let alone = [from, to].iter().all(|end| touched[&end.at].len() == 1)
                && [from, to].iter().all(|end| !matches!(self.beyond.get(&end.at), Some(Beyond::Junction(_))));
            let (Some((from_road, from_lane)), Some((to_road, to_lane))) =
                (self.named(roads, from), self.named(roads, to))
            else {
                continue;
            };
            if alone {
                self.beyond.insert(from.at, Beyond::Road(to_road, to.at));
                self.beyond.insert(to.at, Beyond::Road(from_road, from.at));
                self.lanes.insert((from.at, from.gap), to_lane);
                self.lanes.insert((to.at, to.gap), from_lane);
            }
        }
    }

    /// Numbers of the road and the lane of an end.
    fn named(&self, roads: &[DrawnRoad<'_>], end: &LaneEnd) -> Option<(usize, i64)> {
        Some((self.ids[end.at.road]?, roads[end.at.road].lane_at(end.at, end.gap)))
    }

    /// The number of a road in the file; none where it is too short to be one.
    pub(super) fn road_id(&self, road: usize) -> Option<usize> {
        self.ids[road]
    }

    /// The lane in which a lane goes on beyond the end of its road, where that touches another.
    pub(super) fn lane_beyond(&self, end: RoadEnd, gap: usize) -> Option<i64> {
        self.lanes.get(&(end, gap)).copied()
    }

    /// Writes what is beyond both ends of a road.
    pub(super) fn write<W: Write>(&self, writer: &mut Writer<W>, road: usize) -> io::Result<()> {
        let ends = [("predecessor", false), ("successor", true)];
        let found = ends.map(|(name, is_last)| (name, self.beyond.get(&RoadEnd { road, is_last })));
        if found.iter().all(|(_, beyond)| beyond.is_none()) {
            return Ok(());
        }
        let link = writer.create_element("link");
        link.write_inner_content(|writer| {
            for (name, beyond) in found {
                match beyond {
                    Some(Beyond::Road(id, end)) => write_road_link(writer, name, *id, *end)?,
                    Some(Beyond::Junction(junction)) => {
                        let id = junction_id(*junction);
                        let attributes = [("elementType", "junction"), ("elementId", id.as_str())];
                        writer.create_element(name).with_attributes(attributes).write_empty()?;
                    }
                    None => {}
                }
            }
            Ok(())
        })?;
        Ok(())
    }
}

fn junction_id(index: usize) -> String {
    (index + 1).to_string()
}

fn write_road_link<W: Write>(writer: &mut Writer<W>, name: &str, id: usize, end: RoadEnd) -> io::Result<()> {
    let (id, contact) = (id.to_string(), if end.is_last { "end" } else { "start" });
    let attributes = [("elementType", "road"), ("elementId", id.as_str()), ("contactPoint", contact)];
    writer.create_element(name).with_attributes(attributes).write_empty().map(drop)
}

/// Writes the ways over all junctions.
pub(super) fn write_connecting_roads<W: Write>(
    writer: &mut Writer<W>,
    links: &Links,
    roads: &[DrawnRoad<'_>],
) -> io::Result<()> {
    for (junction, ways) in links.junctions.iter().enumerate() {
        for way in ways {
            write_way(writer, junction, way, roads)?;
        }
    }
    Ok(())
}

/// Where a way leaves or enters a road: its border on the side of lane 0, straight across from the end of that road's reference
/// line and at its height; and the width of the lane, metres.
fn border(end: &LaneEnd, roads: &[DrawnRoad<'_>], keeps_right: bool) -> (Point3<f64>, f64) {
    let DrawnRoad { map, road, .. } = &roads[end.at.road];
    let reference = &map.lines[road.line];
    let sections = &road.sections;
    let (section, parameter) = if end.at.is_last {
        let last = &sections[sections.len() - 1];
        (last, last.to)
    } else {
        (&sections[0], sections[0].from)
    };
    let (origin, tangent) = (reference.point(parameter), reference.tangent(parameter));
    let left_m = |border: &Border| {
        let near = if end.at.is_last { border.to } else { border.from };
        if border.line == road.line { 0.0 } else { abreast(&map.lines[border.line], &origin, &tangent, near).1 }
    };
    let (left_m, right_m) = (left_m(&section.borders[end.gap]), left_m(&section.borders[end.gap + 1]));
    // Of the reference's left and right the one that the driver has on the side of lane 0.
    let is_along = end.leaves == end.at.is_last;
    let inner_m = if is_along == keeps_right { left_m } else { right_m };
    let place = origin + Vector3::new(-tangent.y, tangent.x, 0.0) * inner_m;
    (place, left_m - right_m)
}

fn write_way<W: Write>(writer: &mut Writer<W>, junction: usize, way: &Way, roads: &[DrawnRoad<'_>]) -> io::Result<()> {
    let Connection { from, to } = &way.connection;
    let keeps_right = roads[from.at.road].traffic == TrafficSide::Right;
    let ((start, from_width_m), (end, to_width_m)) = (border(from, roads, keeps_right), border(to, roads, keeps_right));
    let cubic = turn(start, &from.heading, end, &to.heading);
    let length_m = cubic.length_m();
    let geometry = Geometry { from: 0.0, to: 1.0, s_m: 0.0, length_m, cubic };
    let width = Piece { s_m: 0.0, coefficients: widening(from_width_m, to_width_m, length_m) };
    let (id, length, junction) = (way.id.to_string(), attribute(length_m), junction_id(junction));
    let attributes = [
        ("name", ""),
        ("length", length.as_str()),
        ("id", id.as_str()),
        ("junction", junction.as_str()),
        ("rule", if keeps_right { "RHT" } else { "LHT" }),
    ];
    writer.create_element("road").with_attributes(attributes).write_inner_content(|writer| {
        writer.create_element("link").write_inner_content(|writer| {
            write_road_link(writer, "predecessor", way.from.0, from.at)?;
            write_road_link(writer, "successor", way.to.0, to.at)
        })?;
        writer.create_element("planView").write_inner_content(|writer| written::geometry(writer, &geometry))?;
        writer
            .create_element("elevationProfile")
            .write_inner_content(|writer| write_cubics(writer, "elevation", "s", &[elevation(&geometry)], 0.0))?;
        writer.create_element("lanes").write_inner_content(|writer| {
            let section = writer.create_element("laneSection").with_attribute(("s", "0"));
            section.write_inner_content(|writer| {
                if !keeps_right {
                    writer.create_element("left").write_inner_content(|writer| write_lane(writer, way, 1, &width))?;
                }
                writer.create_element("center").write_inner_content(|writer| {
                    let middle = [("id", "0"), ("type", "none"), ("level", "false")];
                    writer.create_element("lane").with_attributes(middle).write_empty().map(drop)
                })?;
                if keeps_right {
                    writer.create_element("right").write_inner_content(|writer| write_lane(writer, way, -1, &width))?;
                }
                Ok(())
            })?;
            Ok(())
        })?;
        Ok(())
    })?;
    Ok(())
}

/// The cubic that goes from one width to another and is level at both ends.
fn widening(from_m: f64, to_m: f64, length_m: f64) -> [f64; 4] {
    let more_m = to_m - from_m;
    [from_m, 0.0, 3.0 * more_m / length_m.powi(2), -2.0 * more_m / length_m.powi(3)]
}

fn write_lane<W: Write>(writer: &mut Writer<W>, way: &Way, id: i64, width: &Piece) -> io::Result<()> {
    let id = id.to_string();
    let attributes = [("id", id.as_str()), ("type", "driving"), ("level", "false")];
    writer.create_element("lane").with_attributes(attributes).write_inner_content(|writer| {
        writer.create_element("link").write_inner_content(|writer| {
            for (name, (_, lane)) in [("predecessor", way.from), ("successor", way.to)] {
                writer.create_element(name).with_attribute(("id", lane.to_string().as_str())).write_empty()?;
            }
            Ok(())
        })?;
        write_cubics(writer, "width", "sOffset", std::slice::from_ref(width), 0.0)
    })?;
    Ok(())
}

/// Writes which ways lead over which junction.
pub(super) fn write_junctions<W: Write>(writer: &mut Writer<W>, links: &Links) -> io::Result<()> {
    for (index, ways) in links.junctions.iter().enumerate() {
        let id = junction_id(index);
        let element = writer.create_element("junction").with_attributes([("id", id.as_str()), ("name", "")]);
        element.write_inner_content(|writer| {
            for (number, way) in ways.iter().enumerate() {
                let (number, road, connecting) = (number.to_string(), way.from.0.to_string(), way.id.to_string());
                let attributes = [
                    ("id", number.as_str()),
                    ("incomingRoad", road.as_str()),
                    ("connectingRoad", connecting.as_str()),
                    ("contactPoint", "start"),
                ];
                writer.create_element("connection").with_attributes(attributes).write_inner_content(|writer| {
                    let (from, to) = (way.from.1.to_string(), links.connecting_lane.to_string());
                    let lanes = [("from", from.as_str()), ("to", to.as_str())];
                    writer.create_element("laneLink").with_attributes(lanes).write_empty().map(drop)
                })?;
            }
            Ok(())
        })?;
    }
    Ok(())
}
