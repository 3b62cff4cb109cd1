//! Lanelets over [junctions](crate::export::junction), between virtual line strings: nothing is painted there.

use nalgebra::Point3;

use super::{Drawing, NodeKey};
use crate::export::{
    junction::{Connection, Joints, LaneEnd, turn},
    map_line::{Cubic, MapLines},
    road::Road,
};

/// Way between the nodes of a virtual line string, metres.
const STEP_M: f64 = 1.5;

/// A lanelet over a junction.
pub(super) struct Crossing {
    pub(super) left: VirtualLine,
    pub(super) right: VirtualLine,
}

impl Crossing {
    /// Its bounds, the left one first.
    pub(super) fn lines(&self) -> [&VirtualLine; 2] {
        [&self.left, &self.right]
    }
}

/// A line string from a node of one line to a node of another.
pub(super) struct VirtualLine {
    pub(super) first: NodeKey,
    /// What lies between both, metres.
    pub(super) between: Vec<Point3<f64>>,
    pub(super) last: NodeKey,
}

/// Adds the lanelets over all junctions; and where lanes touch, makes one node of the two in which their bounds end and begin.
pub(super) fn cross(map: &MapLines, roads: &[Road], joints: &Joints, drawing: &mut Drawing) {
    for connection in &joints.touching {
        let ends = [&connection.from, &connection.to].map(|end| nodes(map, roads, end, drawing));
        for (kept, gone) in ends[0].into_iter().zip(ends[1]) {
            drawing.merge(kept, gone);
        }
    }
    for connection in joints.junctions.iter().flat_map(|junction| &junction.connections) {
        let Connection { from, to } = connection;
        let ([from_left, from_right], [to_left, to_right]) =
            (nodes(map, roads, from, drawing), nodes(map, roads, to, drawing));
        let line = |first, start, last, end| {
            let between = between(&turn(start, &from.heading, end, &to.heading));
            VirtualLine { first, between, last }
        };
        let left = line(from_left, from.left, to_left, to.left);
        let right = line(from_right, from.right, to_right, to.right);
        drawing.crossings.push(Crossing { left, right });
    }
}

/// The nodes of both bounds at the end of a lane, the left one first.
fn nodes(map: &MapLines, roads: &[Road], end: &LaneEnd, drawing: &mut Drawing) -> [NodeKey; 2] {
    let section = end.at.section(roads);
    let node = |border: usize| {
        let border = &section.borders[border];
        let parameter = if end.at.is_last { border.to } else { border.from };
        (border.line, parameter)
    };
    // Of the reference's left and right the ones that the driver has there.
    let is_along = end.leaves == end.at.is_last;
    let (left, right) = if is_along { (end.gap, end.gap + 1) } else { (end.gap + 1, end.gap) };
    [left, right].map(|border| {
        let (line, parameter) = node(border);
        drawing.node(&map.lines[line], line, parameter)
    })
}

fn between(way: &Cubic) -> Vec<Point3<f64>> {
    let steps = (way.length_m() / STEP_M).ceil();
    let mut points = Vec::new();
    let mut step = 1.0;
    while step < steps {
        points.push(way.point(step / steps));
        step += 1.0;
    }
    points
}
