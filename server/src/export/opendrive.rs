//! OpenDRIVE: the roads between the lines, with the splines themselves for reference lines.
//!
//! Format: ASAM OpenDRIVE 1.7. A [road](super::road)'s reference line is a line of the map, and each of its Catmull-Rom segments, a
//! cubic, is a `paramPoly3` in the segment's own frame: the same curve, not a fit. The elevation profile is the segment's own
//! height polynomial. The other lines are the borders of lanes: their distance from the reference line is followed by cubics
//! to within [`WIDTH_ERROR_M`] in plan, and their paint is the `roadMark` on the outer side of a lane. `laneOffset` puts lane 0 on the
//! line that separates the ways of travel, so that lanes are driven as the rule of the road has it. Over a [junction](super::junction),
//! where no line is, a connecting road of one lane leads from each lane to each that it leads on in; lanes that
//! touch are linked.
//!
//! `geoReference` is the PROJ string of the map's plane; heights are above the ellipsoid. Not in it: the slope across a road
//! (borders have the height of the reference line), signs, priorities and speed limits, which a map of lines does not have.

mod connecting;
mod profile;
mod written;

use std::io::{self, Write};

use lanemap_core::Category;
use quick_xml::Writer;

use self::{
    connecting::{Links, write_connecting_roads, write_junctions},
    profile::{Piece, fitted},
    written::{attribute, write_cubics, write_header},
};
use super::{
    ExportError, LaneOptions, Summary, TrafficSide,
    junction::{RoadEnd, joints},
    map_line::{Cubic, MapLines, mirrored},
    road::{Border, GapKind, NARROWEST_LANE_M, Road, Section, Travel, abreast, roads},
};

/// Farthest that a border of a lane leaves its line in plan, metres.
pub const WIDTH_ERROR_M: f64 = 0.003;
/// Shortest road, metres: what is shorter is below what the format is exact to.
const SHORTEST_ROAD_M: f64 = 0.005;

/// Writes a map.
///
/// # Errors
/// The output cannot be written.
pub fn write(map: &MapLines, options: LaneOptions, out: &mut dyn Write) -> Result<Summary, ExportError> {
    let roads = roads(map, options);
    let mut writer = Writer::new_with_indent(&mut *out, b' ', 1);
    let mut summary = Summary { lines: map.pieces, ..Summary::default() };
    written::document(&mut writer, |writer| {
        write_header(writer, map)?;
        let drawn: Vec<DrawnRoad> = roads.iter().map(|road| DrawnRoad::of(map, road, options)).collect();
        let links = Links::of(&joints(map, &roads), &drawn, options.traffic);
        for (index, road) in drawn.iter().enumerate() {
            let Some(id) = links.road_id(index) else { continue };
            road.write(writer, id, &links, index)?;
            summary.lanes += road.road.sections.iter().map(|section| section.lanes() as u64).sum::<u64>();
        }
        write_connecting_roads(writer, &links, &drawn)?;
        write_junctions(writer, &links)
    })?;
    out.write_all(b"\n")?;
    Ok(summary)
}

/// A piece of a reference line: one geometry.
#[derive(Clone, Copy, Debug)]
struct Geometry {
    /// Parameter of the line at which it begins, and at which it ends.
    from: f64,
    to: f64,
    /// Way from the road's start, metres.
    s_m: f64,
    length_m: f64,
    cubic: Cubic,
}

/// A road with its way measured.
struct DrawnRoad<'a> {
    map: &'a MapLines,
    road: &'a Road,
    geometries: Vec<Geometry>,
    /// Of each section the border on which lane 0 lies.
    separators: Vec<usize>,
    traffic: TrafficSide,
}

impl<'a> DrawnRoad<'a> {
    fn of(map: &'a MapLines, road: &'a Road, options: LaneOptions) -> Self {
        let line = &map.lines[road.line];
        let ends = road.sections.first().zip(road.sections.last());
        let (from, to) = ends.map_or((0.0, 0.0), |(first, last)| (first.from, last.to));
        let cubics = line.cubics(from, to);
        let mut geometries: Vec<Geometry> = Vec::with_capacity(cubics.len());
        let mut s_m = 0.0;
        for (index, (start, cubic)) in cubics.iter().enumerate() {
            let length_m = cubic.length_m();
            let end = cubics.get(index + 1).map_or(to, |(next, _)| *next);
            geometries.push(Geometry { from: *start, to: end, s_m, length_m, cubic: *cubic });
            s_m += length_m;
        }
        let mut drawn = Self { map, road, geometries, separators: Vec::new(), traffic: options.traffic };
        for section in &road.sections {
            let before = drawn.separators.last().zip(drawn.separators.len().checked_sub(1));
            let before = before.map(|(border, index)| road.sections[index].borders[*border].line);
            let separator = drawn.separator(section, before);
            drawn.separators.push(separator);
        }
        drawn
    }

    /// Number of the lane in a gap, at an end of the road.
    fn lane_at(&self, end: RoadEnd, gap: usize) -> i64 {
        let index = if end.is_last { self.separators.len() - 1 } else { 0 };
        lane_id(gap, self.separators[index])
    }

    fn length_m(&self) -> f64 {
        self.geometries.last().map_or(0.0, |last| last.s_m + last.length_m)
    }

    /// The way at which a parameter of the reference lies. OpenDRIVE spreads `s` evenly over a curve's parameter, so it is
    /// linear within a geometry.
    fn s_of(&self, parameter: f64) -> f64 {
        let next = self.geometries.partition_point(|geometry| geometry.from <= parameter);
        let Some(geometry) = self.geometries.get(next.saturating_sub(1)) else { return 0.0 };
        let share = ((parameter - geometry.from) / (geometry.to - geometry.from)).clamp(0.0, 1.0);
        geometry.s_m + share * geometry.length_m
    }

    /// The parameter of the reference at a way: the inverse of [`DrawnRoad::s_of`].
    fn parameter_at(&self, s_m: f64) -> f64 {
        let next = self.geometries.partition_point(|geometry| geometry.s_m <= s_m);
        let Some(geometry) = self.geometries.get(next.saturating_sub(1)) else { return 0.0 };
        let share = ((s_m - geometry.s_m) / geometry.length_m).clamp(0.0, 1.0);
        geometry.from + share * (geometry.to - geometry.from)
    }

    /// How far to the left of the reference a border lies, as cubics over the way.
    fn followed(&self, section: &Section, border: &Border) -> Vec<Piece> {
        let (from_m, to_m) = (self.s_of(section.from), self.s_of(section.to));
        let reference = &self.map.lines[self.road.line];
        let line = &self.map.lines[border.line];
        if border.line == self.road.line {
            return vec![Piece { s_m: from_m, coefficients: [0.0; 4] }];
        }
        // Where the border is abreast of the reference's stations, one from the other.
        let mut known: Vec<(f64, f64)> = Vec::new();
        let mut near = border.from;
        let mut station = section.from;
        while station < section.to {
            near = abreast(line, &reference.point(station), &reference.tangent(station), near).0;
            known.push((station, near));
            station += 0.5;
        }
        let left_m = |s_m: f64| {
            let parameter = self.parameter_at(s_m);
            let index = known.partition_point(|(station, _)| *station <= parameter).saturating_sub(1);
            let near = known.get(index).map_or(border.from, |(_, near)| *near);
            abreast(line, &reference.point(parameter), &reference.tangent(parameter), near).1
        };
        fitted(from_m, to_m, WIDTH_ERROR_M / 2.0, &left_m)
    }

    /// The border of a section on which lane 0 lies: with the least lanes on the wrong side of it.
    fn separator(&self, section: &Section, before: Option<usize>) -> usize {
        let keeps_right = self.traffic == TrafficSide::Right;
        let wrong = |border: usize| {
            let lanes = section.gaps.iter().enumerate().filter(|(_, gap)| gap.kind == GapKind::Lane);
            lanes.filter(|(index, gap)| ((*index >= border) == keeps_right) != (gap.travel == Travel::Along)).count()
        };
        let preference = |border: usize| {
            let line = section.borders[border].line;
            (wrong(border), usize::from(before != Some(line)), usize::from(border != section.reference), border)
        };
        (0..section.borders.len()).min_by_key(|border| preference(*border)).unwrap_or_default()
    }

    fn write<W: Write>(&self, writer: &mut Writer<W>, id: usize, links: &Links, index: usize) -> io::Result<()> {
        let rule = if self.traffic == TrafficSide::Right { "RHT" } else { "LHT" };
        let (length, id) = (attribute(self.length_m()), id.to_string());
        let line = &self.map.lines[self.road.line];
        let name = &line.piece_at(self.road.sections[0].from).name;
        let name = format!("{}.{}.{}", name.cell, name.id, name.part);
        let attributes = [
            ("name", name.as_str()),
            ("length", length.as_str()),
            ("id", id.as_str()),
            ("junction", "-1"),
            ("rule", rule),
        ];
        let element = writer.create_element("road").with_attributes(attributes);
        element.write_inner_content(|writer| {
            links.write(writer, index)?;
            writer.create_element("planView").write_inner_content(|writer| {
                self.geometries.iter().try_for_each(|geometry| written::geometry(writer, geometry))
            })?;
            writer.create_element("elevationProfile").write_inner_content(|writer| {
                let heights = self.geometries.iter().map(elevation).collect::<Vec<_>>();
                write_cubics(writer, "elevation", "s", &heights, 0.0)
            })?;
            writer
                .create_element("lanes")
                .write_inner_content(|writer| self.write_lanes(writer, links, index))
                .map(drop)
        })?;
        Ok(())
    }

    fn write_lanes<W: Write>(&self, writer: &mut Writer<W>, links: &Links, road: usize) -> io::Result<()> {
        let separators = &self.separators;
        let followed: Vec<Vec<Vec<Piece>>> = self
            .road
            .sections
            .iter()
            .map(|section| section.borders.iter().map(|border| self.followed(section, border)).collect())
            .collect();
        let offsets = separators.iter().zip(&followed).flat_map(|(separator, followed)| followed[*separator].clone());
        write_cubics(writer, "laneOffset", "s", &offsets.collect::<Vec<_>>(), 0.0)?;
        for (index, section) in self.road.sections.iter().enumerate() {
            let s = attribute(self.s_of(section.from));
            let around = Neighbours {
                before: index.checked_sub(1).map(|before| (&self.road.sections[before], separators[before])),
                after: self.road.sections.get(index + 1).map(|after| (after, separators[index + 1])),
                links,
                road,
            };
            let lanes = SectionLanes {
                drawn: self,
                section,
                separator: separators[index],
                followed: &followed[index],
                s_m: self.s_of(section.from),
                around,
            };
            let element = writer.create_element("laneSection").with_attribute(("s", s.as_str()));
            element.write_inner_content(|writer| lanes.write(writer))?;
        }
        Ok(())
    }
}

/// The height along a geometry, over the way.
fn elevation(geometry: &Geometry) -> Piece {
    let per_m = 1.0 / geometry.length_m;
    let Cubic([a, b, c, d]) = &geometry.cubic;
    Piece { s_m: geometry.s_m, coefficients: [a.z, b.z * per_m, c.z * per_m * per_m, d.z * per_m * per_m * per_m] }
}

/// The sections beside a section, with their separators.
#[derive(Clone, Copy)]
struct Neighbours<'a> {
    before: Option<(&'a Section, usize)>,
    after: Option<(&'a Section, usize)>,
    /// Where the first and the last section lead on.
    links: &'a Links,
    road: usize,
}

/// The lanes of a section while they are written.
struct SectionLanes<'a> {
    drawn: &'a DrawnRoad<'a>,
    section: &'a Section,
    separator: usize,
    followed: &'a [Vec<Piece>],
    s_m: f64,
    around: Neighbours<'a>,
}

/// Number of the lane in a gap: 1, 2, ... to the left of lane 0, -1, -2, ... to the right.
fn lane_id(gap: usize, separator: usize) -> i64 {
    let distance = |lanes: usize| i64::try_from(lanes).unwrap_or(i64::MAX);
    if gap < separator { distance(separator - gap) } else { -distance(gap - separator + 1) }
}

impl SectionLanes<'_> {
    fn write<W: Write>(&self, writer: &mut Writer<W>) -> io::Result<()> {
        let gaps = self.section.gaps.len();
        if self.separator > 0 {
            writer
                .create_element("left")
                .write_inner_content(|writer| (0..self.separator).try_for_each(|gap| self.write_lane(writer, gap)))?;
        }
        writer.create_element("center").write_inner_content(|writer| {
            let lane =
                writer.create_element("lane").with_attributes([("id", "0"), ("type", "none"), ("level", "false")]);
            lane.write_inner_content(|writer| self.write_mark(writer, self.separator, false)).map(drop)
        })?;
        if self.separator < gaps {
            writer.create_element("right").write_inner_content(|writer| {
                (self.separator..gaps).try_for_each(|gap| self.write_lane(writer, gap))
            })?;
        }
        Ok(())
    }

    fn write_lane<W: Write>(&self, writer: &mut Writer<W>, gap: usize) -> io::Result<()> {
        let id = lane_id(gap, self.separator).to_string();
        let attributes = [("id", id.as_str()), ("type", self.lane_type(gap)), ("level", "false")];
        let element = writer.create_element("lane").with_attributes(attributes);
        let is_left = gap < self.separator;
        element.write_inner_content(|writer| {
            self.write_link(writer, gap)?;
            let width = profile::difference(&self.followed[gap], &self.followed[gap + 1]);
            write_cubics(writer, "width", "sOffset", &width, self.s_m)?;
            self.write_mark(writer, if is_left { gap } else { gap + 1 }, is_left)
        })?;
        Ok(())
    }

    fn lane_type(&self, gap: usize) -> &'static str {
        let lane_on = |gaps: &[super::road::Gap]| gaps.iter().any(|gap| gap.kind == GapKind::Lane);
        let between = lane_on(&self.section.gaps[..gap]) && lane_on(&self.section.gaps[gap + 1..]);
        let (left, right) = (&self.section.borders[gap], &self.section.borders[gap + 1]);
        let width_m = 0.5 * (left.from_left_m + left.to_left_m - right.from_left_m - right.to_left_m);
        match (self.section.gaps[gap].kind, between) {
            (GapKind::Lane, _) => "driving",
            (GapKind::Median, _) | (GapKind::Narrow, true) => "median",
            (GapKind::Narrow, false) if width_m < NARROWEST_LANE_M => "shoulder",
            (GapKind::Narrow, false) => "none",
        }
    }

    fn write_link<W: Write>(&self, writer: &mut Writer<W>, gap: usize) -> io::Result<()> {
        let Neighbours { before, after, links, road } = self.around;
        let linked = |is_last: bool| links.lane_beyond(RoadEnd { road, is_last }, gap);
        let before = match before {
            Some((section, separator)) => {
                let found = section.gaps.iter().position(|other| other.goes_on_in == Some(gap));
                found.map(|found| lane_id(found, separator))
            }
            None => linked(false),
        };
        let after = match after {
            Some((_, separator)) => self.section.gaps[gap].goes_on_in.map(|next| lane_id(next, separator)),
            None => linked(true),
        };
        if before.is_none() && after.is_none() {
            return Ok(());
        }
        let link = writer.create_element("link");
        link.write_inner_content(|writer| {
            for (name, id) in [("predecessor", before), ("successor", after)] {
                if let Some(id) = id {
                    writer.create_element(name).with_attribute(("id", id.to_string().as_str())).write_empty()?;
                }
            }
            Ok(())
        })?;
        Ok(())
    }

    /// The paint of a border. A double line is named from the inside of its lane to the outside.
    fn write_mark<W: Write>(&self, writer: &mut Writer<W>, border: usize, is_left: bool) -> io::Result<()> {
        let border = &self.section.borders[border];
        let line = &self.drawn.map.lines[border.line];
        let mut marks: Vec<(f64, Category)> = Vec::new();
        // A line that goes on over the border of a cell may be painted otherwise there.
        for piece in &line.pieces {
            let (first, last) = (piece.first_segment as f64, (piece.first_segment + piece.segments) as f64);
            let (low, high) = (border.from.min(border.to).max(first), border.from.max(border.to).min(last));
            if low < high {
                let share = |parameter: f64| (parameter - border.from) / (border.to - border.from);
                let start = share(if border.along { low } else { high });
                let category = if border.along { piece.category } else { mirrored(piece.category) };
                marks.push((start, if is_left { mirrored(category) } else { category }));
            }
        }
        marks.sort_by(|a, b| a.0.total_cmp(&b.0));
        if let Some(first) = marks.first_mut() {
            first.0 = 0.0;
        }
        marks.dedup_by(|next, kept| next.1 == kept.1);
        let length_m = self.drawn.s_of(self.section.to) - self.s_m;
        for (share, category) in marks {
            let (kind, color) = paint(category);
            let s = attribute(share * length_m);
            let attributes = [("sOffset", s.as_str()), ("type", kind), ("weight", "standard"), ("color", color)];
            writer.create_element("roadMark").with_attributes(attributes).write_empty()?;
        }
        Ok(())
    }
}

/// A category as a `roadMark` has it: type and colour. A line of which the kind is not known reads as solid.
fn paint(category: Category) -> (&'static str, &'static str) {
    match category {
        Category::Unknown => ("solid", "standard"),
        Category::WhiteDashed => ("broken", "white"),
        Category::WhiteSolid => ("solid", "white"),
        Category::DoubleWhiteDashed => ("broken broken", "white"),
        Category::DoubleWhiteSolid => ("solid solid", "white"),
        Category::WhiteLeftDashedRightSolid => ("broken solid", "white"),
        Category::WhiteLeftSolidRightDashed => ("solid broken", "white"),
        Category::YellowDashed => ("broken", "yellow"),
        Category::YellowSolid => ("solid", "yellow"),
        Category::DoubleYellowDashed => ("broken broken", "yellow"),
        Category::DoubleYellowSolid => ("solid solid", "yellow"),
        Category::YellowLeftDashedRightSolid => ("broken solid", "yellow"),
        Category::YellowLeftSolidRightDashed => ("solid broken", "yellow"),
        Category::LeftCurb | Category::RightCurb => ("curb", "standard"),
    }
}
