//! Why a request is refused, as an RFC 9457 problem document (`application/problem+json`).

use axum::{
    http::{HeaderValue, Method, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;
use thiserror::Error;

use crate::{
    auth::{Action, AuthenticationError},
    error::Error as ServiceError,
    journal::JournalError,
    session::SessionId,
};

/// Every reason for which the HTTP side refuses.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum Problem {
    /// No such address.
    #[error("there is nothing at {path:?}")]
    NoSuchPath {
        /// The path of the request.
        path: String,
    },
    /// The address is there, the method is not.
    #[error("{method} is not allowed here; the Allow header names what is")]
    MethodNotAllowed {
        /// The method of the request.
        method: Method,
    },
    /// The address names a session that is not there.
    #[error("there is no session {session:?}; /sessions lists those that there are")]
    NoSuchSession {
        /// The name in the address.
        session: String,
    },
    /// The address names a cell of the shared map that no drive ever touched, or that is none.
    #[error("nothing is known of cell {cell:?}; /cells lists those that there are")]
    NoSuchCell {
        /// The name in the address.
        cell: String,
    },
    /// The address names a line that was in no version of its cell that is kept.
    #[error("cell {cell} has no line {lane:?}, nor had it in any version that is kept")]
    NoSuchLane {
        /// The cell.
        cell: String,
        /// The name in the address.
        lane: String,
    },
    /// The address names a tile that is none, or is not served.
    #[error("there is no tile {tile:?} here: {limit}")]
    NoSuchTile {
        /// The name in the address.
        tile: String,
        /// Which tiles there are.
        limit: String,
    },
    /// Changes were asked for since a version that is not kept.
    #[error("{reason}")]
    VersionNotKept {
        /// Which versions are.
        reason: String,
        /// Address of the cell as a whole.
        whole: String,
    },
    /// Degrees were asked of a session that has none.
    #[error(
        "session {session} has no place on the earth: its GNSS fixes, if any, do not tell yet; \
         ?crs=local gives its lanes in metres, in its own map frame"
    )]
    NotGeoreferenced {
        /// The session.
        session: SessionId,
        /// Address of its lanes in metres.
        local: String,
    },
    /// A query parameter that the address does not know.
    #[error("parameter {name:?} is not known here; known: {known}")]
    UnknownParameter {
        /// Its name.
        name: String,
        /// The names that are known, separated by commas.
        known: String,
    },
    /// A query parameter that stands twice.
    #[error("parameter {name:?} stands more than once")]
    RepeatedParameter {
        /// Its name.
        name: String,
    },
    /// A query parameter whose value cannot be read.
    #[error("parameter {name:?} = {value:?}: {reason}")]
    BadParameter {
        /// Its name.
        name: &'static str,
        /// Its value, the first 64 characters.
        value: String,
        /// What is wrong, and what would be right.
        reason: String,
    },
    /// The query is not `name=value` pairs.
    #[error("the query cannot be read: {reason}")]
    BadQuery {
        /// What is wrong.
        reason: String,
    },
    /// No form of the answer is one that the request takes.
    #[error("no form of this answer is acceptable: {reason}")]
    NotAcceptable {
        /// What the request takes, and what there is.
        reason: String,
    },
    /// The path and query are too long.
    #[error("path and query have {bytes} bytes, and may have {most}")]
    UrlTooLong {
        /// Their length.
        bytes: usize,
        /// The most that is taken.
        most: usize,
    },
    /// The headers are too large.
    #[error("the headers have {bytes} bytes, and may have {most}")]
    HeadersTooLarge {
        /// Their size.
        bytes: usize,
        /// The most that is taken.
        most: usize,
    },
    /// The body is too large.
    #[error("the body has {bytes} bytes, and may have {most}; no address here takes one")]
    BodyTooLarge {
        /// Its length.
        bytes: u64,
        /// The most that is taken.
        most: u64,
    },
    /// The answer was not there in time.
    #[error("the answer was not there after {after_s} s; ask for less at a time, or again later")]
    Overdue {
        /// The time that it had, seconds.
        after_s: u64,
    },
    /// The address names a collection that is not there.
    #[error("there is no collection {collection:?}; /collections lists those that there are")]
    NoSuchCollection {
        /// The name in the address.
        collection: String,
    },
    /// The address names a feature that is not there.
    #[error("there is no feature {feature:?} in {collection}")]
    NoSuchFeature {
        /// The collection.
        collection: &'static str,
        /// The name in the address.
        feature: String,
    },
    /// A page was asked for of a version of the map that is not kept.
    #[error("{reason}; begin anew with the first page")]
    WalkOver {
        /// Which versions are.
        reason: String,
        /// Address of the first page.
        first: String,
    },
    /// The request does not show who sends it, or not in a way that is taken.
    #[error("{0}")]
    Unauthenticated(AuthenticationError),
    /// Who sends the request may not do what it asks for.
    #[error("the sender of this request may not {0}")]
    NotPermitted(Action),
    /// As many are served as may be.
    #[error("{reason}")]
    Busy {
        /// What is full.
        reason: String,
    },
    /// The answer could not be made; the fault is ours.
    #[error("the answer could not be made")]
    Internal,
}

/// The document, as it goes over the wire.
#[derive(Serialize)]
struct Document<'a> {
    #[serde(rename = "type")]
    kind: String,
    title: &'static str,
    status: u16,
    detail: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    parameter: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    alternate: Option<String>,
}

/// Most characters of a request that a refusal repeats.
const MOST_REPEATED: usize = 64;

/// The beginning of a text from a request, short enough to repeat.
#[must_use]
pub fn repeated(text: &str) -> String {
    text.chars().take(MOST_REPEATED).collect()
}

impl Problem {
    /// Status of the answer.
    #[must_use]
    pub fn status(&self) -> StatusCode {
        match self {
            Self::NoSuchPath { .. }
            | Self::NoSuchSession { .. }
            | Self::NoSuchCell { .. }
            | Self::NoSuchLane { .. }
            | Self::NoSuchTile { .. }
            | Self::NoSuchCollection { .. }
            | Self::NoSuchFeature { .. } => StatusCode::NOT_FOUND,
            Self::VersionNotKept { .. } | Self::WalkOver { .. } => StatusCode::GONE,
            Self::NotAcceptable { .. } => StatusCode::NOT_ACCEPTABLE,
            Self::UrlTooLong { .. } => StatusCode::URI_TOO_LONG,
            Self::HeadersTooLarge { .. } => StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE,
            Self::BodyTooLarge { .. } => StatusCode::PAYLOAD_TOO_LARGE,
            Self::Overdue { .. } | Self::Busy { .. } => StatusCode::SERVICE_UNAVAILABLE,
            Self::MethodNotAllowed { .. } => StatusCode::METHOD_NOT_ALLOWED,
            Self::NotGeoreferenced { .. } => StatusCode::CONFLICT,
            Self::Unauthenticated(_) => StatusCode::UNAUTHORIZED,
            Self::NotPermitted(_) => StatusCode::FORBIDDEN,
            Self::UnknownParameter { .. }
            | Self::RepeatedParameter { .. }
            | Self::BadParameter { .. }
            | Self::BadQuery { .. } => StatusCode::BAD_REQUEST,
            Self::Internal => StatusCode::INTERNAL_SERVER_ERROR,
        }
    }

    /// What to show, as RFC 6750 says it.
    fn challenge(&self) -> Option<HeaderValue> {
        let text = match self {
            Self::Unauthenticated(AuthenticationError::Missing) => "Bearer realm=\"lanemap\"".to_owned(),
            Self::Unauthenticated(error) => {
                format!("Bearer realm=\"lanemap\", error=\"invalid_token\", error_description=\"{error}\"")
            }
            Self::NotPermitted(action) => {
                format!("Bearer realm=\"lanemap\", error=\"insufficient_scope\", scope=\"{}\"", action.scope())
            }
            _ => return None,
        };
        HeaderValue::from_str(&text).ok()
    }

    /// Last part of the problem's type, and its title.
    fn kind(&self) -> (&'static str, &'static str) {
        match self {
            Self::NoSuchPath { .. } => ("no-such-path", "No such path"),
            Self::MethodNotAllowed { .. } => ("method-not-allowed", "Method not allowed"),
            Self::NoSuchSession { .. } => ("no-such-session", "No such session"),
            Self::NoSuchCell { .. } => ("no-such-cell", "No such cell"),
            Self::NoSuchLane { .. } => ("no-such-lane", "No such line"),
            Self::NoSuchTile { .. } => ("no-such-tile", "No such tile"),
            Self::VersionNotKept { .. } => ("version-not-kept", "The version is not kept"),
            Self::NotGeoreferenced { .. } => ("not-georeferenced", "The session is not georeferenced"),
            Self::UnknownParameter { .. } => ("unknown-parameter", "Unknown query parameter"),
            Self::RepeatedParameter { .. } => ("repeated-parameter", "Repeated query parameter"),
            Self::BadParameter { .. } => ("bad-parameter", "Malformed query parameter"),
            Self::BadQuery { .. } => ("bad-query", "Malformed query"),
            Self::NotAcceptable { .. } => ("not-acceptable", "Not acceptable"),
            Self::UrlTooLong { .. } => ("url-too-long", "Path and query too long"),
            Self::HeadersTooLarge { .. } => ("headers-too-large", "Headers too large"),
            Self::BodyTooLarge { .. } => ("body-too-large", "Body too large"),
            Self::Overdue { .. } => ("overdue", "The answer takes too long"),
            Self::NoSuchCollection { .. } => ("no-such-collection", "No such collection"),
            Self::NoSuchFeature { .. } => ("no-such-feature", "No such feature"),
            Self::WalkOver { .. } => ("walk-over", "The version of the map is not kept"),
            Self::Unauthenticated(_) => ("unauthenticated", "Unauthenticated"),
            Self::NotPermitted(_) => ("not-permitted", "Not permitted"),
            Self::Busy { .. } => ("busy", "Too many readers"),
            Self::Internal => ("internal", "Internal error"),
        }
    }

    fn document(&self) -> Document<'_> {
        let (kind, title) = self.kind();
        Document {
            kind: format!("urn:lanemap:problem:{kind}"),
            title,
            status: self.status().as_u16(),
            detail: self.to_string(),
            parameter: match self {
                Self::UnknownParameter { name, .. } | Self::RepeatedParameter { name } => Some(name),
                Self::BadParameter { name, .. } => Some(name),
                _ => None,
            },
            alternate: match self {
                Self::NotGeoreferenced { local, .. } => Some(local.clone()),
                Self::VersionNotKept { whole, .. } => Some(whole.clone()),
                Self::WalkOver { first, .. } => Some(first.clone()),
                _ => None,
            },
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let body = serde_json::to_vec(&self.document()).unwrap_or_default();
        let headers = [
            (header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json")),
            (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
        ];
        let mut response = (self.status(), headers, body).into_response();
        let retry_after_s = match self {
            Self::Overdue { .. } => Some("1"),
            Self::Busy { .. } => Some("5"),
            _ => None,
        };
        if let Some(seconds) = retry_after_s {
            response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from_static(seconds));
        }
        if let Some(challenge) = self.challenge() {
            response.headers_mut().insert(header::WWW_AUTHENTICATE, challenge);
        }
        response
    }
}

/// What ends a call of gRPC, as it reads over HTTP.
impl From<ServiceError> for Problem {
    fn from(error: ServiceError) -> Self {
        match error {
            ServiceError::Unauthenticated(error) => Self::Unauthenticated(error),
            ServiceError::NotPermitted(action) => Self::NotPermitted(action),
            other => {
                tracing::error!(error = %other, "an answer could not be made");
                Self::Internal
            }
        }
    }
}

impl From<JournalError> for Problem {
    fn from(error: JournalError) -> Self {
        tracing::error!(%error, "an answer could not be made");
        Self::Internal
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_session_off_the_earth_is_refused_with_the_address_of_its_metres() {
        let session = SessionId::next(None, 0, 1);
        let local = format!("/sessions/{session}/lanes.geojson?crs=local");
        let document =
            serde_json::to_value(Problem::NotGeoreferenced { session, local: local.clone() }.document()).unwrap();
        assert_eq!(document["status"], 409);
        assert_eq!(document["type"], "urn:lanemap:problem:not-georeferenced");
        assert_eq!(document["alternate"], local);
    }

    #[test]
    fn a_long_text_of_a_request_is_repeated_in_part_only() {
        assert_eq!(repeated(&"x".repeat(1000)).len(), MOST_REPEATED);
    }
}
