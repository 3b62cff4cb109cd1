//! The true map of a drive: what a perfect mapper would have drawn.
//!
//! Only lines seen in at least three frames count, and of each the stretch that was ever in sight.

use std::{collections::BTreeMap, ops::Range};

use lanemap_core::Category;
use nalgebra::Point3;

use crate::{
    road::{RoadLine, RoadLineId, RoadNetwork},
    simulation::SimulatedDrive,
};

/// A line seen in fewer frames is left out.
const MIN_FRAMES: u32 = 3;

/// A true line, or the part of one that a drive saw.
#[derive(Clone, Debug)]
pub struct TrueLine {
    /// The painted line.
    pub line: RoadLineId,
    /// Kind, as the drive saw it first.
    pub category: Category,
    /// Frames in which some of it was in sight; 0 for a line of the network as such.
    pub frames_seen: u32,
    /// Points about one metre apart, world frame, metres.
    pub points: Vec<Point3<f64>>,
}

impl TrueLine {
    /// A whole line of the network.
    #[must_use]
    pub fn whole(line: &RoadLine) -> Self {
        Self { line: line.id, category: line.category, frames_seen: 0, points: line.points.clone() }
    }
}

/// The true map of a drive, in the order of the lines' numbers.
#[must_use]
pub fn truth_map(drive: &SimulatedDrive, network: &RoadNetwork) -> Vec<TrueLine> {
    let mut seen: BTreeMap<RoadLineId, (Category, Range<usize>, u32)> = BTreeMap::new();
    for view in drive.frames.iter().flat_map(|frame| &frame.views) {
        let (_, stretch, frames) = seen.entry(view.line).or_insert((view.category, view.stretch.clone(), 0));
        *stretch = stretch.start.min(view.stretch.start)..stretch.end.max(view.stretch.end);
        *frames += 1;
    }
    seen.into_iter()
        .filter(|(_, (_, _, frames))| *frames >= MIN_FRAMES)
        .map(|(line, (category, stretch, frames_seen))| TrueLine {
            line,
            category,
            frames_seen,
            points: network.line(line).points[stretch].to_vec(),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Scenario, Simulation};

    #[test]
    fn the_true_map_holds_every_line_that_was_annotated_for_a_while() {
        let simulation = Simulation::run(&Scenario { drives: 1, length_m: 400.0, ..Scenario::town(6) });
        let drive = &simulation.drives[0];
        let map = truth_map(drive, &simulation.network);
        assert!(map.len() >= 3);
        for frame in &drive.frames {
            for view in &frame.views {
                let Some(line) = map.iter().find(|line| line.line == view.line) else { continue };
                let far = frame.truth.world_from_vehicle * view.visible_points()[view.visible.len() - 1];
                let nearest = line.points.iter().map(|point| (point - far).norm()).fold(f64::INFINITY, f64::min);
                assert!(nearest < 1e-6);
            }
        }
    }
}
