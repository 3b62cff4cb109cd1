//! The lines in which a drive is sought, by cell.

use std::collections::BTreeMap;

use nalgebra::Point3;

use super::profile::Profile;
use crate::{
    category::Category,
    fleet::{
        cell::CellId,
        contribution::DriveId,
        line::{FusedLaneId, Knot, Line, Lines},
    },
    frame::TimestampNs,
    lane_map::LaneId,
};

/// A line of the shared map, east-north-up metres at its cell's anchor.
#[derive(Clone, Debug, PartialEq)]
pub struct AtlasLine {
    /// Its knots, in order, a few metres apart.
    pub points: Vec<Point3<f64>>,
    /// Probability of each category, in the order of [`Category::ALL`]; empty where nothing is known of it.
    pub category_posterior: Vec<f64>,
}

/// All lines of the shared map, made ready to find a drive in them.
#[derive(Clone, Debug, Default)]
pub struct LineAtlas {
    cells: BTreeMap<CellId, CellLines>,
}

/// The lines of one cell.
#[derive(Clone, Debug)]
struct CellLines {
    lines: Vec<AtlasLine>,
    /// Of every line, in both directions.
    profiles: Vec<Profile>,
    length_m: f64,
}

impl LineAtlas {
    /// Puts the lines of a cell in the place of those that it had.
    pub fn put(&mut self, cell: CellId, lines: Vec<AtlasLine>) {
        if lines.is_empty() {
            self.cells.remove(&cell);
            return;
        }
        let length_m = lines.iter().map(|line| length_m(&line.points)).sum();
        let profiles = lines.iter().filter_map(|line| Profile::of(&line.points)).flat_map(|profile| {
            let reversed = profile.reversed();
            [profile, reversed]
        });
        let profiles = profiles.collect();
        self.cells.insert(cell, CellLines { lines, profiles, length_m });
    }

    /// The cells that have lines, in their order.
    pub fn cells(&self) -> impl Iterator<Item = CellId> {
        self.cells.keys().copied()
    }

    /// Length of all lines, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.cells.values().map(|cell| cell.length_m).sum()
    }

    /// The heading profiles of all lines, by cell.
    pub(super) fn profiles(&self) -> impl Iterator<Item = (CellId, &Profile)> {
        self.cells.iter().flat_map(|(cell, lines)| lines.profiles.iter().map(move |profile| (*cell, profile)))
    }

    /// The lines of a cell and of those around it, in the frame of the cell.
    pub(super) fn around(&self, cell: CellId) -> Lines {
        let anchor = cell.anchor();
        let mut lines = Lines::default();
        for near in [vec![cell], cell.neighbours()].concat() {
            let Some(found) = self.cells.get(&near) else { continue };
            let theirs = near.anchor();
            let place = |point: &Point3<f64>| {
                if near == cell { *point } else { anchor.enu_from_wgs84(&theirs.wgs84_from_enu(point)) }
            };
            for line in &found.lines {
                let number = lines.lines.len() as u64;
                lines.lines.push(as_line(number, line.points.iter().map(place), &line.category_posterior));
            }
        }
        lines.index();
        lines
    }
}

fn as_line(number: u64, points: impl Iterator<Item = Point3<f64>>, posterior: &[f64]) -> Line {
    let mut line = Line::new(FusedLaneId {
        started: TimestampNs(0),
        drive: DriveId(0),
        lane: LaneId(number),
        piece: 0,
        stretch: 0,
    });
    if posterior.len() == Category::ALL.len() {
        line.vote(posterior, 1.0);
    }
    for point in points {
        line.push(point, Knot::default());
    }
    line
}

fn length_m(points: &[Point3<f64>]) -> f64 {
    points.windows(2).map(|pair| nalgebra::distance(&pair[0], &pair[1])).sum()
}
