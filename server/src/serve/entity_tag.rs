//! Strong entity tags and conditional requests (RFC 9110, 8.8.3 and 13.1.2).
//!
//! A tag is the hash of what an answer is made of (versions of maps, the query, the build), so it is known, and a 304
//! given, before the answer is made. A compressed answer is another representation: it carries the tag with `-gzip`
//! appended, and either form is understood when it comes back.

use std::{
    fmt,
    hash::{DefaultHasher, Hash, Hasher},
};

use axum::{
    extract::Request,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    middleware::Next,
    response::{IntoResponse, Response},
};

/// The tag of an uncompressed answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EntityTag(String);

/// What a compressed answer's tag has before its closing quote.
const COMPRESSED: &str = "-gzip";

impl EntityTag {
    /// The tag of an answer that is a function of `parts` and of this build.
    #[must_use]
    pub fn of(parts: impl Hash) -> Self {
        let mut hasher = DefaultHasher::new();
        env!("CARGO_PKG_VERSION").hash(&mut hasher);
        parts.hash(&mut hasher);
        Self(format!("\"{:016x}\"", hasher.finish()))
    }

    /// Whether the request's `If-None-Match` names this tag.
    #[must_use]
    pub fn is_held_by(&self, request: &HeaderMap) -> bool {
        request
            .get_all(header::IF_NONE_MATCH)
            .iter()
            .filter_map(|value| value.to_str().ok())
            .flat_map(|value| value.split(','))
            .map(str::trim)
            .any(|held| held == "*" || uncompressed(held) == self.0)
    }

    /// The answer to a request that already holds it.
    #[must_use]
    pub fn not_modified(&self) -> Response {
        self.on(StatusCode::NOT_MODIFIED)
    }

    /// An answer with this tag, to be asked for again before each use.
    #[must_use]
    pub fn on(&self, answer: impl IntoResponse) -> Response {
        let mut response = answer.into_response();
        let headers = response.headers_mut();
        if let Ok(value) = HeaderValue::from_str(&self.0) {
            headers.insert(header::ETAG, value);
        }
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
        headers.insert(header::VARY, HeaderValue::from_static("accept-encoding"));
        response
    }
}

impl fmt::Display for EntityTag {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(formatter)
    }
}

/// A tag without the mark of compression and of weakness (`If-None-Match` compares weakly).
fn uncompressed(tag: &str) -> String {
    tag.trim_start_matches("W/").replace(&format!("{COMPRESSED}\""), "\"")
}

/// Outside the compression layer: tells the tag of a compressed answer from that of the plain one.
pub async fn tell_compressed_apart(request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    if response.headers().contains_key(header::CONTENT_ENCODING) {
        let compressed = response.headers().get(header::ETAG).and_then(|tag| tag.to_str().ok()).and_then(|tag| {
            let inner = tag.strip_suffix('"')?;
            HeaderValue::from_str(&format!("{inner}{COMPRESSED}\"")).ok()
        });
        if let Some(tag) = compressed {
            response.headers_mut().insert(header::ETAG, tag);
        }
    }
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holding(tags: &str) -> HeaderMap {
        HeaderMap::from_iter([(header::IF_NONE_MATCH, HeaderValue::from_str(tags).unwrap())])
    }

    #[test]
    fn a_tag_is_known_again_plain_compressed_weak_and_in_a_list() {
        let tag = EntityTag::of(("session", 7));
        let compressed = format!("{}-gzip\"", tag.to_string().trim_end_matches('"'));
        for held in
            [tag.to_string(), compressed.clone(), format!("W/{tag}"), format!("\"other\", {compressed}"), "*".into()]
        {
            assert!(tag.is_held_by(&holding(&held)), "{held}");
        }
        assert!(!tag.is_held_by(&holding("\"other\"")));
        assert!(!tag.is_held_by(&HeaderMap::new()));
    }

    #[test]
    fn another_version_has_another_tag() {
        assert_ne!(EntityTag::of(("session", 7)), EntityTag::of(("session", 8)));
    }
}
