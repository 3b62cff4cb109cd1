//! `lanemap record`: drives of any kind, as MCAP.

use std::{fs, path::PathBuf, process::ExitCode};

use anyhow::Context;
use clap::Args;
use lanemap_core::{Preset, geometry::georeference::Georeference};
use lanemap_recording::RecordedDrive;
use serde::Serialize;

use crate::{
    recordings::{DriveArgs, RecordingPlace},
    replay::frames::{Disturbance, Fault, FrameSource, parse_origin},
};

/// What to record, and where to.
#[derive(Args, Debug)]
pub struct RecordArgs {
    #[command(flatten)]
    recordings: DriveArgs,
    /// Where to write: a file that ends in .mcap for one drive, a folder for several
    #[arg(long, value_name = "FILE|DIR")]
    output: PathBuf,
    /// Latitude and longitude (degrees) of the origin of the drives' world: poses become GNSS fixes, as in replay
    #[arg(long, value_name = "LAT,LON", value_parser = parse_origin, allow_hyphen_values = true)]
    origin: Option<Georeference>,
    /// Print one JSON object on stdout instead of a summary
    #[arg(long)]
    json: bool,
}

/// A drive that was recorded.
#[derive(Debug, Serialize)]
struct DriveReport {
    name: String,
    /// `None` where the drive has no frame that can be read.
    file: Option<PathBuf>,
    frames: usize,
    bytes: u64,
    left_out: Vec<Fault>,
}

#[derive(Debug, Serialize)]
struct RecordReport {
    frames: usize,
    drives: Vec<DriveReport>,
}

/// Records the drives one after the other. Frames that cannot be read or are not valid are left out, named on stderr and in
/// the report, and make the exit code 1; the rest is recorded.
pub fn run(args: &RecordArgs) -> anyhow::Result<ExitCode> {
    let mut drives = args.recordings.open().context("no drives to record")?;
    let place = RecordingPlace::new(&args.output, "--output", &drives)?;
    let mut report = RecordReport { frames: 0, drives: Vec::new() };
    for drive in &mut drives {
        let drive = record(drive, &place, args.origin)?;
        report.frames += drive.frames;
        report.drives.push(drive);
    }
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print_summary(&report);
    }
    let is_whole = report.drives.iter().all(|drive| drive.left_out.is_empty() && drive.file.is_some());
    Ok(if is_whole { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn record(
    drive: &mut RecordedDrive,
    place: &RecordingPlace,
    origin: Option<Georeference>,
) -> anyhow::Result<DriveReport> {
    let name = drive.name().to_owned();
    let mut recorder = place.recorder(&name, Preset::Default)?;
    let mut source = FrameSource::new(drive, Disturbance::default(), origin);
    let mut frames = 0;
    for prepared in source.by_ref() {
        recorder.take(&prepared)?;
        frames += 1;
    }
    let left_out = source.into_faults();
    let file = recorder.finish()?;
    let bytes = file.as_ref().map_or(Ok(0), |file| fs::metadata(file).map(|file| file.len()))?;
    Ok(DriveReport { name, file, frames, bytes, left_out })
}

fn print_summary(report: &RecordReport) {
    for DriveReport { name, file, frames, bytes, left_out } in &report.drives {
        let file = file.as_ref().map_or_else(|| "no file".to_owned(), |file| file.display().to_string());
        println!("{name:<34} {frames:>7} frames {:>9.2} MB  {} left out  {file}", *bytes as f64 / 1e6, left_out.len());
    }
}
