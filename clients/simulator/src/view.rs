//! What of the road falls into the image at one frame: the ground truth of an annotation.
//!
//! A line is annotated where it falls in the image, up to 75 m ahead of the camera, as its longest unbroken run; lines
//! that cross the view at more than 60 degrees and roads off the route are left out, as in OpenLane. At most eight
//! lines, those nearest to the vehicle's sides. What other vehicles hide is for [`crate::fleet`] to say.

use std::ops::Range;

use lanemap_core::{Category, Pose, Sensor};
use nalgebra::Point3;

use crate::{
    drive::route::Leg,
    road::{RoadLine, RoadLineId, RoadNetwork},
};

/// Farthest annotated point ahead of the camera, metres.
pub const VIEW_RANGE_M: f64 = 75.0;
/// Most lines in a frame.
pub const MAX_LINES: usize = 8;
/// Shortest run worth annotating, points (about metres).
const MIN_POINTS: usize = 3;
/// Legs of the route that may be in sight: this one and the next two.
const LEGS_IN_SIGHT: usize = 3;
/// Steepest angle between a line and the vehicle's heading, as a cosine.
const MIN_ALONG: f64 = 0.5;

/// One line as a vehicle faces it.
#[derive(Clone, Debug)]
pub struct LineView {
    /// The line.
    pub line: RoadLineId,
    /// Kind, as seen in the direction of travel.
    pub category: Category,
    /// Points about one metre apart, near to far, vehicle frame, metres: the visible part and what continues it.
    pub points_vehicle: Vec<Point3<f64>>,
    /// The visible part of `points_vehicle`.
    pub visible: Range<usize>,
    /// Indices of the visible part in the line's own points; of a closed line they may run on past its end.
    pub stretch: Range<usize>,
}

impl LineView {
    /// The visible points, near to far, vehicle frame, metres.
    #[must_use]
    pub fn visible_points(&self) -> &[Point3<f64>] {
        &self.points_vehicle[self.visible.clone()]
    }

    /// Lateral position of the nearest visible point, metres to the left.
    #[must_use]
    pub fn side_m(&self) -> f64 {
        self.visible_points().first().map_or(f64::INFINITY, |point| point.y)
    }
}

/// Lines in sight from a pose on leg `leg` of a route, from left to right.
#[must_use]
pub fn lines_in_view(
    network: &RoadNetwork,
    legs: &[Leg],
    leg: usize,
    world_from_vehicle: &Pose,
    sensor: &Sensor,
) -> Vec<LineView> {
    let lines = line_ids_ahead(network, legs, leg).into_iter().map(|(id, forward)| (network.line(id), forward));
    views_of(lines, world_from_vehicle, sensor)
}

/// The lines of the leg `leg` of a route and of the next ones, each once, and whether they are faced in their direction.
pub(crate) fn line_ids_ahead(network: &RoadNetwork, legs: &[Leg], leg: usize) -> Vec<(RoadLineId, bool)> {
    let mut lines: Vec<(RoadLineId, bool)> = Vec::new();
    for leg in legs_in_sight(legs, leg) {
        for id in &network.link(leg.link).lines {
            if !lines.contains(&(*id, leg.forward)) {
                lines.push((*id, leg.forward));
            }
        }
    }
    lines
}

/// The leg `leg` of a route and the next ones that may be in sight from it; a link driven again and again once.
pub(crate) fn legs_in_sight(legs: &[Leg], leg: usize) -> impl Iterator<Item = &Leg> {
    let ahead = &legs[leg.min(legs.len())..legs.len().min(leg + LEGS_IN_SIGHT)];
    let is_new = |(index, leg): &(usize, &Leg)| {
        ahead[..*index].iter().all(|before| (before.link, before.forward) != (leg.link, leg.forward))
    };
    ahead.iter().enumerate().filter(is_new).map(|(_, leg)| leg)
}

/// Those of `lines` that are in sight from a pose, from left to right; each with whether it is faced in its direction.
pub(crate) fn views_of<'a>(
    lines: impl Iterator<Item = (&'a RoadLine, bool)>,
    world_from_vehicle: &Pose,
    sensor: &Sensor,
) -> Vec<LineView> {
    let mut views: Vec<LineView> =
        lines.filter_map(|(line, forward)| view_of(line, forward, world_from_vehicle, sensor)).collect();
    views.sort_by(|a, b| a.side_m().abs().total_cmp(&b.side_m().abs()));
    views.truncate(MAX_LINES);
    views.sort_by(|a, b| b.side_m().total_cmp(&a.side_m()));
    views
}

fn view_of(line: &RoadLine, forward: bool, world_from_vehicle: &Pose, sensor: &Sensor) -> Option<LineView> {
    let place = world_from_vehicle.translation.vector.into();
    let near = if line.is_closed() { turn_round(line, &place)? } else { indices_near(line, &place)? };
    let around = line.points.len().max(2) - 1;
    let mut points: Vec<Point3<f64>> = near
        .clone()
        .map(|index| if index <= around { index } else { index - around })
        .map(|index| world_from_vehicle.inverse_transform_point(&line.points[index]))
        .collect();
    if !forward {
        points.reverse();
    }
    let camera_x_m = sensor.ground_offset().x;
    let seen: Vec<bool> = (0..points.len())
        .map(|k| sensor.sees(&points[k]) && points[k].x - camera_x_m <= VIEW_RANGE_M && runs_ahead(&points, k))
        .collect();
    let run = longest_run(&seen).filter(|run| run.len() >= MIN_POINTS)?;
    let whole = extend_ahead(&points, &run);
    let stretch =
        if forward { near.start + run.start..near.start + run.end } else { near.end - run.end..near.end - run.start };
    Some(LineView {
        line: line.id,
        category: if forward { line.category } else { seen_from_behind(line.category) },
        visible: run.start - whole.start..run.end - whole.start,
        points_vehicle: points[whole].to_vec(),
        stretch,
    })
}

/// The indices between the first and the last point within sight of a place, or `None` where all are far.
fn indices_near(line: &RoadLine, place: &Point3<f64>) -> Option<Range<usize>> {
    const CHUNK: usize = 32;
    let reach_m = VIEW_RANGE_M + 25.0 + CHUNK as f64;
    let is_near = |chunk: &[Point3<f64>]| (chunk[0] - place).norm() < reach_m;
    let count = line.points.chunks(CHUNK).len();
    let first = line.points.chunks(CHUNK).position(is_near)?;
    let last = count - 1 - line.points.chunks(CHUNK).rev().position(is_near)?;
    Some(first * CHUNK..((last + 1) * CHUNK).min(line.points.len()))
}

/// The indices once round a closed line from where it is farthest from a place, or `None` where all of it is far.
fn turn_round(line: &RoadLine, place: &Point3<f64>) -> Option<Range<usize>> {
    indices_near(line, place)?;
    let distances = line.points.iter().map(|point| (point - place).norm_squared());
    let (farthest, _) = distances.enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(farthest..farthest + line.points.len() - 1)
}

fn runs_ahead(points: &[Point3<f64>], k: usize) -> bool {
    let last = points.len() - 1;
    let direction = points[(k + 1).min(last)] - points[k.saturating_sub(1)];
    direction.x >= MIN_ALONG * direction.norm()
}

fn longest_run(seen: &[bool]) -> Option<Range<usize>> {
    let mut longest: Option<Range<usize>> = None;
    let mut start = None;
    for k in 0..=seen.len() {
        match (seen.get(k).copied().unwrap_or(false), start) {
            (true, None) => start = Some(k),
            (false, Some(from)) => {
                if longest.as_ref().is_none_or(|best| k - from > best.len()) {
                    longest = Some(from..k);
                }
                start = None;
            }
            _ => {}
        }
    }
    longest
}

/// The run with what continues it at both ends, as long as it goes on ahead.
fn extend_ahead(points: &[Point3<f64>], run: &Range<usize>) -> Range<usize> {
    let mut start = run.start;
    while start > 0 && points[start - 1].x < points[start].x {
        start -= 1;
    }
    let mut end = run.end;
    while end < points.len() && points[end].x > points[end - 1].x {
        end += 1;
    }
    start..end
}

/// A category as traffic in the other direction sees it.
fn seen_from_behind(category: Category) -> Category {
    match category {
        Category::LeftCurb => Category::RightCurb,
        Category::RightCurb => Category::LeftCurb,
        Category::WhiteLeftDashedRightSolid => Category::WhiteLeftSolidRightDashed,
        Category::WhiteLeftSolidRightDashed => Category::WhiteLeftDashedRightSolid,
        Category::YellowLeftDashedRightSolid => Category::YellowLeftSolidRightDashed,
        Category::YellowLeftSolidRightDashed => Category::YellowLeftDashedRightSolid,
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Scenario, Simulation};

    #[test]
    fn what_is_annotated_falls_in_the_image_and_lies_on_its_line() {
        let simulation = Simulation::run(&Scenario { drives: 1, length_m: 600.0, ..Scenario::town(3) });
        let drive = &simulation.drives[0];
        let sensor = drive.camera.sensor();
        let mut frames_with_lines = 0;
        for frame in &drive.frames {
            assert!(frame.views.len() <= MAX_LINES);
            frames_with_lines += usize::from(frame.views.len() >= 2);
            for view in &frame.views {
                let line = simulation.network.line(view.line);
                assert_eq!(view.stretch.len(), view.visible.len());
                for point in view.visible_points() {
                    assert!(sensor.sees(point));
                    assert!(point.x - sensor.ground_offset().x <= VIEW_RANGE_M);
                }
                let mut truth = line.points[view.stretch.clone()].to_vec();
                let first = frame.truth.world_from_vehicle * view.visible_points()[0];
                if (truth[0] - first).norm() > 1e-6 {
                    truth.reverse();
                }
                assert!((truth[0] - first).norm() < 1e-6);
            }
        }
        assert!(frames_with_lines * 10 >= drive.frames.len() * 6, "{frames_with_lines} of {}", drive.frames.len());
    }
}
