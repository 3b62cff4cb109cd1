//! Strong entity tags and conditional requests (RFC 9110, 8.8.3 and 13.1.2).
//!
//! A tag is the hash of what an answer is made of (versions of maps, the query, the build), so it is known, and a 304
//! given, before the answer is made. A compressed answer is another representation: it carries the tag with the name of its
//! encoding appended. An answer that tells when it was made carries that time, too: two that were made of the same at
//! different times differ in it and in their tags, and either is up to date as long as what they are made of is.

use std::{
    fmt,
    hash::{DefaultHasher, Hash, Hasher},
    time::{SystemTime, UNIX_EPOCH},
};

use axum::{
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};

/// The tag of an uncompressed answer, without its quotes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EntityTag {
    hash: u64,
    made_at_us: Option<u64>,
}

/// Encodings that have tags of their own.
const ENCODINGS: [&str; 3] = ["gzip", "br", "zstd"];

impl EntityTag {
    /// The tag of an answer that is a function of `parts` and of this build.
    #[must_use]
    pub fn of(parts: impl Hash) -> Self {
        let mut hasher = DefaultHasher::new();
        env!("CARGO_PKG_VERSION").hash(&mut hasher);
        parts.hash(&mut hasher);
        Self { hash: hasher.finish(), made_at_us: None }
    }

    /// The hash itself.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.hash
    }

    /// The tag of an answer that also tells that it is made now; and now, microseconds since the Unix epoch.
    #[must_use]
    pub fn made_now(self) -> (Self, u64) {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let now_us = u64::try_from(now.as_micros()).unwrap_or(u64::MAX);
        (Self { made_at_us: Some(now_us), ..self }, now_us)
    }

    /// Whether the request's `If-None-Match` names this tag, in any encoding, made at any time.
    #[must_use]
    pub fn is_held_by(&self, request: &HeaderMap) -> bool {
        let tag = self.to_string();
        held(request).iter().any(|held| held == "*" || are_of_one(held, &tag))
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
        if let Ok(value) = HeaderValue::from_str(&self.to_string()) {
            headers.insert(header::ETAG, value);
        }
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
        headers.append(header::VARY, HeaderValue::from_static("accept-encoding"));
        response
    }
}

impl fmt::Display for EntityTag {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "\"{:016x}", self.hash)?;
        if let Some(made_at_us) = self.made_at_us {
            write!(formatter, ".{made_at_us:x}")?;
        }
        formatter.write_str("\"")
    }
}

/// The tags of a request's `If-None-Match`, without the mark of weakness: it compares weakly.
pub(super) fn held(request: &HeaderMap) -> Vec<String> {
    let values = request.get_all(header::IF_NONE_MATCH).iter().filter_map(|value| value.to_str().ok());
    let tags = values.flat_map(|value| value.split(',')).map(|tag| tag.trim().trim_start_matches("W/").to_owned());
    tags.collect()
}

/// Whether two tags are of answers made of the same, whatever their encoding and time.
pub(super) fn are_of_one(one: &str, other: &str) -> bool {
    let made_of = |tag: &str| {
        let inner = tag.strip_prefix('"')?.strip_suffix('"')?;
        let plain = ENCODINGS.iter().find_map(|encoding| inner.strip_suffix(encoding)?.strip_suffix('-'));
        let plain = plain.unwrap_or(inner);
        Some(plain.split_once('.').map_or(plain, |(hash, _)| hash).to_owned())
    };
    made_of(one).is_some_and(|parts| made_of(other) == Some(parts))
}

/// The tag of the same answer in an encoding; `None` where that has none of its own.
pub(super) fn encoded(tag: &str, encoding: &str) -> Option<String> {
    ENCODINGS.contains(&encoding).then_some(())?;
    Some(format!("{}-{encoding}\"", tag.strip_suffix('"')?))
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
        let compressed = encoded(&tag.to_string(), "br").unwrap();
        let (made_now, _) = tag.clone().made_now();
        for held in [
            tag.to_string(),
            compressed.clone(),
            format!("W/{tag}"),
            format!("\"other\", {compressed}"),
            "*".into(),
            made_now.to_string(),
            encoded(&made_now.to_string(), "zstd").unwrap(),
        ] {
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
