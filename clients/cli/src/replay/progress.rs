//! The progress of a replay on stderr: frames per second, lanes, lag.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

/// A progress bar; nothing is drawn where stderr is no terminal.
pub struct Progress {
    bar: ProgressBar,
}

impl Progress {
    /// A bar for so many frames.
    pub fn new(frames: usize) -> Self {
        let bar = ProgressBar::new(frames as u64);
        let style = ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {per_sec}, {msg}, {eta} left")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        bar.set_style(style);
        bar.enable_steady_tick(Duration::from_millis(200));
        Self { bar }
    }

    /// One frame more; `lag` is the number of frames that are due and not yet in the map.
    pub fn stepped(&self, lanes: usize, lag: usize) {
        self.bar.inc(1);
        self.bar.set_message(format!("{lanes} lanes, lag {lag} frames"));
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
