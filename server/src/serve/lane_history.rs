//! `/cells/{id}/lanes/{lane}/history`: how a line came to be what it is, over the versions of its cell that are kept.
//!
//! Only versions are told in which the line differs from the version before. How far it moved is the farthest distance of
//! its control points from the line as it was, to its side: where it grew it did not move.
//!
//! What is told of names (`/cells/{id}/events`) leads on: from which lines it came, and what it became, as far as such events are
//! kept. A line that is in no kept version is told of where an event names it.

use std::collections::BTreeMap;

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderMap, Uri},
    response::Response,
};
use lanemap_core::{Category, TimestampNs, fleet::CellId, geometry::polyline::length_m};
use lanemap_proto::v1;
use nalgebra::Point3;
use serde::Serialize;

use super::{
    ServeState,
    entity_tag::EntityTag,
    events::{EventFeature, feature},
    features::{category_name, rfc3339},
    in_background,
    line::rounded,
    problem::{Problem, repeated},
    query::Parameters,
    shared_lanes::feature_id,
};
use crate::{
    fuse::{CellVersion, SharedMap, events::CellEvent, wire::positions},
    journal::JournalError,
};

/// The history of a line within one cell.
#[derive(Debug, Serialize)]
struct History {
    cell: String,
    lane: String,
    /// The oldest version of the cell that is kept: what was before is not told.
    oldest_kept: CellVersion,
    newest: CellVersion,
    /// The versions in which the line changed, the oldest first.
    versions: Vec<Entry>,
    /// The lines that gave it paint; each has a history of its own.
    came_from: Vec<Ancestor>,
    /// The lines that it is now, where its name went or part of it did.
    became: Vec<Heirs>,
    /// What happened to its road.
    events: Vec<EventFeature>,
}

/// A line that gave its paint to this one.
#[derive(Debug, Serialize)]
struct Ancestor {
    kind: &'static str,
    lane: String,
    version: CellVersion,
    at: String,
}

/// The lines to which this one gave its paint.
#[derive(Debug, Serialize)]
struct Heirs {
    kind: &'static str,
    lanes: Vec<String>,
    version: CellVersion,
    at: String,
}

/// The line in one version.
#[derive(Debug, PartialEq, Serialize)]
struct Entry {
    version: CellVersion,
    /// When it was published, RFC 3339.
    at: String,
    /// Ids of the features that it consisted of; none where it was not there.
    features: Vec<String>,
    #[serde(flatten)]
    line: Option<Line>,
    /// How far it moved against the version before, metres; absent where it was not there before.
    #[serde(skip_serializing_if = "Option::is_none")]
    moved_m: Option<f64>,
}

/// What was known of the line, over all its pieces in the cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Line {
    category: &'static str,
    /// Mean over its control points.
    existence: f64,
    /// Median over its control points, metres.
    lateral_sigma_m: f64,
    drives: u32,
    observations: u64,
    length_m: f64,
}

/// `GET /cells/{id}/lanes/{lane}/history`
pub(super) async fn history(
    State(state): State<ServeState>,
    Path((id, lane)): Path<(String, String)>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let no_such_cell = || Problem::NoSuchCell { cell: repeated(&id) };
    let cell: CellId = id.parse().map_err(|_| no_such_cell())?;
    let newest = state.map.record(cell).ok_or_else(no_such_cell)?.version;
    let tag = EntityTag::of((cell, newest, &lane));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let asked = lane.clone();
    let told = in_background(move || told(&state.map, cell, newest, &asked)).await??;
    if told.is_empty() {
        return Err(Problem::NoSuchLane { cell: cell.to_string(), lane: repeated(&lane) });
    }
    Ok(tag.on(Json(told)))
}

fn told(map: &SharedMap, cell: CellId, newest: CellVersion, lane: &str) -> Result<History, JournalError> {
    let kept = map.kept_versions(cell)?;
    let oldest_kept = kept.first().map_or(newest, |(version, _)| *version);
    let mut versions: Vec<Entry> = Vec::new();
    let mut before: Vec<v1::FusedLane> = Vec::new();
    for (version, published_ms) in kept.into_iter().filter(|(version, _)| *version <= newest) {
        // One that was let go of meanwhile is passed over.
        let Some(found) = map.version_of(cell, version)? else { continue };
        let now: Vec<v1::FusedLane> = found.map.lanes.iter().filter(|piece| piece.id == lane).cloned().collect();
        if now != before {
            versions.push(entry(&cell.to_string(), version, published_ms, &before, &now));
            before = now;
        }
    }
    let (of_road, of_names): (Vec<_>, Vec<_>) = map
        .events(cell)?
        .into_iter()
        .filter(|event| event.version <= newest)
        .partition(|event| event.kind.is_of_road());
    let came_from = of_names.iter().filter(|event| event.lane != lane && event.into.iter().any(|heir| heir == lane));
    let became = of_names.iter().filter(|event| event.lane == lane);
    Ok(History {
        cell: cell.to_string(),
        lane: lane.to_owned(),
        oldest_kept,
        newest,
        versions,
        came_from: came_from.map(Ancestor::of).collect(),
        became: became.map(Heirs::of).collect(),
        events: of_road.into_iter().filter(|event| event.lane == lane).map(|event| feature(cell, event)).collect(),
    })
}

impl History {
    fn is_empty(&self) -> bool {
        self.versions.is_empty() && self.came_from.is_empty() && self.became.is_empty() && self.events.is_empty()
    }
}

impl Ancestor {
    fn of(event: &CellEvent) -> Self {
        let at = published(event.published_ms);
        Self { kind: event.kind.name(), lane: event.lane.clone(), version: event.version, at }
    }
}

impl Heirs {
    fn of(event: &CellEvent) -> Self {
        let at = published(event.published_ms);
        Self { kind: event.kind.name(), lanes: event.into.clone(), version: event.version, at }
    }
}

/// When something was published, RFC 3339.
fn published(published_ms: u64) -> String {
    rfc3339(TimestampNs(i64::try_from(published_ms.saturating_mul(1_000_000)).unwrap_or(i64::MAX)))
}

fn entry(
    cell: &str,
    version: CellVersion,
    published_ms: u64,
    before: &[v1::FusedLane],
    now: &[v1::FusedLane],
) -> Entry {
    Entry {
        version,
        at: published(published_ms),
        features: now.iter().map(|piece| feature_id(cell, &piece.id, piece.part)).collect(),
        line: line(now),
        moved_m: (!before.is_empty() && !now.is_empty()).then(|| rounded(moved_m(before, now), 1e3)),
    }
}

fn line(pieces: &[v1::FusedLane]) -> Option<Line> {
    let longest = pieces.iter().max_by_key(|piece| piece.existence_permille.len())?;
    let mut sigmas_mm: Vec<u32> = pieces.iter().flat_map(|piece| piece.lateral_sigma_mm.iter().copied()).collect();
    sigmas_mm.sort_unstable();
    let existences: Vec<u32> = pieces.iter().flat_map(|piece| piece.existence_permille.iter().copied()).collect();
    let existence =
        existences.iter().map(|share| f64::from(*share) / 1e3).sum::<f64>() / existences.len().max(1) as f64;
    let category = u8::try_from(longest.category).ok().and_then(Category::from_openlane_code).unwrap_or_default();
    Some(Line {
        category: category_name(category),
        existence: rounded(existence, 1e3),
        lateral_sigma_m: sigmas_mm.get(sigmas_mm.len() / 2).map_or(0.0, |sigma| f64::from(*sigma) / 1e3),
        drives: pieces.iter().map(|piece| piece.drives).max().unwrap_or(0),
        observations: pieces.iter().map(|piece| piece.observations).max().unwrap_or(0),
        length_m: rounded(pieces.iter().map(|piece| length_m(&positions(piece))).sum(), 1e1),
    })
}

/// The farthest distance of a control point from the line before, metres; points beyond its ends are passed over.
fn moved_m(before: &[v1::FusedLane], now: &[v1::FusedLane]) -> f64 {
    let lines: BTreeMap<u32, Vec<Point3<f64>>> = before.iter().map(|piece| (piece.part, positions(piece))).collect();
    let aside = |point: &Point3<f64>| {
        let distances = lines.values().filter_map(|line| aside_m(point, line));
        distances.min_by(f64::total_cmp)
    };
    now.iter().flat_map(positions).filter_map(|point| aside(&point)).fold(0.0, f64::max)
}

/// Distance of a point from the nearest segment of a line, in the plane; `None` where that is beyond one of its ends.
fn aside_m(point: &Point3<f64>, line: &[Point3<f64>]) -> Option<f64> {
    let last = line.len().checked_sub(2)?;
    let segments = line.windows(2).enumerate().map(|(index, pair)| {
        let (along, to) = ((pair[1] - pair[0]).xy(), (point - pair[0]).xy());
        let share = along.dot(&to) / along.norm_squared().max(1e-12);
        let beyond = (index == 0 && share < 0.0) || (index == last && share > 1.0);
        ((to - along * share.clamp(0.0, 1.0)).norm(), beyond)
    });
    let (distance_m, beyond) = segments.min_by(|one, other| one.0.total_cmp(&other.0))?;
    (!beyond).then_some(distance_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn straight(points: i32, aside_mm: i32) -> v1::FusedLane {
        let mut xyz_mm = vec![0, aside_mm, 0];
        xyz_mm.extend((1..points).flat_map(|_| [3_000, 0, 0]));
        let count = usize::try_from(points).unwrap();
        v1::FusedLane {
            id: "a-line".into(),
            category: 2,
            xyz_mm,
            lateral_sigma_mm: vec![50; count],
            existence_permille: vec![900; count],
            drives: 3,
            ..v1::FusedLane::default()
        }
    }

    #[test]
    fn a_line_that_grew_did_not_move_and_one_that_was_shifted_did() {
        assert!(moved_m(&[straight(4, 0)], &[straight(9, 0)]) < 1e-9);
        assert!((moved_m(&[straight(9, 0)], &[straight(6, 250)]) - 0.25).abs() < 1e-9);
    }

    #[test]
    fn an_entry_tells_what_the_line_was_and_one_without_it_that_it_was_not_there() {
        let there = entry("14-1-1", CellVersion(4), 1_000, &[], &[straight(5, 0)]);
        assert_eq!(there.features, ["14-1-1.a-line.0"]);
        assert_eq!(there.moved_m, None);
        let line = there.line.unwrap();
        assert_eq!((line.category, line.drives, line.length_m), ("white_solid", 3, 12.0));
        assert_eq!((line.existence, line.lateral_sigma_m), (0.9, 0.05));
        let gone = serde_json::to_value(entry("14-1-1", CellVersion(5), 2_000, &[straight(5, 0)], &[])).unwrap();
        assert_eq!(gone, serde_json::json!({ "version": 5, "at": "1970-01-01T00:00:02Z", "features": [] }));
    }
}
