//! What can go wrong for a client.

use std::time::Duration;

use lanemap_proto::{decode::DecodeError, v1::Refusal};
use thiserror::Error;
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::spool::SpoolError;

/// Why a call of the client failed.
#[derive(Clone, Debug, Error)]
pub enum ClientError {
    /// The address is not one.
    #[error("{url:?} is not an address of a service: {reason}")]
    Address {
        /// The address.
        url: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The service cannot be reached.
    #[error("the service cannot be reached: {0}")]
    Unreachable(String),
    /// The service ended the call.
    #[error("the service ended the call: {} ({:?})", .0.message(), .0.code())]
    Status(Box<Status>),
    /// The start of the session was refused.
    #[error("the session was refused: {}", .0.message)]
    Refused(Box<Refusal>),
    /// The service answered what the protocol does not allow.
    #[error("the service's answer does not follow the protocol: {0}")]
    Protocol(String),
    /// A map does not decode.
    #[error("the map does not decode: {0}")]
    Decode(#[from] DecodeError),
    /// HTTP answered with a problem.
    #[error("{url} answered {status}: {detail}")]
    Http {
        /// What was asked for.
        url: String,
        /// Status of the answer.
        status: u16,
        /// What the service says about it.
        detail: String,
    },
    /// There is no tile where one was asked for.
    #[error("there is no tile of zoom {zoom} at latitude {latitude_deg}, longitude {longitude_deg}")]
    NoSuchTile {
        /// The zoom.
        zoom: u8,
        /// Latitude of the place, degrees.
        latitude_deg: f64,
        /// Longitude of the place, degrees.
        longitude_deg: f64,
    },
    /// A certificate or a token cannot be used.
    #[error("{0}")]
    Credentials(String),
    /// The spool does not do what was asked of it. Where it is [`SpoolError::Full`], the session goes on.
    #[error(transparent)]
    Spool(#[from] SpoolError),
    /// The session has ended.
    #[error("the session has ended")]
    Ended,
}

impl ClientError {
    /// Whether another attempt, later, may succeed.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Unreachable(_) => true,
            // `Unknown` and `Cancelled` are what tonic makes of a connection that breaks in the middle of a stream.
            Self::Status(status) => {
                use Code::{Cancelled, DeadlineExceeded, Internal, ResourceExhausted, Unavailable, Unknown};
                matches!(
                    status.code(),
                    Unavailable | Unknown | Cancelled | Internal | ResourceExhausted | DeadlineExceeded
                )
            }
            _ => false,
        }
    }

    /// How long the service wants to be left alone, where it said so.
    #[must_use]
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Status(status) => status.get_details_retry_info().and_then(|info| info.retry_delay),
            _ => None,
        }
    }

    /// Whether the service did not believe who the client is.
    pub(crate) fn is_unauthenticated(&self) -> bool {
        matches!(self, Self::Status(status) if status.code() == Code::Unauthenticated)
    }
}

impl From<Status> for ClientError {
    fn from(status: Status) -> Self {
        Self::Status(Box::new(status))
    }
}

impl From<tonic::transport::Error> for ClientError {
    fn from(error: tonic::transport::Error) -> Self {
        Self::Unreachable(with_sources(&error))
    }
}

/// An error and what caused it, in one line.
pub(crate) fn with_sources(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        text = format!("{text}: {cause}");
        source = cause.source();
    }
    text
}
