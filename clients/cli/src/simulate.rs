//! `lanemap simulate`: synthetic drives with their truth.

mod fleet;

use std::{path::PathBuf, process::ExitCode};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use fleet::{FleetArgs, World, with_speeds};
use lanemap_simulator::{
    FleetScenario, OdometryNoise, Scenario, Seed,
    openlane::{write_fleet, write_simulation},
    road::{Course, NetworkPlan},
};

/// Longest way of one simulation, km: about 15 GB of files.
const MAX_TOTAL_KM: f64 = 1_000.0;

/// What to simulate.
#[derive(Args, Debug)]
pub struct SimulateArgs {
    /// Folder to write into; made where it does not exist. Gets segment-*, results, maps, network.geojson, index.json;
    /// of a fleet also network-before.geojson and changes.geojson
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The roads
    #[arg(long, value_enum, default_value_t = Roads::Town)]
    roads: Roads,
    /// Number of drives
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=1000))]
    drives: u32,
    /// Length of each drive, km
    #[arg(long, value_name = "KM", default_value_t = 1.0, value_parser = positive)]
    length_km: f64,
    /// Seed: the same seed and options give the same bytes
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Let all drives take one route, each on lanes and at a speed of its own: a crowd-sourced road
    #[arg(long)]
    shared_route: bool,
    /// Steepest slope of the land, percent
    #[arg(long, value_name = "PERCENT", default_value_t = 5.0, value_parser = not_negative)]
    max_grade_percent: f64,
    /// Slowest cruise speed of a drive, m/s [default: 8 in a town, 12 on a long road]
    #[arg(long, value_name = "M/S", value_parser = positive)]
    min_speed_mps: Option<f64>,
    /// Fastest cruise speed of a drive, m/s [default: 15 in a town, 22 on a long road]
    #[arg(long, value_name = "M/S", value_parser = positive)]
    max_speed_mps: Option<f64>,
    #[command(flatten)]
    fleet: FleetArgs,
}

/// Which road network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Roads {
    /// A grid of two-way streets with junctions, about 420 m apart
    Town,
    /// One long one-way road that never comes back to where it was
    LongRoad,
    /// A fleet's city: streets, avenues, roundabouts, a motorway with ramps, traffic, GNSS canyons
    City,
    /// A fleet on one straight road of two lanes each way
    Straight,
    /// A fleet on one winding road of two lanes each way
    Winding,
    /// A fleet on a closed loop of 2 km
    Loop,
}

impl Roads {
    /// The world of a fleet; `None` where drives go by themselves.
    fn world(self) -> Option<World> {
        match self {
            Self::Town | Self::LongRoad => None,
            Self::City => Some(World::City),
            Self::Straight => Some(World::Road(Course::Straight)),
            Self::Winding => Some(World::Road(Course::Winding)),
            Self::Loop => Some(World::Road(Course::Loop)),
        }
    }
}

fn positive(text: &str) -> Result<f64, String> {
    not_negative(text).and_then(|value| if value > 0.0 { Ok(value) } else { Err("must be above 0".to_owned()) })
}

fn not_negative(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("{text:?} is not a number"))?;
    if value.is_finite() && value >= 0.0 { Ok(value) } else { Err(format!("{value} is not a number from 0 up")) }
}

/// Simulates and writes.
pub fn run(args: &SimulateArgs) -> anyhow::Result<ExitCode> {
    let written = match args.roads.world() {
        Some(world) => {
            let fleet = fleet_scenario(args, world)?.fleet(Seed(args.seed));
            write_fleet(&args.out, &fleet, args.fleet.drives_of_part(args.drives))
        }
        None => write_simulation(&args.out, &scenario(args)?),
    };
    let written = written.context("the simulation cannot be written; --out must name a folder that can be made")?;
    println!(
        "{} drives, {} frames, {:.2} km, seed {} in {}",
        written.drives,
        written.frames,
        written.length_m / 1e3,
        args.seed,
        args.out.display()
    );
    Ok(ExitCode::SUCCESS)
}

fn fleet_scenario(args: &SimulateArgs, world: World) -> anyhow::Result<FleetScenario> {
    let length_m = length_m(args)?;
    let shared_route = args.shared_route || world != World::City;
    let max_grade = args.max_grade_percent / 100.0;
    let scenario = args.fleet.scenario(world, args.drives, length_m, shared_route, max_grade)?;
    let motion = with_speeds(scenario.motion, args.min_speed_mps, args.max_speed_mps)?;
    Ok(FleetScenario { motion, ..scenario })
}

/// Length of a drive, metres, where all drives together are not too long.
fn length_m(args: &SimulateArgs) -> anyhow::Result<f64> {
    let total_km = args.length_km * f64::from(args.drives);
    if total_km > MAX_TOTAL_KM {
        bail!("{total_km} km in all are more than {MAX_TOTAL_KM}; lower --drives or --length-km, or simulate in parts");
    }
    Ok(args.length_km * 1e3)
}

fn scenario(args: &SimulateArgs) -> anyhow::Result<Scenario> {
    if args.fleet.is_given() {
        bail!("options of fleets need --roads city, straight, winding or loop");
    }
    let length_m = length_m(args)?;
    let base = if args.roads == Roads::LongRoad {
        Scenario::long_road(args.seed, length_m)
    } else {
        Scenario { network: town_for(length_m), ..Scenario::town(args.seed) }
    };
    let motion = with_speeds(base.motion, args.min_speed_mps, args.max_speed_mps)?;
    Ok(Scenario {
        seed: Seed(args.seed),
        drives: args.drives,
        length_m,
        shared_route: args.shared_route || args.roads == Roads::LongRoad,
        max_grade: args.max_grade_percent / 100.0,
        // Written poses are true; the reader of the files adds odometry noise.
        odometry: OdometryNoise::default(),
        motion,
        ..base
    })
}

/// A town large enough that a drive of this length need not come round again and again.
fn town_for(length_m: f64) -> NetworkPlan {
    const SPACING_M: f64 = 420.0;
    let mut blocks: u16 = 4;
    let links_m = |blocks: u16| 2.0 * f64::from(blocks) * f64::from(blocks - 1) * SPACING_M;
    while links_m(blocks) < 2.0 * length_m && blocks < 60 {
        blocks += 1;
    }
    NetworkPlan::Grid { columns: blocks, rows: blocks, spacing_m: SPACING_M }
}
