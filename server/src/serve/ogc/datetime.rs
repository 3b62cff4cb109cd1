//! The parameter `datetime`: an instant or an interval of time (RFC 3339; OGC 17-069r4, 7.15.4).

use std::str::FromStr;

/// Instants from one to the other, both included, nanoseconds since the Unix epoch; an end may be open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::serve) struct Interval {
    from_ns: Option<i128>,
    to_ns: Option<i128>,
}

impl Interval {
    /// Reads an instant, or two with a slash between them, of which `..` or nothing leaves one open.
    pub(in crate::serve) fn parse(text: &str) -> Result<Self, String> {
        let Some((from, to)) = text.split_once('/') else {
            let at = Some(instant(text)?);
            return Ok(Self { from_ns: at, to_ns: at });
        };
        let interval = Self { from_ns: end(from)?, to_ns: end(to)? };
        match interval {
            Self { from_ns: None, to_ns: None } => Err("one end of the interval must be an instant".to_owned()),
            Self { from_ns: Some(from), to_ns: Some(to) } if from > to => {
                Err("the interval must not end before it begins".to_owned())
            }
            _ => Ok(interval),
        }
    }

    /// Whether something that lasted from one instant to another, nanoseconds since the epoch, shares one with it.
    pub(in crate::serve) fn meets(&self, first_ns: i64, last_ns: i64) -> bool {
        self.from_ns.is_none_or(|from| i128::from(last_ns) >= from)
            && self.to_ns.is_none_or(|to| i128::from(first_ns) <= to)
    }
}

fn end(text: &str) -> Result<Option<i128>, String> {
    if matches!(text, "" | "..") { Ok(None) } else { instant(text).map(Some) }
}

fn instant(text: &str) -> Result<i128, String> {
    let wrong = || format!("{:?} is not a time as in 2026-01-31T08:00:00Z", super::super::problem::repeated(text));
    // A date without a time is taken by the parser, and is none here.
    let is_whole =
        text.len() >= "2026-01-31T08:00:00Z".len() && text.as_bytes().get(10).is_some_and(|b| b"Tt".contains(b));
    let time = prost_types::Timestamp::from_str(text).ok().filter(|_| is_whole).ok_or_else(wrong)?;
    Ok(i128::from(time.seconds) * 1_000_000_000 + i128::from(time.nanos))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interval_meets_what_shares_an_instant_with_it() {
        let meets = |text: &str| Interval::parse(text).unwrap().meets(10_000_000_000, 20_000_000_000);
        for text in [
            "1970-01-01T00:00:10Z",
            "1970-01-01T00:00:20Z",
            "1970-01-01T01:00:15+01:00",
            "1970-01-01T00:00:00Z/1970-01-01T00:00:10Z",
            "../1970-01-01T00:00:10Z",
            "1970-01-01T00:00:20Z/..",
            "1970-01-01T00:00:12.5Z/",
        ] {
            assert!(meets(text), "{text}");
        }
        for text in ["1970-01-01T00:00:09.999Z", "/1970-01-01T00:00:09Z", "1970-01-01T00:00:21Z/.."] {
            assert!(!meets(text), "{text}");
        }
    }

    #[test]
    fn what_is_no_time_is_refused() {
        for text in [
            "",
            "..",
            "../..",
            "/",
            "yesterday",
            "2026-01-31",
            "2026-02-31T00:00:00Z",
            "2026-01-31T08:00:00",
            "2026/2027",
            "2026-01-31T08:00:00Z/2026-01-30T08:00:00Z",
            "2026-01-31T08:00:00Z/2026-01-31T09:00:00Z/..",
        ] {
            assert!(Interval::parse(text).is_err(), "{text}");
        }
    }
}
