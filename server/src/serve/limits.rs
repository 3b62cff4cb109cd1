//! Bounds on requests over HTTP: how long they are, and how long they take.
//!
//! The connection's own bounds (headers that come slowly, most connections and streams) are the listener's. A time-out here
//! ends the wait for the beginning of an answer; an answer that stays open (server-sent events) may last.

use std::{sync::Arc, time::Duration};

use axum::{
    extract::{Request, State},
    http::{Method, header},
    middleware::Next,
    response::Response,
};

use super::problem::Problem;
use crate::config::ServerConfig;

/// Largest body of a request; no address here takes one, so a larger one is a mistake.
const MOST_BODY_BYTES: u64 = 64 * 1024;
/// What a header costs beside its name and value: a colon, a space and the end of the line.
const HEADER_OVERHEAD_BYTES: usize = 4;

/// The bounds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    url_bytes: usize,
    header_bytes: usize,
    time: Duration,
}

impl Limits {
    pub(super) fn of(config: &ServerConfig) -> Self {
        Self { url_bytes: config.max_url_bytes, header_bytes: config.max_header_bytes, time: config.request_timeout() }
    }

    fn check(&self, request: &Request) -> Result<(), Problem> {
        let url_bytes = request.uri().path_and_query().map_or(0, |url| url.as_str().len());
        if url_bytes > self.url_bytes {
            return Err(Problem::UrlTooLong { bytes: url_bytes, most: self.url_bytes });
        }
        let header_bytes: usize = request
            .headers()
            .iter()
            .map(|(name, value)| name.as_str().len() + value.len() + HEADER_OVERHEAD_BYTES)
            .sum();
        if header_bytes > self.header_bytes {
            return Err(Problem::HeadersTooLarge { bytes: header_bytes, most: self.header_bytes });
        }
        let length =
            request.headers().get(header::CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
        if let Some(bytes) = length.filter(|bytes| *bytes > MOST_BODY_BYTES) {
            return Err(Problem::BodyTooLarge { bytes, most: MOST_BODY_BYTES });
        }
        Ok(())
    }
}

/// Refuses what is too long, and gives up on what takes too long.
pub(super) async fn keep(State(limits): State<Arc<Limits>>, request: Request, next: Next) -> Result<Response, Problem> {
    limits.check(&request)?;
    let answer = tokio::time::timeout(limits.time, next.run(request)).await;
    answer.map_err(|_| Problem::Overdue { after_s: limits.time.as_secs() })
}

/// Answers a HEAD as its GET, whose headers it is to have; the router leaves out the body.
pub(super) async fn head_as_get(mut request: Request, next: Next) -> Response {
    if request.method() == Method::HEAD {
        *request.method_mut() = Method::GET;
    }
    next.run(request).await
}

#[cfg(test)]
mod tests {
    use axum::{Router, body::Body, http::StatusCode, middleware, routing::get};
    use tower::ServiceExt;

    use super::*;

    #[tokio::test]
    async fn an_answer_that_is_not_there_in_time_is_a_problem_that_says_so() {
        let limits = Limits { url_bytes: 256, header_bytes: 1024, time: Duration::from_millis(5) };
        let never = get(|| async { std::future::pending::<()>().await });
        let router = Router::new().route("/never", never);
        let router = router.layer(middleware::from_fn_with_state(Arc::new(limits), keep));
        let answer = router.oneshot(Request::get("/never").body(Body::empty()).unwrap()).await.unwrap();
        assert_eq!(answer.status(), StatusCode::SERVICE_UNAVAILABLE);
        assert_eq!(answer.headers()[header::RETRY_AFTER], "1");
        assert_eq!(answer.headers()[header::CONTENT_TYPE], "application/problem+json");
    }

    fn check(url: &str, headers: &[(&str, &str)]) -> Result<(), Problem> {
        let limits = Limits { url_bytes: 256, header_bytes: 1024, time: Duration::from_secs(1) };
        let request = headers.iter().fold(Request::get(url), |request, (name, value)| request.header(*name, *value));
        limits.check(&request.body(Body::empty()).unwrap())
    }

    #[test]
    fn what_is_too_long_is_refused_with_its_limit() {
        assert_eq!(check("/cells?limit=1", &[("accept", "*/*"), ("content-length", "3")]), Ok(()));
        let long = format!("/cells?{}", "x".repeat(300));
        assert_eq!(check(&long, &[]), Err(Problem::UrlTooLong { bytes: 307, most: 256 }));
        let value = "x".repeat(1020);
        assert_eq!(check("/", &[("a", &value)]), Err(Problem::HeadersTooLarge { bytes: 1025, most: 1024 }));
        let refused = Err(Problem::BodyTooLarge { bytes: 1_000_000, most: MOST_BODY_BYTES });
        assert_eq!(check("/", &[("content-length", "1000000")]), refused);
    }
}
