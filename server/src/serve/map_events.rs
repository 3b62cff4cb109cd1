//! `/events`: what happened to the road, and to the names of lines, in all cells, the newest first, as GeoJSON.

use std::cmp::Reverse;

use axum::{
    extract::State,
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::fleet::CellId;
use serde::Serialize;

use super::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    events::{EventFeature, feature, parse_since, places},
    in_background,
    items::of_cell,
    ogc::{DEFAULT_FEATURES, MOST_FEATURES},
    problem::Problem,
    query::{Parameters, parse_limit},
    sessions::GEOJSON,
};
use crate::{
    fuse::{
        CellVersion, MapRevision, SharedMap,
        events::{CellEvent, EVENT_KINDS},
    },
    journal::JournalError,
};

/// The newest events.
#[derive(Serialize)]
#[serde(tag = "type", rename = "FeatureCollection")]
struct Newest {
    revision: MapRevision,
    #[serde(rename = "numberReturned")]
    number_returned: usize,
    /// Whether there are older ones: ask for a smaller box, or for more.
    more: bool,
    features: Vec<EventFeature>,
}

/// Which events.
struct Asked {
    since: MapRevision,
    bounds: Option<Bounds>,
    kinds: Vec<&'static str>,
    limit: usize,
}

/// `GET /events`
pub(super) async fn events(State(state): State<ServeState>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let parameters = Parameters::read(&uri, &["since", "bbox", "kind", "limit"])?;
    let asked = Asked {
        since: parameters.get("since", parse_since)?.unwrap_or_default(),
        bounds: parameters.get("bbox", Bounds::parse)?,
        kinds: parameters.get("kind", parse_kinds)?.unwrap_or_else(|| EVENT_KINDS.to_vec()),
        limit: parameters.get("limit", |text| parse_limit(text, MOST_FEATURES))?.unwrap_or(DEFAULT_FEATURES),
    };
    let map = state.map;
    let (revision, cells) = map.list_with_revision();
    let is_wanted = |cell: &CellId| asked.bounds.is_none_or(|bounds| of_cell(*cell).touches(&bounds));
    let telling: Vec<(CellId, CellVersion)> = cells
        .into_iter()
        .filter(|(cell, record)| record.told_in > CellVersion(0) && is_wanted(cell))
        .map(|(cell, record)| (cell, record.told_in))
        .collect();
    let tag = EntityTag::of((&telling, uri.query()));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let told = in_background(move || newest(&map, &telling, revision, &asked)).await??;
    let body = serde_json::to_vec(&told).map_err(|_| Problem::Internal)?;
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body)))
}

fn parse_kinds(text: &str) -> Result<Vec<&'static str>, String> {
    let known = |name: &str| EVENT_KINDS.into_iter().find(|kind| *kind == name);
    let kinds: Option<Vec<_>> = text.split(',').map(known).collect();
    kinds.ok_or_else(|| format!("it must be some of {}, separated by commas", EVENT_KINDS.join(", ")))
}

fn newest(
    map: &SharedMap,
    cells: &[(CellId, CellVersion)],
    revision: MapRevision,
    asked: &Asked,
) -> Result<Newest, JournalError> {
    let mut found: Vec<(CellId, CellEvent)> = Vec::new();
    let mut more = false;
    for (cell, _) in cells {
        let events = map.events(*cell)?.into_iter().filter(|event| asked.wants(*cell, event));
        found.extend(events.map(|event| (*cell, event)));
        more |= keep_newest(&mut found, asked.limit, 2 * asked.limit);
    }
    more |= keep_newest(&mut found, asked.limit, asked.limit);
    found.sort_by_key(in_order);
    let features: Vec<_> = found.into_iter().map(|(cell, event)| feature(cell, event)).collect();
    Ok(Newest { revision, number_returned: features.len(), more, features })
}

/// Lets go of all but the newest, where there are more than so many; says whether it did.
fn keep_newest(found: &mut Vec<(CellId, CellEvent)>, newest: usize, most: usize) -> bool {
    if found.len() <= most {
        return false;
    }
    found.sort_by_key(in_order);
    found.truncate(newest);
    true
}

fn in_order((cell, event): &(CellId, CellEvent)) -> (Reverse<MapRevision>, CellId, u64) {
    (Reverse(event.revision), *cell, event.number)
}

impl Asked {
    fn wants(&self, cell: CellId, event: &CellEvent) -> bool {
        let is_there = |bounds: Bounds| event.xyz_mm.is_empty() || bounds.is_entered_by(&places(cell, event));
        event.revision > self.since && self.kinds.contains(&event.kind.name()) && self.bounds.is_none_or(is_there)
    }
}
