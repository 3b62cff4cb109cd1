//! Promise: the map is a set of collections as OGC API - Features has them, whose pages are one state of the map, and whose
//! description is true.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::collections::BTreeSet;

use lanemap_proto::v1::{self, admin_service_client::AdminServiceClient};
use lanemap_server::{RunningServer, Server, ServerConfig};
use lanemap_tests::{
    fleets::{FLEET, WireDrive, along_a_road, settled},
    http, servers,
};
use reqwest::{Response, StatusCode, header};
use serde_json::Value;
use tempfile::TempDir;

/// Collections of the shared map.
const OF_THE_MAP: [&str; 3] = ["lanes", "control_points", "cells"];

/// A server with a map of some drives.
struct Service {
    server: RunningServer,
    _data: TempDir,
}

impl Service {
    async fn of(drives: &[WireDrive]) -> Self {
        let data = tempfile::tempdir().unwrap();
        let config = ServerConfig { fuse_interval_ms: 20, ..servers::config(data.path()) };
        let service = Self { server: Server::start(config).await.unwrap(), _data: data };
        for drive in drives {
            service.drive(drive).await;
        }
        service
    }

    async fn drive(&self, drive: &WireDrive) {
        drive.upload_whole(&self.server.url()).await;
        settled(&self.server).await;
    }

    fn items(&self, collection: &str, query: &str) -> String {
        format!("{}/collections/{collection}/items?{query}", self.server.url())
    }
}

async fn get(url: &str) -> Response {
    http::get(url).await.unwrap()
}

async fn json(url: &str) -> Value {
    let response = get(url).await;
    assert_eq!(response.status(), StatusCode::OK, "{url}");
    response.json().await.unwrap()
}

fn features(page: &Value) -> &[Value] {
    page["features"].as_array().unwrap()
}

fn link(document: &Value, rel: &str) -> Option<String> {
    let links = document["links"].as_array().unwrap();
    links.iter().find(|link| link["rel"] == rel).map(|link| link["href"].as_str().unwrap().to_owned())
}

/// All features from a page on.
async fn walked(first: &str) -> Vec<Value> {
    let mut all = Vec::new();
    let mut url = Some(first.to_owned());
    while let Some(page) = url {
        let page = json(&page).await;
        assert_eq!(page["numberReturned"], features(&page).len());
        all.extend(features(&page).iter().cloned());
        url = link(&page, "next");
    }
    all
}

fn ids(features: &[Value]) -> Vec<String> {
    features.iter().map(|feature| feature["id"].as_str().unwrap().to_owned()).collect()
}

/// What of features is of the map, and not of now.
fn lasting(features: &[Value]) -> Vec<Value> {
    let mut lasting = features.to_vec();
    for feature in &mut lasting {
        feature["properties"].as_object_mut().unwrap().remove("state");
    }
    lasting
}

/// Coordinates of a line or a point.
fn coordinates(feature: &Value) -> Vec<[f64; 3]> {
    let of = |coordinate: &Value| [0, 1, 2].map(|axis| coordinate[axis].as_f64().unwrap());
    let coordinates = feature["geometry"]["coordinates"].as_array().unwrap();
    if coordinates[0].is_array() { coordinates.iter().map(of).collect() } else { vec![of(&coordinates.clone().into())] }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_pages_of_a_walk_are_one_state_of_the_map_though_it_changes_meanwhile() {
    let drives = along_a_road(21, 3, 200.0, true);
    let service = Service::of(&drives[..1]).await;
    for collection in OF_THE_MAP {
        let limit = if collection == "cells" { 1 } else { 3 };
        let whole = walked(&service.items(collection, "limit=10000")).await;
        let first = json(&service.items(collection, &format!("limit={limit}"))).await;
        assert_eq!(first["numberMatched"], whole.len(), "{collection}");
        let begun = link(&first, "next").expect("there is more than a page");
        if collection == "lanes" {
            service.drive(&drives[1]).await;
            service.drive(&drives[2]).await;
        }
        let now = walked(&service.items(collection, "limit=10000")).await;
        let rest = walked(&begun).await;
        let walk = [features(&first), &rest].concat();
        assert_eq!(lasting(&walk), lasting(&whole), "{collection}");
        if collection == "lanes" {
            assert_ne!(now, whole, "the map has changed meanwhile");
            let page = json(&begun).await;
            assert_eq!(page["numberMatched"], whole.len(), "counts are of the walk's state, too");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_walk_through_a_state_of_which_a_drive_was_deleted_is_over() {
    let drives = along_a_road(22, 2, 120.0, false);
    let service = Service::of(&drives).await;
    let first = json(&service.items("lanes", "limit=1&min_drives=1")).await;
    let next = link(&first, "next").unwrap();
    let mut admin = AdminServiceClient::connect(service.server.url()).await.unwrap();
    let vehicle_id = drives[1].start.vehicle_id.clone();
    let request = v1::ForgetRequest { fleet_id: FLEET.to_owned(), vehicle_id, drive_id: None };
    admin.forget(request).await.unwrap();
    let refused = get(&next).await;
    assert_eq!(refused.status(), StatusCode::GONE);
    let problem: Value = refused.json().await.unwrap();
    assert_eq!(problem["type"], "urn:lanemap:problem:walk-over");
    assert_eq!(problem["alternate"], service.items("lanes", "limit=1&min_drives=1"));
    let anew = json(problem["alternate"].as_str().unwrap()).await;
    assert!(features(&anew)[0]["properties"]["drives"] == 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_pages_of_a_walk_through_the_drives_are_one_state_though_a_drive_goes_on_meanwhile() {
    let drives = along_a_road(27, 2, 200.0, false);
    let service = Service::of(&drives[..1]).await;
    drives[1].upload(&service.server.url(), 60, false).await;
    settled(&service.server).await;
    let url = service.items("drives", "limit=2");
    let next = link(&json(&url).await, "next").expect("there is more than a page");
    let rest = walked(&next).await;
    service.drive(&drives[1]).await;
    let goes_on = async {
        let mut ticks = tokio::time::interval(std::time::Duration::from_millis(50));
        while walked(&service.items("drives", "")).await.iter().rev().take(rest.len()).rev().eq(&rest) {
            ticks.tick().await;
        }
    };
    tokio::time::timeout(std::time::Duration::from_secs(30), goes_on).await.expect("the drive goes on");
    assert_eq!(walked(&next).await, rest);
    let mut admin = AdminServiceClient::connect(service.server.url()).await.unwrap();
    let vehicle_id = drives[1].start.vehicle_id.clone();
    let request = v1::ForgetRequest { fleet_id: FLEET.to_owned(), vehicle_id, drive_id: None };
    admin.forget(request).await.unwrap();
    let mut page = Some(next);
    while let Some(address) = page {
        let answer = get(&address).await;
        if answer.status() == StatusCode::GONE {
            let problem: Value = answer.json().await.unwrap();
            assert_eq!(problem["alternate"], url);
            return;
        }
        page = link(&answer.json().await.unwrap(), "next");
    }
    panic!("a walk through the state of a deleted drive is over");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unchanged_page_is_answered_304_and_one_that_changed_is_not() {
    let drives = along_a_road(23, 2, 120.0, false);
    let service = Service::of(&drives[..1]).await;
    for collection in OF_THE_MAP {
        for query in ["limit=1", "limit=10000"] {
            let url = service.items(collection, query);
            let first = get(&url).await;
            let tag = first.headers()[header::ETAG].clone();
            let again = http::client().get(&url).header(header::IF_NONE_MATCH, &tag).send().await.unwrap();
            assert_eq!((again.status(), &again.headers()[header::ETAG]), (StatusCode::NOT_MODIFIED, &tag), "{url}");
        }
    }
    let url = service.items("lanes", "");
    let tag = get(&url).await.headers()[header::ETAG].clone();
    service.drive(&drives[1]).await;
    let changed = http::client().get(&url).header(header::IF_NONE_MATCH, &tag).send().await.unwrap();
    assert_eq!(changed.status(), StatusCode::OK);
    assert_ne!(changed.headers()[header::ETAG], tag);
}

/// Whether a feature is wanted.
type Wanted = Box<dyn Fn(&Value) -> bool>;

#[tokio::test(flavor = "multi_thread")]
async fn filters_and_times_choose_what_the_properties_say() {
    let drives = along_a_road(24, 2, 200.0, true);
    let service = Service::of(&drives).await;
    for collection in ["lanes", "control_points"] {
        let all = walked(&service.items(collection, "limit=10000")).await;
        let number = |feature: &Value, name: &str| feature["properties"][name].as_f64().unwrap();
        let existence = number(&all[all.len() / 2], "existence");
        let sigma_m = number(&all[all.len() / 3], "lateral_sigma_m");
        let named = |name: &str| all[0]["properties"][name].as_str().unwrap().to_owned();
        let (category, lane, cell) = (named("category"), named("lane"), named("cell"));
        let is = |name: &'static str, value: &str| {
            let value = value.to_owned();
            Box::new(move |feature: &Value| feature["properties"][name] == value.as_str())
                as Box<dyn Fn(&Value) -> bool>
        };
        let chosen: [(String, Wanted); 7] = [
            (format!("category={category}"), is("category", &category)),
            (format!("lane={lane}"), is("lane", &lane)),
            (format!("cell={cell}"), is("cell", &cell)),
            ("drives=2".into(), Box::new(|feature| feature["properties"]["drives"] == 2)),
            ("min_drives=2".into(), Box::new(move |feature| number(feature, "drives") >= 2.0)),
            (format!("min_existence={existence}"), Box::new(move |feature| number(feature, "existence") >= existence)),
            (
                format!("max_lateral_sigma_m={sigma_m}"),
                Box::new(move |feature| number(feature, "lateral_sigma_m") <= sigma_m),
            ),
        ];
        for (query, wanted) in chosen {
            let expected: Vec<_> = all.iter().filter(|feature| wanted(feature)).cloned().collect();
            assert!(!expected.is_empty(), "{query}");
            let url = service.items(collection, &query);
            assert_eq!(json(&url).await["numberMatched"], expected.len(), "{collection}?{query}");
            assert_eq!(ids(&walked(&url).await), ids(&expected), "{collection}?{query}");
        }
    }
    let lanes = walked(&service.items("lanes", "")).await;
    let time = |feature: &Value, name: &str| feature["properties"][name].as_str().unwrap().to_owned();
    let at = time(&lanes[lanes.len() / 2], "first_seen");
    let later: Vec<_> = lanes.iter().filter(|lane| time(lane, "last_seen") >= at).cloned().collect();
    let during: Vec<_> = later.iter().filter(|lane| time(lane, "first_seen") <= at).cloned().collect();
    assert!(!during.is_empty() && during.len() <= later.len());
    assert_eq!(ids(&walked(&service.items("lanes", &format!("datetime={at}"))).await), ids(&during));
    assert_eq!(ids(&walked(&service.items("lanes", &format!("datetime={at}/.."))).await), ids(&later));
    assert_eq!(walked(&service.items("lanes", "datetime=../1999-12-31T00:00:00Z")).await, Vec::<Value>::new());
    let collection = json(&format!("{}/collections/lanes", service.server.url())).await;
    let interval = &collection["extent"]["temporal"]["interval"][0];
    let first = lanes.iter().map(|lane| time(lane, "first_seen")).min().unwrap();
    let last = lanes.iter().map(|lane| time(lane, "last_seen")).max().unwrap();
    assert_eq!((&interval[0], &interval[1]), (&first.into(), &last.into()));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_box_with_heights_has_what_reaches_into_them() {
    let service = Service::of(&along_a_road(25, 1, 120.0, false)).await;
    for collection in ["lanes", "control_points"] {
        let all = walked(&service.items(collection, "limit=10000")).await;
        let range = |feature: &Value| {
            let heights = coordinates(feature).into_iter().map(|coordinate| coordinate[2]);
            heights.fold((f64::MAX, f64::MIN), |(low, high), height| (low.min(height), high.max(height)))
        };
        let (low, high) = range(&all[all.len() / 2]);
        let wanted: Vec<_> =
            all.iter().filter(|feature| range(feature).1 >= low && range(feature).0 <= high).cloned().collect();
        let url = service.items(collection, &format!("limit=10000&bbox=-180,-90,{low},180,90,{high}"));
        assert_eq!(ids(&walked(&url).await), ids(&wanted), "{collection}");
        let above = service.items(collection, "bbox=-180,-90,9000,180,90,9001");
        assert_eq!(json(&above).await["numberMatched"], 0);
    }
}

/// Moves drives to another longitude.
fn moved(mut drives: Vec<WireDrive>, degrees: f64) -> Vec<WireDrive> {
    for frame in drives.iter_mut().flat_map(|drive| &mut drive.frames) {
        if let Some(place) = frame.gnss.as_mut().and_then(|gnss| gnss.position.as_mut()) {
            let moved = place.longitude_deg + degrees;
            place.longitude_deg = moved - 360.0 * (moved / 360.0).round();
        }
    }
    drives
}

/// Longitude of the middle of a drive.
fn middle_deg(drive: &WireDrive) -> f64 {
    let fixes = drive.frames.iter().filter_map(|frame| frame.gnss.as_ref()?.position.as_ref());
    let longitudes: Vec<f64> = fixes.map(|place| place.longitude_deg).collect();
    0.5 * (longitudes[0] + longitudes[longitudes.len() - 1])
}

#[tokio::test(flavor = "multi_thread")]
async fn a_road_over_the_antimeridian_is_cut_there_and_found_by_boxes_over_it() {
    let drives = along_a_road(26, 1, 200.0, false);
    let to_antimeridian = 180.0 - middle_deg(&drives[0]);
    let service = Service::of(&moved(drives, to_antimeridian)).await;
    for collection in ["lanes", "control_points", "drives"] {
        let all = walked(&service.items(collection, "limit=10000")).await;
        let mut sides = BTreeSet::new();
        for feature in &all {
            let geometry = &feature["geometry"];
            let lines = match geometry["type"].as_str().unwrap() {
                "MultiLineString" => geometry["coordinates"].as_array().unwrap().clone(),
                "LineString" => vec![geometry["coordinates"].clone()],
                _ => vec![Value::Array(vec![geometry["coordinates"].clone()])],
            };
            for line in lines {
                let longitudes: Vec<f64> =
                    line.as_array().unwrap().iter().map(|coordinate| coordinate[0].as_f64().unwrap()).collect();
                let is_east = longitudes[0] > 0.0;
                assert!(longitudes.iter().all(|longitude| (*longitude > 0.0) == is_east && longitude.abs() <= 180.0));
                sides.insert(is_east);
            }
        }
        assert_eq!(sides.len(), 2, "{collection} lie on both sides");
        let over = walked(&service.items(collection, "limit=10000&bbox=179,-90,-179,90")).await;
        assert_eq!(ids(&over), ids(&all), "{collection}");
        let west = walked(&service.items(collection, "limit=10000&bbox=170,-90,180,90")).await;
        let east = walked(&service.items(collection, "limit=10000&bbox=-180,-90,-170,90")).await;
        let both: BTreeSet<_> = ids(&west).into_iter().chain(ids(&east)).collect();
        assert_eq!(both, ids(&all).into_iter().collect(), "{collection}");
        assert!(west.len() < all.len() || east.len() < all.len(), "{collection}");
        let beside = service.items(collection, "bbox=-170,-90,170,90");
        assert_eq!(features(&json(&beside).await).len(), 0, "{collection}");
    }
    let collection = json(&format!("{}/collections/lanes", service.server.url())).await;
    let bbox = &collection["extent"]["spatial"]["bbox"][0];
    assert!(bbox[0].as_f64().unwrap() > 179.0 && bbox[2].as_f64().unwrap() < -179.0, "{bbox}");
}

#[tokio::test(flavor = "multi_thread")]
async fn every_feature_has_an_address_of_its_own_and_others_are_not_found() {
    let service = Service::of(&along_a_road(27, 1, 100.0, false)).await;
    for collection in ["lanes", "control_points", "cells", "drives"] {
        let page = json(&service.items(collection, "limit=3")).await;
        for feature in features(&page) {
            let id = feature["id"].as_str().unwrap();
            let mut single = json(&format!("{}/collections/{collection}/items/{id}", service.server.url())).await;
            assert!(link(&single, "self").unwrap().ends_with(id) && link(&single, "collection").is_some());
            single.as_object_mut().unwrap().remove("links");
            assert_eq!(single, *feature);
            let others =
                [format!("{id}x"), format!("{id}."), format!("0{id}"), id.replace("14-", "15-"), "x".to_owned()];
            // A drive's id names no cell.
            for wrong in others.into_iter().filter(|other| other != id) {
                let url = format!("{}/collections/{collection}/items/{wrong}", service.server.url());
                assert_eq!(get(&url).await.status(), StatusCode::NOT_FOUND, "{url}");
            }
        }
    }
    let nowhere = format!("{}/collections/roads/items", service.server.url());
    assert_eq!(get(&nowhere).await.status(), StatusCode::NOT_FOUND);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_landing_page_leads_to_everything_for_programs_and_for_people() {
    let service = Service::of(&along_a_road(28, 1, 60.0, false)).await;
    let base = service.server.url();
    let landing = json(&base).await;
    for (rel, kind) in [
        ("service-desc", "application/vnd.oai.openapi+json;version=3.0"),
        ("service-doc", "text/html; charset=utf-8"),
        ("conformance", "application/json"),
        ("data", "application/json"),
        ("self", "application/json"),
    ] {
        let answer = get(&link(&landing, rel).unwrap()).await;
        assert_eq!(
            (answer.status(), &answer.headers()[header::CONTENT_TYPE]),
            (StatusCode::OK, &kind.parse().unwrap())
        );
    }
    let conformance = json(&format!("{base}/conformance")).await;
    for class in ["core", "geojson", "oas30"] {
        let uri = format!("http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/{class}");
        assert!(conformance["conformsTo"].as_array().unwrap().contains(&uri.into()), "{class}");
    }
    for path in ["/", "/conformance", "/api", "/collections", "/collections/lanes"] {
        let page = http::client().get(format!("{base}{path}")).header(header::ACCEPT, "text/html,*/*;q=0.8");
        let page = page.send().await.unwrap();
        assert!(page.headers()[header::VARY].to_str().unwrap().contains("accept"), "{path}");
        let html = page.text().await.unwrap();
        assert!(html.starts_with("<!doctype html>") && !html.contains("<script"), "{path}");
        let only =
            http::client().get(format!("{base}{path}")).header(header::ACCEPT, "image/png").send().await.unwrap();
        assert_eq!(only.status(), StatusCode::NOT_ACCEPTABLE, "{path}");
    }
}

/// An address whose parts in braces are named somehow.
fn filled(path: &str) -> String {
    path.split('/').map(|part| if part.starts_with('{') { "14" } else { part }).collect::<Vec<_>>().join("/")
}

#[tokio::test(flavor = "multi_thread")]
async fn the_description_names_exactly_the_parameters_that_each_address_knows() {
    let service = Service::of(&[]).await;
    let base = service.server.url();
    let api = json(&format!("{base}/api")).await;
    assert!(api["openapi"].as_str().unwrap().starts_with("3.0."));
    assert_eq!(api["servers"][0]["url"], base);
    let mut asked = 0;
    for (path, methods) in api["paths"].as_object().unwrap() {
        let parameters = methods["get"]["parameters"].as_array().unwrap();
        let of = |place: &'static str| {
            let names = parameters.iter().filter(move |parameter| parameter["in"] == place);
            names.map(|parameter| parameter["name"].as_str().unwrap().to_owned()).collect::<BTreeSet<_>>()
        };
        let in_path: BTreeSet<_> =
            path.split('/').filter_map(|part| Some(part.strip_prefix('{')?.strip_suffix('}')?.to_owned())).collect();
        assert_eq!(of("path"), in_path, "{path}");
        if ["/healthz", "/readyz", "/metrics"].contains(&path.as_str()) {
            continue;
        }
        let answer = get(&format!("{base}{}?no-such-parameter=1", filled(path))).await;
        assert_eq!(answer.status(), StatusCode::BAD_REQUEST, "{path}");
        let detail = answer.json::<Value>().await.unwrap()["detail"].as_str().unwrap().to_owned();
        let known = detail.split_once("; known: ").unwrap().1;
        let known = known.split(", ").filter(|name| *name != "none").map(str::to_owned).collect::<BTreeSet<_>>();
        assert_eq!(known, of("query"), "{path}");
        asked += 1;
    }
    assert!(asked >= 20, "{asked}");
}
