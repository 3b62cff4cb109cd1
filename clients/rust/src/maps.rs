//! Reads maps over HTTP: those of drives, and the cells of the shared one.

mod cells;

use std::{sync::Arc, time::Duration};

use lanemap_core::LaneMap;
use lanemap_proto::{decode, v1};
use prost::Message;
use reqwest::{StatusCode, header};
use rustls::{
    ClientConfig, RootCertStore,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
};

use crate::{
    credentials::{Credentials, Tls},
    error::{ClientError, with_sources},
};

/// Longest wait for a map.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Reads the maps of one service. Clones share connections.
#[derive(Clone, Debug)]
pub struct MapClient {
    base: String,
    http: reqwest::Client,
    credentials: Credentials,
}

impl MapClient {
    /// A reader of the service at `url`, e.g. `http://127.0.0.1:8080`.
    #[must_use]
    pub fn new(url: impl Into<String>) -> Self {
        name_cryptography();
        Self { base: base(&url.into()), http: reqwest::Client::new(), credentials: Credentials::default() }
    }

    /// A reader of a service that asks who reads, or that shows a certificate, e.g. at `https://lanemap.example`.
    ///
    /// # Errors
    /// Certificates that cannot be read.
    pub async fn with(url: impl Into<String>, credentials: &Credentials) -> Result<Self, ClientError> {
        let url = url.into();
        name_cryptography();
        let mut http = reqwest::Client::builder();
        if url.starts_with("https") {
            http = http.tls_backend_preconfigured(client_config(&credentials.tls(&url).await?)?);
        }
        let http = http.build().map_err(|error| ClientError::Credentials(with_sources(&error)))?;
        Ok(Self { base: base(&url), http, credentials: credentials.clone() })
    }

    /// The newest map of a session, as the wire has it: with the vehicle's pose and the map's place on the earth.
    ///
    /// # Errors
    /// No such session, or a service that cannot be reached.
    pub async fn lane_map_message(&self, session: &str) -> Result<v1::LaneMap, ClientError> {
        v1::LaneMap::decode(self.lane_map_bytes(session).await?.as_slice())
            .map_err(|error| ClientError::Protocol(error.to_string()))
    }

    /// The same, as it came: `/sessions/{id}/lanes.pb`.
    ///
    /// # Errors
    /// No such session, or a service that cannot be reached.
    pub async fn lane_map_bytes(&self, session: &str) -> Result<Vec<u8>, ClientError> {
        self.get(&format!("/sessions/{session}/lanes.pb")).await
    }

    /// The newest lanes of a session, map frame, metres.
    ///
    /// # Errors
    /// No such session, a service that cannot be reached, or a map that does not decode.
    pub async fn lane_map(&self, session: &str) -> Result<LaneMap, ClientError> {
        Ok(decode::lane_map(&self.lane_map_message(session).await?)?)
    }

    async fn get(&self, path: &str) -> Result<Vec<u8>, ClientError> {
        let answer = self.get_newer(path, None).await?;
        answer
            .map(|answer| answer.body)
            .ok_or_else(|| ClientError::Protocol("an answer that was not asked for".to_owned()))
    }

    /// What is at a path; `None` where that is what the reader holds under `held_tag`.
    pub(crate) async fn get_newer(&self, path: &str, held_tag: Option<&str>) -> Result<Option<Answer>, ClientError> {
        let url = format!("{}{path}", self.base);
        let unreachable = |error: reqwest::Error| ClientError::Unreachable(with_sources(&error));
        let mut request = self.http.get(&url).timeout(TIMEOUT);
        if let Some(token) = self.credentials.bearer().await? {
            request = request.bearer_auth(token);
        }
        if let Some(tag) = held_tag {
            request = request.header(header::IF_NONE_MATCH, tag);
        }
        let response = request.send().await.map_err(unreachable)?;
        let status = response.status();
        if status == StatusCode::NOT_MODIFIED && held_tag.is_some() {
            return Ok(None);
        }
        let tag = response.headers().get(header::ETAG).and_then(|tag| tag.to_str().ok()).map(str::to_owned);
        let body = response.bytes().await.map_err(unreachable)?;
        if status.is_success() {
            return Ok(Some(Answer { body: body.to_vec(), tag }));
        }
        let problem: serde_json::Value = serde_json::from_slice(&body).unwrap_or_default();
        let detail = problem["detail"].as_str().unwrap_or("no detail").to_owned();
        Err(ClientError::Http { url, status: status.as_u16(), detail })
    }
}

/// What was at a path.
pub(crate) struct Answer {
    pub(crate) body: Vec<u8>,
    /// By which the service knows it again.
    pub(crate) tag: Option<String>,
}

fn base(url: &str) -> String {
    url.trim_end_matches('/').to_owned()
}

/// Somebody in the process must name the cryptography of HTTP; where an owner has, that one counts.
fn name_cryptography() {
    let _ = rustls::crypto::ring::default_provider().install_default();
}

/// TLS as the credentials say.
fn client_config(tls: &Tls) -> Result<ClientConfig, ClientError> {
    let refused = |what: &str, error: &dyn std::error::Error| {
        ClientError::Credentials(format!("the {what} cannot be used: {}", with_sources(error)))
    };
    let certificates = |what: &'static str, pem: &[u8]| {
        let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
        read.map_err(|error| refused(what, &error))
    };
    let mut roots = RootCertStore::empty();
    for certificate in certificates("ca", &tls.ca)? {
        roots.add(certificate).map_err(|error| refused("ca", &error))?;
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|error| refused("cryptography", &error))?
        .with_root_certificates(roots);
    let Some((cert, key)) = &tls.identity else { return Ok(builder.with_no_client_auth()) };
    let key = PrivateKeyDer::from_pem_slice(key).map_err(|error| refused("key", &error))?;
    builder.with_client_auth_cert(certificates("cert", cert)?, key).map_err(|error| refused("cert", &error))
}
