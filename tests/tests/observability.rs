//! Promise: who runs the service sees what it does, and no vehicle in it; balancers hear of a stop before streams do.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{collections::BTreeSet, fs, path::Path, time::Duration};

use lanemap_proto::encode;
use lanemap_server::{Server, ServerConfig};
use lanemap_tests::{drives, http, raw_stream::RawStream, servers};
use tonic::{Code, transport::Channel};
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};

const DEPLOY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy");

async fn get(url: &str) -> (u16, String) {
    let response = http::get(url).await.unwrap();
    (response.status().as_u16(), response.text().await.unwrap())
}

/// The metrics of a server that has mapped a drive and refused a frame.
async fn metrics_after_a_drive() -> String {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(1, 20);
    let (mut stream, _) = RawStream::started(&server.url(), drive.wire_start()).await;
    for frame in &drive.frames {
        stream.send_frame(encode::frame(frame)).await;
    }
    stream.acked(20).await;
    get(&format!("{}/sessions", server.url())).await;
    get(&format!("{}/no/such/path/vehicle-77", server.url())).await;
    let (status, metrics) = get(&format!("{}/metrics", server.url())).await;
    assert_eq!(status, 200);
    server.shutdown().await;
    metrics
}

fn names(metrics: &str) -> BTreeSet<&str> {
    let samples = metrics.lines().filter(|line| !line.starts_with('#') && !line.is_empty());
    samples.filter_map(|line| line.split(['{', ' ']).next()).collect()
}

/// Names of metrics in a text of queries.
fn queried(text: &str) -> BTreeSet<&str> {
    let words = text.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '_');
    words.filter(|word| word.starts_with("lanemap_") || word.starts_with("process_")).collect()
}

fn files(folder: &str, ending: &str) -> Vec<String> {
    let entries = fs::read_dir(Path::new(DEPLOY).join(folder)).unwrap();
    let paths = entries.map(|entry| entry.unwrap().path());
    paths
        .filter(|path| path.to_string_lossy().ends_with(ending))
        .map(|path| fs::read_to_string(path).unwrap())
        .collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn dashboards_and_alerts_ask_for_metrics_that_the_service_has() {
    let metrics = metrics_after_a_drive().await;
    let known = names(&metrics);
    let asking = [files("grafana/dashboards", ".json"), files("prometheus", "alerts.yaml")].concat();
    assert!(asking.len() >= 2, "there are no dashboards or no alerts");
    for text in &asking {
        let wanted = queried(text);
        assert!(!wanted.is_empty());
        for name in wanted {
            assert!(known.contains(name), "{name} is asked for, but the service has {known:#?}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_name_no_vehicle_no_session_and_no_path_of_a_client() {
    let metrics = metrics_after_a_drive().await;
    for line in metrics.lines().filter(|line| !line.starts_with('#')) {
        for label in ["vehicle", "session=", "drive", "fleet", "no/such/path"] {
            assert!(!line.contains(label), "{label} in {line}");
        }
    }
    assert!(
        metrics.contains(r#"lanemap_http_requests_total{method="GET",route="/sessions",status="200"}"#),
        "{metrics}"
    );
    assert!(metrics.contains(r#"route="none",status="404""#), "{metrics}");
    for name in ["process_resident_memory_bytes", "process_cpu_seconds_total", "process_open_fds"] {
        assert!(names(&metrics).contains(name), "{name} is missing");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn readiness_falls_before_streams_end() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServerConfig { drain_delay_ms: 3_000, ..servers::config(folder.path()) };
    let server = Server::start(config).await.unwrap();
    let readyz = format!("{}/readyz", server.url());
    assert_eq!(get(&readyz).await.0, 200);
    let drive = drives::simulated(2, 10);
    let (mut stream, _) = RawStream::started(&server.url(), drive.wire_start()).await;
    let mut health = HealthClient::new(Channel::from_shared(server.url()).unwrap().connect().await.unwrap());
    let service = "lanemap.v1.MapService".to_owned();
    let mut watch = health.watch(HealthCheckRequest { service }).await.unwrap().into_inner();
    assert_eq!(watch.message().await.unwrap().unwrap().status(), ServingStatus::Serving);

    let told = std::time::Instant::now();
    server.shutdown_token().cancel();
    assert_eq!(watch.message().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert_eq!(get(&readyz).await.0, 503);
    for frame in &drive.frames {
        stream.send_frame(encode::frame(frame)).await;
    }
    stream.acked(10).await;
    assert_eq!(stream.end().await.unwrap_err().code(), Code::Unavailable);
    assert!(told.elapsed() >= Duration::from_secs(3), "the drain began before its time");
    server.stopped().await;
}
