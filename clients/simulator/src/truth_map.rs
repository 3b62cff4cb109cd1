//! The true map of a drive: what a perfect mapper would have drawn.
//!
//! Only lines seen in at least three frames count, and of each the stretch that was ever in sight.

use std::{collections::BTreeMap, ops::Range};

use lanemap_core::Category;
use nalgebra::Point3;

use crate::{
    road::{RoadLine, RoadLineId, RoadNetwork},
    simulation::SimulatedFrame,
    view::LineView,
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

/// The true map of a drive that goes on.
#[derive(Clone, Debug, Default)]
pub struct TruthMap {
    seen: BTreeMap<RoadLineId, SeenLine>,
}

#[derive(Clone, Debug)]
struct SeenLine {
    category: Category,
    stretch: Range<usize>,
    frames: u32,
}

impl TruthMap {
    /// Adds what one frame had in sight.
    pub fn observe(&mut self, frame: &SimulatedFrame) {
        self.observe_views(&frame.views);
    }

    /// Adds what was in sight in one frame.
    pub fn observe_views(&mut self, views: &[LineView]) {
        for view in views {
            let LineView { category, stretch, .. } = view;
            let seen = self.seen.entry(view.line).or_insert_with(|| SeenLine {
                category: *category,
                stretch: stretch.clone(),
                frames: 0,
            });
            seen.stretch = seen.stretch.start.min(stretch.start)..seen.stretch.end.max(stretch.end);
            seen.frames += 1;
        }
    }

    /// The lines so far, in the order of their numbers.
    #[must_use]
    pub fn lines(&self, network: &RoadNetwork) -> Vec<TrueLine> {
        self.lines_by(|id| Some(network.line(id)))
    }

    /// The lines so far, in the order of their numbers, where lines are found by their numbers.
    pub(crate) fn lines_by<'a>(&self, line_of: impl Fn(RoadLineId) -> Option<&'a RoadLine>) -> Vec<TrueLine> {
        self.seen
            .iter()
            .filter(|(_, seen)| seen.frames >= MIN_FRAMES)
            .filter_map(|(line, seen)| {
                Some(TrueLine {
                    line: *line,
                    category: seen.category,
                    frames_seen: seen.frames,
                    points: stretch_of(line_of(*line)?, &seen.stretch),
                })
            })
            .collect()
    }
}

/// The points of a stretch; all of a closed line where the stretch runs on past its end.
fn stretch_of(line: &RoadLine, stretch: &Range<usize>) -> Vec<Point3<f64>> {
    line.points.get(stretch.clone()).unwrap_or(&line.points).to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Scenario, Simulation};

    #[test]
    fn the_true_map_holds_every_line_that_was_annotated_for_a_while() {
        let simulation = Simulation::run(&Scenario { drives: 1, length_m: 400.0, ..Scenario::town(6) });
        let drive = &simulation.drives[0];
        let mut map = TruthMap::default();
        drive.frames.iter().for_each(|frame| map.observe(frame));
        let map = map.lines(&simulation.network);
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
