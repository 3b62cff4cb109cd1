//! `/viewer`: the page that draws the lanes, and its files, as `lanemap-web` embeds them.

use axum::{
    extract::Path,
    http::{HeaderMap, HeaderValue, Uri, header},
    response::Response,
};
use bytes::Bytes;

use super::{
    entity_tag::EntityTag,
    problem::{Problem, repeated},
};

/// The page asks nothing of other hosts, and a browser holds it to that.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; script-src 'self'; worker-src 'self'; connect-src 'self'; \
     img-src 'self' data: blob:; style-src 'self'; font-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'";

/// `GET /viewer`
pub(super) async fn page(headers: HeaderMap, uri: Uri) -> Result<Response, Problem> {
    let mut response = asset("index.html", &headers, &uri)?;
    let policy = HeaderValue::from_static(CONTENT_SECURITY_POLICY);
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    Ok(response)
}

/// `GET /viewer/{name}`; a query is passed over, for MapLibre adds its version to the name of its worker.
pub(super) async fn file(Path(name): Path<String>, headers: HeaderMap, uri: Uri) -> Result<Response, Problem> {
    asset(&name, &headers, &uri)
}

fn asset(name: &str, headers: &HeaderMap, uri: &Uri) -> Result<Response, Problem> {
    let asset = lanemap_web::asset(name).ok_or_else(|| Problem::NoSuchPath { path: repeated(uri.path()) })?;
    let tag = EntityTag::of(asset.digest);
    if tag.is_held_by(headers) {
        return Ok(tag.not_modified());
    }
    let content_type = (header::CONTENT_TYPE, HeaderValue::from_static(asset.content_type));
    let no_sniff = (header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    Ok(tag.on(([content_type, no_sniff], Bytes::from_static(asset.bytes))))
}
