//! What a run of the load found.

use std::fmt;

use serde::Serialize;
use tokio::time::Instant;

use super::{rate::FrameRate, tally::Tally};

/// What was streamed, and what came of it.
#[derive(Debug, Serialize)]
pub struct LoadReport {
    /// How frames travelled.
    pub transport: &'static str,
    /// Vehicles at a time.
    pub vehicles: u32,
    /// Frames per second of one vehicle; `None`: as fast as acks allow.
    pub hz: Option<f64>,
    /// Time in which frames were sent, seconds.
    pub seconds: f64,
    /// Drives that were opened.
    pub drives: u64,
    /// Frames handed to the transport.
    pub frames_sent: u64,
    /// Frames acked: on the server's disk.
    pub frames_acked: u64,
    /// Frames sent and not acked, refused ones among them.
    pub frames_lost: u64,
    /// Frames refused.
    pub frames_refused: u64,
    /// Streams that broke.
    pub streams_broken: u64,
    /// Frames acked per second, from the first frame to the last ack.
    pub frames_per_s: f64,
    /// Time from a frame's sending (at a given rate: from when it was due) to its ack.
    pub ack_ms: AckTimes,
    /// Memory of the server's process at the end of the run, MB; `None` where it does not tell.
    pub rss_mb: Option<f64>,
    /// What went wrong, the first few.
    pub complaints: Vec<String>,
}

/// Milliseconds.
#[derive(Debug, Serialize)]
pub struct AckTimes {
    /// Half of the frames took at most this.
    pub p50: f64,
    /// All but one in a hundred took at most this.
    pub p99: f64,
    /// The longest.
    pub max: f64,
}

/// How it was measured.
#[derive(Clone, Copy, Debug)]
pub struct LoadPlan {
    /// How frames travelled.
    pub transport: &'static str,
    /// Vehicles at a time.
    pub vehicles: u32,
    /// How often each sends.
    pub rate: FrameRate,
    /// When the first frame was due.
    pub began: Instant,
    /// When vehicles stopped sending.
    pub stopped: Instant,
}

impl LoadReport {
    /// The report of a run that is over.
    pub fn new(plan: &LoadPlan, tally: &Tally, rss_mb: Option<f64>) -> Self {
        let counts = tally.counts();
        let ms = |us: u64| us as f64 / 1e3;
        let elapsed = counts.last_ack.unwrap_or(plan.stopped).saturating_duration_since(plan.began);
        Self {
            transport: plan.transport,
            vehicles: plan.vehicles,
            hz: plan.rate.hz(),
            seconds: (plan.stopped - plan.began).as_secs_f64(),
            drives: counts.drives,
            frames_sent: counts.sent,
            frames_acked: counts.acked,
            frames_lost: counts.sent.saturating_sub(counts.acked),
            frames_refused: counts.refused,
            streams_broken: counts.broken,
            frames_per_s: counts.acked as f64 / elapsed.as_secs_f64().max(1e-9),
            ack_ms: AckTimes {
                p50: ms(counts.ack_us.value_at_quantile(0.5)),
                p99: ms(counts.ack_us.value_at_quantile(0.99)),
                max: ms(counts.ack_us.max()),
            },
            rss_mb,
            complaints: counts.complaints.clone(),
        }
    }

    /// Whether every frame was acked.
    pub fn is_whole(&self) -> bool {
        self.frames_lost == 0 && self.streams_broken == 0
    }
}

impl fmt::Display for LoadReport {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let pace = self.hz.map_or_else(|| "as fast as acks allow".to_owned(), |hz| format!("{hz:.1} Hz"));
        writeln!(formatter, "{} vehicles, {pace}, {:.0} s, {}", self.vehicles, self.seconds, self.transport)?;
        writeln!(
            formatter,
            "frames    {} sent, {} acked, {} lost, {:.0}/s",
            self.frames_sent, self.frames_acked, self.frames_lost, self.frames_per_s
        )?;
        let AckTimes { p50, p99, max } = self.ack_ms;
        writeln!(formatter, "acks      p50 {p50:.1} ms, p99 {p99:.1} ms, max {max:.1} ms")?;
        if let Some(rss_mb) = self.rss_mb {
            writeln!(formatter, "server    {rss_mb:.0} MB resident")?;
        }
        for complaint in &self.complaints {
            writeln!(formatter, "wrong     {complaint}")?;
        }
        Ok(())
    }
}
