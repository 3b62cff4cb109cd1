//! A cell as its canonical bytes, and what differs between two versions of it.
//!
//! Geometry is rounded to millimetres, so that equal maps have equal bytes and what moved by less is no change.
//! `snapshot(v) + changes(v, w) = snapshot(w)`, byte for byte: lanes are encoded whole, in the order of their names.

use std::{
    cmp::Ordering,
    collections::{BTreeMap, BTreeSet},
};

use lanemap_core::{TimestampNs, fleet::CellId, geometry::georeference::Wgs84};
use lanemap_proto::{
    cell_map::{LaneKey, lane_key},
    encode, v1,
};
use nalgebra::Point3;
use prost::Message;

use super::border::{Join, JoinedPiece, PieceName};

pub use lanemap_proto::{
    cell_map::apply,
    lane_name::{lane_id_text, parse_lane_id},
};

/// A cell in which nothing is.
#[must_use]
pub fn empty_cell(cell: CellId) -> v1::CellMap {
    v1::CellMap { cell: cell.to_string(), version: 0, anchor: Some(anchor(cell)), lanes: vec![] }
}

/// The lanes of a cell as they go over the wire, in their order.
pub(crate) fn lanes(pieces: &[JoinedPiece]) -> Vec<v1::FusedLane> {
    let mut lanes: Vec<v1::FusedLane> = pieces.iter().map(lane).collect();
    lanes.sort_by(in_order);
    lanes
}

/// The changes that make `after` of `before`, two versions of one cell.
#[must_use]
pub fn changes(before: &v1::CellMap, after: &v1::CellMap) -> v1::CellChanges {
    let known: BTreeMap<LaneKey, &v1::FusedLane> = before.lanes.iter().map(|lane| (lane_key(lane), lane)).collect();
    let kept: BTreeSet<LaneKey> = after.lanes.iter().map(lane_key).collect();
    // Compared as bytes: NaN never occurs, but -0.0 and 0.0 would pass for equal.
    let is_new = |lane: &&v1::FusedLane| {
        known.get(&lane_key(lane)).is_none_or(|before| before.encode_to_vec() != lane.encode_to_vec())
    };
    let removed = known.keys().filter(|key| !kept.contains(*key)).map(|(id, part)| v1::LaneName {
        cell: after.cell.clone(),
        id: id.clone(),
        part: *part,
    });
    v1::CellChanges {
        cell: after.cell.clone(),
        from_version: before.version,
        to_version: after.version,
        anchor: after.anchor,
        upserted: after.lanes.iter().filter(is_new).cloned().collect(),
        removed: removed.collect(),
    }
}

/// Control points of a lane, cell frame, metres.
#[must_use]
pub fn positions(lane: &v1::FusedLane) -> Vec<Point3<f64>> {
    let mut at_mm = [0_i64; 3];
    let points = lane.xyz_mm.chunks_exact(3).map(|step| {
        at_mm.iter_mut().zip(step).for_each(|(at, step)| *at += i64::from(*step));
        let [x, y, z] = at_mm.map(|mm| mm as f64 * 1e-3);
        Point3::new(x, y, z)
    });
    points.collect()
}

/// The origin of a cell's frame.
fn anchor(cell: CellId) -> v1::GeodeticPosition {
    place(&cell.anchor().place())
}

fn place(place: &Wgs84) -> v1::GeodeticPosition {
    v1::GeodeticPosition {
        latitude_deg: place.latitude_deg,
        longitude_deg: place.longitude_deg,
        height_m: place.height_m,
    }
}

pub(crate) fn in_order(a: &v1::FusedLane, b: &v1::FusedLane) -> Ordering {
    a.id.cmp(&b.id).then(a.part.cmp(&b.part))
}

fn lane(JoinedPiece { piece, begins_at, ends_at }: &JoinedPiece) -> v1::FusedLane {
    let points = &piece.points;
    v1::FusedLane {
        id: lane_id_text(&piece.name.lane),
        part: piece.name.part,
        category: encode::category(piece.category).into(),
        category_posterior_permille: piece.category_posterior.iter().map(|share| thousandths(*share)).collect(),
        xyz_mm: steps_mm(points.iter().map(|point| point.position)),
        lateral_sigma_mm: points.iter().map(|point| thousandths(point.lateral_sigma_m)).collect(),
        height_sigma_mm: points.iter().map(|point| thousandths(point.height_sigma_m)).collect(),
        drives_at: points.iter().map(|point| point.drives).collect(),
        existence_permille: points.iter().map(|point| thousandths(point.existence)).collect(),
        drives: piece.drives,
        observations: piece.observations,
        first_seen_unix_ns: piece.first_seen.0,
        last_seen_unix_ns: piece.last_seen.0,
        begins_at: begins_at.as_ref().map(border),
        ends_at: ends_at.as_ref().map(border),
        confirmed_after_s: points.iter().map(|point| whole_seconds(piece.first_seen, point.confirmed)).collect(),
    }
}

fn whole_seconds(from: TimestampNs, to: TimestampNs) -> i64 {
    to.0.saturating_sub(from.0).div_euclid(1_000_000_000)
}

fn border(join: &Join) -> v1::LaneBorder {
    let name = |(cell, PieceName { lane, part }): (CellId, PieceName)| v1::LaneName {
        cell: cell.to_string(),
        id: lane_id_text(&lane),
        part,
    };
    v1::LaneBorder { place: Some(place(&join.place)), continues_in: join.continues_in.map(name) }
}

pub(super) fn steps_mm(points: impl Iterator<Item = Point3<f64>>) -> Vec<i32> {
    let mut before = [0_i32; 3];
    let mut steps = Vec::new();
    for point in points {
        let at = [point.x, point.y, point.z].map(millimetres);
        steps.extend(at.iter().zip(before).map(|(at, before)| at.saturating_sub(before)));
        before = at;
    }
    steps
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "a cell is some kilometres wide; the cast saturates beyond 2 147 km"
)]
fn millimetres(metres: f64) -> i32 {
    (metres * 1e3).round() as i32
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "not negative; the cast saturates")]
fn thousandths(value: f64) -> u32 {
    (value * 1e3).round() as u32
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn cell_map(version: u64, lanes: &BTreeMap<u8, i32>) -> v1::CellMap {
        let lanes = lanes.iter().map(|(number, x)| v1::FusedLane {
            id: format!("lane-{number:03}"),
            xyz_mm: vec![*x, 0, 0, 3_000, 0, 0],
            ..v1::FusedLane::default()
        });
        let cell = CellId::new(8_718, 5_685).unwrap();
        v1::CellMap { version, lanes: lanes.collect(), ..empty_cell(cell) }
    }

    proptest! {
        #[test]
        fn a_version_and_its_changes_give_the_bytes_of_the_next(
            before in prop::collection::btree_map(0_u8..40, -5..5, 0..30),
            after in prop::collection::btree_map(0_u8..40, -5..5, 0..30),
        ) {
            let (before, after) = (cell_map(3, &before), cell_map(8, &after));
            let changes = changes(&before, &after);
            prop_assert_eq!(apply(&before, &changes).encode_to_vec(), after.encode_to_vec());
            let unchanged = after.lanes.iter().filter(|lane| before.lanes.contains(lane)).count();
            prop_assert_eq!(changes.upserted.len(), after.lanes.len() - unchanged);
        }

        #[test]
        fn control_points_come_back_to_half_a_millimetre(points in prop::collection::vec(
            prop::array::uniform3(-3e3..3e3f64), 2..20,
        )) {
            let points: Vec<Point3<f64>> = points.into_iter().map(Point3::from).collect();
            let lane = v1::FusedLane { xyz_mm: steps_mm(points.iter().copied()), ..v1::FusedLane::default() };
            for (point, decoded) in points.iter().zip(positions(&lane)) {
                prop_assert!((point - decoded).amax() <= 0.5e-3 + 1e-9);
            }
        }
    }
}
