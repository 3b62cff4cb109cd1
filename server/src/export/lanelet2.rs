//! Lanelet2: the lanes between the lines as lanelets, in OSM XML.
//!
//! Format: Poggenhans et al., *Lanelet2: A High-Definition Map Framework* (2018), and its `LinestringTagging.md` and
//! `LaneletAndAreaTagging.md`. A [road](super::road) gives the lanelets: each section's lanes lie between its borders, so neighbours have
//! a line string in common, and a lanelet follows another where its bounds begin at the nodes at which the other's end. Where
//! a line begins or ends beside another (a lane opens or closes), the line string of the one is led to the node of the other. Over a
//! [junction](super::junction) lanelets lead between virtual line strings.
//!
//! Nodes have latitude and longitude, and the tags `local_x`, `local_y` and `ele`: metres in the plane whose PROJ string stands in
//! the file's first comment, and metres above the ellipsoid. Ids are hashes of the names that the lines have in the shared map, so
//! that they stay the same for as long as those do; hashes that collide give way in the order of the file.
//!
//! `location` is `urban`, the careful choice: a map of lines does not say. Speed limits are left to who knows them.

mod crossing;
mod ids;

use std::{
    collections::BTreeMap,
    io::{self, Write},
    ops::Range,
};

use lanemap_core::Category;
use nalgebra::Point3;
use quick_xml::{
    Writer,
    events::{BytesDecl, BytesText, Event},
};

use self::{
    crossing::{Crossing, cross},
    ids::Ids,
};
use super::{
    ExportError, LaneOptions, Summary,
    junction::joints,
    map_line::{MapLine, MapLines},
    road::{Border, GapKind, Road, Section, Travel, roads},
};

/// Longest way from the end of one line to the beginning of another that makes one bound of both, metres.
const LONGEST_BRIDGE_M: f64 = 1.2;

/// A node: a line, and the parameter on it in thousandths.
type NodeKey = (usize, i64);

/// A line string: the section's road, its number, and the border.
type WayKey = (usize, usize, usize);

/// What goes into the file.
#[derive(Default)]
struct Drawing {
    /// Nodes, with the exact parameter.
    nodes: BTreeMap<NodeKey, f64>,
    ways: BTreeMap<WayKey, Vec<NodeKey>>,
    lanelets: Vec<Lanelet>,
    crossings: Vec<Crossing>,
    /// Nodes in whose place others are.
    merged: BTreeMap<NodeKey, NodeKey>,
}

struct Lanelet {
    left: WayKey,
    right: WayKey,
}

/// Writes a map.
///
/// # Errors
/// The output cannot be written.
pub fn write(map: &MapLines, options: LaneOptions, out: &mut dyn Write) -> Result<Summary, ExportError> {
    let roads = roads(map, options);
    let mut drawing = draw(map, &roads);
    cross(map, &roads, &joints(map, &roads), &mut drawing);
    drawing.forget_points();
    let mut file = File {
        map,
        roads: &roads,
        drawing: &drawing,
        ids: Ids::default(),
        writer: Writer::new_with_indent(out, b' ', 1),
    };
    file.write()?;
    Ok(Summary { lines: map.pieces, lanes: (drawing.lanelets.len() + drawing.crossings.len()) as u64, tiles: 0 })
}

/// Line strings of every border, and the lanelets between them.
fn draw(map: &MapLines, roads: &[Road]) -> Drawing {
    let mut drawing = Drawing::default();
    for (road_index, road) in roads.iter().enumerate() {
        let stretches = stretches(map, road);
        for ((section, border), ends) in &stretches.ends {
            let first = &road.sections[*section].borders[*border];
            let line = &map.lines[first.line];
            let parameters = line.drawn(first.from, *ends);
            let keys = parameters.iter().map(|parameter| drawing.node(line, first.line, *parameter)).collect();
            drawing.ways.insert((road_index, *section, *border), keys);
        }
        for index in 1..road.sections.len() {
            bridge(map, &mut drawing, &stretches, road_index, road, index - 1);
        }
        for (section_index, section) in road.sections.iter().enumerate() {
            for (gap_index, gap) in section.gaps.iter().enumerate().filter(|(_, gap)| gap.kind == GapKind::Lane) {
                let way = |border| (road_index, section_index, border);
                let (left, right) = (way(gap_index), way(gap_index + 1));
                // A lane that goes on uncut was drawn where it began.
                if stretches.first_of(section_index, gap_index) != (section_index, gap_index) {
                    continue;
                }
                drawing.lanelets.push(match gap.travel {
                    Travel::Along => Lanelet { left, right },
                    Travel::Against => Lanelet { left: right, right: left },
                });
            }
        }
    }
    // In the direction of their lines, and only those that are lines.
    for ((road, section, border), keys) in &mut drawing.ways {
        keys.dedup();
        if !roads[*road].sections[*section].borders[*border].along {
            keys.reverse();
        }
    }
    drawing.forget_points();
    drawing
}

/// Borders of a road over the sections through which they run uncut.
struct Stretches {
    /// The first section and border of each, and the line's parameter at which it ends.
    ends: BTreeMap<(usize, usize), f64>,
    /// Of every border that goes on uncut from the section before: the first section and border of its stretch.
    begun: BTreeMap<(usize, usize), (usize, usize)>,
}

impl Stretches {
    /// The first section and border of the stretch that a border belongs to.
    fn first_of(&self, section: usize, border: usize) -> (usize, usize) {
        self.begun.get(&(section, border)).copied().unwrap_or((section, border))
    }
}

/// Finds out which borders go on uncut: lanes side by side are cut together, and only where one of them changes.
fn stretches(map: &MapLines, road: &Road) -> Stretches {
    let mut stretches = Stretches { ends: BTreeMap::new(), begun: BTreeMap::new() };
    for (index, section) in road.sections.iter().enumerate() {
        let before = index.checked_sub(1).map(|before| &road.sections[before]);
        for (border_index, border) in section.borders.iter().enumerate() {
            let goes_on = before.and_then(|before| uncut(map, before, section, border_index));
            let first = match goes_on {
                Some(from) => stretches.first_of(index - 1, from),
                None => (index, border_index),
            };
            if first != (index, border_index) {
                stretches.begun.insert((index, border_index), first);
            }
            stretches.ends.insert(first, border.to);
        }
    }
    stretches
}

/// The border of the section before that goes on uncut in one of this section.
fn uncut(map: &MapLines, before: &Section, here: &Section, border: usize) -> Option<usize> {
    let own = &here.borders[border];
    let found = before.borders.iter().position(|other| other.line == own.line && other.along == own.along)?;
    let category = |section: &Section, border: usize| {
        let border = &section.borders[border];
        map.lines[border.line].piece_at(0.5 * (border.from + border.to)).category
    };
    let (group_before, group_here) = (lanes_around(before, found), lanes_around(here, border));
    let as_many = group_before.len() == group_here.len() && found - group_before.start == border - group_here.start;
    let same_lanes = as_many
        && group_before.clone().zip(group_here.clone()).all(|(other, own)| {
            before.gaps[other].goes_on_in == Some(own) && before.gaps[other].travel == here.gaps[own].travel
        });
    let borders = |group: &Range<usize>, single: usize| {
        if group.is_empty() { single..single + 1 } else { group.start..group.end + 1 }
    };
    let same_borders = borders(&group_before, found).zip(borders(&group_here, border)).all(|(other, own)| {
        before.borders[other].line == here.borders[own].line && category(before, other) == category(here, own)
    });
    (same_lanes && same_borders).then_some(found)
}

/// The gaps of the lanes side by side to which a border belongs; empty, at the border, where there is none beside it.
fn lanes_around(section: &Section, border: usize) -> Range<usize> {
    let is_lane = |gap: usize| section.gaps.get(gap).is_some_and(|gap| gap.kind == GapKind::Lane);
    let (mut start, mut end) = (border, border);
    while start > 0 && is_lane(start - 1) {
        start -= 1;
    }
    while is_lane(end) {
        end += 1;
    }
    start..end
}

impl Drawing {
    #[expect(clippy::cast_possible_truncation, reason = "a line has far fewer than 2^53 segments")]
    fn node(&mut self, line: &MapLine, index: usize, parameter: f64) -> NodeKey {
        // A ring's last node is its first.
        let parameter = if line.closed && parameter >= line.end() - 1e-9 { 0.0 } else { parameter };
        let key = (index, (parameter * 1e3).round() as i64);
        if let Some(other) = self.merged.get(&key) {
            return *other;
        }
        self.nodes.entry(key).or_insert(parameter);
        key
    }

    /// Makes one node of two.
    fn merge(&mut self, kept: NodeKey, gone: NodeKey) {
        if kept == gone {
            return;
        }
        for keys in self.ways.values_mut() {
            keys.iter_mut().filter(|key| **key == gone).for_each(|key| *key = kept);
            keys.dedup();
        }
        self.merged.values_mut().filter(|key| **key == gone).for_each(|key| *key = kept);
        self.merged.insert(gone, kept);
        self.nodes.remove(&gone);
    }

    /// Leaves out line strings that are none, and the lanelets that they would bound.
    fn forget_points(&mut self) {
        self.ways.retain(|_, keys| keys.len() > 1);
        let ways = &self.ways;
        self.lanelets.retain(|lanelet| ways.contains_key(&lanelet.left) && ways.contains_key(&lanelet.right));
    }
}

/// Joins the bounds of lanes that go on in the next section where these are other lines.
fn bridge(map: &MapLines, drawing: &mut Drawing, stretches: &Stretches, road_index: usize, road: &Road, index: usize) {
    let (here, next) = (&road.sections[index], &road.sections[index + 1]);
    let has = |section: &Section, line: usize| section.borders.iter().any(|border| border.line == line);
    for (gap, lane) in here.gaps.iter().enumerate() {
        let Some(other) = lane.goes_on_in else { continue };
        for side in 0..2 {
            let (ending, beginning) = (gap + side, other + side);
            let (before, after) = (&here.borders[ending], &next.borders[beginning]);
            if before.line == after.line || !are_near(map, before, after) {
                continue;
            }
            let way = |(section, border)| (road_index, section, border);
            let way_before = way(stretches.first_of(index, ending));
            let way_after = way(stretches.first_of(index + 1, beginning));
            let (Some(last), Some(first)) = (
                drawing.ways.get(&way_before).and_then(|keys| keys.last().copied()),
                drawing.ways.get(&way_after).and_then(|keys| keys.first().copied()),
            ) else {
                continue;
            };
            if !has(here, after.line) {
                if let Some(keys) = drawing.ways.get_mut(&way_after) {
                    keys.insert(0, last);
                }
            } else if !has(next, before.line)
                && let Some(keys) = drawing.ways.get_mut(&way_before)
            {
                keys.push(first);
            }
        }
    }
}

fn are_near(map: &MapLines, before: &Border, after: &Border) -> bool {
    let (end, start) = (map.lines[before.line].point(before.to), map.lines[after.line].point(after.from));
    nalgebra::distance(&end, &start) <= LONGEST_BRIDGE_M
}

/// The file while it is written.
struct File<'a> {
    map: &'a MapLines,
    roads: &'a [Road],
    drawing: &'a Drawing,
    ids: Ids,
    writer: Writer<&'a mut dyn Write>,
}

impl File<'_> {
    fn write(&mut self) -> io::Result<()> {
        self.writer.write_event(Event::Decl(BytesDecl::new("1.0", Some("UTF-8"), None)))?;
        let plane = format!(" local_x, local_y: {} ", self.map.plane.proj_string());
        self.writer.write_event(Event::Comment(BytesText::from_escaped(plane)))?;
        let (map, roads, drawing, ids) = (self.map, self.roads, self.drawing, &mut self.ids);
        let root = self.writer.create_element("osm").with_attributes([("version", "0.6"), ("generator", "lanemap")]);
        root.write_inner_content(|writer| {
            let mut node_ids = BTreeMap::new();
            for (key, parameter) in &drawing.nodes {
                let line = &map.lines[key.0];
                let id = ids.next(&format!("n {}", place_name(line, *parameter)));
                write_node(writer, id, map, line, *parameter)?;
                node_ids.insert(*key, id);
            }
            let mut between_ids = Vec::new();
            for line in drawing.crossings.iter().flat_map(Crossing::lines) {
                let name = |index| format!("c {} {} {index}", node_ids[&line.first], node_ids[&line.last]);
                let named: Vec<u64> = (0..line.between.len()).map(|index| ids.next(&name(index))).collect();
                for (id, point) in named.iter().zip(&line.between) {
                    write_point(writer, *id, map, point)?;
                }
                between_ids.push(named);
            }
            let mut way_ids = BTreeMap::new();
            for (key, nodes) in &drawing.ways {
                let border = &roads[key.0].sections[key.1].borders[key.2];
                let line = &map.lines[border.line];
                let name = |node: Option<&NodeKey>| {
                    let parameter = node.and_then(|node| drawing.nodes.get(node).map(|at| (&map.lines[node.0], *at)));
                    parameter.map_or_else(String::new, |(line, parameter)| place_name(line, parameter))
                };
                let id = ids.next(&format!("w {} {}", name(nodes.first()), name(nodes.last())));
                way_ids.insert(*key, id);
                let nodes = nodes.iter().filter_map(|node| node_ids.get(node).copied());
                let marking = marking(line.piece_at(0.5 * (border.from + border.to)).category);
                write_way(writer, id, nodes, &marking)?;
            }
            let mut crossed = Vec::new();
            for (line, between) in drawing.crossings.iter().flat_map(Crossing::lines).zip(between_ids) {
                let (first, last) = (node_ids[&line.first], node_ids[&line.last]);
                let id = ids.next(&format!("v {first} {last}"));
                let nodes = [first].into_iter().chain(between).chain([last]);
                write_way(writer, id, nodes, &Marking { kind: "virtual", subtype: None, color: None })?;
                crossed.push(id);
            }
            for lanelet in &drawing.lanelets {
                if let (Some(left), Some(right)) = (way_ids.get(&lanelet.left), way_ids.get(&lanelet.right)) {
                    let id = ids.next(&format!("l {left} {right}"));
                    write_lanelet(writer, id, *left, *right)?;
                }
            }
            for sides in crossed.chunks_exact(2) {
                let id = ids.next(&format!("l {} {}", sides[0], sides[1]));
                write_lanelet(writer, id, sides[0], sides[1])?;
            }
            Ok(())
        })?;
        self.writer.get_mut().write_all(b"\n")
    }
}

/// Names a place on a line by what the shared map calls it.
fn place_name(line: &MapLine, parameter: f64) -> String {
    let piece = line.piece_at(parameter);
    let within = parameter - piece.first_segment as f64;
    let within = if piece.reversed { piece.segments as f64 - within } else { within };
    format!("{} {} {} {within:.3}", piece.name.cell, piece.name.id, piece.name.part)
}

fn write_tag<W: Write>(writer: &mut Writer<W>, key: &str, value: &str) -> io::Result<()> {
    writer.create_element("tag").with_attributes([("k", key), ("v", value)]).write_empty().map(drop)
}

fn write_node<W: Write>(
    writer: &mut Writer<W>,
    id: u64,
    map: &MapLines,
    line: &MapLine,
    parameter: f64,
) -> io::Result<()> {
    write_point(writer, id, map, &line.point(parameter))
}

fn write_point<W: Write>(writer: &mut Writer<W>, id: u64, map: &MapLines, point: &Point3<f64>) -> io::Result<()> {
    let place = map.plane.unproject(point);
    let (id, latitude, longitude) =
        (id.to_string(), format!("{:.10}", place.latitude_deg), format!("{:.10}", place.longitude_deg));
    let attributes = [
        ("id", id.as_str()),
        ("visible", "true"),
        ("version", "1"),
        ("lat", latitude.as_str()),
        ("lon", longitude.as_str()),
    ];
    let element = writer.create_element("node").with_attributes(attributes);
    let tags = |writer: &mut Writer<W>| {
        write_tag(writer, "ele", &format!("{:.4}", point.z))?;
        write_tag(writer, "local_x", &format!("{:.4}", point.x))?;
        write_tag(writer, "local_y", &format!("{:.4}", point.y))
    };
    element.write_inner_content(tags).map(drop)
}

fn write_way<W: Write>(
    writer: &mut Writer<W>,
    id: u64,
    nodes: impl Iterator<Item = u64>,
    marking: &Marking,
) -> io::Result<()> {
    let id = id.to_string();
    let attributes = [("id", id.as_str()), ("visible", "true"), ("version", "1")];
    let element = writer.create_element("way").with_attributes(attributes);
    let content = |writer: &mut Writer<W>| {
        for node in nodes {
            writer.create_element("nd").with_attribute(("ref", node.to_string().as_str())).write_empty()?;
        }
        write_tag(writer, "type", marking.kind)?;
        if let Some(subtype) = marking.subtype {
            write_tag(writer, "subtype", subtype)?;
        }
        marking.color.map_or(Ok(()), |color| write_tag(writer, "color", color))
    };
    element.write_inner_content(content).map(drop)
}

fn write_lanelet<W: Write>(writer: &mut Writer<W>, id: u64, left: u64, right: u64) -> io::Result<()> {
    let id = id.to_string();
    let attributes = [("id", id.as_str()), ("visible", "true"), ("version", "1")];
    let element = writer.create_element("relation").with_attributes(attributes);
    let content = |writer: &mut Writer<W>| {
        for (role, way) in [("left", left), ("right", right)] {
            let way = way.to_string();
            let member = [("type", "way"), ("ref", way.as_str()), ("role", role)];
            writer.create_element("member").with_attributes(member).write_empty()?;
        }
        for (key, value) in [("type", "lanelet"), ("subtype", "road"), ("location", "urban"), ("one_way", "yes")] {
            write_tag(writer, key, value)?;
        }
        Ok(())
    };
    element.write_inner_content(content).map(drop)
}

/// Tags of a line string.
struct Marking {
    kind: &'static str,
    subtype: Option<&'static str>,
    color: Option<&'static str>,
}

/// A category as Lanelet2 tags it. A double dashed line has no subtype of its own there: it reads as `dashed`.
fn marking(category: Category) -> Marking {
    let line = |subtype, color| Marking { kind: "line_thin", subtype: Some(subtype), color: Some(color) };
    match category {
        Category::Unknown => Marking { kind: "line_thin", subtype: None, color: None },
        Category::WhiteDashed | Category::DoubleWhiteDashed => line("dashed", "white"),
        Category::WhiteSolid => line("solid", "white"),
        Category::DoubleWhiteSolid => line("solid_solid", "white"),
        Category::WhiteLeftDashedRightSolid => line("dashed_solid", "white"),
        Category::WhiteLeftSolidRightDashed => line("solid_dashed", "white"),
        Category::YellowDashed | Category::DoubleYellowDashed => line("dashed", "yellow"),
        Category::YellowSolid => line("solid", "yellow"),
        Category::DoubleYellowSolid => line("solid_solid", "yellow"),
        Category::YellowLeftDashedRightSolid => line("dashed_solid", "yellow"),
        Category::YellowLeftSolidRightDashed => line("solid_dashed", "yellow"),
        Category::LeftCurb | Category::RightCurb => Marking { kind: "curbstone", subtype: Some("high"), color: None },
    }
}
