//! Promise: a collector of traces sees what the service does with a vehicle's frames, and neither vehicle, drive nor fleet.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
    time::Duration,
};

use lanemap_proto::{
    encode,
    v1::{self, stream_observations_request},
};
use lanemap_tests::{drives, http, raw_stream::RawStream};
use opentelemetry_proto::tonic::{
    collector::trace::v1::{
        ExportTraceServiceRequest, ExportTraceServiceResponse,
        trace_service_server::{TraceService, TraceServiceServer},
    },
    common::v1::any_value::Value,
    trace::v1::Span,
};
use prost::Message;
use tokio::{net::TcpListener, sync::mpsc, time::timeout};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, transport::Server};

/// Longest wait for what takes seconds: spans are sent in batches, every five seconds.
const PATIENCE: Duration = Duration::from_mins(1);

/// The command as a process of its own; killed where a test fails, too.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Passes on what it is sent.
struct Collector(mpsc::UnboundedSender<ExportTraceServiceRequest>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        self.0.send(request.into_inner()).map_err(|_| Status::unavailable("the test is over"))?;
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

fn spans(export: &ExportTraceServiceRequest) -> impl Iterator<Item = &Span> {
    export.resource_spans.iter().flat_map(|resource| &resource.scope_spans).flat_map(|scope| &scope.spans)
}

fn attribute(span: &Span, key: &str) -> Option<String> {
    let found = span.attributes.iter().find(|attribute| attribute.key == key)?;
    match found.value.as_ref()?.value.as_ref()? {
        Value::StringValue(text) => Some(text.clone()),
        Value::IntValue(number) => Some(number.to_string()),
        other => Some(format!("{other:?}")),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_collector_sees_the_frames_of_a_stream_and_no_name_of_its_vehicle() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let collector = format!("http://{}", listener.local_addr().unwrap());
    let (sender, mut exports) = mpsc::unbounded_channel();
    let service = TraceServiceServer::new(Collector(sender));
    tokio::spawn(Server::builder().add_service(service).serve_with_incoming(TcpListenerStream::new(listener)));

    let folder = tempfile::tempdir().unwrap();
    let child = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
        .args(["serve", "--listen", "127.0.0.1:0", "--otlp-endpoint", &collector, "--data-dir"])
        .arg(folder.path())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lanemap = Running(child);
    let line = BufReader::new(lanemap.0.stdout.take().unwrap()).lines().next().unwrap().unwrap();
    let url =
        line.split_whitespace().find(|word| word.starts_with("http://")).unwrap().trim_end_matches(',').to_owned();

    let drive = drives::simulated(1, 20);
    let mut start = drive.wire_start();
    (start.fleet_id, start.vehicle_id, start.drive_id) =
        ("blue-fleet".to_owned(), "truck-4711".to_owned(), "trip-0815".to_owned());
    let (mut stream, _) = RawStream::started(&url, start).await;
    for frame in &drive.frames {
        stream.send_frame(encode::frame(frame)).await;
    }
    stream.acked(20).await;
    stream.send(stream_observations_request::Message::End(v1::SessionEnd {})).await;
    stream.end().await.unwrap();
    assert_eq!(http::get(format!("{url}/sessions")).await.unwrap().status().as_u16(), 200);

    let (mut committed, mut streamed, mut asked) = (0_u64, false, false);
    let receiving = async {
        while !(committed >= 20 && streamed && asked) {
            let export = exports.recv().await.expect("the collector runs");
            let text = String::from_utf8_lossy(&export.encode_to_vec()).into_owned();
            for name in ["blue-fleet", "truck-4711", "trip-0815"] {
                assert!(!text.contains(name), "{name} in {export:?}");
            }
            for span in spans(&export) {
                let route = attribute(span, "route").unwrap_or_default();
                committed += attribute(span, "frames").and_then(|frames| frames.parse::<u64>().ok()).unwrap_or(0);
                streamed |= span.name == "request" && route.contains("IngestService");
                asked |= span.name == "request" && route == "/sessions" && attribute(span, "status").unwrap() == "200";
            }
        }
    };
    let received = timeout(PATIENCE, receiving).await;
    drop(lanemap);
    assert!(received.is_ok(), "{committed} frames committed, stream seen: {streamed}, request seen: {asked}");
}
