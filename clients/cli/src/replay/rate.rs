//! How fast a drive is replayed.

use std::{
    str::FromStr,
    time::{Duration, Instant},
};

use lanemap_core::TimestampNs;

/// Speed of a replay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rate {
    /// As fast as frames are taken.
    Max,
    /// So many times as fast as recorded.
    Times(f64),
}

impl FromStr for Rate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "max" {
            return Ok(Self::Max);
        }
        match text.parse::<f64>() {
            Ok(times) if times.is_finite() && times > 0.0 => Ok(Self::Times(times)),
            _ => Err(format!("{text:?} is neither max nor a number above 0")),
        }
    }
}

/// Says when each frame of a drive is due.
#[derive(Debug)]
pub struct Pacer {
    rate: Rate,
    began: Option<(Instant, TimestampNs)>,
}

impl Pacer {
    /// A pacer of one drive; its clock starts at the first frame.
    pub fn new(rate: Rate) -> Self {
        Self { rate, began: None }
    }

    /// When the frame of a time is due, or `None` where it is due at once.
    pub fn due(&mut self, time: TimestampNs) -> Option<Instant> {
        let Rate::Times(times) = self.rate else { return None };
        let (began, first) = *self.began.get_or_insert_with(|| (Instant::now(), time));
        let after = Duration::try_from_secs_f64(time.seconds_since(first) / times).unwrap_or_default();
        began.checked_add(after)
    }

    /// Waits until the frame of a time is due, and says when that was.
    pub async fn wait_for(&mut self, time: TimestampNs) -> Instant {
        let Some(due) = self.due(time) else { return Instant::now() };
        tokio::time::sleep_until(due.into()).await;
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_max_or_a_number_above_zero() {
        assert_eq!("max".parse(), Ok(Rate::Max));
        assert_eq!("2.5".parse(), Ok(Rate::Times(2.5)));
        for wrong in ["0", "-1", "NaN", "inf", "fast"] {
            assert!(wrong.parse::<Rate>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn frames_are_due_as_far_apart_as_they_were_recorded() {
        let mut pacer = Pacer::new(Rate::Times(2.0));
        let first = pacer.due(TimestampNs(5_000_000_000)).unwrap();
        let later = pacer.due(TimestampNs(6_000_000_000)).unwrap();
        assert_eq!(later - first, Duration::from_millis(500));
        assert_eq!(Pacer::new(Rate::Max).due(TimestampNs(1)), None);
    }
}
