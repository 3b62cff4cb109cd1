//! Lines of the shared map as GeoJSON: plain functions of a cell, without HTTP.

use lanemap_core::{
    Category, TimestampNs,
    fleet::CellId,
    geometry::georeference::{Anchor, Wgs84},
};
use lanemap_proto::v1;
use nalgebra::Point3;
use serde::Serialize;

use super::{
    bounds::Bounds,
    features::{LaneGeometry, category_name, on_the_earth, rfc3339},
    line::{Coordinate, drawn_through, rounded, written},
    ogc::filters::Filtered,
};
use crate::fuse::wire::positions;

/// One line within one cell, with what is known of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename = "Feature")]
pub(crate) struct SharedLane {
    /// Cell, line and part, joined by dots: unique over all cells.
    pub(crate) id: String,
    pub(crate) geometry: LaneGeometry,
    pub(crate) properties: SharedLaneProperties,
}

/// What is known of a line.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct SharedLaneProperties {
    /// Name of the line: the same in every cell and every version, as long as its oldest witness is.
    lane: String,
    /// The cell that it is cut to.
    cell: String,
    /// Which piece of the line within the cell.
    part: u32,
    /// Version of the cell.
    version: u64,
    /// Most probable category, in `snake_case`.
    category: &'static str,
    /// The category's code in OpenLane.
    category_code: u8,
    /// Probability of each category, in the order of the wire protocol's `LaneCategory`.
    category_posterior: Vec<f64>,
    /// Drives that saw some of it.
    drives: u32,
    /// Frames that saw some of it.
    observations: u64,
    /// Probability that the line is there, mean over its control points, in `[0, 1]`.
    existence: f64,
    /// Standard deviation across the line against the map around it, median over its control points, metres.
    lateral_sigma_m: f64,
    /// The same of its height, metres.
    height_sigma_m: f64,
    /// Time of the first frame that saw it, RFC 3339.
    first_seen: String,
    /// Time of the last frame that saw it, RFC 3339.
    last_seen: String,
    /// Start of the last drive that saw its stalest control point, RFC 3339.
    confirmed: String,
    /// The feature on the other side of the border from which the line comes.
    #[serde(skip_serializing_if = "Option::is_none")]
    comes_from: Option<String>,
    /// The feature on the other side of the border in which the line goes on.
    #[serde(skip_serializing_if = "Option::is_none")]
    continues_in: Option<String>,
}

/// The lines of one cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename = "FeatureCollection")]
pub(super) struct CellLanes {
    cell: String,
    version: u64,
    features: Vec<SharedLane>,
}

/// The lines of a cell, in their order.
pub(super) fn cell_lanes(cell: CellId, map: &v1::CellMap) -> CellLanes {
    let anchor = cell.anchor();
    let features = map.lanes.iter().filter_map(|lane| shared_lane(&anchor, map, lane)).collect();
    CellLanes { cell: map.cell.clone(), version: map.version, features }
}

/// One line of a cell as a feature; `None` where it draws nothing.
pub(crate) fn shared_lane(anchor: &Anchor, map: &v1::CellMap, lane: &v1::FusedLane) -> Option<SharedLane> {
    let coordinates = coordinates(anchor, lane);
    if coordinates.len() < 2 {
        return None;
    }
    let geometry = on_the_earth(coordinates);
    Some(SharedLane { id: feature_id(&map.cell, &lane.id, lane.part), geometry, properties: properties(map, lane) })
}

/// Whether a line of a cell enters a box.
pub(crate) fn enters(cell: CellId, lane: &v1::FusedLane, bounds: &Bounds) -> bool {
    let line = coordinates(&cell.anchor(), lane);
    line.len() > 1 && on_the_earth(line).enters(bounds)
}

/// The feature id of a piece of a line.
pub(super) fn feature_id(cell: &str, lane: &str, part: u32) -> String {
    format!("{cell}.{lane}.{part}")
}

/// Longitude, latitude and height along a line; its ends on a border are exact.
pub(super) fn coordinates(anchor: &Anchor, lane: &v1::FusedLane) -> Vec<Coordinate> {
    on_the_earth_with_ends(anchor, lane, &drawn_through(&positions(lane)))
}

/// The same of its control points.
pub(super) fn control_points(anchor: &Anchor, lane: &v1::FusedLane) -> Vec<Coordinate> {
    on_the_earth_with_ends(anchor, lane, &positions(lane))
}

/// The category of a line, where this build knows it.
pub(super) fn category(lane: &v1::FusedLane) -> Category {
    Category::from_openlane_code(u8::try_from(lane.category).unwrap_or_default()).unwrap_or_default()
}

/// What filters look at in a line: the same figures as in its properties.
pub(super) fn filtered(lane: &v1::FusedLane) -> Filtered {
    Filtered {
        category: category(lane),
        drives: lane.drives,
        existence: rounded(mean(&lane.existence_permille) / 1e3, 1e3),
        lateral_sigma_m: median(&lane.lateral_sigma_mm) / 1e3,
    }
}

fn on_the_earth_with_ends(anchor: &Anchor, lane: &v1::FusedLane, line: &[Point3<f64>]) -> Vec<Coordinate> {
    let mut coordinates: Vec<Coordinate> = line.iter().map(|point| written(anchor.wgs84_from_enu(point))).collect();
    for (border, end) in [(&lane.begins_at, coordinates.len().min(1)), (&lane.ends_at, coordinates.len())] {
        let place = border.as_ref().and_then(|border| border.place.as_ref());
        if let (Some(place), Some(end)) = (place, end.checked_sub(1)) {
            coordinates[end] = written(Wgs84 {
                latitude_deg: place.latitude_deg,
                longitude_deg: place.longitude_deg,
                height_m: place.height_m,
            });
        }
    }
    coordinates
}

fn properties(map: &v1::CellMap, lane: &v1::FusedLane) -> SharedLaneProperties {
    let Filtered { category, drives, existence, lateral_sigma_m } = filtered(lane);
    let beyond = |border: &Option<v1::LaneBorder>| {
        let name = border.as_ref()?.continues_in.as_ref()?;
        Some(feature_id(&name.cell, &name.id, name.part))
    };
    SharedLaneProperties {
        lane: lane.id.clone(),
        cell: map.cell.clone(),
        part: lane.part,
        version: map.version,
        category: category_name(category),
        category_code: category.openlane_code(),
        category_posterior: lane.category_posterior_permille.iter().map(|share| f64::from(*share) / 1e3).collect(),
        drives,
        observations: lane.observations,
        existence,
        lateral_sigma_m,
        height_sigma_m: median(&lane.height_sigma_mm) / 1e3,
        first_seen: rfc3339(TimestampNs(lane.first_seen_unix_ns)),
        last_seen: rfc3339(TimestampNs(lane.last_seen_unix_ns)),
        confirmed: rfc3339(TimestampNs(lane.first_seen_unix_ns.saturating_add(
            lane.confirmed_after_s.iter().min().map_or(0, |seconds| seconds.saturating_mul(1_000_000_000)),
        ))),
        comes_from: beyond(&lane.begins_at),
        continues_in: beyond(&lane.ends_at),
    }
}

fn mean(values: &[u32]) -> f64 {
    values.iter().map(|value| f64::from(*value)).sum::<f64>() / values.len().max(1) as f64
}

fn median(values: &[u32]) -> f64 {
    let mut values = values.to_vec();
    values.sort_unstable();
    values.get(values.len() / 2).map_or(0.0, |value| f64::from(*value))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fuse::wire::empty_cell;

    #[test]
    fn a_line_ends_exactly_where_its_border_point_lies() {
        let cell = CellId::new(8_718, 5_685).unwrap();
        let place = v1::GeodeticPosition { latitude_deg: 48.1, longitude_deg: 11.5, height_m: 512.25 };
        let lane = v1::FusedLane {
            id: "a-line".into(),
            category: 2,
            xyz_mm: vec![0, 0, 512_000, 3_000, 0, 0, 3_000, 0, 0],
            lateral_sigma_mm: vec![50, 70, 60],
            existence_permille: vec![900, 800, 850],
            ends_at: Some(v1::LaneBorder {
                place: Some(place),
                continues_in: Some(v1::LaneName { cell: "14-8719-5685".into(), id: "next".into(), part: 1 }),
            }),
            ..v1::FusedLane::default()
        };
        let map = v1::CellMap { lanes: vec![lane], version: 4, ..empty_cell(cell) };
        let lanes = cell_lanes(cell, &map);
        let feature = &lanes.features[0];
        let LaneGeometry::LineString { coordinates } = &feature.geometry else { panic!("a line") };
        assert_eq!(coordinates.last(), Some(&[11.5, 48.1, 512.25]));
        assert!((coordinates[0][1] - cell.anchor().place().latitude_deg).abs() < 1e-6);
        assert_eq!(feature.id, "14-8718-5685.a-line.0");
        let properties = serde_json::to_value(&feature.properties).unwrap();
        assert_eq!(properties["continues_in"], "14-8719-5685.next.1");
        assert_eq!((&properties["category"], &properties["lateral_sigma_m"]), (&"white_solid".into(), &0.06.into()));
        assert_eq!(properties["existence"], 0.85);
        assert!(properties.get("comes_from").is_none());
    }
}
