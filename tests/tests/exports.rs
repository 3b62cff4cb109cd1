//! Promise: whoever asks for the map in a format of their own tools gets it, with what HTTP needs to keep it, and the
//! command line writes the same.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    path::Path,
    process::{Command, Output},
};

use lanemap_server::RunningServer;
use lanemap_tests::{
    fleets::{along_a_road, cell_maps, settled},
    http, servers,
};
use reqwest::{Response, header};
use serde_json::Value;

/// Name, suffix, media type, and how a file begins.
const FORMATS: [(&str, &str, &str, &[u8]); 5] = [
    ("geojson", "geojson", "application/geo+json", b"{\"type\":\"FeatureCollection\""),
    ("flatgeobuf", "fgb", "application/vnd.flatgeobuf", b"fgb\x03fgb"),
    ("pmtiles", "pmtiles", "application/vnd.pmtiles", b"PMTiles\x03"),
    ("lanelet2", "osm", "application/vnd.openstreetmap.data+xml", b"<?xml"),
    ("opendrive", "xodr", "application/xml", b"<?xml"),
];

/// A server with the map of two drives over a border of cells.
async fn mapped(folder: &Path) -> (RunningServer, Vec<String>) {
    let server = servers::start(folder).await;
    for drive in &along_a_road(21, 2, 200.0, true) {
        drive.upload_whole(&server.url()).await;
    }
    settled(&server).await;
    let cells = cell_maps(&server.url()).await.into_iter().map(|map| map.cell).collect();
    (server, cells)
}

async fn get(server: &RunningServer, path: &str, headers: &[(&str, &str)]) -> Response {
    let request = http::client().get(format!("{}{path}", server.url()));
    headers.iter().fold(request, |request, (name, value)| request.header(*name, *value)).send().await.unwrap()
}

fn text(response: &Response, name: header::HeaderName) -> String {
    response.headers().get(name).map(|value| value.to_str().unwrap().to_owned()).unwrap_or_default()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cell_is_had_in_every_format_by_suffix_and_by_name_with_a_tag_and_a_file_name() {
    let folder = tempfile::tempdir().unwrap();
    let (server, cells) = mapped(folder.path()).await;
    let cell = &cells[0];
    for (name, suffix, media_type, start) in FORMATS {
        let answer = get(&server, &format!("/exports/{cell}.{suffix}"), &[]).await;
        assert_eq!(answer.status(), 200, "{name}");
        assert_eq!(text(&answer, header::CONTENT_TYPE), media_type);
        let disposition = text(&answer, header::CONTENT_DISPOSITION);
        assert!(disposition.starts_with(&format!("attachment; filename=\"lanemap-{cell}-v")), "{disposition}");
        assert!(disposition.ends_with(&format!(".{suffix}\"")), "{disposition}");
        let tag = text(&answer, header::ETAG);
        let body = answer.bytes().await.unwrap();
        assert!(body.starts_with(start), "{name}: {:?}", &body[..30.min(body.len())]);
        let path = format!("/exports/{cell}?format={name}");
        let held = get(&server, &path, &[("if-none-match", &tag)]).await;
        assert_eq!((held.status().as_u16(), text(&held, header::ETAG)), (304, tag), "{name}");
        assert_eq!(get(&server, &path, &[]).await.bytes().await.unwrap(), body, "{name}");
    }
    let liked = get(&server, &format!("/exports/{cell}"), &[("accept", "application/vnd.flatgeobuf")]).await;
    assert_eq!(text(&liked, header::CONTENT_TYPE), "application/vnd.flatgeobuf");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_format_that_there_is_not_is_refused_with_those_that_there_are() {
    let folder = tempfile::tempdir().unwrap();
    let (server, cells) = mapped(folder.path()).await;
    let cell = &cells[0];
    for (path, accept, status, kind) in [
        (format!("/exports/{cell}?format=shapefile"), "*/*", 400, "bad-parameter"),
        (format!("/exports/{cell}.osm?format=geojson"), "*/*", 400, "bad-parameter"),
        (format!("/exports/{cell}.osm?traffic=up"), "*/*", 400, "bad-parameter"),
        (format!("/exports/{cell}?side=left"), "*/*", 400, "unknown-parameter"),
        (format!("/exports/{cell}"), "image/png", 406, "not-acceptable"),
        (format!("/exports/{cell}.shp"), "*/*", 404, "no-such-path"),
        ("/exports/14-0-0.osm".to_owned(), "*/*", 404, "no-such-cell"),
        ("/exports/somewhere".to_owned(), "*/*", 404, "no-such-cell"),
    ] {
        let answer = get(&server, &path, &[("accept", accept)]).await;
        assert_eq!(answer.status().as_u16(), status, "{path}");
        let problem: Value = answer.json().await.unwrap();
        assert_eq!(problem["type"], format!("urn:lanemap:problem:{kind}"), "{path}");
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn geojson_has_the_features_that_are_served() {
    let folder = tempfile::tempdir().unwrap();
    let (server, cells) = mapped(folder.path()).await;
    let mut exported = Vec::new();
    for cell in &cells {
        let export: Value = get(&server, &format!("/exports/{cell}.geojson"), &[]).await.json().await.unwrap();
        exported.extend(export["features"].as_array().unwrap().clone());
    }
    let items: Value = get(&server, "/collections/lanes/items", &[]).await.json().await.unwrap();
    assert!(exported.len() > 6);
    assert_eq!(Value::Array(exported), items["features"]);
    server.shutdown().await;
}

fn export(arguments: &[&str]) -> Output {
    let binary = env!("CARGO_BIN_EXE_lanemap-under-test");
    Command::new(binary).arg("export").args(arguments).output().unwrap()
}

/// The same, beside a server in this process.
async fn export_beside(arguments: Vec<String>) -> Output {
    let run = move || export(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    tokio::task::spawn_blocking(run).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_command_line_exports_the_same_from_a_server_and_from_its_store_once_it_is_closed() {
    let folder = tempfile::tempdir().unwrap();
    let out = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let (server, cells) = mapped(&store).await;
    assert_eq!(cells.len(), 2);
    let path = |name: &str| out.path().join(name).to_str().unwrap().to_owned();
    let mut from_server = Vec::new();
    for (name, suffix, ..) in FORMATS {
        let output = path(&format!("server.{suffix}"));
        let server_url = server.url();
        let done =
            export_beside(["--format", name, "--server", &server_url, "--output", &output].map(str::to_owned).to_vec())
                .await;
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        from_server.push(std::fs::read(&output).unwrap());
    }
    let one = path("one.geojson");
    let asked = ["--format", "geojson", "--cell", &cells[0], "--server", &server.url(), "--output", &one];
    assert!(export_beside(asked.map(str::to_owned).to_vec()).await.status.success());
    let served = get(&server, &format!("/exports/{}.geojson", cells[0]), &[]).await.bytes().await.unwrap();
    assert_eq!(std::fs::read(&one).unwrap(), served);

    let refused = export(&["--format", "geojson", "--store", store.to_str().unwrap(), "--output", &path("x")]);
    let error = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && error.contains("--server"), "{error}");
    server.shutdown().await;

    for ((name, suffix, ..), bytes) in FORMATS.iter().zip(from_server) {
        let output = path(&format!("store.{suffix}"));
        let done = export(&["--format", name, "--store", store.to_str().unwrap(), "--output", &output]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        assert_eq!(std::fs::read(&output).unwrap(), bytes, "{name}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_command_line_takes_lines_that_enter_a_box_and_refuses_what_is_none() {
    let folder = tempfile::tempdir().unwrap();
    let out = tempfile::tempdir().unwrap();
    let (server, _) = mapped(folder.path()).await;
    let items: Value = get(&server, "/collections/lanes/items", &[]).await.json().await.unwrap();
    let place = items["features"][0]["geometry"]["coordinates"][0].clone();
    let (longitude, latitude) = (place[0].as_f64().unwrap(), place[1].as_f64().unwrap());
    let bbox = format!("{},{},{},{}", longitude - 1e-6, latitude - 1e-6, longitude + 1e-6, latitude + 1e-6);
    let output = out.path().join("box.geojson").to_str().unwrap().to_owned();
    let asked = ["--format", "geojson", "--bbox", &bbox, "--server", &server.url(), "--output", &output];
    assert!(export_beside(asked.map(str::to_owned).to_vec()).await.status.success());
    let served: Value = get(&server, &format!("/collections/lanes/items?bbox={bbox}"), &[]).await.json().await.unwrap();
    let written: Value = serde_json::from_slice(&std::fs::read(&output).unwrap()).unwrap();
    assert!(!served["features"].as_array().unwrap().is_empty());
    assert_eq!(written["features"], served["features"]);
    for (arguments, reason) in [
        (vec!["--bbox", "1,2,3"], "4 or 6 numbers"),
        (vec!["--cell", "13-1-1"], "14-x-y"),
        (vec!["--format", "shapefile"], "geojson"),
        (vec!["--store", "/no/such/folder"], "no such folder"),
    ] {
        let given = if arguments[0] == "--format" { vec![] } else { vec!["--format", "geojson"] };
        let refused = export(&[given, arguments.clone(), vec!["--output", &output]].concat());
        let error = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(!refused.status.success() && error.contains(reason), "{arguments:?}: {error}");
    }
    server.shutdown().await;
}
