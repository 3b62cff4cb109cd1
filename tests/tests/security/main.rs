//! Promise: nobody streams as another's vehicle, reads or administers without a right to, or listens in; who may is
//! told by certificates, tokens and settings alone; and no secret shows in a log.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::time::Duration;

use lanemap_proto::{
    encode as wire,
    v1::{self, ingest_service_client::IngestServiceClient},
};
use lanemap_server::{RunningServer, Server, ServerConfig};
use lanemap_tests::{
    authorities::{Certified, TlsFolder},
    drives,
    tokens::{self, TokenIssuer},
};
use serde_json::json;
use tempfile::TempDir;
use tokio::time::timeout;
use tonic::{Code, Request, Status, transport::Channel};

mod bearer_tokens;
mod certificates;
mod readers;
mod secrets;
mod settings;
mod zenoh_access;

/// Longest wait for something that takes milliseconds, or, for files that change, two seconds.
const PATIENCE: Duration = Duration::from_secs(20);

/// A server with mTLS and tokens, everything of it in one folder.
struct Secured {
    server: RunningServer,
    tls: TlsFolder,
    issuer: TokenIssuer,
    _folder: TempDir,
}

impl Secured {
    async fn start(adjust: impl FnOnce(ServerConfig) -> ServerConfig) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let tls = TlsFolder::new(folder.path());
        let issuer = TokenIssuer::new("key-1");
        let keys = tls.write("keys.json", &TokenIssuer::jwks(&[&issuer]));
        let config =
            ServerConfig { token_keys_file: Some(keys), token_issuer: Some(tokens::ISSUER.to_owned()), ..tls.config() };
        let server = Server::start(adjust(config)).await.unwrap();
        Self { server, tls, issuer, _folder: folder }
    }

    async fn channel(&self, client: Option<&Certified>) -> Channel {
        self.tls.channel(&self.server.url(), client).await.unwrap()
    }

    /// Uploads a frame as `vehicle`, on a connection with a certificate, or a token, or both, or neither.
    async fn upload_as(
        &self,
        vehicle: &str,
        client: Option<&Certified>,
        token: Option<&str>,
    ) -> Result<v1::UploadObservationsResponse, Status> {
        upload(self.channel(client).await, "north", vehicle, token).await
    }

    fn http(&self, client: Option<&Certified>) -> reqwest::Client {
        let tls = self.tls.client_tls(client);
        reqwest::Client::builder().tls_backend_preconfigured(tls).build().unwrap()
    }

    /// What `path` answers.
    async fn get(&self, path: &str, token: Option<&str>) -> reqwest::Response {
        let url = format!("https://localhost:{}{path}", self.server.address().port());
        let request = self.http(None).get(url);
        let request = token.iter().fold(request, reqwest::RequestBuilder::bearer_auth);
        request.send().await.unwrap()
    }
}

fn upload_request(fleet: &str, vehicle: &str) -> v1::UploadObservationsRequest {
    let drive = drives::simulated(1, 2);
    let start = v1::SessionStart { fleet_id: fleet.to_owned(), vehicle_id: vehicle.to_owned(), ..drive.wire_start() };
    let frames = drive.frames.iter().map(wire::frame).collect();
    v1::UploadObservationsRequest { start: Some(start), frames, end: false }
}

fn with_token<T>(message: T, token: Option<&str>) -> Request<T> {
    let mut request = Request::new(message);
    if let Some(token) = token {
        request.metadata_mut().insert("authorization", format!("Bearer {token}").parse().unwrap());
    }
    request
}

async fn upload(
    channel: Channel,
    fleet: &str,
    vehicle: &str,
    token: Option<&str>,
) -> Result<v1::UploadObservationsResponse, Status> {
    let request = with_token(upload_request(fleet, vehicle), token);
    let answer = timeout(PATIENCE, IngestServiceClient::new(channel).upload_observations(request)).await;
    answer.expect("no answer").map(tonic::Response::into_inner)
}

fn car(token: &TokenIssuer, vehicle: &str) -> String {
    token.token(json!({ "fleet": "north", "vehicle": vehicle, "scope": "ingest" }))
}

#[track_caller]
fn assert_code<T: std::fmt::Debug>(answer: Result<T, Status>, code: Code) {
    assert_eq!(answer.unwrap_err().code(), code);
}

/// Waits until `holds` does; it takes a file's change to be seen.
async fn eventually<F: Future<Output = bool>>(holds: impl Fn() -> F) {
    let waiting = async {
        while !holds().await {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    timeout(PATIENCE, waiting).await.expect("it never came about");
}
