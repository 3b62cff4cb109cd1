//! Reads maps over HTTP.

use std::time::Duration;

use lanemap_core::LaneMap;
use lanemap_proto::{decode, v1};
use prost::Message;

use crate::error::{ClientError, with_sources};

/// Longest wait for a map.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Reads the maps of one service. Clones share connections.
#[derive(Clone, Debug)]
pub struct MapClient {
    base: String,
    http: reqwest::Client,
}

impl MapClient {
    /// A reader of the service at `url`, e.g. `http://127.0.0.1:8080`.
    #[must_use]
    pub fn new(url: impl Into<String>) -> Self {
        // Somebody in the process must name the cryptography; where an owner has, that one counts.
        let _ = rustls::crypto::ring::default_provider().install_default();
        Self { base: url.into().trim_end_matches('/').to_owned(), http: reqwest::Client::new() }
    }

    /// The newest map of a session, as the wire has it: with the vehicle's pose and the map's place on the earth.
    ///
    /// # Errors
    /// No such session, or a service that cannot be reached.
    pub async fn lane_map_message(&self, session: &str) -> Result<v1::LaneMap, ClientError> {
        let bytes = self.get(&format!("/sessions/{session}/lanes.pb")).await?;
        v1::LaneMap::decode(bytes.as_slice()).map_err(|error| ClientError::Protocol(error.to_string()))
    }

    /// The newest lanes of a session, map frame, metres.
    ///
    /// # Errors
    /// No such session, a service that cannot be reached, or a map that does not decode.
    pub async fn lane_map(&self, session: &str) -> Result<LaneMap, ClientError> {
        Ok(decode::lane_map(&self.lane_map_message(session).await?)?)
    }

    async fn get(&self, path: &str) -> Result<Vec<u8>, ClientError> {
        let url = format!("{}{path}", self.base);
        let unreachable = |error: reqwest::Error| ClientError::Unreachable(with_sources(&error));
        let response = self.http.get(&url).timeout(TIMEOUT).send().await.map_err(unreachable)?;
        let status = response.status();
        let body = response.bytes().await.map_err(unreachable)?;
        if status.is_success() {
            return Ok(body.to_vec());
        }
        let problem: serde_json::Value = serde_json::from_slice(&body).unwrap_or_default();
        let detail = problem["detail"].as_str().unwrap_or("no detail").to_owned();
        Err(ClientError::Http { url, status: status.as_u16(), detail })
    }
}
