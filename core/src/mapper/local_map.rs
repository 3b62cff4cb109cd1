//! What is shown of a drive's map: whole lanes, and the window ahead of the vehicle.
//!
//! `paper` shows the lanes matched in this very frame, as the authors do. `default` also shows what memory knows and this
//! frame missed, between the ends that were estimated.

use nalgebra::{Matrix3, Point3};

use super::Mapper;
use crate::{
    geometry::{Pose, polyline::length_m},
    landmark::Landmark,
    lane_map::{ControlPoint, LocalLane, LocalWindow, MapLane},
    params::{Params, Preset},
    sensor::Sensor,
    spline::sampling::sample,
};

/// Samples per chord of a local lane: 0.5 m apart for chords of 3 m.
const PIECES_PER_CHORD: usize = 6;

/// Whether a lane is believed enough to be shown to its vehicle.
fn is_shown(lane: &Landmark, params: &Params) -> bool {
    is_confirmed(lane, params) && lane.existence.probability() > params.landmark.shown_existence
}

/// Whether a lane is believed enough to be published in the drive's map.
pub(super) fn is_published(lane: &Landmark, params: &Params) -> bool {
    is_confirmed(lane, params) && lane.existence.greatest_probability() > params.landmark.published_existence
}

fn is_confirmed(lane: &Landmark, params: &Params) -> bool {
    lane.observations >= params.landmark.least_observations
}

/// A lane as it is published.
pub(super) fn map_lane(lane: &Landmark, params: &Params) -> Option<MapLane> {
    let (drawn_from, drawn_to) = lane.drawn(&params.landmark)?;
    let variances = lane.information().variances(0);
    let control_points = lane
        .positions()
        .iter()
        .zip(variances)
        .map(|(position, variance)| ControlPoint {
            position: *position,
            covariance: Matrix3::identity() * (variance * params.landmark.variance_inflation),
        })
        .collect();
    Some(MapLane {
        id: lane.id,
        category: lane.category.best(),
        category_posterior: lane.category.posterior(params.association.category_confusion).to_vec(),
        category_stretches: lane.category_along.stretches(lane.knots().0, params.association.category_confusion),
        control_points,
        ends: params.landmark.ends,
        drawn_from,
        drawn_to,
        existence: lane.existence.greatest_probability(),
        observations: lane.observations,
        first_seen: lane.first_seen,
        last_seen: lane.last_seen,
    })
}

/// The lanes in a window ahead of the vehicle.
pub(super) fn local_map(mapper: &Mapper, window: &LocalWindow) -> Vec<LocalLane> {
    let pose = mapper.pose.map_from_vehicle;
    let middle = pose * Point3::new(0.5 * (window.ahead_from_m + window.ahead_to_m), 0.0, 0.0);
    let radius_m = (0.5 * (window.ahead_to_m - window.ahead_from_m)).hypot(window.side_m) + 10.0;
    let mut local = Vec::new();
    for run in mapper.index.within(&middle, radius_m) {
        let Some(lane) = mapper.lanes.get(&run.lane) else { continue };
        let seen_now = mapper.seen_now.contains(&run.lane);
        let shown = match mapper.params.preset {
            Preset::Paper => seen_now,
            Preset::Default => is_shown(lane, &mapper.params),
        };
        if !shown {
            continue;
        }
        let Some((from, to)) = lane.drawn(&mapper.params.landmark) else { continue };
        let Some(curve) = lane.curve(mapper.params.landmark.ends) else { continue };
        let from = from.max(lane.index_of(run.first) as f64);
        let to = to.min(lane.index_of(run.last) as f64);
        let points = sample(&curve, from, to, PIECES_PER_CHORD);
        let points_vehicle = in_window(&points, &pose, window, &mapper.sensor);
        if points_vehicle.len() < 2 || length_m(&points_vehicle) < mapper.params.landmark.shown_in_window_m {
            continue;
        }
        let in_image: Vec<Point3<f64>> =
            points_vehicle.iter().filter(|point| mapper.sensor.sees(point)).copied().collect();
        if seen_now || length_m(&in_image) >= mapper.params.landmark.shown_in_image_m {
            local.push(LocalLane { id: lane.id, category: lane.category.best(), points_vehicle });
        }
    }
    local
}

fn in_window(
    points: &[Point3<f64>],
    map_from_vehicle: &Pose,
    window: &LocalWindow,
    sensor: &Sensor,
) -> Vec<Point3<f64>> {
    let camera = sensor.ground_offset();
    let inside = |point: &Point3<f64>| {
        let offset = point.coords - camera;
        offset.x > window.ahead_from_m && offset.x < window.ahead_to_m && offset.y.abs() < window.side_m
    };
    points.iter().map(|point| map_from_vehicle.inverse_transform_point(point)).filter(inside).collect()
}
