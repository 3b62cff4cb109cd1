//! The path under which a proxy serves the service.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Longest path, bytes.
const LONGEST: usize = 256;

/// A path before those of the service: empty, or e.g. `/maps/lanes`, without a slash at its end.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct BasePath(String);

/// A text that is no such path.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error(
    "{text:?} is no base path: it must be empty or like /maps/lanes, of letters, digits and -._~, at most {LONGEST} bytes"
)]
pub struct BasePathError {
    text: String,
}

impl BasePath {
    /// The path; empty where the service is at the root.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// What of a request's path follows this one, with its slash; `None` where the path does not lie under it.
    #[must_use]
    pub fn stripped<'a>(&self, path: &'a str) -> Option<&'a str> {
        match path.strip_prefix(self.as_str())? {
            "" => Some("/"),
            rest => rest.starts_with('/').then_some(rest),
        }
    }
}

impl FromStr for BasePath {
    type Err = BasePathError;

    fn from_str(text: &str) -> Result<Self, BasePathError> {
        let path = text.strip_suffix('/').unwrap_or(text);
        let is_segment = |segment: &str| {
            let is_plain = segment.chars().all(|letter| letter.is_ascii_alphanumeric() || "-._~".contains(letter));
            is_plain && !matches!(segment, "" | "." | "..")
        };
        let is_path = path.strip_prefix('/').is_some_and(|segments| segments.split('/').all(is_segment));
        if path.is_empty() || (is_path && path.len() <= LONGEST) {
            return Ok(Self(path.to_owned()));
        }
        Err(BasePathError { text: text.chars().take(LONGEST).collect() })
    }
}

impl TryFrom<String> for BasePath {
    type Error = BasePathError;

    fn try_from(text: String) -> Result<Self, BasePathError> {
        text.parse()
    }
}

impl From<BasePath> for String {
    fn from(path: BasePath) -> Self {
        path.0
    }
}

impl fmt::Display for BasePath {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_kept_without_the_slash_at_its_end() {
        for (text, path) in [("", ""), ("/", ""), ("/maps", "/maps"), ("/maps/v-1/", "/maps/v-1")] {
            assert_eq!(text.parse::<BasePath>().unwrap().as_str(), path);
        }
    }

    #[test]
    fn a_text_that_would_lead_elsewhere_is_refused() {
        for text in ["maps", "//host", "/a//b", "/a/../b", "/a b", "/a?b", "/a\"b", "https://host"] {
            assert!(text.parse::<BasePath>().is_err(), "{text}");
        }
    }

    #[test]
    fn only_what_lies_under_a_path_is_stripped_of_it() {
        let base: BasePath = "/maps".parse().unwrap();
        assert_eq!(base.stripped("/maps/cells"), Some("/cells"));
        assert_eq!(base.stripped("/maps"), Some("/"));
        assert_eq!(base.stripped("/mapsy"), None);
        assert_eq!(base.stripped("/cells"), None);
    }
}
