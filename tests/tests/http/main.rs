//! HTTP: a drive that was uploaded is served as GeoJSON, as protobuf and page by page; what is refused says why.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod transfer;

use std::collections::BTreeSet;

use geojson::{Feature, FeatureCollection, GeoJson, GeometryValue, Position};
use lanemap_proto::v1::{self, ingest_service_client::IngestServiceClient};
use lanemap_server::{RunningServer, Server, ServerConfig, session::SessionState};
use lanemap_tests::servers;
use prost::Message;
use reqwest::{Method, Response, StatusCode, header};
use serde_json::Value;
use tempfile::TempDir;

/// Names that no answer may hold.
const FLEET: &str = "fleet-of-secrets";
const VEHICLE: &str = "vehicle-of-secrets";

/// Where the georeferenced drives begin; they head north.
const LATITUDE_DEG: f64 = 48.14;
const LONGITUDE_DEG: f64 = 11.58;
const HEIGHT_M: f64 = 520.0;
/// How far the two lines of the road lie to each side, metres.
const SIDE_M: f64 = 1.75;
/// Frames of a drive, 1 m apart.
const FRAMES: u64 = 40;

/// A server with a store of its own, and a client.
struct Service {
    server: RunningServer,
    client: reqwest::Client,
    _data: TempDir,
}

impl Service {
    async fn start() -> Self {
        Self::start_with(|_| {}).await
    }

    async fn start_with(set: impl FnOnce(&mut ServerConfig)) -> Self {
        let data = tempfile::tempdir().unwrap();
        let mut config = servers::config(data.path());
        set(&mut config);
        let server = Server::start(config).await.unwrap();
        Self { server, client: lanemap_tests::http::client(), _data: data }
    }

    /// Uploads a whole drive over gRPC and waits until its map is published as closed; gives the session's id.
    async fn drive(&self, drive_id: &str, with_gnss: bool) -> String {
        let mut ingest = IngestServiceClient::connect(self.server.url()).await.unwrap();
        let request = v1::UploadObservationsRequest {
            start: Some(start(drive_id)),
            frames: (1..=FRAMES).map(|sequence| frame(sequence, with_gnss)).collect(),
            end: true,
        };
        let answer = ingest.upload_observations(request).await.unwrap().into_inner();
        assert_eq!(answer.refusals, [], "the drive is valid");
        assert_eq!(answer.acked_sequence_inclusive, Some(FRAMES));
        let id = answer.accepted.unwrap().session_id;
        let session = id.parse().unwrap();
        let mut publications = self.server.sessions().publications();
        while self.server.sessions().get(&session).is_none_or(|map| map.state != SessionState::Closed) {
            publications.changed().await.unwrap();
        }
        assert_eq!(self.server.sessions().get(&session).unwrap().version.0, FRAMES);
        id
    }

    async fn request(&self, method: Method, path: &str, headers: &[(header::HeaderName, &str)]) -> Response {
        // A link of an answer is whole.
        let url = if path.starts_with("http") { path.to_owned() } else { format!("{}{path}", self.server.url()) };
        let mut request = self.client.request(method, url);
        for (name, value) in headers {
            request = request.header(name, *value);
        }
        request.send().await.unwrap()
    }

    async fn get(&self, path: &str) -> Response {
        self.request(Method::GET, path, &[]).await
    }

    async fn json(&self, path: &str) -> Value {
        let response = self.get(path).await;
        assert_eq!(response.status(), StatusCode::OK, "{path}");
        response.json().await.unwrap()
    }

    async fn features(&self, path: &str) -> FeatureCollection {
        let response = self.get(path).await;
        assert_eq!(response.status(), StatusCode::OK, "{path}");
        assert_eq!(response.headers()[header::CONTENT_TYPE], "application/geo+json");
        response.text().await.unwrap().parse::<GeoJson>().unwrap().try_into().unwrap()
    }

    /// The problem document at a path that is refused.
    async fn problem(&self, path: &str, status: StatusCode) -> Value {
        let response = self.get(path).await;
        assert_eq!(response.status(), status, "{path}");
        assert_eq!(response.headers()[header::CONTENT_TYPE], "application/problem+json");
        let problem: Value = response.json().await.unwrap();
        assert_eq!(problem["status"], status.as_u16());
        problem
    }
}

fn pose(x: f64, z: f64) -> v1::Pose {
    v1::Pose {
        position: Some(v1::Point { x, y: 0.0, z }),
        rotation: Some(v1::Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }),
    }
}

fn start(drive_id: &str) -> v1::SessionStart {
    v1::SessionStart {
        fleet_id: FLEET.into(),
        vehicle_id: VEHICLE.into(),
        drive_id: drive_id.into(),
        preset: v1::MapperPreset::Default.into(),
        sensor: Some(v1::Sensor {
            vehicle_from_sensor: Some(pose(1.5, 1.5)),
            axis_convention: v1::AxisConvention::Vehicle.into(),
            field_of_view: None,
        }),
        wants_local_map: false,
    }
}

/// A frame of a straight drive between a dashed line on the left and a solid one on the right.
fn frame(sequence: u64, with_gnss: bool) -> v1::Frame {
    let travelled_m = sequence as f64 - 1.0;
    let line = |category: v1::LaneCategory, y: f64| v1::Detection {
        category: category.into(),
        xyz: (0..45).flat_map(|step| [5.0 + f64::from(step), y, 0.0]).collect(),
    };
    v1::Frame {
        sequence,
        time_unix_ns: 1_700_000_000_000_000_000 + i64::try_from(sequence).unwrap() * 100_000_000,
        odometry: Some(v1::Odometry { odometry_from_vehicle: Some(pose(travelled_m, 0.0)), motion_covariance: None }),
        gnss: with_gnss.then(|| v1::GnssFix {
            position: Some(v1::GeodeticPosition {
                latitude_deg: LATITUDE_DEG + travelled_m / 111_210.0,
                longitude_deg: LONGITUDE_DEG,
                height_m: HEIGHT_M,
            }),
            horizontal_sigma_m: 0.5,
            vertical_sigma_m: 1.0,
            yaw_enu_rad: Some(std::f64::consts::FRAC_PI_2),
        }),
        detections: vec![line(v1::LaneCategory::WhiteDashed, SIDE_M), line(v1::LaneCategory::WhiteSolid, -SIDE_M)],
        occlusions: vec![],
    }
}

fn coordinates(feature: &Feature) -> &[Position] {
    match &feature.geometry.as_ref().unwrap().value {
        GeometryValue::LineString { coordinates } => coordinates,
        other => panic!("a lane is a line, and this is {}", other.type_name()),
    }
}

fn property<'a>(feature: &'a Feature, name: &str) -> &'a Value {
    feature.property(name).unwrap_or_else(|| panic!("a feature has {name}"))
}

/// The drive's two lines, by category.
fn line_of<'a>(features: &'a FeatureCollection, category: &str) -> &'a Feature {
    features.features.iter().find(|feature| property(feature, "category") == category).expect("the line is in the map")
}

#[tokio::test]
async fn a_session_without_gnss_is_refused_in_degrees_and_served_in_metres() {
    let service = Service::start().await;
    let id = service.drive("no-gnss", false).await;

    let problem = service.problem(&format!("/sessions/{id}/lanes.geojson"), StatusCode::CONFLICT).await;
    assert_eq!(problem["type"], "urn:lanemap:problem:not-georeferenced");
    assert!(problem["detail"].as_str().unwrap().contains("?crs=local"));

    let local = service.features(problem["alternate"].as_str().unwrap()).await;
    let frame = &local.foreign_members.as_ref().unwrap()["frame"];
    assert_eq!((&frame["name"], &frame["unit"]), (&"map".into(), &"metre".into()));
    for (category, y) in [("white_dashed", SIDE_M), ("white_solid", -SIDE_M)] {
        let line = coordinates(line_of(&local, category));
        assert!(line.iter().all(|point| (point[1] - y).abs() < 0.1), "{category}: {line:?}");
        assert!(line[line.len() - 1][0] - line[0][0] > 40.0, "{category} is as long as what was seen");
    }
}

#[tokio::test]
async fn a_georeferenced_session_is_served_in_degrees_with_heights() {
    let service = Service::start().await;
    let id = service.drive("gnss", true).await;

    let listed = &service.json("/sessions").await["sessions"][0];
    assert_eq!((&listed["id"], &listed["georeferenced"]), (&id.clone().into(), &true.into()));
    assert_eq!(listed["frames"], FRAMES);
    let heading = listed["vehicle"]["heading_deg"].as_f64().unwrap();
    assert!(heading.min(360.0 - heading) < 0.5, "{heading} degrees is not north");
    let address = listed["links"].as_array().unwrap().iter().find(|link| link["rel"] == "lanes").unwrap();

    let lanes = service.features(address["href"].as_str().unwrap()).await;
    let metres_per_degree = 111_320.0 * LATITUDE_DEG.to_radians().cos();
    for (category, to_the_east_m) in [("white_dashed", -SIDE_M), ("white_solid", SIDE_M)] {
        for place in coordinates(line_of(&lanes, category)) {
            let east_m = (place[0] - LONGITUDE_DEG) * metres_per_degree;
            assert!((east_m - to_the_east_m).abs() < 0.3, "{category}: {east_m} m east");
            assert!((place[2] - HEIGHT_M).abs() < 0.5, "{category}: {} m high", place[2]);
        }
    }
}

#[tokio::test]
async fn the_protobuf_has_the_lanes_of_the_geojson_as_splines() {
    let service = Service::start().await;
    let id = service.drive("splines", true).await;
    let features = service.features(&format!("/sessions/{id}/lanes.geojson?crs=local")).await;

    let response = service.get(&format!("/sessions/{id}/lanes.pb")).await;
    assert_eq!(response.headers()[header::CONTENT_TYPE], "application/x-protobuf");
    let map = v1::LaneMap::decode(response.bytes().await.unwrap()).unwrap();

    assert_eq!(map.last_sequence_inclusive, Some(FRAMES));
    assert!(map.georeference.is_some());
    let numbers: Vec<_> = map.lanes.iter().map(|lane| lane.id).collect();
    let served: Vec<_> = features.features.iter().map(|lane| property(lane, "lane").as_u64().unwrap()).collect();
    assert_eq!(numbers, served);
    assert!(map.lanes.iter().all(|lane| lane.control_points.len() > 10));
}

#[tokio::test]
async fn an_unchanged_map_is_answered_304_until_a_frame_comes() {
    let service = Service::start().await;
    let id = service.drive("first", true).await;
    let lanes = format!("/sessions/{id}/lanes.geojson");
    for path in
        ["/sessions", lanes.as_str(), &format!("/sessions/{id}/lanes.pb"), "/collections/drives/items", "/viewer"]
    {
        let first = service.get(path).await;
        let tag = first.headers()[header::ETAG].to_str().unwrap().to_owned();
        assert!(tag.starts_with('"'), "{path}: {tag} is a strong tag");
        let again = service.request(Method::GET, path, &[(header::IF_NONE_MATCH, &tag)]).await;
        assert_eq!(again.status(), StatusCode::NOT_MODIFIED, "{path}");
        assert_eq!(again.headers()[header::ETAG], tag.as_str());
        assert_eq!(again.bytes().await.unwrap().len(), 0);
    }

    let tag = service.get("/sessions").await.headers()[header::ETAG].to_str().unwrap().to_owned();
    service.drive("second", true).await;
    let changed = service.request(Method::GET, "/sessions", &[(header::IF_NONE_MATCH, &tag)]).await;
    assert_eq!(changed.status(), StatusCode::OK);
}

#[tokio::test]
async fn a_compressed_answer_is_gzip_with_a_tag_of_its_own_that_is_known_again() {
    let service = Service::start().await;
    let id = service.drive("compressed", true).await;
    let path = format!("/sessions/{id}/lanes.geojson");
    let plain = service.get(&path).await.headers()[header::ETAG].to_str().unwrap().to_owned();

    let compressed = service.request(Method::GET, &path, &[(header::ACCEPT_ENCODING, "gzip")]).await;
    assert_eq!(compressed.headers()[header::CONTENT_ENCODING], "gzip");
    assert_eq!(compressed.headers()[header::VARY], "accept-encoding");
    let tag = compressed.headers()[header::ETAG].to_str().unwrap().to_owned();
    assert_ne!(tag, plain);
    assert_eq!(compressed.bytes().await.unwrap()[..2], [0x1f, 0x8b]);

    let headers = [(header::ACCEPT_ENCODING, "gzip"), (header::IF_NONE_MATCH, tag.as_str())];
    let again = service.request(Method::GET, &path, &headers).await;
    assert_eq!(again.status(), StatusCode::NOT_MODIFIED);
}

#[tokio::test]
async fn a_parameter_that_is_malformed_or_not_known_is_refused_by_its_name() {
    let service = Service::start().await;
    let id = service.drive("parameters", true).await;
    for (query, parameter) in [
        ("bbox=1,2,3", "bbox"),
        ("bbox=1,2,nan,4", "bbox"),
        ("bbox=11,49,12,48", "bbox"),
        ("limit=0", "limit"),
        ("limit=many", "limit"),
        ("cursor=somewhere", "cursor"),
        ("bbbox=1,2,3,4", "bbbox"),
        ("limit=1&limit=2", "limit"),
    ] {
        for collection in ["lanes", "drives"] {
            let path = format!("/collections/{collection}/items?{query}");
            let problem = service.problem(&path, StatusCode::BAD_REQUEST).await;
            assert_eq!(problem["parameter"], parameter, "{path}: {problem}");
        }
    }
    let crs = service.problem(&format!("/sessions/{id}/lanes.geojson?crs=utm"), StatusCode::BAD_REQUEST).await;
    assert_eq!(crs["parameter"], "crs");
    assert_eq!(crs["detail"], "parameter \"crs\" = \"utm\": it must be wgs84 or local");
}

#[tokio::test]
async fn pages_that_are_linked_by_next_hold_every_lane_of_the_georeferenced_sessions_once() {
    let service = Service::start().await;
    service.drive("a", true).await;
    let without_gnss = service.drive("b", false).await;
    service.drive("c", true).await;

    let mut path = "/collections/drives/items?limit=1&bbox=11.5,48.1,11.7,48.2".to_owned();
    let mut seen = Vec::new();
    loop {
        let page = service.features(&path).await;
        assert_eq!(page.features.len(), 1);
        for name in ["session", "lane", "category", "existence", "sigma_m", "observations", "first_seen", "last_seen"] {
            assert!(!property(&page.features[0], name).is_null(), "{name}");
        }
        assert_ne!(property(&page.features[0], "session"), without_gnss.as_str());
        seen.push(format!("{:?}", page.features[0].id));
        let links = page.foreign_members.unwrap()["links"].clone();
        let Some(next) = links.as_array().unwrap().iter().find(|link| link["rel"] == "next") else { break };
        path = next["href"].as_str().unwrap().to_owned();
    }
    assert_eq!(seen.iter().collect::<BTreeSet<_>>().len(), seen.len(), "no lane comes twice");
    let whole = service.features("/collections/drives/items").await;
    assert_eq!(seen, whole.features.iter().map(|feature| format!("{:?}", feature.id)).collect::<Vec<_>>());
    assert!(service.features("/collections/drives/items?bbox=0,0,1,1").await.features.is_empty());
}

#[tokio::test]
async fn a_head_request_has_the_headers_of_its_get_and_no_body() {
    let service = Service::start().await;
    let id = service.drive("head", true).await;
    for path in ["/sessions", &format!("/sessions/{id}/lanes.geojson"), "/healthz", "/viewer"] {
        let get = service.get(path).await;
        let head = service.request(Method::HEAD, path, &[]).await;
        assert_eq!(head.status(), StatusCode::OK, "{path}");
        for name in [header::CONTENT_TYPE, header::CONTENT_LENGTH, header::ETAG] {
            assert_eq!(head.headers().get(&name), get.headers().get(&name), "{path}: {name}");
        }
        assert_eq!(head.bytes().await.unwrap().len(), 0);
    }
}

#[tokio::test]
async fn an_unknown_path_is_a_problem_of_http_and_an_unknown_grpc_method_one_of_grpc() {
    let service = Service::start().await;
    for path in
        ["/nothing", "/sessions/", "/sessions/0123456789abcdef/lanes.geojson", "/sessions/x/lanes.pb", "/viewer/x.js"]
    {
        let response = service.get(path).await;
        assert_eq!(response.status(), StatusCode::NOT_FOUND, "{path}");
        assert_eq!(response.headers()[header::CONTENT_TYPE], "application/problem+json", "{path}");
        assert!(response.headers().get("grpc-status").is_none(), "{path}");
    }
    let grpc = [(header::CONTENT_TYPE, "application/grpc")];
    let response = service.request(Method::POST, "/lanemap.v1.NoService/NoMethod", &grpc).await;
    assert_eq!((response.status(), &response.headers()["grpc-status"]), (StatusCode::OK, &"12".parse().unwrap()));
}

#[tokio::test]
async fn a_wrong_method_is_refused_with_the_methods_that_are_allowed() {
    let service = Service::start().await;
    let response = service.request(Method::DELETE, "/sessions", &[]).await;
    assert_eq!(response.status(), StatusCode::METHOD_NOT_ALLOWED);
    assert_eq!(response.headers()[header::ALLOW], "GET,HEAD");
    assert_eq!(response.headers()[header::CONTENT_TYPE], "application/problem+json");
}

#[tokio::test]
async fn no_answer_names_the_fleet_the_vehicle_or_the_drive() {
    let service = Service::start().await;
    let id = service.drive("drive-of-secrets", true).await;
    for path in [
        "/sessions",
        &format!("/sessions/{id}/lanes.geojson"),
        &format!("/sessions/{id}/lanes.geojson?crs=local"),
        &format!("/sessions/{id}/lanes.pb"),
        "/",
        "/api",
        "/collections",
        "/collections/lanes/items",
        "/collections/control_points/items",
        "/collections/cells/items",
        "/collections/drives/items",
        "/cells",
        "/metrics",
        "/healthz",
        "/readyz",
    ] {
        let response = service.get(path).await;
        assert_eq!(response.status(), StatusCode::OK, "{path}");
        let body = response.bytes().await.unwrap();
        assert!(!String::from_utf8_lossy(&body).contains("of-secrets"), "{path}");
    }
    let metrics = service.get("/metrics").await.text().await.unwrap();
    assert!(!metrics.is_empty() && !metrics.contains("vehicle=") && !metrics.contains(&id), "{metrics}");
}

#[tokio::test]
async fn the_viewer_and_all_that_it_loads_are_served_from_here() {
    let service = Service::start().await;
    let page = service.get("/viewer").await;
    assert!(page.headers()[header::CONTENT_SECURITY_POLICY].to_str().unwrap().contains("connect-src 'self'"));
    let html = page.text().await.unwrap();
    let files: Vec<_> =
        html.split('"').filter(|text| text.starts_with("viewer/") && !text.contains("maplibre-gl.css")).collect();
    assert!(files.contains(&"viewer/viewer.js") && files.contains(&"viewer/viewer.css"), "{files:?}");
    for file in files {
        let response = service.get(&format!("/{file}?v=1")).await;
        assert_eq!(response.status(), StatusCode::OK, "{file}");
        assert!(!response.bytes().await.unwrap().is_empty(), "{file}");
    }
}
