//! The collection `lanes`: lines, written once per version of their cell.

use std::sync::Arc;

use lanemap_core::{TimestampNs, fleet::CellId};
use lanemap_proto::v1;

use super::cell_features::{CellFeatures, NewFeature};
use crate::serve::{
    line::Coordinate,
    shared_lanes::{filtered, shared_lane},
};

/// The lines of a cell.
pub(super) fn features(cell: CellId, map: &Arc<v1::CellMap>) -> CellFeatures {
    let anchor = cell.anchor();
    let mut features = CellFeatures::new(cell, Arc::clone(map), None);
    for (index, lane) in map.lanes.iter().enumerate() {
        let Some(feature) = shared_lane(&anchor, map, lane) else { continue };
        let coordinates: Vec<Coordinate> = feature.geometry.parts().flatten().copied().collect();
        features.push(NewFeature {
            lane: index,
            within: 0,
            filtered: filtered(lane),
            seen: Some((TimestampNs(lane.first_seen_unix_ns), TimestampNs(lane.last_seen_unix_ns))),
            coordinates: &coordinates,
            text: serde_json::to_vec(&feature).unwrap_or_default(),
        });
    }
    features
}

/// Index of the feature of a name within its cell.
pub(in crate::serve) fn find(features: &CellFeatures, lane: &str, part: u32) -> Option<usize> {
    features.entries().iter().position(|entry| {
        features.map.lanes.get(entry.lane).is_some_and(|found| found.id == lane && found.part == part)
    })
}
