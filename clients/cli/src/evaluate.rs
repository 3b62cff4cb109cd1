//! `lanemap evaluate`: the paper's three measures on recorded drives, for both presets.

mod association;
mod association_method;
mod association_pairs;
mod drives;
mod fleet;
mod map_quality;
mod map_table;
mod parallel;
mod pose;
mod table;

use std::{path::PathBuf, process::ExitCode};

use clap::{Args, Subcommand, ValueEnum};
use lanemap_core::Preset;

/// Arguments of `lanemap evaluate`.
#[derive(Debug, Args)]
pub struct EvaluateArgs {
    #[command(subcommand)]
    measure: Measure,
}

#[derive(Debug, Subcommand)]
enum Measure {
    /// Quality of the online local map, beside the raw detections, by the paper's scorer and a strict one.
    Map(map_quality::MapArgs),
    /// Relative pose error under odometry noise, beside odometry and beside the limit where only the error along the road remains.
    Pose(pose::PoseArgs),
    /// Association of the true lanes of two frames with a wrong pose between them, beside the paper's baselines.
    Association(association::AssociationArgs),
    /// The fused map of many drives, by their number: absolute and relative errors, coverage, precision, names that stay.
    Fleet(fleet::FleetArgs),
}

/// What every measure takes.
#[derive(Debug, Args)]
struct CommonArgs {
    /// Folder of drives in OpenLane's layout: segment-NAME beside results/segment-NAME
    #[arg(long, value_name = "DIR")]
    drives: PathBuf,
    /// Only drives whose name contains one of these, separated by commas
    #[arg(long, value_name = "NAME,..", allow_hyphen_values = true, value_delimiter = ',')]
    only: Vec<String>,
    /// Which mapper to evaluate
    #[arg(long, value_enum, default_value_t = PresetChoice::Both)]
    preset: PresetChoice,
    /// Seed of everything random: the same seed gives the same figures
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// One JSON object on stdout in place of tables
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum PresetChoice {
    /// The paper's method
    Paper,
    /// The mended one
    Default,
    /// One after the other
    Both,
}

impl PresetChoice {
    fn presets(self) -> &'static [Preset] {
        match self {
            Self::Paper => &[Preset::Paper],
            Self::Default => &[Preset::Default],
            Self::Both => &[Preset::Paper, Preset::Default],
        }
    }
}

/// Name of a preset in tables and in JSON.
fn preset_name(preset: Preset) -> &'static str {
    match preset {
        Preset::Paper => "paper",
        Preset::Default => "default",
    }
}

/// Runs one measure and prints its figures.
///
/// # Errors
/// Drives that cannot be read; the error names file and field.
pub fn run(args: &EvaluateArgs) -> anyhow::Result<ExitCode> {
    match &args.measure {
        Measure::Map(args) => map_quality::run(args)?,
        Measure::Pose(args) => pose::run(args)?,
        Measure::Association(args) => association::run(args)?,
        Measure::Fleet(args) => fleet::run(args)?,
    }
    Ok(ExitCode::SUCCESS)
}
