//! What a drive that was found on the map says to it: the stretch that lies on the map, with fixes that tell where.

use std::ops::RangeInclusive;

use nalgebra::{Matrix2, Matrix3, Point3};

use super::{MapPlace, fit::Fit, hypotheses::Hypothesis, profile::half_turn};
use crate::{
    fleet::{
        cell::CellId,
        contribution::{Contribution, PlacedBy},
        prepared::{PreparedDrive, PreparedLane, count_of},
    },
    frame::GnssFix,
    geometry::{Pose, georeference::Georeference},
    lane_map::MapLane,
};

/// Gap between samples on lines that ends a stretch, metres.
const LONGEST_GAP_M: f64 = 100.0;
/// Way beyond the stretch that is kept, metres.
const TAIL_M: f64 = 20.0;
/// Least standard deviation of where a drive lies, metres: what the map's lines are off by against each other.
const LEAST_SIGMA_M: f64 = 0.1;
/// Standard deviation of its height, metres.
const HEIGHT_SIGMA_M: f64 = 0.5;
/// How far off the errors are from independent: factor on the covariance. See the test of calibration.
const INFLATION: f64 = 4.0;

/// The longest stretch of the way from which lines of the map were seen without a long gap, metres from the start.
pub(super) fn stretch_m(on_line_m: &[f64]) -> Option<RangeInclusive<f64>> {
    let stretches = on_line_m.chunk_by(|before, after| after - before <= LONGEST_GAP_M);
    let stretches = stretches.filter_map(|stretch| Some(*stretch.first()?..=*stretch.last()?));
    stretches.max_by(|a, b| length_m(a).total_cmp(&length_m(b)))
}

pub(super) fn length_m(stretch: &RangeInclusive<f64>) -> f64 {
    stretch.end() - stretch.start()
}

/// Covariance of east, north and turn at the middle of the way, for a fit whose information is not open anywhere.
pub(super) fn covariance(fit: &Fit) -> Option<Matrix3<f64>> {
    let mut covariance = fit.covariance()? * INFLATION;
    covariance[(0, 0)] += LEAST_SIGMA_M * LEAST_SIGMA_M;
    covariance[(1, 1)] += LEAST_SIGMA_M * LEAST_SIGMA_M;
    Some(covariance)
}

/// Standard deviation in the worst direction, metres.
pub(super) fn worst_sigma_m(covariance: &Matrix3<f64>) -> f64 {
    let horizontal: Matrix2<f64> = covariance.fixed_view::<2, 2>(0, 0).into_owned();
    horizontal.symmetric_eigenvalues().max().max(0.0).sqrt()
}

/// The place of a drive, and what it says there.
pub(super) fn placed(
    contribution: &Contribution,
    prepared: &PreparedDrive<'_>,
    fit: &Fit,
    cell: CellId,
    stretch: &RangeInclusive<f64>,
    covariance: Matrix3<f64>,
    margin: f64,
) -> MapPlace {
    let kept_m = stretch.start() - TAIL_M..=stretch.end() + TAIL_M;
    let anchor = cell.anchor();
    let sigma_m = worst_sigma_m(&covariance);
    let mut way: Vec<_> =
        contribution.trajectory.iter().filter(|point| kept_m.contains(&point.arc_m)).cloned().collect();
    for point in &mut way {
        let place = anchor.wgs84_from_enu(&fit.correction.apply(&point.position, point.arc_m));
        point.fix = Some(GnssFix {
            latitude_deg: place.latitude_deg,
            longitude_deg: place.longitude_deg,
            height_m: place.height_m,
            horizontal_sigma_m: sigma_m,
            vertical_sigma_m: HEIGHT_SIGMA_M,
            yaw_enu_rad: Some(half_turn(point.yaw_rad + fit.correction.yaw_rad(point.arc_m))),
        });
    }
    let lanes = prepared.passes.iter().flat_map(|pass| &pass.lanes).collect::<Vec<_>>();
    let middle = way[way.len() / 2].clone();
    let placed = Contribution {
        placed_by: PlacedBy::Map,
        trajectory: way,
        lanes: kept_lanes(&contribution.lanes, &lanes, &kept_m),
        ..contribution.clone()
    };
    let yaw_rad = fit.correction.yaw_rad(middle.arc_m);
    let enu = fit.correction.apply(&middle.position, middle.arc_m);
    let rigid = Hypothesis::at(cell, yaw_rad, middle.position, enu, middle.arc_m);
    let origin = rigid.apply(&Point3::origin());
    let enu_from_map = Pose::new(origin.coords, nalgebra::Vector3::z() * yaw_rad);
    MapPlace {
        contribution: placed,
        georeference: Georeference { anchor, enu_from_map },
        covariance,
        margin,
        way_m: length_m(stretch),
    }
}

/// Of every lane, what was seen from the stretch, cut at control points.
fn kept_lanes(lanes: &[MapLane], prepared: &[&PreparedLane<'_>], kept_m: &RangeInclusive<f64>) -> Vec<MapLane> {
    let cut = lanes.iter().filter_map(|lane| {
        let of_lane = prepared.iter().filter(|prepared| prepared.lane.id == lane.id);
        let kept = of_lane.flat_map(|prepared| &prepared.samples).filter(|sample| kept_m.contains(&sample.arc_m));
        let (from, to) = kept.fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), sample| {
            (from.min(sample.parameter), to.max(sample.parameter))
        });
        let first = count_of(from.max(0.0).floor());
        let last = count_of(to.ceil()).min(lane.control_points.len().checked_sub(1)?);
        (from < to && first < last).then(|| MapLane {
            control_points: lane.control_points[first..=last].to_vec(),
            category_stretches: lane.category_stretches_between(first as f64, last as f64),
            drawn_from: (lane.drawn_from - first as f64).max(from - first as f64),
            drawn_to: (lane.drawn_to - first as f64).min(to - first as f64),
            ..lane.clone()
        })
    });
    cut.collect()
}
