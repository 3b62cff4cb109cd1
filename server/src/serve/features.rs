//! Lanes as GeoJSON (RFC 7946): plain functions of a published map, without HTTP.
//!
//! On the earth, coordinates are WGS84 longitude, latitude and ellipsoidal height, as the RFC asks. In the map frame they
//! are metres, which the RFC allows among parties that agree; the collection then says so in its member `frame`.

use lanemap_core::{Category, MapLane, TimestampNs, spline::Curve};
use serde::Serialize;

use super::{
    bounds::Bounds,
    line::{self, Coordinate, rounded},
};
use crate::session::{PublishedMap, SessionId};

/// The frame in which coordinates are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Crs {
    /// WGS84 degrees; only for a georeferenced session.
    Wgs84,
    /// Metres in the session's own map frame.
    Local,
}

impl Crs {
    /// Reads the parameter `crs`.
    ///
    /// # Errors
    /// Any text but `wgs84` and `local`.
    pub fn parse(text: &str) -> Result<Self, String> {
        match text {
            "wgs84" => Ok(Self::Wgs84),
            "local" => Ok(Self::Local),
            _ => Err("it must be wgs84 or local".to_owned()),
        }
    }
}

/// One lane: a line with what is known of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename = "Feature")]
pub struct LaneFeature {
    /// Session and lane, joined by a dot: unique over all sessions.
    pub id: String,
    /// The line.
    pub geometry: LaneGeometry,
    /// What is known of it.
    pub properties: LaneProperties,
}

/// The line of a lane; in parts where the antimeridian cuts it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type")]
pub enum LaneGeometry {
    /// The usual lane.
    LineString {
        /// Its points in the direction of travel.
        coordinates: Vec<Coordinate>,
    },
    /// A lane over the antimeridian.
    MultiLineString {
        /// Its parts in the direction of travel.
        coordinates: Vec<Vec<Coordinate>>,
    },
}

impl LaneGeometry {
    /// The parts of the line, one for the usual lane.
    pub fn parts(&self) -> impl Iterator<Item = &[Coordinate]> {
        let parts = match self {
            Self::LineString { coordinates } => std::slice::from_ref(coordinates),
            Self::MultiLineString { coordinates } => coordinates.as_slice(),
        };
        parts.iter().map(Vec::as_slice)
    }

    /// Number of coordinates.
    #[must_use]
    pub fn size(&self) -> usize {
        self.parts().map(<[Coordinate]>::len).sum()
    }

    /// Whether any part enters a box.
    #[must_use]
    pub fn enters(&self, bounds: &Bounds) -> bool {
        self.parts().any(|part| bounds.is_entered_by(part))
    }
}

/// What is known of a lane.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LaneProperties {
    /// The session that drew it.
    pub session: String,
    /// Number of the lane within the session.
    pub lane: u64,
    /// Most probable category, in `snake_case`.
    pub category: &'static str,
    /// The category's code in OpenLane.
    pub category_code: u8,
    /// Probability that the line exists, in `[0, 1]`.
    pub existence: f64,
    /// Standard deviation of the line's position to its side, root mean square over its control points, metres.
    pub sigma_m: f64,
    /// Frames that saw it.
    pub observations: u32,
    /// Time of the first frame that saw it, RFC 3339.
    pub first_seen: String,
    /// Time of the last frame that saw it, RFC 3339.
    pub last_seen: String,
}

/// The lanes of one session.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename = "FeatureCollection")]
pub struct SessionLanes {
    /// The session.
    pub session: String,
    /// Version of its map.
    pub version: u64,
    /// The frame of the coordinates, where it is not WGS84.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame: Option<LocalFrame>,
    /// The lanes, in the order of their numbers.
    pub features: Vec<LaneFeature>,
}

/// The foreign member `frame`: says that coordinates are metres.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct LocalFrame {
    /// Name of the frame.
    pub name: &'static str,
    /// Unit of the coordinates.
    pub unit: &'static str,
    /// What the three coordinates are.
    pub axes: [&'static str; 3],
    /// Where the frame is defined.
    pub origin: &'static str,
}

/// The map frame of a session.
const MAP_FRAME: LocalFrame = LocalFrame {
    name: "map",
    unit: "metre",
    axes: ["x", "y", "z, up"],
    origin: "the odometry frame of this session's drive at its first frame",
};

/// The lanes of a session in one frame; `None` where degrees are asked of a session that has none.
#[must_use]
pub fn session_lanes(published: &PublishedMap, crs: Crs) -> Option<SessionLanes> {
    if crs == Crs::Wgs84 && published.georeference.is_none() {
        return None;
    }
    Some(SessionLanes {
        session: published.session.to_string(),
        version: published.version.0,
        frame: (crs == Crs::Local).then_some(MAP_FRAME),
        features: published.map.lanes.iter().filter_map(|lane| feature(published, lane, crs)).collect(),
    })
}

/// One lane as a feature; `None` where it draws no line, or where degrees are asked of a session that has none.
#[must_use]
pub fn feature(published: &PublishedMap, lane: &MapLane, crs: Crs) -> Option<LaneFeature> {
    let line = line::drawn(lane);
    if line.len() < 2 {
        return None;
    }
    let geometry = match crs {
        Crs::Local => LaneGeometry::LineString { coordinates: line.iter().map(line::in_metres).collect() },
        Crs::Wgs84 => {
            let georeference = published.georeference.as_ref()?;
            on_the_earth(line.iter().map(|point| line::on_the_earth(georeference, point)).collect())
        }
    };
    Some(LaneFeature { id: feature_id(published.session, lane), geometry, properties: properties(published, lane) })
}

pub(super) fn on_the_earth(line: Vec<Coordinate>) -> LaneGeometry {
    let mut parts = line::cut_at_antimeridian(line);
    match (parts.len(), parts.pop()) {
        (1, Some(coordinates)) => LaneGeometry::LineString { coordinates },
        (_, last) => LaneGeometry::MultiLineString { coordinates: parts.into_iter().chain(last).collect() },
    }
}

/// The feature id of a lane.
#[must_use]
pub fn feature_id(session: SessionId, lane: &MapLane) -> String {
    format!("{session}.{}", lane.id.0)
}

fn properties(published: &PublishedMap, lane: &MapLane) -> LaneProperties {
    LaneProperties {
        session: published.session.to_string(),
        lane: lane.id.0,
        category: category_name(lane.category),
        category_code: lane.category.openlane_code(),
        existence: rounded(lane.existence, 1e3),
        sigma_m: rounded(lateral_sigma_m(lane), 1e3),
        observations: lane.observations,
        first_seen: rfc3339(lane.first_seen),
        last_seen: rfc3339(lane.last_seen),
    }
}

/// Root mean square over the control points of the standard deviation across the line, in the plane, metres.
fn lateral_sigma_m(lane: &MapLane) -> f64 {
    let points = lane.control_points.as_slice();
    let Some(curve) = Curve::new(points, lane.ends) else { return 0.0 };
    let variances = points.iter().enumerate().filter_map(|(index, point)| {
        let tangent = curve.derivative(index as f64);
        let across = nalgebra::Vector3::new(-tangent.y, tangent.x, 0.0).try_normalize(1e-9)?;
        Some(across.dot(&(point.covariance * across)).max(0.0))
    });
    let (count, sum) = variances.fold((0_u32, 0.0), |(count, sum), variance| (count + 1, sum + variance));
    if count == 0 { 0.0 } else { (sum / f64::from(count)).sqrt() }
}

/// A time as RFC 3339 writes it, in UTC.
#[must_use]
pub fn rfc3339(time: TimestampNs) -> String {
    const NS_PER_S: i64 = 1_000_000_000;
    let nanos = i32::try_from(time.0.rem_euclid(NS_PER_S)).unwrap_or_default();
    prost_types::Timestamp { seconds: time.0.div_euclid(NS_PER_S), nanos }.to_string()
}

/// A category as the wire protocol names it, without the prefix and in lower case.
#[must_use]
pub fn category_name(category: Category) -> &'static str {
    match category {
        Category::Unknown => "unknown",
        Category::WhiteDashed => "white_dashed",
        Category::WhiteSolid => "white_solid",
        Category::DoubleWhiteDashed => "double_white_dashed",
        Category::DoubleWhiteSolid => "double_white_solid",
        Category::WhiteLeftDashedRightSolid => "white_left_dashed_right_solid",
        Category::WhiteLeftSolidRightDashed => "white_left_solid_right_dashed",
        Category::YellowDashed => "yellow_dashed",
        Category::YellowSolid => "yellow_solid",
        Category::DoubleYellowDashed => "double_yellow_dashed",
        Category::DoubleYellowSolid => "double_yellow_solid",
        Category::YellowLeftDashedRightSolid => "yellow_left_dashed_right_solid",
        Category::YellowLeftSolidRightDashed => "yellow_left_solid_right_dashed",
        Category::LeftCurb => "left_curb",
        Category::RightCurb => "right_curb",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::sample::{georeference, placed, published};

    #[test]
    fn a_georeferenced_map_is_valid_geojson_in_degrees_with_heights() {
        let map = placed(published(1, 3), georeference(11.58, 48.14));
        let text = serde_json::to_string(&session_lanes(&map, Crs::Wgs84).unwrap()).unwrap();
        let collection: geojson::FeatureCollection = text.parse::<geojson::GeoJson>().unwrap().try_into().unwrap();
        assert_eq!(collection.features.len(), 3);
        assert!(collection.foreign_members.unwrap().get("frame").is_none());
        for feature in collection.features {
            let geojson::GeometryValue::LineString { coordinates } = feature.geometry.unwrap().value else {
                panic!("a lane is a line");
            };
            for place in coordinates {
                assert!((place[0] - 11.58).abs() < 0.01 && (place[1] - 48.14).abs() < 0.01, "{place:?}");
                assert!((place[2] - 520.0).abs() < 1.0);
            }
        }
    }

    #[test]
    fn degrees_of_a_session_without_gnss_are_none_and_its_metres_name_their_frame() {
        let map = published(1, 2);
        assert_eq!(session_lanes(&map, Crs::Wgs84), None);
        let local = session_lanes(&map, Crs::Local).unwrap();
        assert_eq!(local.frame.unwrap().unit, "metre");
        let LaneGeometry::LineString { coordinates } = &local.features[0].geometry else { panic!("a line") };
        let first = map.map.lanes[0].control_points[0].position;
        assert!((nalgebra::Point3::from(coordinates[0]) - first).norm() < 1e-3);
    }

    #[test]
    fn every_coordinate_has_at_most_seven_decimals() {
        let map = placed(published(1, 3), georeference(11.58, 48.14));
        let text = serde_json::to_string(&session_lanes(&map, Crs::Wgs84).unwrap()).unwrap();
        let longest = text
            .split(|c: char| !(c.is_ascii_digit() || c == '.'))
            .filter_map(|n| n.split_once('.'))
            .map(|(_, d)| d.len())
            .max();
        assert_eq!(longest, Some(7));
    }

    #[test]
    fn sigma_is_taken_across_the_line_and_not_along_it() {
        let mut map = published(1, 1);
        let mut lane = map.map.lanes[0].clone();
        for (i, point) in lane.control_points.iter_mut().enumerate() {
            point.position = nalgebra::Point3::new(3.0 * i as f64, 0.0, 0.0);
            point.covariance = nalgebra::Matrix3::from_diagonal(&nalgebra::Vector3::new(25.0, 0.04, 9.0));
        }
        map.map = std::sync::Arc::new(lanemap_core::LaneMap { lanes: vec![lane] });
        let sigma_m = session_lanes(&map, Crs::Local).unwrap().features[0].properties.sigma_m;
        assert!((sigma_m - 0.2).abs() < 1e-12);
    }

    #[test]
    fn a_category_is_named_as_the_wire_protocol_names_it() {
        for category in Category::ALL {
            let wire = format!("LANE_CATEGORY_{}", category_name(category).to_uppercase());
            let known = lanemap_proto::v1::LaneCategory::from_str_name(&wire);
            assert!(known.is_some() || category == Category::Unknown, "{wire}");
        }
    }

    #[test]
    fn times_before_and_after_the_epoch_are_written_in_utc() {
        assert_eq!(rfc3339(TimestampNs(1_700_000_000_100_000_000)), "2023-11-14T22:13:20.100Z");
        assert_eq!(rfc3339(TimestampNs(-1)), "1969-12-31T23:59:59.999999999Z");
    }
}
