//! The progress of a replay on stderr: frames per second, lanes, lag.

use std::{fmt::Write, time::Duration};

use indicatif::{ProgressBar, ProgressState, ProgressStyle};

/// A progress bar; nothing is drawn where stderr is no terminal.
pub struct Progress {
    bar: ProgressBar,
}

impl Progress {
    /// A bar for so many frames.
    pub fn new(frames: usize) -> Self {
        let bar = ProgressBar::new(frames as u64);
        let style = ProgressStyle::with_template("{bar:24} {pos}/{len} frames, {rate} frames/s, {msg}, {eta} left")
            .unwrap_or_else(|_| ProgressStyle::default_bar())
            .with_key("rate", |state: &ProgressState, out: &mut dyn Write| {
                // A bar that cannot be drawn is not worth an error.
                let _ = write!(out, "{:.0}", state.per_sec());
            });
        bar.set_style(style);
        bar.enable_steady_tick(Duration::from_millis(200));
        Self { bar }
    }

    /// One frame more: `unacked` frames are sent and not durable yet, and this one was done `late` after it was due.
    pub fn stepped(&self, lanes: usize, unacked: u64, late: Duration) {
        self.bar.inc(1);
        self.bar.set_message(format!("{lanes} lanes, lag {} ms and {unacked} frames", late.as_millis()));
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
