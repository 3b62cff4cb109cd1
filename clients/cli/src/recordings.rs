//! Recordings on the command line: which drives to read, and where to write them.

use std::{
    fs,
    io::BufWriter,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail};
use clap::Args;
use lanemap_core::Preset;
use lanemap_recording::{BagOptions, DriveStart, McapRecorder, ReadOptions, RecordedDrive};

use crate::replay::frames::PreparedFrame;

/// Drives to read.
#[derive(Args, Debug)]
pub struct DriveArgs {
    /// Drives: a folder of segment-*/TIMESTAMP.json beside results/segment-*/TIMESTAMP.json, or of recordings; an MCAP
    /// file; a ROS 1 bag of the paper's authors. What a file is shows in its first bytes
    #[arg(long, value_name = "DIR|FILE")]
    drives: PathBuf,
    /// Only drives whose name contains one of these texts
    #[arg(long, value_name = "NAME,..", value_delimiter = ',')]
    only: Vec<String>,
    /// Of bags, which do not hold it: the camera, as an OpenLane annotation, or as a folder of drives of the bags' names;
    /// without it the camera is taken for the vehicle
    #[arg(long, value_name = "FILE|DIR")]
    bag_camera: Option<PathBuf>,
    /// Of bags: topic of the camera's poses
    #[arg(long, value_name = "TOPIC", default_value = "/gt_pose_wc")]
    bag_pose_topic: String,
    /// Of bags: topic of the lanes
    #[arg(long, value_name = "TOPIC", default_value = "/lanes_predict")]
    bag_lanes_topic: String,
}

impl DriveArgs {
    /// The drives, in the order of their names. What they do not say is said on stderr.
    pub fn open(&self) -> anyhow::Result<Vec<RecordedDrive>> {
        let bag = BagOptions {
            pose_topic: self.bag_pose_topic.clone(),
            lanes_topic: self.bag_lanes_topic.clone(),
            camera: self.bag_camera.clone(),
        };
        let options = ReadOptions { only: self.only.clone(), bag };
        let drives = lanemap_recording::open(&self.drives, &options)?;
        for drive in &drives {
            for note in drive.notes() {
                tracing::warn!("{}: {note}", drive.name());
            }
        }
        Ok(drives)
    }
}

/// Where drives are recorded.
#[derive(Debug)]
pub struct RecordingPlace {
    path: PathBuf,
    is_folder: bool,
}

impl RecordingPlace {
    /// A file for one drive, a folder for several, or where `path` is one or does not end in `.mcap`.
    pub fn new(path: &Path, option: &str, drives: &[RecordedDrive]) -> anyhow::Result<Self> {
        let is_folder = path.is_dir() || path.extension().is_none_or(|ending| ending != "mcap");
        if drives.len() > 1 && !is_folder {
            bail!("{} drives do not go into one file: {option} must name a folder, or --only one drive", drives.len());
        }
        if is_folder {
            fs::create_dir_all(path).with_context(|| format!("{}: cannot be made", path.display()))?;
        }
        Ok(Self { path: path.to_owned(), is_folder })
    }

    /// The file of a drive.
    pub fn file_of(&self, drive: &str) -> PathBuf {
        if !self.is_folder {
            return self.path.clone();
        }
        // A drive's id comes from its recording, and must not lead out of the folder.
        let safe = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
        let name: String = drive.chars().map(safe).collect();
        self.path.join(format!("{}.mcap", name.trim_start_matches('.')))
    }

    /// Records a drive, whose file is made when its first frame comes.
    pub fn recorder(&self, drive: &str, preset: Preset) -> anyhow::Result<DriveRecorder> {
        let path = self.file_of(drive);
        if path.exists() {
            bail!("{}: is there already; name another file, or remove it", path.display());
        }
        Ok(DriveRecorder { path, drive: drive.to_owned(), preset, recorder: None })
    }
}

/// Records one drive.
pub struct DriveRecorder {
    path: PathBuf,
    drive: String,
    preset: Preset,
    recorder: Option<McapRecorder<BufWriter<fs::File>>>,
}

impl DriveRecorder {
    /// Records a frame.
    pub fn take(&mut self, prepared: &PreparedFrame) -> anyhow::Result<()> {
        let recorder = if let Some(recorder) = &mut self.recorder {
            recorder
        } else {
            let start = DriveStart {
                fleet: "recorded".to_owned(),
                vehicle: self.drive.clone(),
                drive: self.drive.clone(),
                preset: self.preset,
                sensor: prepared.camera.sensor,
            };
            self.recorder.insert(McapRecorder::create(&self.path, start)?)
        };
        Ok(recorder.frame(&prepared.frame)?)
    }

    /// Ends the file; `None` where no frame came, and so no file was made.
    pub fn finish(self) -> anyhow::Result<Option<PathBuf>> {
        let Some(recorder) = self.recorder else { return Ok(None) };
        let file = recorder.finish()?.into_inner().context("the end of the recording cannot be written")?;
        file.sync_all().with_context(|| format!("{}: cannot be made durable", self.path.display()))?;
        Ok(Some(self.path))
    }
}
