//! `/cells`: the cells of the shared map, their state and quality, their lines, and what changed in them.

use std::sync::Arc;

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::{TimestampNs, fleet::CellId};
use lanemap_proto::v1;
use prost::Message;
use serde::Serialize;

use super::{
    ServeState,
    entity_tag::EntityTag,
    features::rfc3339,
    in_background,
    items::of_cell,
    line::rounded,
    link_base::LinkBase,
    problem::{Problem, repeated},
    query::{Parameters, parse_limit, whole_number},
    sessions::{GEOJSON, Link, PROTOBUF},
    shared_lanes::{SharedLane, cell_lanes, feature_id, shared_lane},
};
use crate::fuse::{CellRecord, ChangesError, PublishedCell, SharedMap};

/// Cells of a page, where the query does not say.
const DEFAULT_LIMIT: usize = 1_000;
/// Most cells of a page.
const MOST_CELLS: usize = 10_000;

/// A page of cells, in the order of their columns, then of their rows.
#[derive(Serialize)]
struct CellList {
    /// Number of cells, on all pages.
    total: usize,
    /// Whether all that drives have said is in the map.
    settled: bool,
    cells: Vec<Entry>,
    links: Vec<Link>,
}

/// One cell of the list.
#[derive(Debug, Serialize)]
struct Entry {
    id: String,
    /// Grows with every change of the cell's lines; the same version has the same bytes.
    version: u64,
    /// Whether drives have said something that is not in it yet.
    dirty: bool,
    /// Drives that it was fused from.
    drives: u32,
    /// Those among them that fit no other, or not in one place only, and were left out.
    kept_apart: usize,
    /// Pieces of lines.
    lanes: u32,
    /// Length of all lines, kilometres.
    line_km: f64,
    /// Median of the standard deviations across the lines, metres; absent without lines.
    #[serde(skip_serializing_if = "Option::is_none")]
    median_lateral_sigma_m: Option<f64>,
    /// When it was fused last, RFC 3339.
    fused_at: String,
    /// Time that it took, seconds.
    fused_in_s: f64,
    /// West, south, east and north border.
    bbox: [f64; 4],
    links: Vec<Link>,
}

/// What changed, as GeoJSON.
#[derive(Serialize)]
pub(super) struct Changes {
    cell: String,
    pub(super) from_version: u64,
    to_version: u64,
    #[serde(flatten)]
    pub(super) lines: ChangedLines,
}

/// The lines that changed.
#[derive(Serialize)]
pub(super) struct ChangedLines {
    /// Features that are new or differ.
    upserted: Vec<SharedLane>,
    /// Ids of features that are no longer there.
    removed: Vec<String>,
}

/// `GET /cells`
pub(super) async fn list(
    State(state): State<ServeState>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = Parameters::read(&uri, &["limit", "after"])?;
    let limit = parameters.get("limit", |text| parse_limit(text, MOST_CELLS))?.unwrap_or(DEFAULT_LIMIT);
    let after = parameters.get("after", |text| text.parse::<CellId>().map_err(|error| error.to_string()))?;
    let settled = state.map.is_settled();
    let cells = state.map.list();
    let total = cells.len();
    let mut cells: Vec<_> = cells.into_iter().filter(|(cell, _)| after.is_none_or(|after| *cell > after)).collect();
    let more = cells.len() > limit;
    cells.truncate(limit);
    let parts: Vec<_> = cells.iter().map(|(cell, record)| identity(*cell, record, &state.map)).collect();
    let tag = EntityTag::of((total, settled, limit, more, parts, &base));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let entries: Vec<Entry> = cells.iter().map(|(cell, record)| entry(*cell, record, &state.map, &base)).collect();
    let next = entries.last().filter(|_| more).map(|last| Link {
        rel: "next",
        media_type: "application/json",
        href: base.link(&format!("/cells?limit={limit}&after={}", last.id)),
    });
    Ok(tag.on(Json(CellList { total, settled, links: next.into_iter().collect(), cells: entries })))
}

/// `GET /cells/{id}`
pub(super) async fn one(
    State(state): State<ServeState>,
    base: LinkBase,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let (cell, record) = known(&state.map, &id)?;
    let tag = EntityTag::of((identity(cell, &record, &state.map), &base));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    Ok(tag.on(Json(entry(cell, &record, &state.map, &base))))
}

/// `GET /cells/{id}/lanes.geojson`
pub(super) async fn lanes_geojson(
    State(state): State<ServeState>,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let (cell, published) = published(&state.map, &id).await?;
    let tag = EntityTag::of((cell, published.map.version));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let body = in_background(move || serde_json::to_vec(&cell_lanes(cell, &published.map))).await?;
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body.map_err(|_| Problem::Internal)?)))
}

/// `GET /cells/{id}/lanes.pb`
pub(super) async fn lanes_protobuf(
    State(state): State<ServeState>,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let (cell, published) = published(&state.map, &id).await?;
    let tag = EntityTag::of((cell, published.map.version));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    Ok(tag.on(([(header::CONTENT_TYPE, PROTOBUF)], published.bytes.clone())))
}

/// `GET /cells/{id}/changes`
pub(super) async fn changes_json(
    State(state): State<ServeState>,
    base: LinkBase,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let (cell, changes) = changes(&state.map, &base, &id, &uri).await?;
    let tag = EntityTag::of((cell, changes.from_version, changes.to_version));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    Ok(tag.on(Json(in_background(move || written(cell, changes)).await?)))
}

/// `GET /cells/{id}/changes.pb`
pub(super) async fn changes_protobuf(
    State(state): State<ServeState>,
    base: LinkBase,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let (cell, changes) = changes(&state.map, &base, &id, &uri).await?;
    let tag = EntityTag::of((cell, changes.from_version, changes.to_version));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    Ok(tag.on(([(header::CONTENT_TYPE, PROTOBUF)], changes.encode_to_vec())))
}

/// What tells one state of a cell from all others.
fn identity(cell: CellId, record: &CellRecord, map: &SharedMap) -> (CellId, u64, u64, bool) {
    (cell, record.version.0, record.fused_at_ms, map.is_dirty(cell))
}

fn entry(cell: CellId, record: &CellRecord, map: &SharedMap, base: &LinkBase) -> Entry {
    let id = cell.to_string();
    let link = |rel, media_type, tail: &str| Link { rel, media_type, href: base.link(&format!("/cells/{id}/{tail}")) };
    let fused_at = i64::try_from(record.fused_at_ms.saturating_mul(1_000_000)).unwrap_or(i64::MAX);
    Entry {
        version: record.version.0,
        dirty: map.is_dirty(cell),
        drives: record.drives,
        kept_apart: record.kept_apart.len(),
        lanes: record.lanes,
        line_km: rounded(record.line_m / 1e3, 1e3),
        median_lateral_sigma_m: (record.lanes > 0).then(|| rounded(record.median_lateral_sigma_m, 1e3)),
        fused_at: rfc3339(TimestampNs(fused_at)),
        fused_in_s: record.fused_in_ms as f64 / 1e3,
        bbox: of_cell(cell).to_array(),
        links: vec![
            link("lanes", GEOJSON, "lanes.geojson"),
            link("splines", PROTOBUF, "lanes.pb"),
            link("changes", "application/json", &format!("changes?since={}", record.version.0)),
        ],
        id,
    }
}

fn no_such_cell(id: &str) -> Problem {
    Problem::NoSuchCell { cell: repeated(id) }
}

/// A cell that is there.
pub(super) fn known(map: &SharedMap, id: &str) -> Result<(CellId, Arc<CellRecord>), Problem> {
    let cell = id.parse().map_err(|_| no_such_cell(id))?;
    Ok((cell, map.record(cell).ok_or_else(|| no_such_cell(id))?))
}

/// The newest version of a cell, read beside the runtime.
pub(super) async fn published(map: &SharedMap, id: &str) -> Result<(CellId, Arc<PublishedCell>), Problem> {
    let (cell, _) = known(map, id)?;
    let map = map.clone();
    let found = in_background(move || map.get(cell)).await??;
    Ok((cell, found.ok_or_else(|| no_such_cell(id))?))
}

async fn changes(map: &SharedMap, base: &LinkBase, id: &str, uri: &Uri) -> Result<(CellId, v1::CellChanges), Problem> {
    let version = |text: &str| whole_number(text).ok_or_else(|| "it must be a version, a whole number".to_owned());
    let since = Parameters::read(uri, &["since"])?.get("since", version)?.unwrap_or(0);
    let (cell, _) = known(map, id)?;
    let map = map.clone();
    let changes = in_background(move || map.changes_since(cell, since)).await?;
    let refused = |error: ChangesError| match error {
        ChangesError::NoSuchCell { .. } => no_such_cell(id),
        ChangesError::NotKept { .. } => {
            let whole = base.link(&format!("/cells/{cell}/lanes.pb"));
            Problem::VersionNotKept { reason: error.to_string(), whole }
        }
        ChangesError::Store(error) => error.into(),
    };
    Ok((cell, changes.map_err(refused)?))
}

/// Changes as GeoJSON.
pub(super) fn written(cell: CellId, changes: v1::CellChanges) -> Changes {
    let anchor = cell.anchor();
    let removed = changes.removed.iter().map(|name| feature_id(&name.cell, &name.id, name.part)).collect();
    let after = v1::CellMap {
        cell: changes.cell,
        version: changes.to_version,
        anchor: changes.anchor,
        lanes: changes.upserted,
    };
    Changes {
        from_version: changes.from_version,
        to_version: changes.to_version,
        lines: ChangedLines {
            upserted: after.lanes.iter().filter_map(|lane| shared_lane(&anchor, &after, lane)).collect(),
            removed,
        },
        cell: after.cell,
    }
}
