//! `/collections/drives/items`: the lanes of all georeferenced sessions, as each drive alone saw them, a bounded page at a time.
//!
//! The first page is of now. The link `next` names the state in which all drives then were ([`drive_walks`]), so that all pages
//! of a walk are one state however drives go on meanwhile. Once that state is not held any more, or a drive of it was
//! deleted, the walk is over (410). The cursor names the last lane of the page before, which is not repeated.
//!
//! [`drive_walks`]: super::ogc::drive_walks

use std::sync::Arc;

use axum::{
    extract::{Path, State},
    http::{HeaderMap, Uri},
    response::Response,
};
use lanemap_core::MapLane;

use super::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    extents::Extents,
    features::{Crs, LaneFeature, feature},
    form, in_background,
    line::rounded,
    link_base::LinkBase,
    ogc::{
        MOST_COORDINATES,
        collection::DRIVE_LANES,
        cursor::{Cursor, DriveCursor},
        drive_walks::{DriveWalk, DriveWalks},
        filters::Filtered,
        item_query::ItemQuery,
    },
    page::{PageFeatures, single},
    problem::{Problem, repeated},
    query::Parameters,
};
use crate::session::{PublishedMap, SessionId};

/// `GET /collections/drives/items`
pub(super) async fn items(
    State(state): State<ServeState>,
    State(extents): State<Extents>,
    State(walks): State<DriveWalks>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let query = ItemQuery::read(&uri, &DRIVE_LANES)?;
    form::accepts_geojson(&headers)?;
    let first = base.link(&format!("{}{}", DRIVE_LANES.items_path(), query.written_with(None)));
    let over = |reason: &str| Problem::WalkOver { reason: reason.to_owned(), first };
    let (walk, after) = match query.cursor {
        None => (walks.begin(&state.sessions), None),
        Some(Cursor::Drives(after)) => match walks.go_on(after.walk, &state.sessions) {
            Some(walk) => (walk, Some(after)),
            None => return Err(over("the state of the drives, of which this page is, is not held any more")),
        },
        Some(Cursor::Map(_)) => return Err(query.foreign_cursor()),
    };
    let tag = EntityTag::of((walk.number, &query.written, base.as_str()));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let drives = Drives { walk, extents };
    let (query, page) = in_background(move || {
        let page = drives.page(&query, after);
        (query, page)
    })
    .await?;
    let page = page.map_err(|DriveGone| over("a drive of this walk was deleted, or went on after it had ended"))?;
    page.answer(&DRIVE_LANES, &query, &base, tag)
}

/// `GET /collections/drives/items/{id}`
pub(super) async fn item(
    State(state): State<ServeState>,
    base: LinkBase,
    Path(id): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    form::accepts_geojson(&headers)?;
    let missing = || Problem::NoSuchFeature { collection: DRIVE_LANES.id, feature: repeated(&id) };
    let named = |(session, lane): (&str, &str)| Some((session.parse::<SessionId>().ok()?, lane.parse::<u64>().ok()?));
    let (session, lane) = id.split_once('.').and_then(named).ok_or_else(missing)?;
    let map = in_background(move || state.sessions.get(&session)).await?.ok_or_else(missing)?;
    let found = map.map.lanes.iter().find(|found| found.id.0 == lane).ok_or_else(missing)?;
    let found = feature(&map, found, Crs::Wgs84).filter(|found| found.id == id).ok_or_else(missing)?;
    let text = serde_json::to_vec(&found).map_err(|_| Problem::Internal)?;
    let tag = EntityTag::of((&text, base.as_str()));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    single(&DRIVE_LANES, &id, text, &base, &tag)
}

/// Where the lanes of a page are found.
struct Drives {
    walk: Arc<DriveWalk>,
    extents: Extents,
}

/// The map of a drive is not what it was when the walk began.
#[derive(Debug, PartialEq)]
struct DriveGone;

impl Drives {
    /// The page after a lane, or the first.
    fn page(&self, query: &ItemQuery, after: Option<DriveCursor>) -> Result<PageFeatures, DriveGone> {
        let mut page = PageFeatures::default();
        let mut last = None;
        for drive in self.wanted(query, after) {
            let map = match self.walk.map(drive) {
                Some(map) => map,
                // What of a first page is deleted meanwhile is not of it.
                None if after.is_none() => continue,
                None => return Err(DriveGone),
            };
            for lane in self.lanes(&map, query, after) {
                let Some(found) = feature(&map, lane, Crs::Wgs84).filter(|found| is_wanted(found, query)) else {
                    continue;
                };
                if page.returned == query.limit || page.coordinates >= MOST_COORDINATES {
                    page.next = last.map(Cursor::Drives);
                    return Ok(page);
                }
                // A feature is always text: its keys are, and its numbers are finite.
                page.push(found.geometry.size(), |out| out.extend(serde_json::to_vec(&found).unwrap_or_default()));
                last = Some(DriveCursor::at(self.walk.number, map.session, lane.id.0));
            }
        }
        Ok(page)
    }

    /// The georeferenced drives from the cursor on that may enter the box.
    fn wanted(&self, query: &ItemQuery, after: Option<DriveCursor>) -> impl Iterator<Item = usize> {
        self.walk
            .summaries()
            .filter(|(_, summary)| summary.georeference.is_some())
            .filter(move |(_, summary)| after.is_none_or(|after| summary.session.to_key() >= after.session))
            .filter(|(_, summary)| {
                query.filters.session.as_ref().is_none_or(|name| *name == summary.session.to_string())
            })
            .filter(|(_, summary)| may_touch(query.bounds, || self.extents.of(summary)))
            .map(|(drive, _)| drive)
    }

    /// The lanes of a map after the cursor that may be wanted.
    fn lanes<'a>(
        &self,
        map: &'a PublishedMap,
        query: &'a ItemQuery,
        after: Option<DriveCursor>,
    ) -> impl Iterator<Item = &'a MapLane> {
        let walk = self.walk.number;
        map.map
            .lanes
            .iter()
            .filter(move |lane| after.is_none_or(|after| DriveCursor::at(walk, map.session, lane.id.0) > after))
            .filter(|lane| query.filters.pass(&filtered(lane)))
            .filter(|lane| query.interval.is_none_or(|interval| interval.meets(lane.first_seen.0, lane.last_seen.0)))
            .filter(|lane| may_touch(query.bounds, || around(map, lane)))
    }
}

fn filtered(lane: &MapLane) -> Filtered {
    let existence = rounded(lane.existence, 1e3);
    Filtered { category: lane.category, drives: 1, existence, lateral_sigma_m: 0.0 }
}

fn is_wanted(found: &LaneFeature, query: &ItemQuery) -> bool {
    query.bounds.is_none_or(|bounds| found.geometry.enters(&bounds))
}

/// Whether what lies within the box `around` it may enter `bounds`; never wrong where it says no.
fn may_touch(bounds: Option<Bounds>, around: impl FnOnce() -> Option<Bounds>) -> bool {
    bounds.is_none_or(|bounds| around().is_some_and(|around| around.loosened().touches(&bounds)))
}

/// The box around a lane's control points.
fn around(map: &PublishedMap, lane: &MapLane) -> Option<Bounds> {
    let points = lane.control_points.iter().map(|point| point.position);
    Bounds::around(map.georeference.as_ref()?, points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        serve::{
            features::feature_id,
            sample::{georeference, placed, published},
        },
        session::Sessions,
    };

    fn three_sessions() -> Vec<PublishedMap> {
        [(1, Some(11.58)), (2, None), (3, Some(11.60))]
            .into_iter()
            .map(|(number, longitude)| {
                let map = published(number, 3);
                match longitude {
                    Some(longitude) => placed(map, georeference(longitude, 48.14)),
                    None => map,
                }
            })
            .collect()
    }

    fn ask(query: &str) -> PageFeatures {
        let uri = format!("/collections/drives/items?{query}").parse().unwrap();
        let sessions = Sessions::default();
        for map in three_sessions() {
            sessions.publish(map);
        }
        let walk = DriveWalks::new(1 << 20).begin(&sessions);
        let drives = Drives { walk, extents: Extents::default() };
        let query = ItemQuery::read(&uri, &DRIVE_LANES).unwrap();
        let after = query.cursor.map(|cursor| match cursor {
            Cursor::Drives(after) => after,
            Cursor::Map(_) => panic!("a cursor of the drives"),
        });
        drives.page(&query, after).unwrap()
    }

    fn features(page: &PageFeatures) -> Vec<serde_json::Value> {
        serde_json::from_str(&format!("[{}]", std::str::from_utf8(&page.text).unwrap())).unwrap()
    }

    #[test]
    fn pages_of_two_give_every_lane_of_the_georeferenced_sessions_once() {
        let mut query = "limit=2".to_owned();
        let mut seen = Vec::new();
        loop {
            let page = ask(&query);
            assert!(page.returned <= 2);
            seen.extend(features(&page).iter().map(|feature| feature["id"].as_str().unwrap().to_owned()));
            let Some(next) = page.next else { break };
            query = format!("limit=2&cursor={}", next.text());
        }
        let maps = three_sessions();
        let expected: Vec<_> = [0, 2]
            .iter()
            .flat_map(|&i| maps[i].map.lanes.iter().map(move |lane| (i, lane)))
            .map(|(i, lane)| feature_id(maps[i].session, lane))
            .collect();
        assert_eq!(seen, expected);
    }

    #[test]
    fn a_page_that_is_just_full_has_no_next() {
        assert_eq!(ask("limit=6").next, None);
        assert!(ask("limit=5").next.is_some());
    }

    #[test]
    fn a_box_around_one_session_gives_its_lanes_only() {
        let found = features(&ask("bbox=11.57,48.13,11.59,48.15"));
        assert_eq!(found.len(), 3);
        let session = found[0]["properties"]["session"].as_str().unwrap();
        assert!(found.iter().all(|feature| feature["properties"]["session"] == session));
        assert_eq!(ask("bbox=12,48,13,49").returned, 0);
        assert_eq!(ask(&format!("session={session}")).returned, 3);
        assert_eq!(ask("category=yellow_solid").returned, 0);
        assert_eq!(ask("min_existence=0.9").returned, 6);
        assert_eq!(ask("min_existence=0.95").returned, 0);
    }
}
