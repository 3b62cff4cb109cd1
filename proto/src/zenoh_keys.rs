//! Where a stream of observations lives in zenoh: the keys of a vehicle, and what is attached to each message.
//!
//! | key | put by | holds |
//! |---|---|---|
//! | `lanemap/v1/{fleet}/{vehicle}/observations` | vehicle | `StreamObservationsRequest` |
//! | `lanemap/v1/{fleet}/{vehicle}/acks` | server | `StreamObservationsResponse`: accepted, ack, refusal, ended, closed |
//! | `lanemap/v1/{fleet}/{vehicle}/pose` | server | `StreamObservationsResponse`: pose, local map |
//! | `lanemap/v1/{fleet}/{vehicle}/@alive/{nonce}` | vehicle | liveliness token of one stream |
//! | `lanemap/v1/@server` | server | liveliness token |
//! | `lanemap/v1/map/{cell}` | server | `CellMap`: the newest version of the cell; it answers queries, too |
//! | `lanemap/v1/map/{cell}/events/{number}` | server | `MapEvent`: what happened in the cell; it answers queries, too |
//!
//! Ids are percent-encoded in keys ([`encode_id`]), so that none can hold a `/` or a wildcard.

use std::{fmt, fmt::Write as _, str::FromStr};

use thiserror::Error;

/// What every key begins with.
pub const PREFIX: &str = "lanemap/v1";
/// The server's liveliness token: there while a server takes observations.
pub const SERVER: &str = "lanemap/v1/@server";
/// Matches the observations of every vehicle.
pub const EVERY_OBSERVATIONS: &str = "lanemap/v1/*/*/observations";
/// Matches the liveliness token of every stream.
pub const EVERY_ALIVE: &str = "lanemap/v1/*/*/@alive/*";
/// Matches every cell of the shared map.
pub const EVERY_CELL: &str = "lanemap/v1/map/*";
/// Encoding of cells.
pub const CELL_ENCODING: &str = "application/protobuf;lanemap.v1.CellMap";
/// Matches every event of every cell.
pub const EVERY_EVENT: &str = "lanemap/v1/map/*/events/*";
/// Encoding of events.
pub const EVENT_ENCODING: &str = "application/protobuf;lanemap.v1.MapEvent";
/// Encoding of requests.
pub const REQUEST_ENCODING: &str = "application/protobuf;lanemap.v1.StreamObservationsRequest";
/// Encoding of responses.
pub const RESPONSE_ENCODING: &str = "application/protobuf;lanemap.v1.StreamObservationsResponse";

/// The key of a cell of the shared map, by its name.
#[must_use]
pub fn cell_key(cell: &str) -> String {
    format!("{PREFIX}/map/{cell}")
}

/// The name of the cell whose key this is; `None` where it is another key, or one that matches several.
#[must_use]
pub fn parse_cell_key(key: &str) -> Option<&str> {
    let cell = key.strip_prefix(PREFIX)?.strip_prefix("/map/")?;
    (!cell.is_empty() && !cell.contains(['/', '*', '$'])).then_some(cell)
}

/// The key of an event of a cell, by the cell's name and the event's number.
#[must_use]
pub fn event_key(cell: &str, number: u64) -> String {
    format!("{PREFIX}/map/{cell}/events/{number}")
}

/// The keys of one vehicle.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct VehicleKeys {
    root: String,
}

impl VehicleKeys {
    /// The keys of `vehicle` of `fleet`, both as `SessionStart` names them.
    #[must_use]
    pub fn new(fleet: &str, vehicle: &str) -> Self {
        Self { root: format!("{PREFIX}/{}/{}", encode_id(fleet), encode_id(vehicle)) }
    }

    /// Where the vehicle puts its observations.
    #[must_use]
    pub fn observations(&self) -> String {
        format!("{}/observations", self.root)
    }

    /// Where the server puts what must be heard.
    #[must_use]
    pub fn acks(&self) -> String {
        format!("{}/acks", self.root)
    }

    /// Where the server puts poses and local maps.
    #[must_use]
    pub fn pose(&self) -> String {
        format!("{}/pose", self.root)
    }

    /// The liveliness token of one stream of the vehicle.
    #[must_use]
    pub fn alive(&self, nonce: StreamNonce) -> String {
        format!("{}/@alive/{nonce}", self.root)
    }

    /// Matches every key of the vehicle but its liveliness tokens; for access rules.
    #[must_use]
    pub fn all(&self) -> String {
        format!("{}/**", self.root)
    }
}

/// A key of a vehicle, read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VehicleKey<'a> {
    /// The fleet, decoded.
    pub fleet: String,
    /// The vehicle, decoded.
    pub vehicle: String,
    /// What follows, e.g. `observations` or `@alive/0123456789abcdef`.
    pub rest: &'a str,
}

impl<'a> VehicleKey<'a> {
    /// Reads a key below [`PREFIX`].
    ///
    /// # Errors
    /// A key that [`VehicleKeys`] would not write.
    pub fn parse(key: &'a str) -> Result<Self, KeyError> {
        let refuse = || KeyError { key: key.chars().take(256).collect() };
        let below = key.strip_prefix(PREFIX).and_then(|rest| rest.strip_prefix('/')).ok_or_else(refuse)?;
        let mut parts = below.splitn(3, '/');
        let (Some(fleet), Some(vehicle), Some(rest)) = (parts.next(), parts.next(), parts.next()) else {
            return Err(refuse());
        };
        let fleet = decode_id(fleet).ok_or_else(refuse)?;
        let vehicle = decode_id(vehicle).ok_or_else(refuse)?;
        Ok(Self { fleet, vehicle, rest })
    }

    /// The nonce of a stream's liveliness token; `None` where the key is none.
    #[must_use]
    pub fn alive_nonce(&self) -> Option<StreamNonce> {
        self.rest.strip_prefix("@alive/")?.parse().ok()
    }
}

/// A key that names no vehicle.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("{key:?} is no key of a vehicle: lanemap/v1/{{fleet}}/{{vehicle}}/..., ids percent-encoded")]
pub struct KeyError {
    /// The key, its first 256 characters.
    pub key: String,
}

/// An id as one chunk of a key: every byte but `A-Z a-z 0-9 - _ . ~` is percent-encoded, with capital digits.
#[must_use]
pub fn encode_id(id: &str) -> String {
    id.bytes().fold(String::with_capacity(id.len()), |mut chunk, byte| {
        if is_plain(byte) {
            chunk.push(char::from(byte));
        } else {
            // Writing to a String does not fail.
            let _ = write!(chunk, "%{byte:02X}");
        }
        chunk
    })
}

/// The id of a chunk that [`encode_id`] wrote; `None` where it could not have: one id has one chunk.
#[must_use]
pub fn decode_id(chunk: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(chunk.len());
    let mut rest = chunk.bytes();
    while let Some(byte) = rest.next() {
        match byte {
            b'%' => bytes.push(16 * hex_value(rest.next()?)? + hex_value(rest.next()?)?),
            byte if is_plain(byte) => bytes.push(byte),
            _ => return None,
        }
    }
    let id = String::from_utf8(bytes).ok()?;
    (!id.is_empty() && encode_id(&id) == chunk).then_some(id)
}

fn is_plain(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_' | b'.' | b'~')
}

fn hex_value(digit: u8) -> Option<u8> {
    match digit {
        b'0'..=b'9' => Some(digit - b'0'),
        b'A'..=b'F' => Some(digit - b'A' + 10),
        _ => None,
    }
}

/// Tells the streams of a vehicle apart: chosen at random by the client for each stream. Written as 16 hexadecimal
/// digits, lower case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct StreamNonce(pub u64);

impl fmt::Display for StreamNonce {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{:016x}", self.0)
    }
}

impl FromStr for StreamNonce {
    type Err = AttachmentError;

    fn from_str(text: &str) -> Result<Self, AttachmentError> {
        hex16(text.as_bytes()).map(Self).ok_or(AttachmentError)
    }
}

/// What is attached to every message of a stream, in both directions: 32 hexadecimal digits, lower case. A vehicle that
/// shows a bearer token adds it to that of message 0 ([`attachment_with_token`]).
///
/// Each direction numbers its messages by itself, and the server numbers `acks` and `pose` each by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Attachment {
    /// The stream.
    pub nonce: StreamNonce,
    /// The message's number within its stream, key and direction, from 0 without a gap.
    pub number: u64,
}

/// An attachment that does not read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error(
    "the attachment is not 32 hexadecimal digits, lower case: 16 of the stream's nonce, 16 of the message's number"
)]
pub struct AttachmentError;

impl Attachment {
    /// Reads the bytes of an attachment.
    ///
    /// # Errors
    /// Anything but 32 hexadecimal digits in lower case.
    pub fn parse(bytes: &[u8]) -> Result<Self, AttachmentError> {
        let (nonce, number) = bytes.split_at_checked(16).ok_or(AttachmentError)?;
        let nonce = StreamNonce(hex16(nonce).ok_or(AttachmentError)?);
        Ok(Self { nonce, number: hex16(number).ok_or(AttachmentError)? })
    }
}

/// The attachment of a stream's message 0 with a bearer token: after the 32 digits come a blank and the token.
#[must_use]
pub fn attachment_with_token(attachment: Attachment, token: &str) -> String {
    format!("{attachment} {token}")
}

/// Reads the bytes of an attachment that may hold a token, as [`attachment_with_token`] writes it.
///
/// # Errors
/// Anything else; also a token on another message than the first.
pub fn parse_with_token(bytes: &[u8]) -> Result<(Attachment, Option<&str>), AttachmentError> {
    let Some((attachment, rest)) = bytes.split_at_checked(32).filter(|(_, rest)| !rest.is_empty()) else {
        return Ok((Attachment::parse(bytes)?, None));
    };
    let attachment = Attachment::parse(attachment)?;
    let token = rest.strip_prefix(b" ").and_then(|token| std::str::from_utf8(token).ok());
    match token.filter(|_| attachment.number == 0) {
        Some(token) => Ok((attachment, Some(token))),
        None => Err(AttachmentError),
    }
}

impl fmt::Display for Attachment {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}{:016x}", self.nonce, self.number)
    }
}

fn hex16(digits: &[u8]) -> Option<u64> {
    let lower_hex = |digit: &u8| matches!(digit, b'0'..=b'9' | b'a'..=b'f');
    if digits.len() != 16 || !digits.iter().all(lower_hex) {
        return None;
    }
    u64::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn keys_read_as_they_are_documented() {
        let keys = VehicleKeys::new("north", "car 1/ä*");
        assert_eq!(keys.observations(), "lanemap/v1/north/car%201%2F%C3%A4%2A/observations");
        assert_eq!(keys.alive(StreamNonce(0xab)), "lanemap/v1/north/car%201%2F%C3%A4%2A/@alive/00000000000000ab");
        let alive = keys.alive(StreamNonce(0xab));
        let read = VehicleKey::parse(&alive).unwrap();
        assert_eq!((read.fleet.as_str(), read.vehicle.as_str()), ("north", "car 1/ä*"));
        assert_eq!(read.alive_nonce(), Some(StreamNonce(0xab)));
    }

    #[test]
    fn a_key_that_would_be_written_otherwise_is_refused() {
        for key in [
            "lanemap/v1/a/%41/observations",
            "lanemap/v1/a/%4/observations",
            "lanemap/v1/a/%c3%a4/observations",
            "lanemap/v1/a/%FF/observations",
            "lanemap/v1/@server",
            "lanemap/v1x/a/b/observations",
            "other/v1/a/b/observations",
        ] {
            assert!(VehicleKey::parse(key).is_err(), "{key}");
        }
    }

    #[test]
    fn an_attachment_survives_its_text_and_nothing_else_is_one() {
        let attachment = Attachment { nonce: StreamNonce(7), number: u64::MAX };
        assert_eq!(attachment.to_string(), "0000000000000007ffffffffffffffff");
        assert_eq!(Attachment::parse(attachment.to_string().as_bytes()), Ok(attachment));
        for bytes in [&b""[..], b"0000000000000007", b"0000000000000007FFFFFFFFFFFFFFFF", &[0xff; 32], &[b'+'; 32]] {
            assert_eq!(Attachment::parse(bytes), Err(AttachmentError));
        }
    }

    #[test]
    fn a_token_travels_with_the_first_message_only() {
        let first = Attachment { nonce: StreamNonce(7), number: 0 };
        let with_token = attachment_with_token(first, "a.b.c");
        assert_eq!(parse_with_token(with_token.as_bytes()), Ok((first, Some("a.b.c"))));
        assert_eq!(parse_with_token(first.to_string().as_bytes()), Ok((first, None)));
        let second = attachment_with_token(Attachment { number: 1, ..first }, "a.b.c");
        for refused in [second.as_str(), &with_token[..31], &format!("{first}a.b.c")] {
            assert_eq!(parse_with_token(refused.as_bytes()), Err(AttachmentError), "{refused}");
        }
    }

    proptest! {
        #[test]
        fn every_id_survives_its_key(fleet in "\\PC{1,20}", vehicle in any::<String>().prop_filter("not empty", |id| !id.is_empty())) {
            let key = VehicleKeys::new(&fleet, &vehicle).acks();
            let read = VehicleKey::parse(&key).unwrap();
            prop_assert_eq!((read.fleet, read.vehicle, read.rest), (fleet, vehicle, "acks"));
        }
    }
}
