//! Pose: relative pose error of the corrected poses under odometry noise, over 10, 30 and 50 m.
//!
//! Beside it odometry itself, and two limits. `limit`: what remains when lane lines have taken away all lateral and all yaw
//! error of the same draws, as they say nothing of the way along a straight road. `true_map`: what the detector's own errors
//! leave of the heading when every frame is read against the true lines, whose number and place it knows.

use clap::Args;
use lanemap_core::{
    Mapper, Params, Pose,
    evaluation::{RelativePoseError, relative_pose_error, shown_heading},
    geometry::pose::perturb,
};
use lanemap_openlane::{DriveFrame, MotionNoise, apply_motion_noise};
use nalgebra::Vector6;
use serde_json::{Value, json};

use super::{
    CommonArgs,
    drives::{PoseNoise, RecordedDrive, chosen},
    parallel, preset_name,
    table::Table,
};

/// Lengths of road, metres.
const LENGTHS_M: [f64; 3] = [10.0, 30.0, 50.0];

#[derive(Debug, Args)]
pub struct PoseArgs {
    #[command(flatten)]
    common: CommonArgs,
    /// Noise levels s: yaw by s degrees, x and y by s metres between every two frames
    #[arg(long, value_name = "S,..", value_delimiter = ',', value_parser = parse_level, default_values_t = [0.1, 0.2, 0.3, 0.4, 0.5])]
    noise: Vec<f64>,
    /// How many draws of the noise are averaged; the first has the seed `--seed`, the others those after it
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=1000))]
    draws: u64,
}

fn parse_level(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(value) if value.is_finite() && value >= 0.0 => Ok(value),
        _ => Err(format!("{text:?} is not a number of 0 or above")),
    }
}

/// Errors over [`LENGTHS_M`].
type Errors = [RelativePoseError; LENGTHS_M.len()];

/// One noise level: odometry first, then the limit, then each preset.
struct Level {
    noise: f64,
    methods: Vec<(&'static str, Errors)>,
}

pub fn run(args: &PoseArgs) -> anyhow::Result<()> {
    let drives = chosen(&args.common)?;
    let per_drive = parallel::for_each(&drives, |folder| {
        let drive = RecordedDrive::read(folder)?;
        args.noise.iter().map(|noise| level_of_drive(&drive, *noise, args)).collect::<anyhow::Result<Vec<_>>>()
    })?;
    let mut drives = per_drive.into_iter();
    let mut levels = drives.next().unwrap_or_default();
    for drive in drives {
        for (total, level) in levels.iter_mut().zip(&drive) {
            add(&mut total.methods, &level.methods);
        }
    }
    if args.common.json {
        println!("{}", serde_json::to_string_pretty(&as_json(args, &levels))?);
    } else {
        print!("{}", as_text(args, &levels));
    }
    Ok(())
}

fn level_of_drive(drive: &RecordedDrive, noise: f64, args: &PoseArgs) -> anyhow::Result<Level> {
    let mut methods = Vec::new();
    for seed in args.common.seed..args.common.seed.saturating_add(args.draws) {
        add(&mut methods, &one_draw(drive, PoseNoise { yaw_deg: noise, shift_m: noise }, seed, args)?);
    }
    Ok(Level { noise, methods })
}

fn one_draw(
    drive: &RecordedDrive,
    noise: PoseNoise,
    seed: u64,
    args: &PoseArgs,
) -> anyhow::Result<Vec<(&'static str, Errors)>> {
    let errors = |poses: &[Pose]| LENGTHS_M.map(|length_m| relative_pose_error(&drive.poses, poses, length_m));
    let draw = drive.draw_noise(noise, seed);
    let odometry = apply_motion_noise(&drive.poses, &draw);
    let along: Vec<MotionNoise> = draw.iter().map(|noise| noise.along_track_only()).collect();
    let mut methods =
        vec![("odometry", errors(&odometry)), ("limit", errors(&apply_motion_noise(&drive.poses, &along)))];
    let frames = drive.mapper_frames(&odometry, noise)?;
    methods.push(("true_map", errors(&read_off_true_map(drive))));
    for preset in args.common.preset.presets() {
        let mut mapper = Mapper::new(Params::preset(*preset), drive.sensor());
        let corrected: Vec<Pose> = frames.iter().map(|frame| mapper.step(frame).map_from_vehicle).collect();
        methods.push((preset_name(*preset), errors(&corrected)));
    }
    Ok(methods)
}

/// True poses, turned by what each frame's detections show of the heading; a frame that shows nothing repeats the last.
fn read_off_true_map(drive: &RecordedDrive) -> Vec<Pose> {
    let mut yaw_rad = 0.0;
    let mut read = |(frame, pose): (&DriveFrame, &Pose)| {
        let detections: Vec<_> = frame.detections_vehicle().into_iter().map(|seen| seen.points_vehicle).collect();
        yaw_rad = shown_heading(&frame.truth_vehicle(), &detections).unwrap_or(yaw_rad);
        perturb(pose, &Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, -yaw_rad))
    };
    drive.frames.iter().zip(&drive.poses).map(&mut read).collect()
}

fn add(total: &mut Vec<(&'static str, Errors)>, more: &[(&'static str, Errors)]) {
    if total.is_empty() {
        total.extend_from_slice(more);
        return;
    }
    for ((_, total), (_, more)) in total.iter_mut().zip(more) {
        for (total, more) in total.iter_mut().zip(more) {
            *total += *more;
        }
    }
}

fn as_text(args: &PoseArgs, levels: &[Level]) -> String {
    let mut text = format!(
        "Relative pose error, mean of {} draws from seed {}: rotation (deg) / translation (m).\n\
         limit: the same draws without their lateral and yaw parts.\n\
         true_map: the heading that each frame shows against the true lines; its translation is of no meaning.\n\n",
        args.draws, args.common.seed
    );
    let mut table = Table::new(&["noise (deg, m)", "", "10 m", "30 m", "50 m"]);
    for level in levels {
        for (index, (name, errors)) in level.methods.iter().enumerate() {
            let label = if index == 0 { format!("({0}, {0})", level.noise) } else { String::new() };
            let mut cells = vec![label, (*name).to_owned()];
            cells.extend(errors.map(|error| format!("{:.3} / {:.3}", error.rotation_deg(), error.translation_m())));
            table.row(cells);
        }
    }
    text.push_str(&table.render());
    text
}

fn as_json(args: &PoseArgs, levels: &[Level]) -> Value {
    let level = |level: &Level| {
        let mut object = serde_json::Map::new();
        object.insert("yaw_deg".to_owned(), level.noise.into());
        object.insert("shift_m".to_owned(), level.noise.into());
        for (name, errors) in &level.methods {
            let lengths: serde_json::Map<String, Value> = LENGTHS_M
                .iter()
                .zip(errors)
                .map(|(length_m, error)| {
                    let value = json!({ "rotation_deg": error.rotation_deg(), "translation_m": error.translation_m() });
                    (format!("{length_m}m"), value)
                })
                .collect();
            object.insert((*name).to_owned(), lengths.into());
        }
        Value::from(object)
    };
    json!({
        "measure": "pose",
        "seed": args.common.seed,
        "draws": args.draws,
        "levels": levels.iter().map(level).collect::<Vec<_>>(),
    })
}
