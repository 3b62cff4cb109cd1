//! Counts of the whole fleet.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use hdrhistogram::Histogram;
use tokio::time::{Duration, Instant};

/// Significant digits of latencies.
const DIGITS: u8 = 3;
/// Longest latency told apart, microseconds: ten minutes.
const LONGEST_US: u64 = 600_000_000;
/// Complaints that are repeated to the user; the others are only counted.
const MOST_COMPLAINTS: usize = 5;

/// What all vehicles have sent and heard so far. Clones share it.
#[derive(Clone, Debug)]
pub struct Tally {
    counts: Arc<Mutex<Counts>>,
}

/// The counts.
#[derive(Debug)]
pub struct Counts {
    /// Frames handed to the transport.
    pub sent: u64,
    /// Frames acked.
    pub acked: u64,
    /// Frames refused.
    pub refused: u64,
    /// Streams that broke.
    pub broken: u64,
    /// Drives opened.
    pub drives: u64,
    /// Microseconds from a frame's sending to its ack.
    pub ack_us: Histogram<u64>,
    /// When the last ack came.
    pub last_ack: Option<Instant>,
    /// What went wrong, the first few.
    pub complaints: Vec<String>,
}

impl Tally {
    /// Nothing yet.
    pub fn new() -> anyhow::Result<Self> {
        let counts = Counts {
            sent: 0,
            acked: 0,
            refused: 0,
            broken: 0,
            drives: 0,
            ack_us: Histogram::new_with_bounds(1, LONGEST_US, DIGITS)?,
            last_ack: None,
            complaints: Vec::new(),
        };
        Ok(Self { counts: Arc::new(Mutex::new(counts)) })
    }

    /// The counts, to read or change.
    pub fn counts(&self) -> MutexGuard<'_, Counts> {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Counts {
    /// A frame was acked so long after it was sent.
    pub fn acked_after(&mut self, latency: Duration) {
        self.acked += 1;
        let us = u64::try_from(latency.as_micros()).unwrap_or(u64::MAX);
        self.ack_us.saturating_record(us);
    }

    /// Notes what went wrong.
    pub fn complain(&mut self, complaint: impl FnOnce() -> String) {
        if self.complaints.len() < MOST_COMPLAINTS {
            self.complaints.push(complaint());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latencies_are_kept_to_a_thousandth() {
        let tally = Tally::new().unwrap();
        for ms in 1..=100 {
            tally.counts().acked_after(Duration::from_millis(ms));
        }
        let counts = tally.counts();
        assert_eq!(counts.acked, 100);
        assert!(
            counts.ack_us.value_at_quantile(0.5).abs_diff(50_000) <= 50,
            "{:?}",
            counts.ack_us.value_at_quantile(0.5)
        );
        assert!(counts.ack_us.max().abs_diff(100_000) <= 100);
    }
}
