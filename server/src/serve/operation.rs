//! For those who operate the service: is it alive, does it take traffic, what does it count.

use axum::{
    extract::State,
    http::{StatusCode, header},
    response::IntoResponse,
};

use super::{Readiness, ServeState};
use crate::telemetry;

/// `GET /healthz`: the process answers.
pub(super) async fn healthz() -> impl IntoResponse {
    ([(header::CACHE_CONTROL, "no-store")], "ok\n")
}

/// `GET /readyz`: the service takes traffic; 503 with the reason while frames cannot be made durable, and from the moment
/// it shuts down.
pub(super) async fn readyz(State(state): State<ServeState>) -> impl IntoResponse {
    let (status, text) = match &*state.ready.borrow() {
        Readiness::Ready => (StatusCode::OK, "ready\n".to_owned()),
        Readiness::NotReady(reason) => (StatusCode::SERVICE_UNAVAILABLE, format!("not ready: {reason}\n")),
    };
    (status, [(header::CACHE_CONTROL, "no-store")], text)
}

/// `GET /metrics`: the Prometheus text format.
pub(super) async fn metrics(State(state): State<ServeState>) -> impl IntoResponse {
    let headers =
        [(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8"), (header::CACHE_CONTROL, "no-store")];
    (headers, telemetry::render(&state.metrics))
}
