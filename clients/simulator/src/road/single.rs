//! One road without junctions: straight, winding, or closed to a loop.
//!
//! The winding road has bends of alternating hand about every 300 m ([`Bends`]); the loop is a circle whose radius swings,
//! `r(a) = R (1 + 0.18 sin(2 a + p) + 0.07 sin(3 a + q))`, scaled to its length and about the origin, so that it bends
//! both ways and comes back to its beginning without a seam.

use std::f64::consts::TAU;

use nalgebra::{Point2, Vector2};

use crate::{
    random::{Purpose, Seed, SimRng, uniform},
    road::{
        Link, LinkKind, ReferenceLine, RoadNetwork, Terrain,
        cross_section::{Carriageway, PaintedLine},
        marking::{Marking, mark},
        reference_line::Bends,
    },
};

/// Tightest bend of a winding road, metres.
const MIN_RADIUS_M: f64 = 150.0;
/// Widest swing of a winding road to either side, metres.
const SWING_M: f64 = 40.0;
/// Way between two bends of a winding road, metres.
const BEND_M: f64 = 300.0;

/// The course of a single road in plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Course {
    /// From west to east through the origin.
    Straight,
    /// From west to east through the origin, bending to both sides.
    Winding,
    /// Once round the origin, counter-clockwise.
    Loop,
}

/// A single road.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SingleRoad {
    /// Its course.
    pub course: Course,
    /// Its length, metres.
    pub length_m: f64,
    /// Its lanes.
    pub carriageway: Carriageway,
    /// Width of a lane, metres.
    pub lane_width_m: f64,
    /// What is painted.
    pub marking: Marking,
}

impl SingleRoad {
    /// Two lanes each way with a dashed centre line and edge lines.
    #[must_use]
    pub fn new(course: Course, length_m: f64) -> Self {
        Self {
            course,
            length_m,
            carriageway: Carriageway::TwoWay { lanes_each: 2 },
            lane_width_m: 3.5,
            marking: Marking::default(),
        }
    }

    /// Builds the road on land nowhere steeper than `max_grade`.
    #[must_use]
    pub fn build(&self, max_grade: f64, seed: Seed) -> RoadNetwork {
        let terrain = Terrain::random(max_grade, &mut seed.stream(Purpose::Terrain, 0));
        let reference = self.reference(&mut seed.stream(Purpose::Network, 0));
        let (start, end) = (reference.points()[0], reference.points()[reference.len() - 1]);
        let mut network = RoadNetwork::on(terrain);
        let from = network.add_junction(start);
        let to = if self.course == Course::Loop { from } else { network.add_junction(end) };
        let painted = mark(self.carriageway, self.lane_width_m, reference.length_m(), &self.marking);
        let places = |line: &PaintedLine| reference.offset_line(|s_m| line.offset_at_m(s_m));
        let lines = painted.iter().map(|line| network.add_line(line.category, &places(line))).collect();
        network.add_link(Link {
            from,
            to,
            carriageway: self.carriageway,
            lane_width_m: self.lane_width_m,
            kind: LinkKind::Street,
            lines,
            reference,
        });
        network
    }

    fn reference(&self, rng: &mut SimRng) -> ReferenceLine {
        let half = Vector2::new(0.5 * self.length_m, 0.0);
        let (start, end) = (Point2::origin() - half, Point2::origin() + half);
        match self.course {
            Course::Straight => ReferenceLine::through(&[start, end]),
            Course::Winding => {
                let bends = Bends {
                    amplitude_m: SWING_M,
                    waves: self.length_m / (2.0 * BEND_M),
                    phase_rad: uniform(rng, 0.0, TAU),
                    min_radius_m: MIN_RADIUS_M,
                };
                ReferenceLine::between(start, end, &bends)
            }
            Course::Loop => closed(self.length_m, rng),
        }
    }
}

fn closed(length_m: f64, rng: &mut SimRng) -> ReferenceLine {
    let phases = [0; 2].map(|_| uniform(rng, 0.0, TAU));
    let radius =
        |angle_rad: f64| 1.0 + 0.18 * (2.0 * angle_rad + phases[0]).sin() + 0.07 * (3.0 * angle_rad + phases[1]).sin();
    let samples = crate::count_of(length_m * 4.0).max(64);
    let unit: Vec<Point2<f64>> = (0..=samples)
        .map(|k| TAU * (k % samples) as f64 / samples as f64)
        .map(|angle_rad| Point2::new(angle_rad.cos(), angle_rad.sin()) * radius(angle_rad))
        .collect();
    let unit_length: f64 = unit.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
    let scaled: Vec<_> = unit.iter().map(|point| point * (length_m / unit_length)).collect();
    ReferenceLine::closed_through(&scaled)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(course: Course) -> RoadNetwork {
        SingleRoad::new(course, 2_000.0).build(0.03, Seed(1))
    }

    #[test]
    fn the_lines_of_a_road_stay_parallel_at_their_lanes_width() {
        for course in [Course::Straight, Course::Winding, Course::Loop] {
            let network = lines(course);
            for pair in network.lines().windows(2) {
                for point in pair[0].points.iter().skip(5).step_by(40) {
                    let nearest = pair[1].points.windows(2).map(|piece| {
                        let along = (piece[1] - piece[0]).xy();
                        let share = ((point - piece[0]).xy().dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
                        (piece[0].xy() + along * share - point.xy()).norm()
                    });
                    let distance_m = nearest.fold(f64::INFINITY, f64::min);
                    assert!((distance_m - 3.5).abs() < 0.01, "{course:?}: {distance_m}");
                }
            }
        }
    }

    #[test]
    fn a_loop_is_closed_without_a_seam_and_has_its_length() {
        let network = lines(Course::Loop);
        let link = &network.links()[0];
        assert!((link.reference.length_m() - 2_000.0).abs() < 5.0);
        assert!(network.lines().iter().all(crate::road::RoadLine::is_closed));
        let headings = link.reference.headings_rad();
        assert!((headings[headings.len() - 1] - headings[0] - TAU).abs() < 0.03, "once round");
        for pair in headings.windows(2) {
            assert!((pair[1] - pair[0]).abs() < 1.0 / 60.0, "no bend is tighter than 60 m");
        }
    }
}
