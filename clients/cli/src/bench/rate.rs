//! How often a vehicle sends.

use std::{fmt, str::FromStr, time::Duration};

/// Fastest rate of one vehicle, frames per second.
const HIGHEST_HZ: f64 = 10_000.0;

/// Frames per second of one vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FrameRate {
    /// As fast as acks allow.
    Max,
    /// One frame in so long.
    Every(Duration),
}

impl FrameRate {
    /// Frames per second, `None` where acks set the pace.
    pub fn hz(self) -> Option<f64> {
        match self {
            Self::Max => None,
            Self::Every(period) => Some(1.0 / period.as_secs_f64()),
        }
    }
}

impl FromStr for FrameRate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "max" {
            return Ok(Self::Max);
        }
        match text.parse::<f64>() {
            Ok(hz) if (0.01..=HIGHEST_HZ).contains(&hz) => Ok(Self::Every(Duration::from_secs_f64(1.0 / hz))),
            _ => Err(format!("{text:?} is neither max nor a rate from 0.01 to {HIGHEST_HZ} Hz")),
        }
    }
}

impl fmt::Display for FrameRate {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.hz() {
            Some(hz) => write!(formatter, "{hz:.4} Hz"),
            None => formatter.write_str("as fast as acks allow"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_max_or_hertz_in_range() {
        assert_eq!("max".parse(), Ok(FrameRate::Max));
        assert_eq!("10".parse(), Ok(FrameRate::Every(Duration::from_millis(100))));
        for wrong in ["0", "-1", "NaN", "inf", "1e9", "fast"] {
            assert!(wrong.parse::<FrameRate>().is_err(), "{wrong}");
        }
    }
}
