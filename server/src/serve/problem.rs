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
    /// The request does not show who sends it, or not in a way that is taken.
    #[error("{0}")]
    Unauthenticated(AuthenticationError),
    /// Who sends the request may not do what it asks for.
    #[error("the sender of this request may not {0}")]
    NotPermitted(Action),
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
            | Self::NoSuchTile { .. } => StatusCode::NOT_FOUND,
            Self::VersionNotKept { .. } => StatusCode::GONE,
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
            Self::NoSuchTile { .. } => ("no-such-tile", "No such tile"),
            Self::VersionNotKept { .. } => ("version-not-kept", "The version is not kept"),
            Self::NotGeoreferenced { .. } => ("not-georeferenced", "The session is not georeferenced"),
            Self::UnknownParameter { .. } => ("unknown-parameter", "Unknown query parameter"),
            Self::RepeatedParameter { .. } => ("repeated-parameter", "Repeated query parameter"),
            Self::BadParameter { .. } => ("bad-parameter", "Malformed query parameter"),
            Self::BadQuery { .. } => ("bad-query", "Malformed query"),
            Self::Unauthenticated(_) => ("unauthenticated", "Unauthenticated"),
            Self::NotPermitted(_) => ("not-permitted", "Not permitted"),
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
                Self::NotGeoreferenced { session } => Some(format!("/sessions/{session}/lanes.geojson?crs=local")),
                Self::VersionNotKept { whole, .. } => Some(whole.clone()),
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
        let document = serde_json::to_value(Problem::NotGeoreferenced { session }.document()).unwrap();
        assert_eq!(document["status"], 409);
        assert_eq!(document["type"], "urn:lanemap:problem:not-georeferenced");
        assert_eq!(document["alternate"], format!("/sessions/{session}/lanes.geojson?crs=local"));
    }

    #[test]
    fn a_long_text_of_a_request_is_repeated_in_part_only() {
        assert_eq!(repeated(&"x".repeat(1000)).len(), MOST_REPEATED);
    }
}
