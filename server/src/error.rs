//! What can go wrong for a vehicle or a reader of maps, once, with its gRPC status.
//!
//! A message that is not valid is no error: it is a [`Refusal`], and its stream goes on. The HTTP side's own refusals
//! are problem documents ([`crate::serve`]).

use std::time::Duration;

use thiserror::Error;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::{
    auth::{Action, AuthenticationError},
    ingest::Refusal,
    journal::JournalError,
    session::SessionId,
};

/// A failure that ends a call or a stream.
#[derive(Clone, Debug, Error)]
pub enum Error {
    /// A unary call's message, or a stream's hundredth, was refused.
    #[error("{0}")]
    Refused(Box<Refusal>),
    /// No such session.
    #[error("there is no session {session}")]
    NoSuchSession {
        /// The name that was asked for.
        session: String,
    },
    /// Who asks has not shown who it is.
    #[error("{0}")]
    Unauthenticated(AuthenticationError),
    /// Who asks may not do what it asks for. Who it is and for which vehicle it asked is not repeated: it may be logged.
    #[error("this peer may not {0}")]
    NotPermitted(Action),
    /// A newer stream of the same drive took over.
    #[error("a newer stream of this drive has taken over")]
    Superseded,
    /// The service is shutting down; the drive can be resumed elsewhere or later.
    #[error("the service is shutting down; resume the drive on another connection")]
    ShuttingDown,
    /// Frames cannot be made durable.
    #[error("frames cannot be made durable: {0}")]
    Journal(#[from] JournalError),
    /// What the store holds of a session cannot be read by this build.
    #[error("session {session} cannot be read from the store: {reason}")]
    Unreadable {
        /// The session.
        session: SessionId,
        /// What is wrong with it.
        reason: String,
    },
    /// The drive's data were deleted on request.
    #[error("this drive was deleted on request and takes no more frames; begin another drive")]
    Forgotten,
    /// As many streams are open as may be.
    #[error("{limit} streams are open, the most that are served at a time; try again later")]
    TooManyStreams {
        /// The most.
        limit: usize,
    },
    /// A stream did not name its drive in time.
    #[error("no start came within {waited_s} s")]
    NoStart {
        /// How long it was waited for, seconds.
        waited_s: u64,
    },
    /// The service takes no more for now.
    #[error("the service is overloaded: {what}; try again later")]
    Overloaded {
        /// What is full.
        what: String,
    },
    /// The session's actor ended while it was being spoken to; a new attempt starts another.
    #[error("the session has ended; try again")]
    SessionGone,
}

impl Error {
    /// The gRPC code.
    #[must_use]
    pub fn code(&self) -> Code {
        match self {
            Self::Refused(_) => Code::InvalidArgument,
            Self::NoSuchSession { .. } => Code::NotFound,
            Self::Unauthenticated(_) => Code::Unauthenticated,
            Self::NotPermitted(_) => Code::PermissionDenied,
            Self::Forgotten => Code::FailedPrecondition,
            Self::Superseded => Code::Aborted,
            Self::Journal(JournalError::NoRoom { .. }) | Self::TooManyStreams { .. } | Self::Overloaded { .. } => {
                Code::ResourceExhausted
            }
            Self::NoStart { .. } => Code::DeadlineExceeded,
            Self::ShuttingDown | Self::Journal(_) | Self::SessionGone => Code::Unavailable,
            Self::Unreadable { .. } => Code::DataLoss,
        }
    }

    /// How long a client should wait before it tries again; `None` where trying again does not help.
    #[must_use]
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Journal(JournalError::NoRoom { .. }) => Some(Duration::from_secs(10)),
            Self::TooManyStreams { .. } => Some(Duration::from_secs(5)),
            Self::Journal(_) | Self::Overloaded { .. } | Self::ShuttingDown => Some(Duration::from_secs(1)),
            Self::SessionGone => Some(Duration::from_millis(100)),
            _ => None,
        }
    }

    fn details(&self) -> Option<ErrorDetails> {
        match self {
            Self::Refused(refusal) => {
                Some(ErrorDetails::with_bad_request_violation(&refusal.field, refusal.to_string()))
            }
            Self::NoSuchSession { session } => {
                Some(ErrorDetails::with_resource_info("session", session, "", "no such session"))
            }
            _ => self.retry_after().map(|pause| ErrorDetails::with_retry_info(Some(pause))),
        }
    }
}

impl From<Error> for Status {
    fn from(error: Error) -> Self {
        match error.details() {
            Some(details) => Self::with_error_details(error.code(), error.to_string(), details),
            None => Self::new(error.code(), error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use lanemap_proto::v1::RefusalReason;

    #[test]
    fn a_full_disk_tells_a_client_to_come_back_later() {
        let status = Status::from(Error::from(JournalError::NoRoom { free_bytes: 1, minimum_bytes: 2 }));
        assert_eq!(status.code(), Code::ResourceExhausted);
        assert_eq!(status.get_details_retry_info().unwrap().retry_delay, Some(Duration::from_secs(10)));
    }

    #[test]
    fn a_refusal_tells_a_machine_which_field_it_was() {
        let refusal = Refusal::new(RefusalReason::Missing, "start.sensor", "nothing", "required");
        let status = Status::from(Error::Refused(Box::new(refusal)));
        assert_eq!(status.code(), Code::InvalidArgument);
        let violation = &status.get_details_bad_request().unwrap().field_violations[0];
        assert_eq!(violation.field, "start.sensor");
    }
}
