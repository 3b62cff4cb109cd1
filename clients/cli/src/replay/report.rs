//! What a replay has to say at its end.

use std::{fmt, time::Duration};

use serde::Serialize;

use super::{
    frames::Fault,
    mapper_run::MapperRun,
    step_times::{StepFigures, StepTimes},
    stream::SessionReport,
};

/// Everything that was replayed.
#[derive(Debug, Serialize)]
pub struct ReplayReport {
    /// Frames replayed.
    pub frames: usize,
    /// Time that it took, seconds.
    pub seconds: f64,
    /// Times of `Mapper::step` in this process, microseconds.
    pub step_us: Option<StepFigures>,
    /// The drives in the order of their names.
    pub drives: Vec<DriveReport>,
}

/// One drive.
#[derive(Debug, Serialize)]
pub struct DriveReport {
    /// Name of its folder.
    pub name: String,
    /// Frames replayed.
    pub frames: usize,
    /// Lanes in the map at the end.
    pub lanes: usize,
    /// Distance driven, metres.
    pub length_m: f64,
    /// Times of `Mapper::step`, microseconds.
    pub step_us: Option<StepFigures>,
    /// Mean time of `Mapper::step` in each kilometre driven, microseconds.
    pub step_us_per_km: Vec<Option<f64>>,
    /// Frames left out, and why.
    pub left_out: Vec<Fault>,
    /// What became of it at the server; absent with `--local`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub session: Option<SessionReport>,
    /// Why it was not streamed to its end.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
    #[serde(skip)]
    times: StepTimes,
}

impl DriveReport {
    /// The report of a drive; `run` is `None` where no frame of it could be replayed.
    pub fn new(name: &str, run: Option<&MapperRun>, left_out: Vec<Fault>, session: Option<SessionReport>) -> Self {
        let times = run.map(|run| run.times().clone()).unwrap_or_default();
        Self {
            name: name.to_owned(),
            frames: run.map_or(0, MapperRun::steps),
            lanes: run.map_or(0, |run| run.mapper().finished_lane_map().lanes.len()),
            length_m: run.map_or(0.0, MapperRun::driven_m),
            step_us: StepTimes::figures([&times]),
            step_us_per_km: times.means_per_km_us(),
            left_out,
            session,
            failure: None,
            times,
        }
    }

    /// The same, of a drive that was not streamed to its end.
    pub fn failed(self, failure: Option<String>) -> Self {
        Self { failure, ..self }
    }

    /// Whether every frame was replayed, taken by the server, and mapped there as here.
    fn is_whole(&self) -> bool {
        let served = self.session.as_ref().is_none_or(|session| session.refused == 0 && session.same_as_local);
        self.left_out.is_empty() && self.failure.is_none() && served
    }
}

impl ReplayReport {
    /// The report of all drives.
    pub fn new(drives: Vec<DriveReport>, took: Duration) -> Self {
        Self {
            frames: drives.iter().map(|drive| drive.frames).sum(),
            seconds: took.as_secs_f64(),
            step_us: StepTimes::figures(drives.iter().map(|drive| &drive.times)),
            drives,
        }
    }

    /// Whether nothing was left out.
    pub fn is_whole(&self) -> bool {
        self.frames > 0 && self.drives.iter().all(DriveReport::is_whole)
    }
}

impl fmt::Display for ReplayReport {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(out, "{:<34} {:>7} {:>9} {:>6} {:>9}", "drive", "frames", "metres", "lanes", "left out")?;
        for drive in &self.drives {
            let DriveReport { name, frames, length_m, lanes, left_out, .. } = drive;
            writeln!(out, "{name:<34} {frames:>7} {length_m:>9.1} {lanes:>6} {:>9}", left_out.len())?;
            if let Some(failure) = &drive.failure {
                writeln!(out, "  not streamed to its end: {failure}")?;
            }
            if let Some(session) = &drive.session {
                write!(out, "  {}", session.lanes_url)?;
                match (session.refused, session.same_as_local) {
                    (0, true) => writeln!(out)?,
                    (0, false) => writeln!(out, "  NOT the map that the same frames make here")?,
                    (refused, _) => writeln!(out, "  {refused} frames refused")?,
                }
            }
        }
        write!(out, "{} frames in {:.2} s", self.frames, self.seconds)?;
        if let Some(step) = &self.step_us {
            let StepFigures { mean, p50, p99, max } = step;
            write!(out, "; a step took {mean:.0} us on average, p50 {p50:.0}, p99 {p99:.0}, at most {max:.0}")?;
        }
        writeln!(out)
    }
}
