//! Map quality: the online local map of every frame against the annotation of that frame.

use std::ops::AddAssign;

use clap::Args;
use lanemap_core::{
    LocalWindow, Mapper, Params, Preset, Sensor,
    evaluation::{Counts, GroundFrame, LineError, ScoreBox, score_authors, score_strict},
};
use lanemap_openlane::DriveFrame;
use nalgebra::Point3;

use super::{
    CommonArgs,
    drives::{DisturbanceArgs, RecordedDrive, chosen},
    map_table, parallel,
};

#[derive(Debug, Args)]
pub struct MapArgs {
    #[command(flatten)]
    pub common: CommonArgs,
    #[command(flatten)]
    pub disturbance: DisturbanceArgs,
}

/// Both scorers over any number of frames.
#[derive(Clone, Debug, Default)]
pub struct MapScore {
    pub authors: Counts,
    pub strict: Counts,
    pub errors: Vec<LineError>,
}

impl MapScore {
    fn add_frame(&mut self, truth: &[Vec<Point3<f64>>], predicted: &[Vec<Point3<f64>>], sensor: &Sensor) {
        self.authors += score_authors(truth, predicted);
        let strict = score_strict(truth, predicted, sensor);
        self.strict += strict.counts;
        self.errors.extend(strict.errors);
    }
}

impl AddAssign<&Self> for MapScore {
    fn add_assign(&mut self, other: &Self) {
        self.authors += other.authors;
        self.strict += other.strict;
        self.errors.extend_from_slice(&other.errors);
    }
}

/// The scores of a drive: its detections as they are, and the map of each preset.
pub struct DriveScore {
    pub name: String,
    pub frames: usize,
    pub raw: MapScore,
    pub maps: Vec<(Preset, MapScore)>,
}

pub fn run(args: &MapArgs) -> anyhow::Result<()> {
    let drives = chosen(&args.common)?;
    let scores = parallel::for_each(&drives, |folder| {
        let mut drive = RecordedDrive::read(folder)?;
        drive.drop_detections(args.disturbance.drop, args.common.seed);
        score_drive(&drive, args)
    })?;
    map_table::print(args, &scores)
}

fn score_drive(drive: &RecordedDrive, args: &MapArgs) -> anyhow::Result<DriveScore> {
    let truth: Vec<Vec<Vec<Point3<f64>>>> = drive.frames.iter().map(DriveFrame::truth_ground).collect();
    let mut raw = MapScore::default();
    for (frame, truth) in drive.frames.iter().zip(&truth) {
        raw.add_frame(truth, &frame.detections_ground(), &frame.annotation.sensor());
    }
    let noise = args.disturbance.pose_noise;
    let odometry = drive.odometry(noise, args.common.seed);
    let frames = drive.mapper_frames(&odometry, noise)?;
    let score_preset = |preset: Preset| {
        let mut score = MapScore::default();
        let mut mapper = Mapper::new(Params::preset(preset), drive.sensor());
        for ((frame, recorded), truth) in frames.iter().zip(&drive.frames).zip(&truth) {
            mapper.step(frame);
            let sensor = recorded.annotation.sensor();
            score.add_frame(truth, &local_map_ground(&mapper, &sensor), &sensor);
        }
        (preset, score)
    };
    let maps = args.common.preset.presets().iter().map(|preset| score_preset(*preset)).collect();
    Ok(DriveScore { name: drive.name.clone(), frames: frames.len(), raw, maps })
}

/// The local map around the vehicle in the ground frame, cropped to the box in which maps are scored.
fn local_map_ground(mapper: &Mapper, sensor: &Sensor) -> Vec<Vec<Point3<f64>>> {
    let (ground, score_box) = (GroundFrame::below(sensor), ScoreBox::default());
    let to_ground = |line: Vec<Point3<f64>>| {
        score_box.crop(&line.iter().map(|point| ground.ground_from_vehicle(point)).collect::<Vec<_>>())
    };
    mapper.local_map(&LocalWindow::default()).into_iter().map(|lane| to_ground(lane.points_vehicle)).collect()
}
