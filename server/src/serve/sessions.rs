//! `/sessions`: which drives there are, and the lanes of each.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::geometry::georeference::Wgs84;
use nalgebra::{Isometry3, Point3};
use prost::Message;
use serde::Serialize;

use super::{
    ServeState,
    entity_tag::EntityTag,
    extents::Extents,
    features::{Crs, rfc3339, session_lanes},
    in_background,
    line::{Coordinate, in_metres, rounded, written},
    link_base::LinkBase,
    problem::{Problem, repeated},
    query::{Parameters, parse_limit},
};
use crate::{
    fuse::localizing::Alignment,
    map_service::lane_map,
    session::{PublishedMap, SessionId, SessionState, SessionSummary, Sessions},
};

/// Media type of GeoJSON.
pub(super) const GEOJSON: &str = "application/geo+json";
/// Media type of protobuf.
pub(super) const PROTOBUF: &str = "application/x-protobuf";

/// A link to a related resource.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Link {
    pub rel: &'static str,
    #[serde(rename = "type")]
    pub media_type: &'static str,
    pub href: String,
}

/// Sessions of a page, where the query does not say.
const DEFAULT_LIMIT: usize = 1_000;
/// Most sessions of a page.
const MOST_SESSIONS: usize = 10_000;

/// A page of sessions, the newest first.
#[derive(Serialize)]
struct SessionList {
    /// Number of sessions, on all pages.
    total: usize,
    sessions: Vec<Entry>,
    links: Vec<Link>,
}

/// One session of the list.
#[derive(Serialize)]
struct Entry {
    id: String,
    state: SessionState,
    /// Grows with every frame, and with the clean-up of a map whose drive is over; the same version has the same map.
    version: u64,
    lanes: usize,
    frames: u64,
    /// Whether the session has a place on the earth; without one, the members below are metres of its map frame.
    georeferenced: bool,
    /// Whether it is in the shared map: `shared map`, `own frame` without a place on the earth, or `kept apart` where it
    /// fits no other drive, or not in one place only.
    placement: &'static str,
    /// Whether it was found on the shared map, of a session without a place on the earth of its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    aligned_to_map: Option<AlignedToMap>,
    #[serde(skip_serializing_if = "Option::is_none")]
    last_frame_at: Option<String>,
    /// West, south, east and north border of its lanes.
    #[serde(skip_serializing_if = "Option::is_none")]
    bbox: Option<[f64; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    vehicle: Option<Vehicle>,
    links: Vec<Link>,
}

/// What came of the search for a session without GNSS on the shared map.
#[derive(Debug, PartialEq, Serialize)]
struct AlignedToMap {
    /// `aligned`, `own_frame`, `not_unique` or `no_fit`.
    state: &'static str,
    /// The same in words.
    why: &'static str,
    /// Standard deviation of its place on the map in the worst direction, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma_m: Option<f64>,
    /// Way of it that lies on the map, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    way_m: Option<f64>,
}

impl AlignedToMap {
    fn new(alignment: Alignment) -> Self {
        let of = |state, why| Self { state, why, sigma_m: None, way_m: None };
        match alignment {
            Alignment::OwnFrame => of("own_frame", "it has no GNSS, and is too short to be sought on the map"),
            Alignment::MapTooLarge => of("own_frame", "the map has more line than max_localization_km"),
            Alignment::Straight => {
                of("not_unique", "its road does not bend enough to tell where along it the drive is")
            }
            Alignment::NotUnique => of("not_unique", "it fits in more than one place of the map"),
            Alignment::NoFit => of("no_fit", "it fits nowhere on the map"),
            Alignment::Aligned { sigma_m, way_m } => Self {
                sigma_m: Some(rounded(sigma_m, 1e3)),
                way_m: Some(rounded(way_m, 10.0)),
                ..of("aligned", "its lanes fit the map in one place only")
            },
        }
    }
}

/// Where the vehicle of a session was at its last frame. It has no name here.
#[derive(Debug, PartialEq, Serialize)]
pub(super) struct Vehicle {
    pub(super) position: Coordinate,
    /// Clockwise from north, or from the y axis of the map frame, degrees in `[0, 360)`.
    pub(super) heading_deg: f64,
}

/// `GET /sessions`
pub(super) async fn list(
    State(state): State<ServeState>,
    State(extents): State<Extents>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = Parameters::read(&uri, &["limit", "after"])?;
    let limit = parameters.get("limit", |text| parse_limit(text, MOST_SESSIONS))?.unwrap_or(DEFAULT_LIMIT);
    let after = parameters.get("after", |text| text.parse::<SessionId>().map_err(|error| error.to_string()))?;
    let all = state.sessions.list();
    let total = all.len();
    let older = all.into_iter().rev().filter(|map| after.is_none_or(|after| map.session < after));
    let mut maps: Vec<_> = older.take(limit + 1).collect();
    let more = maps.len() > limit;
    maps.truncate(limit);

    let cells = state.map.list();
    let kept_apart: BTreeSet<SessionId> =
        cells.iter().flat_map(|(_, record)| record.kept_apart.iter().copied()).collect();
    let aligned: BTreeMap<SessionId, AlignedToMap> = maps
        .iter()
        .filter(|map| map.georeference.is_none())
        .map(|map| (map.session, AlignedToMap::new(state.map.alignment(&map.session))))
        .collect();
    let part = |map: &Arc<SessionSummary>| {
        let alignment = aligned.get(&map.session).map(|aligned| (aligned.why, aligned.way_m.map(f64::to_bits)));
        (identity(map), map.state as u8, kept_apart.contains(&map.session), alignment)
    };
    let parts: Vec<_> = maps.iter().map(part).collect();
    let tag = EntityTag::of((total, limit, more, parts, &base));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let page = in_background(move || {
        let mut aligned = aligned;
        let sessions: Vec<_> =
            maps.iter().map(|map| entry(map, &extents, &kept_apart, aligned.remove(&map.session), &base)).collect();
        let last = sessions.last().filter(|_| more);
        let next = last.map(|last| Link {
            rel: "next",
            media_type: "application/json",
            href: base.link(&format!("/sessions?limit={limit}&after={}", last.id)),
        });
        SessionList { total, links: next.into_iter().collect(), sessions }
    });
    Ok(tag.on(Json(page.await?)))
}

/// What tells one version of one session's map from all others.
pub(super) fn identity(map: &SessionSummary) -> (u64, u64, bool) {
    (u64::from_be_bytes(map.session.to_key()), map.version.0, map.georeference.is_some())
}

fn entry(
    map: &SessionSummary,
    extents: &Extents,
    kept_apart: &BTreeSet<SessionId>,
    aligned_to_map: Option<AlignedToMap>,
    base: &LinkBase,
) -> Entry {
    let path = base.link(&format!("/sessions/{}", map.session));
    let link = |rel, media_type, tail: &str| Link { rel, media_type, href: format!("{path}/{tail}") };
    let mut links = vec![
        link("lanes-local", GEOJSON, "lanes.geojson?crs=local"),
        link("trace-local", GEOJSON, "trace.geojson?crs=local"),
        link("splines", PROTOBUF, "lanes.pb"),
        Link { rel: "viewer", media_type: "text/html", href: base.link(&format!("/viewer?session={}", map.session)) },
    ];
    if map.georeference.is_some() {
        links.insert(0, link("lanes", GEOJSON, "lanes.geojson"));
        links.insert(1, link("trace", GEOJSON, "trace.geojson"));
    }
    Entry {
        id: map.session.to_string(),
        state: map.state,
        version: map.version.0,
        lanes: map.lanes,
        frames: map.frames(),
        georeferenced: map.georeference.is_some(),
        placement: match &aligned_to_map {
            Some(aligned) if aligned.state != "aligned" => "own frame",
            _ if kept_apart.contains(&map.session) => "kept apart",
            _ => "shared map",
        },
        aligned_to_map,
        last_frame_at: map.last_sequence.map(|_| rfc3339(map.last_time)),
        bbox: border(map, extents),
        vehicle: map.last_sequence.map(|_| vehicle(map)),
        links,
    }
}

fn border(map: &SessionSummary, extents: &Extents) -> Option<[f64; 4]> {
    if map.georeference.is_some() {
        return extents.of(map).map(|bounds| bounds.to_array());
    }
    let [low, high] = map.extent?.map(|corner| in_metres(&corner));
    Some([low[0], low[1], high[0], high[1]])
}

pub(super) fn vehicle(map: &SessionSummary) -> Vehicle {
    let Some(georeference) = &map.georeference else {
        let (east, north) = forward(&map.map_from_vehicle);
        return Vehicle { position: in_metres(&origin(&map.map_from_vehicle)), heading_deg: heading_deg(east, north) };
    };
    // Heading from two places a metre apart: away from the anchor, north is not the anchor's.
    let place = |ahead_m: f64| georeference.to_wgs84(&(map.map_from_vehicle * Point3::new(ahead_m, 0.0, 0.0)));
    let (here, ahead) = (place(0.0), place(1.0));
    Vehicle { position: written(here), heading_deg: bearing_deg(&here, &ahead) }
}

fn origin(map_from_vehicle: &Isometry3<f64>) -> Point3<f64> {
    map_from_vehicle.translation.vector.into()
}

fn forward(map_from_vehicle: &Isometry3<f64>) -> (f64, f64) {
    let ahead = map_from_vehicle.rotation * nalgebra::Vector3::x();
    (ahead.x, ahead.y)
}

/// Direction from one place to another near by, clockwise from north, degrees in `[0, 360)`.
pub(super) fn bearing_deg(from: &Wgs84, to: &Wgs84) -> f64 {
    let across = to.longitude_deg - from.longitude_deg;
    let east = (across - 360.0 * (across / 360.0).round()) * from.latitude_deg.to_radians().cos();
    heading_deg(east, to.latitude_deg - from.latitude_deg)
}

/// Direction of a vector, clockwise from north, degrees in `[0, 360)`.
pub(super) fn heading_deg(east: f64, north: f64) -> f64 {
    rounded(east.atan2(north).to_degrees().rem_euclid(360.0), 10.0) % 360.0
}

/// `GET /sessions/{id}/lanes.geojson`
pub(super) async fn lanes_geojson(
    State(state): State<ServeState>,
    base: LinkBase,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let crs = Parameters::read(&uri, &["crs"])?.get("crs", Crs::parse)?.unwrap_or(Crs::Wgs84);
    let map = find(&state.sessions, &id).await?;
    if crs == Crs::Wgs84 && map.georeference.is_none() {
        let local = base.link(&format!("/sessions/{}/lanes.geojson?crs=local", map.session));
        return Err(Problem::NotGeoreferenced { session: map.session, local });
    }
    let tag = EntityTag::of((identity(&map), crs));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let body = in_background(move || session_lanes(&map, crs).map(|lanes| serde_json::to_vec(&lanes))).await?;
    let body = body.and_then(Result::ok).ok_or(Problem::Internal)?;
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body)))
}

/// `GET /sessions/{id}/lanes.pb`
pub(super) async fn lanes_protobuf(
    State(state): State<ServeState>,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let map = find(&state.sessions, &id).await?;
    let tag = EntityTag::of(identity(&map));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let body = in_background(move || lane_map(&map).encode_to_vec()).await?;
    Ok(tag.on(([(header::CONTENT_TYPE, PROTOBUF)], body)))
}

/// The map of a session; where the session sleeps, it is read from the store.
pub(super) async fn find(sessions: &Sessions, id: &str) -> Result<Arc<PublishedMap>, Problem> {
    let found = match id.parse() {
        Ok(session) => {
            let sessions = sessions.clone();
            in_background(move || sessions.get(&session)).await?
        }
        Err(_) => None,
    };
    found.ok_or_else(|| Problem::NoSuchSession { session: repeated(id) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::sample::{georeference, placed, published};

    #[test]
    fn a_vehicle_that_drives_along_an_axis_that_points_north_heads_north() {
        let map = published(1, 1);
        assert_eq!(vehicle(&map), Vehicle { position: [10.0, 1.0, 0.0], heading_deg: 90.0 });
        let map = placed(map, georeference(-170.0, 60.0));
        let on_the_earth = vehicle(&map);
        assert!(on_the_earth.heading_deg.min(360.0 - on_the_earth.heading_deg) < 0.1, "{on_the_earth:?}");
    }

    #[test]
    fn an_entry_of_the_list_has_the_border_of_its_lanes() {
        let map = published(1, 2);
        let local = border(&map, &Extents::default()).unwrap();
        assert!(local[0].abs() < 1e-9 && local[2] > 50.0, "{local:?}");
        let map = placed(map, georeference(11.58, 48.14));
        let [west, south, east, north] = border(&map, &Extents::default()).unwrap();
        assert!(west < east && east <= 11.58 && (48.14..48.141).contains(&north) && south < north);
    }

    #[test]
    fn a_session_that_has_seen_no_frame_has_neither_border_nor_vehicle() {
        let mut map = published(1, 0);
        map.summary.last_sequence = None;
        let entry =
            serde_json::to_value(entry(&map, &Extents::default(), &BTreeSet::new(), None, &LinkBase::of_path("")))
                .unwrap();
        assert!(entry.get("bbox").is_none() && entry.get("vehicle").is_none());
        assert_eq!(entry["state"], "live");
    }
}
