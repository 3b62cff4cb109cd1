//! The HTTP side: maps for consumers, health and metrics for operators.

use axum::{Router, routing::get};
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::session::Sessions;

/// What the HTTP handlers read.
#[derive(Clone)]
pub struct ServeState {
    /// The published maps.
    pub sessions: Sessions,
    /// Renders `/metrics`.
    pub metrics: PrometheusHandle,
    /// Whether the service takes traffic; falls first when it shuts down.
    pub ready: watch::Receiver<bool>,
    /// Cancelled when the service shuts down: answers that stay open (server-sent events) must end.
    pub shutdown: CancellationToken,
}

/// Every HTTP route of the service.
pub fn router(state: ServeState) -> Router {
    Router::new().route("/healthz", get(|| async { "ok\n" })).with_state(state)
}
