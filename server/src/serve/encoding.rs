//! Compression as a request negotiates it (RFC 9110, 12.5.3): zstd, br or gzip, q-values honoured.
//!
//! A compressed answer is another representation than the plain one, so that its strong entity tag is another, too: the tag
//! has the name of the encoding appended. A 304 names the tag that the request holds.

use axum::{
    extract::Request,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    middleware::Next,
    response::{IntoResponse, Response},
};
use tower_http::compression::{
    CompressionLayer, Predicate,
    predicate::{NotForContentType, SizeAbove},
};

use super::{entity_tag, problem::Problem};

/// Smallest body that is compressed, bytes: a smaller one takes one packet in any case.
const LEAST_BYTES: u64 = 1024;

/// Compresses answers that are worth it, and not those that are compressed or stay open.
pub(super) fn layer() -> CompressionLayer<impl Predicate> {
    let worth_it = SizeAbove::new(LEAST_BYTES)
        .and(NotForContentType::GRPC)
        .and(NotForContentType::IMAGES)
        .and(NotForContentType::SSE);
    CompressionLayer::new().compress_when(worth_it)
}

/// Outside the compression: gives a compressed answer a tag of its own, and one whose every encoding was declined its
/// problem document.
pub(super) async fn tell_apart(request: Request, next: Next) -> Response {
    let held = entity_tag::held(request.headers());
    let mut response = next.run(request).await;
    if response.status() == StatusCode::NOT_ACCEPTABLE && !is_problem(response.headers()) {
        let reason = "Accept-Encoding declines every encoding, and the plain answer, too".to_owned();
        return Problem::NotAcceptable { reason }.into_response();
    }
    let Some(tag) = response.headers().get(header::ETAG).and_then(|tag| tag.to_str().ok()) else { return response };
    let told = if response.status() == StatusCode::NOT_MODIFIED {
        held.into_iter().find(|held| entity_tag::are_of_one(held, tag))
    } else {
        let encoding = response.headers().get(header::CONTENT_ENCODING).and_then(|encoding| encoding.to_str().ok());
        encoding.and_then(|encoding| entity_tag::encoded(tag, encoding))
    };
    if let Some(told) = told.and_then(|told| HeaderValue::from_str(&told).ok()) {
        response.headers_mut().insert(header::ETAG, told);
    }
    response
}

fn is_problem(headers: &HeaderMap) -> bool {
    headers.get(header::CONTENT_TYPE).is_some_and(|kind| kind == "application/problem+json")
}
