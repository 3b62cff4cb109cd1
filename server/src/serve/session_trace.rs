//! `/sessions/{id}/trace.geojson`: where the vehicle of one drive was, and when.
//!
//! One feature, a `MultiPoint` with a point every few metres in the order of travel; `times_ms` and `headings_deg` have an
//! entry for each. It has no more of a drive than its map has: what a trip's ends keep back is not in it.

use axum::{
    extract::{Path, State},
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::geometry::georeference::Georeference;
use nalgebra::{Point3, Vector3};
use serde::Serialize;

use super::{
    ServeState,
    entity_tag::EntityTag,
    features::Crs,
    in_background,
    line::{Coordinate, in_metres, written},
    link_base::LinkBase,
    problem::Problem,
    query::Parameters,
    sessions::{GEOJSON, bearing_deg, find, heading_deg, identity},
};
use crate::session::{PublishedMap, WayPoint};

#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "Feature")]
struct Trace {
    id: String,
    geometry: Places,
    properties: Moments,
}

#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "MultiPoint")]
struct Places {
    coordinates: Vec<Coordinate>,
}

#[derive(Debug, Serialize)]
struct Moments {
    session: String,
    version: u64,
    /// Milliseconds since the Unix epoch, one of each place.
    times_ms: Vec<i64>,
    /// Clockwise from north, or from the y axis of the map frame, degrees in `[0, 360)`, one of each place.
    headings_deg: Vec<f64>,
}

/// `GET /sessions/{id}/trace.geojson`
pub(super) async fn trace_geojson(
    State(state): State<ServeState>,
    Path(id): Path<String>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let crs = Parameters::read(&uri, &["crs"])?.get("crs", Crs::parse)?.unwrap_or(Crs::Wgs84);
    let map = find(&state.sessions, &id).await?;
    if crs == Crs::Wgs84 && map.georeference.is_none() {
        let local = base.link(&format!("/sessions/{}/trace.geojson?crs=local", map.session));
        return Err(Problem::NotGeoreferenced { session: map.session, local });
    }
    let tag = EntityTag::of((identity(&map), crs));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let body = in_background(move || serde_json::to_vec(&trace(&map, crs))).await?;
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body.map_err(|_| Problem::Internal)?)))
}

fn trace(map: &PublishedMap, crs: Crs) -> Trace {
    let georeference = map.georeference.as_ref().filter(|_| crs == Crs::Wgs84);
    let placed = map.way.iter().map(|point| georeference.map_or_else(|| in_the_frame(point), |at| on_earth(point, at)));
    let (coordinates, headings_deg) = placed.unzip();
    Trace {
        id: format!("{}.trace", map.session),
        geometry: Places { coordinates },
        properties: Moments {
            session: map.session.to_string(),
            version: map.version.0,
            times_ms: map.way.iter().map(|point| point.time.0.div_euclid(1_000_000)).collect(),
            headings_deg,
        },
    }
}

fn in_the_frame(point: &WayPoint) -> (Coordinate, f64) {
    (in_metres(&point.position), heading_deg(point.yaw_rad.cos(), point.yaw_rad.sin()))
}

/// The heading is taken from two places a metre apart: away from the anchor, north is not the anchor's.
fn on_earth(point: &WayPoint, georeference: &Georeference) -> (Coordinate, f64) {
    let ahead: Point3<f64> = point.position + Vector3::new(point.yaw_rad.cos(), point.yaw_rad.sin(), 0.0);
    let (here, ahead) = (georeference.to_wgs84(&point.position), georeference.to_wgs84(&ahead));
    let heading_deg = bearing_deg(&here, &ahead);
    (written(here), heading_deg)
}

#[cfg(test)]
mod tests {
    use lanemap_core::{Frame, FrameLimits, FrameParts, Odometry, Sequence, TimestampNs, fleet, geometry::Pose};

    use super::*;
    use crate::{
        serve::sample::{georeference, placed, published},
        session::Way,
    };

    fn driven_along_x() -> PublishedMap {
        let mut way = fleet::Trace::default();
        for number in 0..3_u32 {
            let pose = Pose::translation(5.0 * f64::from(number), 0.0, 0.0);
            let odometry = Odometry { odometry_from_vehicle: pose, motion_covariance: None };
            let (sequence, time) = (Sequence(u64::from(number)), TimestampNs(i64::from(number) * 500_000_000));
            let parts = FrameParts { sequence, time, odometry, gnss: None, detections: vec![], occlusions: vec![] };
            way.observe(&Frame::new(parts, &FrameLimits::default()).unwrap(), &pose);
        }
        PublishedMap { way: Way::of(&way), ..published(1, 1) }
    }

    #[test]
    fn a_trace_says_of_every_place_when_the_vehicle_was_there_and_where_it_headed() {
        let local = trace(&driven_along_x(), Crs::Local);
        assert_eq!(local.geometry.coordinates, [[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [10.0, 0.0, 0.0]]);
        assert_eq!(local.properties.times_ms, [0, 500, 1_000]);
        assert_eq!(local.properties.headings_deg, [90.0; 3]);
    }

    #[test]
    fn a_drive_whose_x_axis_points_north_heads_north_on_the_earth() {
        let trace = trace(&placed(driven_along_x(), georeference(11.58, 48.14)), Crs::Wgs84);
        let north_m = (trace.geometry.coordinates[2][1] - 48.14) * 111_200.0;
        assert!((north_m - 10.0).abs() < 0.1, "{north_m}");
        assert!(trace.properties.headings_deg.iter().all(|heading| heading.min(360.0 - heading) < 0.1));
    }
}
