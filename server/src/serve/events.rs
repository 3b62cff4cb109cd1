//! `/cells/{id}/events`: what happened to the road of a cell, and to the names of its lines, as GeoJSON.

use axum::{
    extract::{Path, State},
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::{Category, TimestampNs, fleet::CellId};
use serde::Serialize;

use super::{
    ServeState,
    cells::known,
    entity_tag::EntityTag,
    features::{category_name, rfc3339},
    in_background,
    line::{Coordinate, written},
    link_base::LinkBase,
    ogc::{DEFAULT_FEATURES, MOST_FEATURES},
    problem::Problem,
    query::{Parameters, parse_limit, whole_number},
    sessions::{GEOJSON, Link},
};
use crate::fuse::{
    MapRevision,
    events::{CellEvent, EventKind},
};

/// A page of events, in the order of their numbers.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "FeatureCollection")]
struct Page {
    cell: String,
    #[serde(rename = "numberReturned")]
    number_returned: usize,
    links: Vec<Link>,
    features: Vec<EventFeature>,
}

/// One event.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "Feature")]
pub(super) struct EventFeature {
    id: String,
    /// Where the line is now, or was; none for names.
    geometry: Option<LineString>,
    properties: EventProperties,
}

#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "LineString")]
struct LineString {
    coordinates: Vec<Coordinate>,
}

/// What is known of an event.
#[derive(Debug, Serialize)]
struct EventProperties {
    kind: &'static str,
    cell: String,
    /// The revision of the map, and the version of the cell, that told of it, or of its withdrawal.
    revision: MapRevision,
    version: u64,
    told_at: String,
    /// It is believed no more.
    withdrawn: bool,
    /// The line; where it moved, the new one.
    lane: String,
    /// What bears its paint now, where its name went.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    into: Vec<String>,
    /// How far it moved, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    moved_m: Option<f64>,
    /// Where it was repainted, that of the stretch since then.
    category: &'static str,
    /// What it was before it was repainted.
    #[serde(skip_serializing_if = "Option::is_none")]
    category_before: Option<&'static str>,
    /// Probability that it happened.
    probability: f64,
    /// Start of the drive that was the last to be needed to believe it.
    #[serde(skip_serializing_if = "Option::is_none")]
    noticed: Option<String>,
    /// Drives that saw the line.
    drives: u32,
}

/// `GET /cells/{id}/events`
pub(super) async fn events(
    State(state): State<ServeState>,
    base: LinkBase,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = Parameters::read(&uri, &["since", "limit", "after"])?;
    let since = parameters.get("since", parse_since)?.unwrap_or_default();
    let limit = parameters.get("limit", |text| parse_limit(text, MOST_FEATURES))?.unwrap_or(DEFAULT_FEATURES);
    let number = |text: &str| whole_number(text).ok_or_else(|| "it must be the number of an event".to_owned());
    let after = parameters.get("after", number)?.unwrap_or(0);
    let (cell, _) = known(&state.map, &id)?;
    let map = state.map.clone();
    let mut events = in_background(move || map.events(cell)).await??;
    events.retain(|event| event.number > after && event.revision > since);
    let more = events.len() > limit;
    events.truncate(limit);
    let parts: Vec<_> = events.iter().map(|event| (event.number, event.revision)).collect();
    let tag = EntityTag::of((cell, since, limit, more, parts, &base));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let next = events.last().filter(|_| more).map(|last| Link {
        rel: "next",
        media_type: GEOJSON,
        href: base.link(&format!("/cells/{cell}/events?since={since}&limit={limit}&after={}", last.number)),
    });
    let page = Page {
        cell: cell.to_string(),
        number_returned: events.len(),
        links: next.into_iter().collect(),
        features: events.into_iter().map(|event| feature(cell, event)).collect(),
    };
    let body = serde_json::to_vec(&page).map_err(|_| Problem::Internal)?;
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body)))
}

/// Reads the revision of the map after which events are told.
pub(super) fn parse_since(text: &str) -> Result<MapRevision, String> {
    let since = whole_number(text).filter(|since| i64::try_from(*since).is_ok());
    since.map(MapRevision).ok_or_else(|| format!("it must be a revision of the map, a whole number up to {}", i64::MAX))
}

/// Where an event happened, on the earth; nowhere of names.
pub(super) fn places(cell: CellId, event: &CellEvent) -> Vec<Coordinate> {
    let anchor = cell.anchor();
    event.points().iter().map(|point| written(anchor.wgs84_from_enu(point))).collect()
}

/// An event as a feature.
pub(super) fn feature(cell: CellId, event: CellEvent) -> EventFeature {
    let named = |code: i32| {
        let code = u8::try_from(code).unwrap_or_default();
        category_name(Category::from_openlane_code(code).unwrap_or_default())
    };
    let id = format!("{cell}.event.{}", event.number);
    let coordinates = places(cell, &event);
    let told_at = i64::try_from(event.published_ms.saturating_mul(1_000_000)).unwrap_or(i64::MAX);
    let properties = EventProperties {
        kind: event.kind.name(),
        cell: cell.to_string(),
        revision: event.revision,
        version: event.version.0,
        told_at: rfc3339(TimestampNs(told_at)),
        withdrawn: event.withdrawn,
        lane: event.lane,
        into: event.into,
        moved_m: match event.kind {
            EventKind::Moved { by_mm } => Some(f64::from(by_mm) / 1e3),
            _ => None,
        },
        category: named(event.category),
        category_before: match event.kind {
            EventKind::Repainted { from } => Some(named(from)),
            _ => None,
        },
        probability: f64::from(event.probability_permille) / 1e3,
        noticed: event.noticed_unix_ns.map(|noticed| rfc3339(TimestampNs(noticed))),
        drives: event.drives,
    };
    EventFeature { id, geometry: (coordinates.len() > 1).then_some(LineString { coordinates }), properties }
}
