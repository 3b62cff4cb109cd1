//! The collection `cells`: the tiles in which the map is fused, with the quality of what is in them.
//!
//! All but `state` is a function of the cell's version; `state` is of now, and written last.

use std::sync::Arc;

use lanemap_core::{TimestampNs, fleet::CellId};
use lanemap_proto::v1;
use serde::Serialize;

use super::{
    cell_features::{CellFeatures, NewFeature},
    filters::Filtered,
};
use crate::{
    fuse::{CellVersion, SharedMap, wire::positions},
    serve::{
        features::rfc3339,
        items::of_cell,
        line::{Coordinate, rounded},
    },
};

#[derive(Serialize)]
#[serde(tag = "type", rename = "Feature")]
struct Cell<'a> {
    id: &'a str,
    geometry: Tile,
    properties: Properties<'a>,
}

#[derive(Serialize)]
#[serde(tag = "type", rename = "Polygon")]
struct Tile {
    coordinates: [[[f64; 2]; 5]; 1],
}

#[derive(Serialize)]
struct Properties<'a> {
    cell: &'a str,
    /// Version of the cell.
    version: u64,
    /// Pieces of lines.
    lanes: usize,
    control_points: usize,
    /// Length of all lines along their control points, kilometres.
    line_km: f64,
    /// Most drives that saw one of the lines.
    drives: u32,
    /// Probability that a line is there, mean over all control points.
    #[serde(skip_serializing_if = "Option::is_none")]
    existence: Option<f64>,
    /// Median over all control points, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    lateral_sigma_m: Option<f64>,
    /// Median over all control points, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    height_sigma_m: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    first_seen: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    last_seen: Option<String>,
}

/// The cell as the only feature in it.
pub(super) fn features(cell: CellId, map: &Arc<v1::CellMap>) -> CellFeatures {
    let bounds = of_cell(cell);
    let [west, south, east, north] = bounds.to_array().map(|degrees| rounded(degrees, 1e7));
    let ring = [[west, south], [east, south], [east, north], [west, north], [west, south]];
    let lanes = &map.lanes;
    let seen = lanes.iter().map(|lane| (TimestampNs(lane.first_seen_unix_ns), TimestampNs(lane.last_seen_unix_ns)));
    let seen = seen.reduce(|(first, last), (from, to)| (first.min(from), last.max(to)));
    let existence: Vec<u32> = lanes.iter().flat_map(|lane| lane.existence_permille.iter().copied()).collect();
    let drives = lanes.iter().map(|lane| lane.drives).max().unwrap_or(0);
    let lateral_sigma_m = median_m(lanes.iter().flat_map(|lane| lane.lateral_sigma_mm.iter().copied()).collect());
    let mean = |permille: &[u32]| permille.iter().map(|value| f64::from(*value)).sum::<f64>() / permille.len() as f64;
    let existence_mean = (!existence.is_empty()).then(|| rounded(mean(&existence) / 1e3, 1e3));
    let written = Cell {
        id: &map.cell,
        geometry: Tile { coordinates: [ring] },
        properties: Properties {
            cell: &map.cell,
            version: map.version,
            lanes: lanes.len(),
            control_points: lanes.iter().map(|lane| lane.xyz_mm.len() / 3).sum(),
            line_km: rounded(lanes.iter().map(length_m).sum::<f64>() / 1e3, 1e3),
            drives,
            existence: existence_mean,
            lateral_sigma_m,
            height_sigma_m: median_m(lanes.iter().flat_map(|lane| lane.height_sigma_mm.iter().copied()).collect()),
            first_seen: seen.map(|(first, _)| rfc3339(first)),
            last_seen: seen.map(|(_, last)| rfc3339(last)),
        },
    };
    let mut text = serde_json::to_vec(&written).unwrap_or_default();
    // Open at the end of the properties: the state follows.
    text.truncate(text.len().saturating_sub(2));
    let filtered = Filtered {
        category: lanemap_core::Category::Unknown,
        drives,
        existence: existence_mean.unwrap_or(0.0),
        lateral_sigma_m: lateral_sigma_m.unwrap_or(0.0),
    };
    let coordinates: Vec<Coordinate> = ring.iter().map(|[longitude, latitude]| [*longitude, *latitude, 0.0]).collect();
    let mut features = CellFeatures::new(cell, Arc::clone(map), None).filled();
    features.push(NewFeature { lane: 0, within: 0, filtered, seen, coordinates: &coordinates, text });
    features
}

/// Closes a cell's feature with its state.
pub(in crate::serve) fn write_state(map: &SharedMap, cell: CellId, version: u64, out: &mut Vec<u8>) {
    let state = match map.record(cell) {
        Some(record) if record.version != CellVersion(version) => "replaced",
        _ if map.is_dirty(cell) => "dirty",
        _ => "current",
    };
    out.extend(format!(",\"state\":\"{state}\"}}}}").bytes());
}

fn length_m(lane: &v1::FusedLane) -> f64 {
    positions(lane).windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum()
}

fn median_m(mut values_mm: Vec<u32>) -> Option<f64> {
    values_mm.sort_unstable();
    values_mm.get(values_mm.len() / 2).map(|value| f64::from(*value) / 1e3)
}
