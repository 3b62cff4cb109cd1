//! Promise: what happened to the road, and to the names of its lines, is told where it did and when, over every wire alike.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::collections::BTreeSet;

use lanemap_core::Category;
use lanemap_proto::{
    v1::{
        self, admin_service_client::AdminServiceClient, map_service_client::MapServiceClient,
        watch_changes_response::Told,
    },
    zenoh_keys::{EVENT_ENCODING, EVERY_EVENT, event_key},
};
use lanemap_server::config::ZenohMode;
use lanemap_simulator::fleet::{ChangeKind, ChangePlan};
use lanemap_tests::{
    endpoints::HeldEndpoint,
    events::Events,
    fleets::{ChangingRoad, FLEET, PATIENCE, along_a_changing_road, along_a_road, cell_bytes, settled},
    http, raw_zenoh,
    servers::{self},
};
use prost::Message;
use reqwest::StatusCode;
use serde_json::{Value, json};
use tokio::time::timeout;

/// Features of `/cells/{id}/events` of all cells.
async fn events_of(url: &str) -> Vec<Value> {
    let mut events = Vec::new();
    for cell in cell_bytes(url).await.into_keys() {
        let page = http::get(format!("{url}/cells/{cell}/events")).await.unwrap().error_for_status().unwrap();
        let page: Value = page.json().await.unwrap();
        events.extend(page["features"].as_array().unwrap().clone());
    }
    events
}

#[tokio::test(flavor = "multi_thread")]
async fn a_line_that_an_older_drive_renames_is_told_by_both_names_and_a_deletion_takes_them_out() {
    let drives = along_a_road(32, 2, 200.0, false);
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    let url = server.url();
    drives[1].upload_whole(&url).await;
    settled(&server).await;
    let mut events = Events::open(&format!("{url}/changes"), "").await;
    let since = events.expect("start").await.data["revision"].clone();
    drives[0].upload_whole(&url).await;
    settled(&server).await;
    let renamed = |event: &Value| event["properties"]["kind"] == "renamed" || event["properties"]["kind"] == "merged";
    let told = events_of(&url).await;
    let told: Vec<&Value> = told.iter().filter(|event| renamed(event)).collect();
    assert!(!told.is_empty(), "the older drive gives the lines their names");
    let lanes: Vec<String> = cell_bytes(&url)
        .await
        .into_values()
        .flat_map(|bytes| v1::CellMap::decode(bytes.as_slice()).unwrap().lanes)
        .map(|lane| lane.id)
        .collect();
    for event in &told {
        let properties = &event["properties"];
        assert!(properties["revision"].as_u64() > since.as_u64(), "{event}");
        assert!(!lanes.contains(&properties["lane"].as_str().unwrap().to_owned()), "{event}");
        assert!(properties["into"][0].is_string(), "{event}");
    }
    // From the line that went its history leads to the one that has its paint, and back.
    let (cell, lane, heir) = {
        let known = &told[0]["properties"];
        let text = |value: &Value| value.as_str().unwrap().to_owned();
        (text(&known["cell"]), text(&known["lane"]), text(&known["into"][0]))
    };
    let history = async |lane: &str| {
        let answer = http::get(format!("{url}/cells/{cell}/lanes/{lane}/history")).await.unwrap();
        answer.error_for_status().unwrap().json::<Value>().await.unwrap()
    };
    let was = history(&lane).await;
    assert!(was["became"].as_array().unwrap().iter().any(|descent| descent["lanes"][0] == *heir), "{was}");
    let is = history(&heir).await;
    assert!(is["came_from"].as_array().unwrap().iter().any(|descent| descent["lane"] == *lane), "{is}");
    // The stream tells of each before the change of the cell.
    let mut told = Vec::new();
    while events.last_id != server.map().revision().to_string() {
        told.push(timeout(PATIENCE, events.next()).await.unwrap().expect("the stream goes on"));
    }
    let change = told.iter().position(|event| event.name == "change").expect("it is told");
    assert!(change + 1 < told.len() && told[change].data["type"] == "Feature", "{told:?}");

    let mut client = AdminServiceClient::connect(url.clone()).await.unwrap();
    let vehicle_id = drives[1].start.vehicle_id.clone();
    let request = v1::ForgetRequest { fleet_id: FLEET.to_owned(), vehicle_id, drive_id: None };
    client.forget(request).await.unwrap();
    assert_eq!(events_of(&url).await.iter().filter(|event| renamed(event)).count(), 0);
    server.shutdown().await;
}

/// Metres east and north of a place, near it.
fn metres_from(origin: [f64; 2], place: [f64; 2]) -> [f64; 2] {
    const M_PER_DEG: f64 = 111_195.0;
    [(place[0] - origin[0]) * M_PER_DEG * origin[1].to_radians().cos(), (place[1] - origin[1]) * M_PER_DEG]
}

/// Share of the places of one line that lie within `within_m` of a place of the other.
fn share_near(line: &[[f64; 2]], other: &[[f64; 2]], within_m: f64) -> f64 {
    let distance_m = |from: [f64; 2], to: [f64; 2]| metres_from(from, to).iter().fold(0.0, |sum, m| m.hypot(sum));
    let near = |place: &&[f64; 2]| other.iter().any(|to| distance_m(**place, *to) <= within_m);
    line.iter().filter(near).count() as f64 / line.len() as f64
}

fn places_of(event: &Value) -> Vec<[f64; 2]> {
    let coordinates = event["geometry"]["coordinates"].as_array().expect("a line");
    coordinates.iter().map(|place| [place[0].as_f64().unwrap(), place[1].as_f64().unwrap()]).collect()
}

/// A road on which a stretch vanishes and one appears, between the sixth drive and the seventh.
fn changing_road() -> ChangingRoad {
    let each = ChangePlan { vanished: 1, appeared: 1, max_length_m: 100.0, ..ChangePlan::none() };
    along_a_changing_road(33, 12, ChangePlan { first_drive: 6, last_drive: 6, ..each })
}

/// The believed events of the road of a server that all drives were uploaded to.
async fn told_of_road(road: &ChangingRoad) -> Vec<Value> {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    let url = server.url();
    for drive in &road.drives {
        drive.upload_whole(&url).await;
        settled(&server).await;
    }
    let mut events = events_of(&url).await;
    events.retain(|event| !event["geometry"].is_null() && event["properties"]["withdrawn"] == false);
    server.shutdown().await;
    events
}

/// The only event of a road, which is of a kind and lies along a line.
fn only_event<'a>(events: &'a [Value], kind: &str, line: &[[f64; 2]]) -> &'a Value {
    let [event] = events else { panic!("one thing happened: {events:#?}") };
    assert_eq!(event["properties"]["kind"], kind);
    assert!(share_near(&places_of(event), line, 3.0) > 0.8, "{event} is not at {line:?}");
    assert!(event["properties"]["probability"].as_f64().unwrap() > 0.8, "{event}");
    event
}

/// Roads of which a line moves by 0.8 to 1.5 m, and one of which a stretch is repainted.
const MOVES: [u64; 3] = [4, 6, 11];
const REPAINTED: u64 = 2;

#[tokio::test(flavor = "multi_thread")]
async fn a_line_that_moves_is_told_once_with_its_probability_and_how_far() {
    for seed in MOVES {
        let each = ChangePlan { moved: 1, max_length_m: 100.0, ..ChangePlan::none() };
        let road = along_a_changing_road(seed, 12, ChangePlan { first_drive: 6, last_drive: 6, ..each });
        let [(ChangeKind::Moved { left_m }, _, after)] = road.changes.as_slice() else { panic!("{:?}", road.changes) };
        let events = told_of_road(&road).await;
        let event = only_event(&events, "moved", after);
        let told_m = event["properties"]["moved_m"].as_f64().unwrap();
        assert!((told_m - left_m.abs()).abs() < 0.25, "{told_m} m of {left_m} m");
        let noticed = event["properties"]["noticed"].as_str().unwrap();
        assert!(("2025-01-07".."2025-01-13").contains(&noticed), "{noticed}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stretch_that_is_repainted_is_told_once_with_what_it_was_and_is() {
    let each = ChangePlan { repainted: 1, max_length_m: 100.0, ..ChangePlan::none() };
    let road = along_a_changing_road(REPAINTED, 12, ChangePlan { first_drive: 6, last_drive: 6, ..each });
    let [(ChangeKind::Repainted { from, to }, _, after)] = road.changes.as_slice() else {
        panic!("{:?}", road.changes)
    };
    let events = told_of_road(&road).await;
    let event = only_event(&events, "repainted", after);
    // Most of the stretch, and little of the line beside it.
    assert!(share_near(after, &places_of(event), 5.0) > 0.7, "{event}");
    let code = |category: &Value| category.as_str().unwrap().replace('_', "");
    let name = |category: &Category| format!("{category:?}").to_lowercase();
    assert_eq!(code(&event["properties"]["category_before"]), name(from));
    assert_eq!(code(&event["properties"]["category"]), name(to));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_vanishes_and_what_appears_while_vehicles_drive_is_told_where_it_did() {
    let road = changing_road();
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |_| ()).await;
    let url = server.url();
    for drive in &road.drives {
        drive.upload_whole(&url).await;
    }
    settled(&server).await;
    let events = events_of(&url).await;
    let of_road = |event: &&Value| !event["geometry"].is_null() && event["properties"]["withdrawn"] == false;
    let told: Vec<&Value> = events.iter().filter(of_road).collect();
    assert_eq!(road.changes.len(), 2);
    for (kind, before, after) in &road.changes {
        let truth = if after.is_empty() { before } else { after };
        let name = if *kind == ChangeKind::Vanished { "vanished" } else { "appeared" };
        let of_kind = |event: &&&Value| event["properties"]["kind"] == name;
        let at = told.iter().filter(of_kind).find(|event| share_near(truth, &places_of(event), 3.0) > 0.5);
        let event = at.unwrap_or_else(|| panic!("{kind:?} is not told: {events:#?}"));
        let properties = &event["properties"];
        assert!(properties["probability"].as_f64().unwrap() > 0.5 && properties["noticed"].is_string(), "{event}");
        // Noticed with one of the four drives that came first after it, two each way.
        let noticed = properties["noticed"].as_str().unwrap();
        assert!(("2025-01-07".."2025-01-11").contains(&noticed), "{noticed}");
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn of_the_events_of_a_cell_the_newest_are_kept_and_those_that_left_are_not_told_again() {
    let road = changing_road();
    let folder = tempfile::tempdir().unwrap();
    let server = servers::lively(folder.path(), |config| config.max_events_per_cell = 1).await;
    let url = server.url();
    let mut told = BTreeSet::new();
    for drive in &road.drives {
        drive.upload_whole(&url).await;
        settled(&server).await;
        let events = events_of(&url).await;
        assert!(events.iter().filter(|event| !event["geometry"].is_null()).count() <= 1, "{events:#?}");
        told.extend(events.iter().map(|event| event["id"].as_str().unwrap().to_owned()));
    }
    assert!(told.len() > 1, "{told:?}");
    // Nothing is told of a map that nobody changes, though what was told first is still believed.
    let revision = server.map().revision();
    server.shutdown().await;
    let server = servers::lively(folder.path(), |config| config.max_events_per_cell = 1).await;
    settled(&server).await;
    assert_eq!(server.map().revision(), revision);
    server.shutdown().await;
}

/// What tells an event, whatever the wire.
fn told_of(event: &v1::MapEvent) -> (String, String, u64, bool, u32) {
    let kind = event.kind().as_str_name().trim_start_matches("MAP_EVENT_KIND_").to_lowercase();
    let id = format!("{}.event.{}", event.cell, event.number);
    (id, kind, event.revision, event.withdrawn, event.probability_permille)
}

#[tokio::test(flavor = "multi_thread")]
async fn over_grpc_and_zenoh_the_same_happened_as_over_http() {
    let road = changing_road();
    let folder = tempfile::tempdir().unwrap();
    let endpoint = HeldEndpoint::tcp();
    let server = servers::lively(folder.path(), |config| {
        config.zenoh_mode = ZenohMode::Router;
        config.zenoh_listen = endpoint.parse().unwrap();
    })
    .await;
    let url = server.url();
    let session = raw_zenoh::connect(&endpoint).await;
    let heard = session.declare_subscriber(EVERY_EVENT).await.unwrap();
    for drive in &road.drives {
        drive.upload_whole(&url).await;
    }
    settled(&server).await;
    let over_http: BTreeSet<_> = events_of(&url)
        .await
        .iter()
        .map(|event| {
            let known = &event["properties"];
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "thousandths")]
            let permille = (known["probability"].as_f64().unwrap() * 1e3).round() as u32;
            let text = |value: &Value| value.as_str().unwrap().to_owned();
            let revision = known["revision"].as_u64().unwrap();
            (text(&event["id"]), text(&known["kind"]), revision, known["withdrawn"] == true, permille)
        })
        .collect();
    assert!(over_http.iter().any(|event| event.1 == "vanished"), "{over_http:?}");

    let mut client = MapServiceClient::connect(url.clone()).await.unwrap();
    let request = v1::WatchChangesRequest { since_revision: Some(0), ..v1::WatchChangesRequest::default() };
    let mut messages = client.watch_changes(request).await.unwrap().into_inner();
    let (mut over_grpc, mut position) = (BTreeSet::new(), String::new());
    while position != server.map().revision().to_string() {
        let message = timeout(PATIENCE, messages.message()).await.unwrap().unwrap().expect("the stream goes on");
        if let Some(Told::Event(event)) = &message.told {
            assert_eq!(message.position, position, "it is told again to who is cut off here");
            over_grpc.insert(told_of(event));
        }
        position = message.position;
    }
    assert_eq!(over_grpc, over_http);

    let replies = session.get(EVERY_EVENT).await.unwrap();
    let mut over_zenoh = BTreeSet::new();
    while let Ok(reply) = replies.recv_async().await {
        let sample = reply.into_result().unwrap();
        assert_eq!(sample.encoding().to_string(), EVENT_ENCODING);
        let event = v1::MapEvent::decode(sample.payload().to_bytes().as_ref()).unwrap();
        assert_eq!(sample.key_expr().as_str(), event_key(&event.cell, event.number));
        over_zenoh.insert(told_of(&event));
    }
    assert_eq!(over_zenoh, over_http);
    // What was put as it happened ends with what is known now.
    let newest = over_http.iter().max_by_key(|event| event.2).unwrap().clone();
    let hearing = async {
        loop {
            let sample = heard.recv_async().await.unwrap();
            let event = v1::MapEvent::decode(sample.payload().to_bytes().as_ref()).unwrap();
            if told_of(&event) == newest {
                return;
            }
        }
    };
    timeout(PATIENCE, hearing).await.expect("it is put");

    // All cells at once, the newest first, in a box, of some kinds.
    let kinds = "kind=vanished,appeared";
    let answer = http::get(format!("{url}/events?{kinds}&limit=1")).await.unwrap().error_for_status().unwrap();
    let page: Value = answer.json().await.unwrap();
    let wanted: Vec<_> = over_http.iter().filter(|event| event.1 == "vanished" || event.1 == "appeared").collect();
    assert_eq!(page["features"][0]["properties"]["revision"], wanted.iter().map(|event| event.2).max().unwrap());
    assert_eq!(page["more"], wanted.len() > 1);
    let [longitude, latitude] = places_of(&page["features"][0])[0];
    for (bbox, count) in [(format!("{longitude},{latitude},{longitude},{latitude}"), 1), ("0,0,1,1".to_owned(), 0)] {
        let answer = http::get(format!("{url}/events?{kinds}&bbox={bbox}")).await.unwrap().error_for_status().unwrap();
        let page: Value = answer.json().await.unwrap();
        assert!(page["numberReturned"].as_u64().unwrap() >= count && (count == 1 || page["features"] == json!([])));
    }
    let wrong = http::get(format!("{url}/events?kind=came")).await.unwrap();
    assert_eq!(wrong.status(), StatusCode::BAD_REQUEST);
    server.shutdown().await;
}
