//! `lanemap replay`: recorded drives, streamed as if they were driven now.
//!
//! A mapper runs in this process on the very frames that are streamed. It is deterministic, so that what it makes of
//! them is what the server makes of them: step times and the local map of every frame come from it, with `--server` too.

pub mod frames;
mod mapper_run;
mod progress;
mod rate;
mod report;
mod results;
mod server;
mod step_times;
mod stream;

use std::{path::PathBuf, process::ExitCode, time::Instant};

use anyhow::Context;
use clap::{Args, ValueEnum};
use lanemap_core::{Params, Preset};
use lanemap_recording::RecordedDrive;

use crate::recordings::{DriveArgs, DriveRecorder, RecordingPlace};
use frames::{Disturbance, Fault, FrameSource, PreparedFrame};
use mapper_run::MapperRun;
use progress::Progress;
use rate::{Pacer, Rate};
use report::{DriveReport, ReplayReport};
use results::ResultWriter;
use server::ServerArgs;
use stream::{ServerLink, StreamedDrive};

/// What to replay, how, and where to.
#[derive(Args, Debug)]
pub struct ReplayArgs {
    #[command(flatten)]
    recordings: DriveArgs,
    /// The mapper
    #[arg(long, value_enum, default_value_t = PresetArg::Default)]
    preset: PresetArg,
    /// Odometry noise put between every two frames: standard deviation of yaw (degrees), and of x and y (metres)
    #[arg(long, value_name = "DEG,M", value_parser = frames::parse_pose_noise, default_value = "0,0")]
    pose_noise: lanemap_simulator::OdometryNoise,
    /// Probability that one detection of a frame is left out
    #[arg(long, value_name = "P", value_parser = frames::parse_probability, default_value_t = 0.0)]
    drop: f64,
    /// Seed of noise and drops: the same seed gives the same frames
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// How fast: 1 is as recorded, 10 ten times faster, max as fast as frames are taken
    #[arg(long, value_name = "1|max", default_value = "max")]
    rate: Rate,
    #[command(flatten)]
    server: ServerArgs,
    /// Run the mapper in this process only; no server is needed
    #[arg(long, conflicts_with = "server")]
    local: bool,
    /// Folder for the online local map of every frame (3 to 50 m ahead, 10 m to each side, what was known at that
    /// frame), in OpenLane's result format under the drives' own folder and file names; with --server too it is the
    /// mapper in this process that makes it, on the frames that are streamed
    #[arg(long, value_name = "OUT")]
    results_dir: Option<PathBuf>,
    /// Record what is streamed, noise and all, as MCAP: a file for one drive, a folder for several
    #[arg(long, value_name = "FILE|DIR")]
    record: Option<PathBuf>,
    /// Latitude and longitude (degrees) of the origin of the drives' world: poses become GNSS fixes, those of the drive's
    /// receiver in every frame, or of a drive that has none the first true pose; a fix that was recorded stays as it is
    #[arg(long, value_name = "LAT,LON", value_parser = frames::parse_origin, allow_hyphen_values = true)]
    origin: Option<lanemap_core::geometry::georeference::Georeference>,
    /// Print one JSON object on stdout instead of a summary
    #[arg(long)]
    json: bool,
}

/// Which mapper.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum PresetArg {
    /// The paper's method as it is meant
    Paper,
    /// The paper's weaknesses mended
    Default,
}

impl From<PresetArg> for Preset {
    fn from(preset: PresetArg) -> Self {
        match preset {
            PresetArg::Paper => Self::Paper,
            PresetArg::Default => Self::Default,
        }
    }
}

/// Replays the drives one after the other. Frames that cannot be read or are not valid are left out, named on stderr and
/// in the report, and make the exit code 1, as do frames that the server refuses and a map of the server that is not the
/// one made here; the rest is replayed. A connection that breaks is made anew; a drive whose connection stays broken is
/// reported, and the next one begins.
#[tokio::main]
pub async fn run(args: &ReplayArgs) -> anyhow::Result<ExitCode> {
    let mut drives = args.recordings.open().context("no drives to replay")?;
    let record = args.record.as_ref().map(|path| RecordingPlace::new(path, "--record", &drives)).transpose()?;
    let server = if args.local { None } else { Some(ServerLink::connect(&args.server).await?) };
    let progress = Progress::new(drives.iter().map(RecordedDrive::len).sum());
    let started = Instant::now();
    let mut reports = Vec::new();
    for drive in &mut drives {
        reports.push(Box::pin(replay_drive(args, drive, server.as_ref(), record.as_ref(), &progress)).await?);
    }
    progress.finish();
    let report = ReplayReport::new(reports, started.elapsed());
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print!("{report}");
    }
    Ok(if report.is_whole() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

async fn replay_drive(
    args: &ReplayArgs,
    drive: &mut RecordedDrive,
    server: Option<&ServerLink>,
    record: Option<&RecordingPlace>,
    progress: &Progress,
) -> anyhow::Result<DriveReport> {
    let name = drive.name().to_owned();
    let disturbance = Disturbance { pose_noise: args.pose_noise, drop: args.drop, seed: args.seed };
    let mut source = FrameSource::new(drive, disturbance, args.origin);
    let results = args.results_dir.as_ref().map(|root| ResultWriter::new(root, &name));
    let mut recorder = record.map(|place| place.recorder(&name, args.preset.into())).transpose()?;
    let mut pacer = Pacer::new(args.rate);
    let mut run: Option<DriveRun<'_>> = None;
    for prepared in source.by_ref() {
        let run = match &mut run {
            Some(run) => run,
            None => run.insert(DriveRun::start(args.preset, &name, &prepared, server).await),
        };
        let due = pacer.wait_for(prepared.frame.time()).await;
        if let Some(recorder) = &mut recorder {
            recorder.take(&prepared)?;
        }
        run.take(&name, &prepared, results.as_ref()).await?;
        progress.stepped(run.mapper.lanes(), run.unacked, due.elapsed());
    }
    let faults = source.into_faults();
    recorder.map(DriveRecorder::finish).transpose()?;
    match run {
        Some(run) => Ok(run.finish(&name, faults).await),
        None => Ok(DriveReport::new(&name, None, faults, None)),
    }
}

/// One drive on its way: into the mapper of this process, and to the server where there is one.
struct DriveRun<'a> {
    mapper: MapperRun,
    stream: Option<StreamedDrive<'a>>,
    /// Why it is not streamed any more.
    failure: Option<String>,
    unacked: u64,
}

impl<'a> DriveRun<'a> {
    async fn start(preset: PresetArg, name: &str, first: &PreparedFrame, server: Option<&'a ServerLink>) -> Self {
        let sensor = first.camera.sensor;
        let opened = match server {
            Some(link) => Some(link.open(name, preset.into(), sensor).await),
            None => None,
        };
        let mapper = MapperRun::new(Params::preset(preset.into()), sensor);
        let mut run = Self { mapper, stream: None, failure: None, unacked: 0 };
        match opened.transpose() {
            Ok(stream) => run.stream = stream,
            Err(error) => run.fail(name, &error),
        }
        run
    }

    async fn take(
        &mut self,
        name: &str,
        prepared: &PreparedFrame,
        results: Option<&ResultWriter<'_>>,
    ) -> anyhow::Result<()> {
        let PreparedFrame { frame, recorded_pose, camera } = prepared;
        if let Some(stream) = &mut self.stream {
            match stream.send(frame).await {
                Ok(()) => self.unacked = stream.unacked_at(frame),
                Err(error) => self.fail(name, &error),
            }
        }
        self.mapper.step(frame, recorded_pose);
        match results {
            Some(results) => results.write(frame.time(), camera, self.mapper.mapper()),
            None => Ok(()),
        }
    }

    /// The drive is not streamed any more; the mapper here goes on.
    fn fail(&mut self, name: &str, error: &anyhow::Error) {
        let error = format!("{error:#}");
        tracing::error!("{name}: {error}");
        (self.stream, self.failure, self.unacked) = (None, Some(error), 0);
    }

    async fn finish(mut self, name: &str, faults: Vec<Fault>) -> DriveReport {
        let mut session = None;
        if let Some(stream) = self.stream.take() {
            match stream.finish(&self.mapper.mapper().finished_lane_map()).await {
                Ok(report) => session = Some(report),
                Err(error) => self.fail(name, &error),
            }
        }
        DriveReport::new(name, Some(&self.mapper), faults, session).failed(self.failure)
    }
}
