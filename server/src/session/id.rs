//! The server's own name of a session. It names no vehicle, so that it may be shown to map consumers.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Name of a session: grows with the time of creation, and is hardly ever given twice, not even by a store that was wiped.
///
/// It tells the hour in which a drive began, as the map's own times do, and not the moment, which the map may hide.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SessionId(u64);

/// Why a text is not a session id.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("session id {text:?} is not 16 hexadecimal digits")]
pub struct SessionIdError {
    /// The text.
    pub text: String,
}

/// Milliseconds of an hour.
const HOUR_MS: u64 = 3_600_000;
/// Ids of one hour: 2^38, room for 10 million drives; the bits above hold the hours of 7,000 years.
const BITS_WITHIN_HOUR: u32 = 38;
/// The first id of an hour is one of so many, so that a store that was wiped does not give it again.
const FIRST_OF_HOUR: u64 = 1 << 36;
/// Every other lies up to so many above the one before.
const MOST_STEP: u64 = 1 << 14;

impl SessionId {
    /// The id of a session created in the hour of `unix_ms`, after `previous`; `noise` chooses among those that follow.
    #[must_use]
    pub fn next(previous: Option<Self>, unix_ms: u64, noise: u64) -> Self {
        let hour = (unix_ms / HOUR_MS) << BITS_WITHIN_HOUR;
        Self(match previous {
            Some(previous) if previous.0 >= hour => previous.0 + 1 + noise % MOST_STEP,
            _ => hour + noise % FIRST_OF_HOUR,
        })
    }

    /// Big-endian bytes: keys of the store that sort as the ids do.
    #[must_use]
    pub fn to_key(self) -> [u8; 8] {
        self.0.to_be_bytes()
    }

    /// The id of [`SessionId::to_key`]'s bytes.
    #[must_use]
    pub fn from_key(key: [u8; 8]) -> Self {
        Self(u64::from_be_bytes(key))
    }
}

impl fmt::Display for SessionId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{:016x}", self.0)
    }
}

impl FromStr for SessionId {
    type Err = SessionIdError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let refuse = || SessionIdError { text: text.chars().take(64).collect() };
        let hexadecimal = text.len() == 16 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        if !hexadecimal {
            return Err(refuse());
        }
        u64::from_str_radix(text, 16).map(Self).map_err(|_| refuse())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_survives_its_text_and_its_key() {
        let id = SessionId::next(None, 1_700_000_000_000, 77);
        assert_eq!(id.to_string().parse(), Ok(id));
        assert_eq!(SessionId::from_key(id.to_key()), id);
    }

    #[test]
    fn ids_grow_even_when_the_clock_falls_back() {
        let first = SessionId::next(None, HOUR_MS, 5);
        let second = SessionId::next(Some(first), 0, 0);
        assert!(second > first);
    }

    #[test]
    fn an_id_does_not_tell_when_within_the_hour_its_drive_began() {
        let (early, late) =
            (1_700_000_000_000 / HOUR_MS * HOUR_MS, 1_700_000_000_000 / HOUR_MS * HOUR_MS + HOUR_MS - 1);
        assert_eq!(SessionId::next(None, early, 9), SessionId::next(None, late, 9));
        assert_ne!(SessionId::next(None, early, 9), SessionId::next(None, early, 10));
    }

    #[test]
    fn a_text_that_is_no_id_is_refused_by_name() {
        let error = "+123456789abcdef".parse::<SessionId>().unwrap_err();
        assert_eq!(error.to_string(), "session id \"+123456789abcdef\" is not 16 hexadecimal digits");
    }
}
