//! `/sessions/live`: where the vehicles are that stream now. Made to be asked for every second.
//!
//! A point has the name of its drive and no other: a vehicle has none here. Drives without a place on the earth are not
//! in it.

use std::sync::Arc;

use axum::{
    extract::State,
    http::{HeaderMap, Uri, header},
    response::Response,
};
use serde::Serialize;

use super::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    features::rfc3339,
    in_background,
    line::Coordinate,
    problem::Problem,
    query::{Parameters, parse_limit},
    sessions::{GEOJSON, identity, vehicle},
};
use crate::session::{SessionState, SessionSummary};

/// Vehicles of an answer, where the query does not say.
const DEFAULT_LIMIT: usize = 1_000;
/// Most vehicles of an answer.
const MOST_VEHICLES: usize = 10_000;

#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "FeatureCollection")]
struct Vehicles {
    /// Drives that stream now, also those that are not in the answer.
    live: usize,
    /// Drives of the store.
    drives: usize,
    #[serde(rename = "numberReturned")]
    number_returned: usize,
    features: Vec<Vehicle>,
}

#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "Feature")]
struct Vehicle {
    /// The drive's id.
    id: String,
    geometry: Point,
    properties: Motion,
}

#[derive(Debug, Serialize)]
#[serde(tag = "type")]
struct Point {
    coordinates: Coordinate,
}

#[derive(Debug, Serialize)]
struct Motion {
    /// Clockwise from north, degrees in `[0, 360)`.
    heading_deg: f64,
    /// Time of its last frame, RFC 3339.
    at: String,
    /// Frames in its map.
    frames: u64,
    /// Lanes in its map.
    lanes: usize,
}

/// `GET /sessions/live`
pub(super) async fn live(State(state): State<ServeState>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let parameters = Parameters::read(&uri, &["bbox", "limit"])?;
    let bounds = parameters.get("bbox", Bounds::parse)?;
    let limit = parameters.get("limit", |text| parse_limit(text, MOST_VEHICLES))?.unwrap_or(DEFAULT_LIMIT);
    let mut drives = state.sessions.list();
    let known = drives.len();
    drives.retain(|drive| drive.state == SessionState::Live);
    let parts: Vec<_> = drives.iter().map(|drive| identity(drive)).collect();
    let tag = EntityTag::of((known, parts, uri.query()));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let body = in_background(move || serde_json::to_vec(&vehicles(known, &drives, bounds.as_ref(), limit))).await?;
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body.map_err(|_| Problem::Internal)?)))
}

/// The vehicles of drives within a box, the newest drives first.
fn vehicles(known: usize, live: &[Arc<SessionSummary>], bounds: Option<&Bounds>, limit: usize) -> Vehicles {
    let on_earth = live.iter().rev().filter(|drive| drive.georeference.is_some() && drive.last_sequence.is_some());
    let seen = on_earth.map(|drive| point(drive));
    let within =
        seen.filter(|vehicle| bounds.is_none_or(|bounds| bounds.is_entered_by(&[vehicle.geometry.coordinates; 2])));
    let features: Vec<Vehicle> = within.take(limit).collect();
    Vehicles { live: live.len(), drives: known, number_returned: features.len(), features }
}

fn point(drive: &SessionSummary) -> Vehicle {
    let at = vehicle(drive);
    Vehicle {
        id: drive.session.to_string(),
        geometry: Point { coordinates: at.position },
        properties: Motion {
            heading_deg: at.heading_deg,
            at: rfc3339(drive.last_time),
            frames: drive.frames(),
            lanes: drive.lanes,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::sample::{georeference, placed, published};

    #[test]
    fn vehicles_within_a_box_are_told_by_the_names_of_their_drives_alone() {
        let here = Arc::new(placed(published(1, 1), georeference(11.58, 48.14)).summary);
        let there = Arc::new(placed(published(2, 1), georeference(-70.0, 10.0)).summary);
        let nowhere = Arc::new(published(3, 1).summary);
        let live = [Arc::clone(&here), there, nowhere];
        let bounds = Bounds::parse("11,48,12,49").unwrap();
        let told = vehicles(9, &live, Some(&bounds), 10);
        let told = serde_json::to_value(&told).unwrap();
        assert_eq!((&told["live"], &told["drives"], &told["numberReturned"]), (&3.into(), &9.into(), &1.into()));
        assert_eq!(told["features"][0]["id"], here.session.to_string());
        assert_eq!(told["features"][0]["geometry"]["type"], "Point");
        let properties: Vec<_> = told["features"][0]["properties"].as_object().unwrap().keys().cloned().collect();
        assert_eq!(properties, ["at", "frames", "heading_deg", "lanes"]);
        assert_eq!(vehicles(9, &live, None, 1).features.len(), 1);
    }
}
