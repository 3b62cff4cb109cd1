//! `/collections/lanes/items`: the lines of the shared map, a bounded page at a time.
//!
//! Pages are cut after a line, not at an offset, so that a map that changes between two pages neither repeats nor hides a
//! line that was there all along: `after` names the last line of the page before, which is not repeated.

use std::sync::Arc;

use axum::{
    extract::State,
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::fleet::CellId;
use lanemap_proto::v1;

use super::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    in_background,
    page::{MOST_COORDINATES, Page, PageQuery, links},
    problem::Problem,
    sessions::GEOJSON,
    shared_lanes::{SharedLane, shared_lane},
};
use crate::{
    fuse::{CellRecord, SharedMap, wire::parse_lane_id},
    journal::JournalError,
};

/// Path of the collection's items.
pub(super) const PATH: &str = "/collections/lanes/items";

/// The last line of a page.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Cursor {
    cell: CellId,
    lane: String,
    part: u32,
}

impl Cursor {
    fn parse(text: &str) -> Result<Self, String> {
        let mut parts = text.split('.');
        let mut read = || {
            let (cell, lane, part) = (parts.next()?, parts.next()?, parts.next()?);
            parse_lane_id(lane)?;
            Some(Self { cell: cell.parse().ok()?, lane: lane.to_owned(), part: part.parse().ok()? })
        };
        read().filter(|_| parts.next().is_none()).ok_or_else(|| "it must be the id of a feature".to_owned())
    }

    fn is_before(&self, cell: CellId, lane: &v1::FusedLane) -> bool {
        (self.cell, self.lane.as_str(), self.part) < (cell, lane.id.as_str(), lane.part)
    }
}

impl PageQuery<Cursor> {
    /// Whether a cell may have lines of the page.
    fn wants(&self, cell: CellId) -> bool {
        self.after_exclusive.as_ref().is_none_or(|after| after.cell <= cell)
            && self.bounds.is_none_or(|bounds| of_cell(cell).loosened().touches(&bounds))
    }
}

/// The borders of a cell.
pub(crate) fn of_cell(cell: CellId) -> Bounds {
    let bounds = cell.bounds();
    Bounds { west: bounds.west, south: bounds.south, east: bounds.east, north: bounds.north, heights: None }
}

/// `GET /collections/lanes/items`
pub(super) async fn items(State(state): State<ServeState>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let query = PageQuery::read(&uri, Cursor::parse)?;
    let mut cells = state.map.list();
    cells.retain(|(cell, record)| record.lanes > 0 && query.wants(*cell));
    let asked = uri.query().unwrap_or_default().to_owned();
    let versions: Vec<_> = cells.iter().map(|(cell, record)| (*cell, record.version)).collect();
    let tag = EntityTag::of((versions, &asked));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let body = in_background(move || {
        let page = page(&state.map, &cells, &query, &asked)?;
        serde_json::to_vec(&page).map_err(|error| JournalError::Store(error.to_string()))
    });
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body.await??)))
}

/// The page that a query asks for; `asked` is the query as it was written.
fn page(
    map: &SharedMap,
    cells: &[(CellId, Arc<CellRecord>)],
    query: &PageQuery<Cursor>,
    asked: &str,
) -> Result<Page<SharedLane>, JournalError> {
    let mut features = Vec::new();
    let mut coordinates = 0;
    let mut more = false;
    'page: for (cell, _) in cells {
        let Some(found) = map.get(*cell)? else { continue };
        let anchor = cell.anchor();
        let after = query.after_exclusive.as_ref();
        for lane in found.map.lanes.iter().filter(|lane| after.is_none_or(|after| after.is_before(*cell, lane))) {
            let Some(lane) = shared_lane(&anchor, &found.map, lane) else { continue };
            if query.bounds.is_some_and(|bounds| !lane.geometry.enters(&bounds)) {
                continue;
            }
            if features.len() == query.limit || coordinates >= MOST_COORDINATES {
                more = true;
                break 'page;
            }
            coordinates += lane.geometry.size();
            features.push(lane);
        }
    }
    let last = features.last().filter(|_| more).map(|last: &SharedLane| last.id.clone());
    Ok(Page { number_returned: features.len(), links: links(PATH, asked, last.as_deref()), features })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_or_cursor_out_of_range_is_refused() {
        for (query, parameter) in [
            ("limit=0", "limit"),
            ("limit=10001", "limit"),
            ("limit=-1", "limit"),
            ("after=3", "after"),
            ("after=14-1-1.x.0", "after"),
        ] {
            let uri = format!("{PATH}?{query}").parse().unwrap();
            let Err(Problem::BadParameter { name, .. }) = PageQuery::read(&uri, Cursor::parse) else {
                panic!("{query}")
            };
            assert_eq!(name, parameter);
        }
    }
}
