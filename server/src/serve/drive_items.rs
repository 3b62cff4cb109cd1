//! `/collections/drives/items`: the lanes of all georeferenced sessions, as each drive alone saw them, a bounded page at a time.
//!
//! Pages are cut after a lane, not at an offset, so that a map that grows between two pages neither repeats nor hides a
//! lane that was there all along: `after` names the last lane of the page before, which is not repeated.

use std::sync::Arc;

use axum::{
    extract::State,
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::MapLane;

use super::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    extents::Extents,
    features::{Crs, LaneFeature, feature},
    in_background,
    page::{MOST_COORDINATES, Page, PageQuery, links},
    problem::Problem,
    sessions::{GEOJSON, identity},
};
use crate::session::{PublishedMap, SessionId, SessionSummary, Sessions};

/// Path of the collection's items.
pub(super) const PATH: &str = "/collections/drives/items";

/// The last lane of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Cursor {
    session: SessionId,
    lane: u64,
}

impl Cursor {
    fn parse(text: &str) -> Result<Self, String> {
        let read =
            |(session, lane): (&str, &str)| Some(Self { session: session.parse().ok()?, lane: lane.parse().ok()? });
        text.split_once('.').and_then(read).ok_or_else(|| "it must be the id of a feature".to_owned())
    }
}

/// `GET /collections/drives/items`
pub(super) async fn items(
    State(state): State<ServeState>,
    State(extents): State<Extents>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let query = PageQuery::read(&uri, Cursor::parse)?;
    let summaries = state.sessions.list();
    let asked = uri.query().unwrap_or_default().to_owned();
    let tag = EntityTag::of((summaries.iter().map(|summary| identity(summary)).collect::<Vec<_>>(), &asked));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let candidates = Candidates { summaries, sessions: state.sessions, extents };
    let body = in_background(move || serde_json::to_vec(&page(&candidates, &query, &asked))).await?;
    let body = body.map_err(|_| Problem::Internal)?;
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body)))
}

/// Where the lanes of a page are found.
struct Candidates {
    summaries: Vec<Arc<SessionSummary>>,
    sessions: Sessions,
    extents: Extents,
}

/// The page that a query asks for; `asked` is the query as it was written.
fn page(candidates: &Candidates, query: &PageQuery<Cursor>, asked: &str) -> Page<LaneFeature> {
    let mut features = Vec::new();
    let mut coordinates = 0;
    let mut more = false;
    'page: for map in candidates.maps(query) {
        for lane in lanes(&map, query) {
            let Some(found) = feature(&map, lane, Crs::Wgs84) else { continue };
            if query.bounds.is_some_and(|bounds| !found.geometry.enters(&bounds)) {
                continue;
            }
            if features.len() == query.limit || coordinates >= MOST_COORDINATES {
                more = true;
                break 'page;
            }
            coordinates += found.geometry.size();
            features.push(found);
        }
    }
    let last = features.last().filter(|_| more).map(|last: &LaneFeature| last.id.clone());
    Page { number_returned: features.len(), links: links(PATH, asked, last.as_deref()), features }
}

impl Candidates {
    /// The maps of georeferenced sessions from the cursor on that may enter the box, read one after the other.
    fn maps(&self, query: &PageQuery<Cursor>) -> impl Iterator<Item = Arc<PublishedMap>> {
        self.summaries
            .iter()
            .filter(|summary| summary.georeference.is_some())
            .filter(|summary| query.after_exclusive.is_none_or(|after| summary.session >= after.session))
            .filter(|summary| may_touch(query.bounds, || self.extents.of(summary)))
            .filter_map(|summary| self.sessions.get(&summary.session))
    }
}

/// The lanes of a map after the cursor that may enter the box.
fn lanes<'a>(map: &'a PublishedMap, query: &'a PageQuery<Cursor>) -> impl Iterator<Item = &'a MapLane> {
    map.map
        .lanes
        .iter()
        .filter(|lane| {
            query.after_exclusive.is_none_or(|after| Cursor { session: map.session, lane: lane.id.0 } > after)
        })
        .filter(|lane| may_touch(query.bounds, || around(map, lane)))
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
    use crate::serve::{
        features::feature_id,
        sample::{georeference, placed, published},
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

    fn ask(query: &str) -> Page<LaneFeature> {
        let uri = format!("{PATH}?{query}").parse().unwrap();
        let sessions = Sessions::default();
        for map in three_sessions() {
            sessions.publish(map);
        }
        let candidates = Candidates { summaries: sessions.list(), sessions, extents: Extents::default() };
        page(&candidates, &PageQuery::read(&uri, Cursor::parse).unwrap(), query)
    }

    #[test]
    fn pages_of_two_give_every_lane_of_the_georeferenced_sessions_once() {
        let mut query = "limit=2".to_owned();
        let mut seen = Vec::new();
        loop {
            let page = ask(&query);
            assert!(page.number_returned <= 2);
            seen.extend(page.features.iter().map(|feature| feature.id.clone()));
            let Some(next) = page.links.iter().find(|link| link.rel == "next") else { break };
            query = next.href.split_once('?').unwrap().1.to_owned();
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
        assert_eq!(ask("limit=6").links.len(), 1);
        assert_eq!(ask("limit=5").links.len(), 2);
    }

    #[test]
    fn a_box_around_one_session_gives_its_lanes_only() {
        let page = ask("bbox=11.57,48.13,11.59,48.15");
        assert_eq!(page.number_returned, 3);
        assert!(page.features.iter().all(|feature| feature.properties.session == page.features[0].properties.session));
        assert_eq!(ask("bbox=12,48,13,49").number_returned, 0);
    }

    #[test]
    fn a_limit_or_cursor_out_of_range_is_refused() {
        for (query, parameter) in
            [("limit=0", "limit"), ("limit=10001", "limit"), ("limit=-1", "limit"), ("after=3", "after")]
        {
            let uri = format!("{PATH}?{query}").parse().unwrap();
            let Err(Problem::BadParameter { name, .. }) = PageQuery::read(&uri, Cursor::parse) else {
                panic!("{query}")
            };
            assert_eq!(name, parameter);
        }
    }
}
