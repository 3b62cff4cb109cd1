//! A refusal: which field, which value, which limit.

use std::fmt;

use lanemap_core::{FrameError, PoseError, Sequence};
use lanemap_proto::{
    decode::{DecodeError, ROTATION_NORM_TOLERANCE},
    v1::{self, RefusalReason},
};

/// Most characters of a value that a refusal repeats.
const MOST_REPEATED: usize = 64;

/// Why a message was not taken. The stream that carried it goes on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// The frame; `None` where the message was no frame.
    pub sequence: Option<Sequence>,
    /// The kind of fault.
    pub reason: RefusalReason,
    /// Path of the field from the message's root.
    pub field: String,
    /// The value found.
    pub value: String,
    /// The limit that it breaks.
    pub limit: String,
}

impl Refusal {
    /// A refusal of a message that is no frame; see [`Refusal::of_frame`].
    #[must_use]
    pub fn new(
        reason: RefusalReason,
        field: impl Into<String>,
        value: impl fmt::Display,
        limit: impl fmt::Display,
    ) -> Self {
        let value: String = value.to_string().chars().take(MOST_REPEATED).collect();
        Self { sequence: None, reason, field: field.into(), value, limit: limit.to_string() }
    }

    /// The same refusal, of the frame `sequence`.
    #[must_use]
    pub fn of_frame(self, sequence: Sequence) -> Self {
        Self { sequence: Some(sequence), ..self }
    }

    /// The refusal of a frame that `Frame::new` does not take.
    #[must_use]
    pub fn from_frame_error(error: FrameError) -> Self {
        match error {
            FrameError::NotFinite { field, value } => {
                Self::new(RefusalReason::NotFinite, in_frame(&field), value, "finite")
            }
            FrameError::OutOfRange { field, value, minimum, maximum } => {
                let limit = format!("{minimum} ..= {maximum}");
                Self::new(RefusalReason::OutOfRange, in_frame(&field), value, limit)
            }
            FrameError::TooMany { field, count, limit } => {
                let (value, limit) = (format!("{count} entries"), format!("at most {limit}"));
                Self::new(RefusalReason::TooMany, in_frame(&field), value, limit)
            }
            FrameError::Pose { field, source } => Self::from_pose_error(&in_frame(&field), &source),
            FrameError::Covariance { field, reason } => {
                let limit = "symmetric and positive semi-definite";
                Self::new(RefusalReason::NotACovariance, in_frame(&field), reason, limit)
            }
        }
    }

    fn from_pose_error(field: &str, error: &PoseError) -> Self {
        match error {
            PoseError::NotFinite { value } => Self::new(RefusalReason::NotFinite, field, value, "finite"),
            PoseError::NotARotation { deviation, limit } => {
                let limit = format!("deviation from a rotation at most {limit}");
                Self::new(RefusalReason::NotARotation, field, deviation, limit)
            }
            PoseError::LastRow => Self::new(RefusalReason::NotARotation, field, "another last row", "0 0 0 1"),
        }
    }

    /// The message as it goes over the wire.
    #[must_use]
    pub fn to_wire(&self) -> v1::Refusal {
        v1::Refusal {
            sequence: self.sequence.map(|sequence| sequence.0),
            reason: self.reason.into(),
            field: self.field.clone(),
            value: self.value.clone(),
            limit: self.limit.clone(),
            message: self.to_string(),
        }
    }
}

fn in_frame(field: &str) -> String {
    format!("frame.{field}")
}

impl From<DecodeError> for Refusal {
    fn from(error: DecodeError) -> Self {
        match error {
            DecodeError::Missing { field } => Self::new(RefusalReason::Missing, field, "nothing", "required"),
            DecodeError::NotFinite { field, value } => Self::new(RefusalReason::NotFinite, field, value, "finite"),
            DecodeError::NotARotation { field, norm } => {
                let limit = format!("1 +- {ROTATION_NORM_TOLERANCE}");
                Self::new(RefusalReason::NotARotation, field, format!("norm {norm}"), limit)
            }
            DecodeError::Length { field, count, needs } => {
                Self::new(RefusalReason::OutOfRange, field, format!("{count} entries"), needs)
            }
            DecodeError::NotListed { field, value } => {
                Self::new(RefusalReason::OutOfRange, field, value, "a number that the protocol lists")
            }
            DecodeError::OutOfRange { field, value, limit } => {
                Self::new(RefusalReason::OutOfRange, field, value, limit)
            }
            DecodeError::TooMany { field, count, limit } => {
                let (value, limit) = (format!("{count} entries"), format!("at most {limit}"));
                Self::new(RefusalReason::TooMany, field, value, limit)
            }
            DecodeError::TooFew { field, count, least } => {
                let (value, limit) = (format!("{count} entries"), format!("at least {least}"));
                Self::new(RefusalReason::TooFew, field, value, limit)
            }
            DecodeError::Frame(error) => Self::from_frame_error(error),
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(sequence) = self.sequence {
            write!(formatter, "frame {}: ", sequence.0)?;
        }
        write!(formatter, "{} is {}, limit: {}", self.field, self.value, self.limit)
    }
}
