//! Cells of the shared map as messages: the order of their lines, and how changes apply to them.
//!
//! `snapshot(v) + changes(v, w) = snapshot(w)`, byte for byte: lanes are encoded whole, in the order of their names.

use std::collections::BTreeMap;

use crate::v1;

/// Key of a lane within its cell, by which lanes are ordered: its id, then which piece of it.
pub type LaneKey = (String, u32);

/// The key of a lane.
#[must_use]
pub fn lane_key(lane: &v1::FusedLane) -> LaneKey {
    (lane.id.clone(), lane.part)
}

/// Applies changes to the version that they were made from; an empty cell where that is version 0.
#[must_use]
pub fn apply(before: &v1::CellMap, changes: &v1::CellChanges) -> v1::CellMap {
    let mut lanes: BTreeMap<LaneKey, v1::FusedLane> =
        before.lanes.iter().map(|lane| (lane_key(lane), lane.clone())).collect();
    for name in &changes.removed {
        lanes.remove(&(name.id.clone(), name.part));
    }
    lanes.extend(changes.upserted.iter().map(|lane| (lane_key(lane), lane.clone())));
    v1::CellMap {
        cell: changes.cell.clone(),
        version: changes.to_version,
        anchor: changes.anchor,
        lanes: lanes.into_values().collect(),
    }
}
