//! The server's own name of a session. It names no vehicle, so that it may be shown to map consumers.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Name of a session: grows with the time of creation, and is never given twice, not even by a store that was wiped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SessionId(u64);

/// Why a text is not a session id.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("session id {text:?} is not 16 hexadecimal digits")]
pub struct SessionIdError {
    /// The text.
    pub text: String,
}

/// Bits below the milliseconds: ids of sessions that begin in one millisecond.
const BITS_WITHIN_MILLISECOND: u32 = 16;

impl SessionId {
    /// The id of a session created at `unix_ms`, after `previous`.
    #[must_use]
    pub fn next(previous: Option<Self>, unix_ms: u64) -> Self {
        let by_time = unix_ms << BITS_WITHIN_MILLISECOND;
        Self(previous.map_or(by_time, |previous| by_time.max(previous.0 + 1)))
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
        let id = SessionId::next(None, 1_700_000_000_000);
        assert_eq!(id.to_string().parse(), Ok(id));
        assert_eq!(SessionId::from_key(id.to_key()), id);
    }

    #[test]
    fn ids_grow_even_when_the_clock_falls_back() {
        let first = SessionId::next(None, 1_000);
        let second = SessionId::next(Some(first), 900);
        assert!(second > first);
    }

    #[test]
    fn a_text_that_is_no_id_is_refused_by_name() {
        let error = "+123456789abcdef".parse::<SessionId>().unwrap_err();
        assert_eq!(error.to_string(), "session id \"+123456789abcdef\" is not 16 hexadecimal digits");
    }
}
