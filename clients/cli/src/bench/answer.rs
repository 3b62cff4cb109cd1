//! What the server says, read no further than the measurement needs: poses are most of the bytes, and only counted.

use bytes::Bytes;
use lanemap_core::Sequence;
use lanemap_proto::v1::{self, stream_observations_response::Message};
use prost::Message as _;

/// First byte of a response that holds a pose or a local map: field 4 or 5, length-delimited.
const POSE: u8 = 4 << 3 | 2;
const LOCAL_MAP: u8 = 5 << 3 | 2;

/// An answer.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer {
    /// The drive is open; the server takes so many frames unacked.
    Accepted { max_frames_in_flight: usize },
    /// Frames up to this one are durable.
    Acked(Sequence),
    /// A frame, or another message, was refused.
    Refused { sequence: Option<Sequence>, message: String },
    /// The drive is over and durable.
    Ended,
    /// The stream is closed (zenoh); with what is wrong, where something is.
    Closed { trouble: Option<String> },
    /// Nothing that is measured.
    Other,
}

impl Answer {
    /// Reads an answer of the ingest service.
    pub fn parse(bytes: Bytes) -> Result<Self, prost::DecodeError> {
        if matches!(bytes.first(), Some(&(POSE | LOCAL_MAP))) {
            return Ok(Self::Other);
        }
        Ok(match v1::StreamObservationsResponse::decode(bytes)?.message {
            Some(Message::Accepted(accepted)) => {
                let limits = accepted.limits.unwrap_or_default();
                Self::Accepted { max_frames_in_flight: limits.max_frames_in_flight.max(1) as usize }
            }
            Some(Message::Ack(ack)) => Self::Acked(Sequence(ack.acked_sequence_inclusive)),
            Some(Message::Refusal(refusal)) => {
                Self::Refused { sequence: refusal.sequence.map(Sequence), message: refusal.message }
            }
            Some(Message::Closed(closed)) => {
                Self::Closed { trouble: (closed.code != 0).then(|| format!("{}: {}", closed.code, closed.message)) }
            }
            Some(Message::Ended(_)) => Self::Ended,
            _ => Self::Other,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(message: Message) -> Answer {
        let response = v1::StreamObservationsResponse { message: Some(message) };
        Answer::parse(response.encode_to_vec().into()).unwrap()
    }

    #[test]
    fn poses_are_passed_over_and_acks_are_read() {
        assert_eq!(parse(Message::Pose(v1::PoseUpdate { sequence: 3, ..v1::PoseUpdate::default() })), Answer::Other);
        assert_eq!(parse(Message::LocalMap(v1::LocalMapUpdate::default())), Answer::Other);
        assert_eq!(parse(Message::Ack(v1::Ack { acked_sequence_inclusive: 7 })), Answer::Acked(Sequence(7)));
    }
}
