//! OpenLane's file names: 16 digits of microseconds followed by two more digits, 18 in all.

use lanemap_core::TimestampNs;

/// Time of the stem of a file name, or `None` where it is not 18 digits.
///
/// ```
/// use lanemap_core::TimestampNs;
/// use lanemap_openlane::{timestamp_from_stem, timestamp_stem};
///
/// let time = timestamp_from_stem("152268801497018700");
/// assert_eq!(time, Some(TimestampNs(1_522_688_014_970_187_000)));
/// assert_eq!(timestamp_stem(TimestampNs(1_522_688_014_970_187_000)), "152268801497018700");
/// assert_eq!(timestamp_from_stem("frame-1"), None);
/// ```
#[must_use]
pub fn timestamp_from_stem(stem: &str) -> Option<TimestampNs> {
    if stem.len() != 18 || !stem.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let hundredths_of_us: i64 = stem.parse().ok()?;
    hundredths_of_us.checked_mul(10).map(TimestampNs)
}

/// Stem of the file name of a time; what lies below ten nanoseconds, or before 1970, is lost.
#[must_use]
pub fn timestamp_stem(time: TimestampNs) -> String {
    format!("{:018}", time.0.max(0) / 10)
}
