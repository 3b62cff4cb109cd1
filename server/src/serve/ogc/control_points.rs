//! The collection `control_points`: what is known of a line at each of its control points.
//!
//! There are many, and each is short: their places are kept, and a point is written when it is asked for.

use std::sync::Arc;

use lanemap_core::{Category, TimestampNs, fleet::CellId};
use lanemap_proto::v1;
use serde::Serialize;

use super::{
    cell_features::{CellFeatures, Entry, NewFeature},
    filters::Filtered,
};
use crate::serve::{
    features::{category_name, rfc3339},
    line::Coordinate,
    shared_lanes::{category, control_points, feature_id},
};

/// A control point as a feature.
#[derive(Serialize)]
#[serde(tag = "type", rename = "Feature")]
struct ControlPoint<'a> {
    id: String,
    geometry: Place,
    properties: Properties<'a>,
}

#[derive(Serialize)]
#[serde(tag = "type", rename = "Point")]
struct Place {
    coordinates: Coordinate,
}

#[derive(Serialize)]
struct Properties<'a> {
    /// Name of the line.
    lane: &'a str,
    /// The cell in which it lies.
    cell: &'a str,
    /// Which piece of the line within the cell.
    part: u32,
    /// Which point of the piece, from 0.
    index: usize,
    /// Version of the cell.
    version: u64,
    category: &'static str,
    /// Drives that saw the line here.
    drives: u32,
    /// Probability that the line is here, in `[0, 1]`.
    existence: f64,
    /// Standard deviation across the line against the map around it, metres.
    lateral_sigma_m: f64,
    /// The same of its height, metres.
    height_sigma_m: f64,
    /// Start of the last drive that saw the line here, RFC 3339.
    confirmed: String,
}

/// The control points of a cell, in the order of its lines.
pub(super) fn features(cell: CellId, map: &Arc<v1::CellMap>) -> CellFeatures {
    let anchor = cell.anchor();
    let mut features = CellFeatures::new(cell, Arc::clone(map), Some(written));
    for (index, lane) in map.lanes.iter().enumerate() {
        let points = control_points(&anchor, lane);
        if points.len() < 2 {
            continue;
        }
        let seen = Some((TimestampNs(lane.first_seen_unix_ns), TimestampNs(lane.last_seen_unix_ns)));
        for (within, point) in points.iter().enumerate() {
            let (filtered, coordinates) = (filtered(lane, within), std::slice::from_ref(point));
            features.push(NewFeature { lane: index, within, filtered, seen, coordinates, text: vec![] });
        }
    }
    features
}

/// Index of a control point within its cell.
pub(in crate::serve) fn find(features: &CellFeatures, lane: &str, part: u32, within: usize) -> Option<usize> {
    let first = super::lanes::find(features, lane, part)?;
    let entry = features.entries().get(first.checked_add(within)?)?;
    (entry.within == within && entry.lane == features.entries()[first].lane).then_some(first + within)
}

fn filtered(lane: &v1::FusedLane, within: usize) -> Filtered {
    Filtered {
        category: category(lane),
        drives: at(&lane.drives_at, within),
        existence: f64::from(at(&lane.existence_permille, within)) / 1e3,
        lateral_sigma_m: f64::from(at(&lane.lateral_sigma_mm, within)) / 1e3,
    }
}

fn at<T: Copy + Default>(values: &[T], index: usize) -> T {
    values.get(index).copied().unwrap_or_default()
}

fn written(features: &CellFeatures, entry: &Entry, coordinates: Coordinate) -> Vec<u8> {
    let Some(lane) = features.map.lanes.get(entry.lane) else { return vec![] };
    let Filtered { drives, existence, lateral_sigma_m, .. } = filtered(lane, entry.within);
    let category: Category = category(lane);
    let confirmed_ns = at(&lane.confirmed_after_s, entry.within).saturating_mul(1_000_000_000);
    let point = ControlPoint {
        id: format!("{}.{}", feature_id(&features.map.cell, &lane.id, lane.part), entry.within),
        geometry: Place { coordinates },
        properties: Properties {
            lane: &lane.id,
            cell: &features.map.cell,
            part: lane.part,
            index: entry.within,
            version: features.map.version,
            category: category_name(category),
            drives,
            existence,
            lateral_sigma_m,
            height_sigma_m: f64::from(at(&lane.height_sigma_mm, entry.within)) / 1e3,
            confirmed: rfc3339(TimestampNs(lane.first_seen_unix_ns.saturating_add(confirmed_ns))),
        },
    };
    serde_json::to_vec(&point).unwrap_or_default()
}
