//! `lanemap evaluate fleet`: how a fused map gets better with every drive, on recorded roads and on simulated fleets.

mod contributed;
mod loop_closure;
mod plot;
mod recorded;
mod report;
mod simulated;
mod true_change;

use std::{
    collections::{BTreeMap, BTreeSet},
    path::PathBuf,
};

use clap::{Args, ValueEnum};
use lanemap_core::{
    evaluation::{ChangeScore, FleetScore, TrueChange, fleet_score::RigidMotion, score_changes, score_fleet},
    fleet::{Contribution, FleetParams, FusedMap, MapChange, fuse},
    geometry::georeference::Anchor,
    lane_map::EndRule,
    spline::{curve::Curve, sampling::sample},
};
use nalgebra::Point3;

use super::parallel;

/// Pieces into which a chord of a fused line is cut to be scored and drawn.
const PIECES_PER_CHORD: usize = 3;

/// Arguments of `lanemap evaluate fleet`.
#[derive(Debug, Args)]
pub struct FleetArgs {
    /// Folder of drives in OpenLane's layout, whose index.json names roads that were driven more than once
    #[arg(long, value_name = "DIR", required_unless_present = "simulate")]
    drives: Option<PathBuf>,
    /// A simulated fleet in place of recorded drives
    #[arg(long, value_enum, conflicts_with = "drives")]
    simulate: Option<SimulatedFleet>,
    /// Numbers of drives to fuse, separated by commas; of recorded roads all up to their number of drives
    #[arg(long, value_name = "N,..", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=2000))]
    counts: Vec<u32>,
    /// Share of a simulated fleet's drives with gross errors
    #[arg(long, value_name = "P", default_value_t = 0.0, value_parser = share)]
    gross: f64,
    /// Share of a simulated fleet's drives whose lanes all lie one lane off
    #[arg(long, value_name = "P", default_value_t = 0.0, value_parser = share)]
    adversarial: f64,
    /// Changes of the road that a simulated fleet drives over: so many stretches of line that vanish, that appear, that
    /// move and that are repainted, between a quarter and three quarters of the drives
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1000))]
    changes: u32,
    /// Other vehicles as in a town, which hide parts of the road; changes that are reported are scored, too
    #[arg(long)]
    traffic: bool,
    /// Seed of everything random: the same seed gives the same figures
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Simulated worlds per figure, with seeds from --seed on; figures are their means
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    worlds: u64,
    /// Writes a plot of each map beside its truth, and of the errors by the number of drives, as SVG into this folder
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// One JSON object on stdout in place of tables
    #[arg(long)]
    json: bool,
}

/// The worlds of `lanemap_simulator`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum SimulatedFleet {
    /// One straight road of 1 km
    StraightRoad,
    /// One winding road of 1 km
    WindingRoad,
    /// A loop of 2 km, driven once and 300 m on, with 1 % of drift
    Loop,
    /// A town of about 2 km^2
    SmallTown,
    /// A town of about 10 km^2
    Town,
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=1.0).contains(&value) => Ok(value),
        _ => Err(format!("{text:?} is not a share from 0 to 1")),
    }
}

/// Drives of one road or world, and its truth.
pub struct Road {
    pub name: String,
    pub contributions: Vec<Contribution>,
    /// The true lines, metres east, north, up of the anchor.
    pub truth: Vec<Vec<Point3<f64>>>,
    pub anchor: Anchor,
    /// What truly happened to it.
    pub changes: Vec<true_change::SeenChange>,
    /// Whether it is asked how well that was noticed.
    pub changes_asked: bool,
    /// Where the drives truly went, of worlds in which a drive comes back over its own road.
    pub true_ways: Vec<loop_closure::TrueWay>,
}

/// The figures of one road at one number of drives: means over the choices of so many.
#[derive(Clone, Debug)]
pub struct ByDrives {
    pub drives: usize,
    pub scores: Vec<FleetScore>,
    /// Drives that were kept apart, mean.
    pub apart: f64,
    /// Share of the line names that the map of one drive fewer had, too.
    pub kept_names: Option<f64>,
    /// Bytes of the map, were it packed as [`contributed::packed_bytes`] says.
    pub bytes: f64,
    /// Milliseconds of fusing, median.
    pub fuse_ms: f64,
    /// How well changes of the road were noticed, where that is asked.
    pub changes: Option<ChangeScore>,
    /// How well a drive that came back over its own road lies on itself.
    pub closure: Option<loop_closure::LoopClosure>,
    /// Way that the drives took together, metres; mean.
    pub driven_m: f64,
}

/// Runs the measure.
///
/// # Errors
/// Drives that cannot be read; the error names file and field.
pub fn run(args: &FleetArgs) -> anyhow::Result<()> {
    let roads = match (&args.drives, args.simulate) {
        (Some(folder), _) => recorded::roads(folder)?,
        (None, Some(fleet)) => simulated::worlds(args, fleet)?,
        (None, None) => anyhow::bail!("either --drives or --simulate is needed"),
    };
    let figures = parallel::for_each(&roads, |road| Ok(by_drives(road, &counts(args, road), args.simulate.is_none())))?;
    let figures: Vec<(&Road, Vec<ByDrives>)> = roads.iter().zip(figures).collect();
    if let Some(folder) = &args.plots {
        plot::write(folder, &figures)?;
    }
    report::print(args, &figures)
}

/// Numbers of drives to fuse.
fn counts(args: &FleetArgs, road: &Road) -> Vec<usize> {
    let most = road.contributions.len();
    if args.counts.is_empty() {
        return if args.simulate.is_some() { vec![most] } else { (1..=most).collect() };
    }
    args.counts.iter().map(|count| *count as usize).filter(|count| *count <= most).collect()
}

/// The figures of a road for each number of drives. `choose` tries several choices of so many drives, else the first.
fn by_drives(road: &Road, counts: &[usize], choose: bool) -> Vec<ByDrives> {
    counts.iter().map(|count| figures_of(road, *count, choose)).collect()
}

fn figures_of(road: &Road, count: usize, choose: bool) -> ByDrives {
    let most = road.contributions.len();
    let choices = if choose && count < most { most } else { 1 };
    let (mut scores, mut apart, mut bytes, mut times, mut kept) = (Vec::new(), 0, 0.0, Vec::new(), None);
    let mut driven_m = 0.0;
    let (mut changes, mut closure) = (None, None);
    for first in 0..choices {
        let chosen: Vec<Contribution> =
            (0..count).map(|step| road.contributions[(first + step) % most].clone()).collect();
        driven_m += chosen.iter().filter_map(|drive| drive.trajectory.last()).map(|last| last.arc_m).sum::<f64>();
        let began = std::time::Instant::now();
        let map = fuse(&chosen, &road.anchor, &FleetParams::default());
        times.push(began.elapsed().as_secs_f64() * 1e3);
        apart += map.drives.iter().filter(|drive| drive.correction.is_none()).count();
        bytes += contributed::packed_bytes(&map) as f64;
        let score = score_fleet(&polylines(&map), &road.truth);
        scores.extend(score);
        changes = score.filter(|_| road.changes_asked).map(|score| noticed(road, &chosen, &map, &score.motion));
        closure = road.true_ways.iter().find_map(|way| way.closure(&chosen, &map));
        kept = (!choose && count > 1).then(|| kept_names(road, count, &map));
    }
    let choices = choices as f64;
    ByDrives {
        drives: count,
        scores,
        apart: apart as f64 / choices,
        kept_names: kept,
        bytes: bytes / choices,
        closure,
        driven_m: driven_m / choices,
        fuse_ms: lanemap_core::evaluation::quantile(&mut times, 0.5),
        changes,
    }
}

/// How well a map tells what happened while its drives were under way; places are compared after the map's one rigid motion.
fn noticed(road: &Road, drives: &[Contribution], map: &FusedMap, motion: &RigidMotion) -> ChangeScore {
    let over = drives.iter().map(|drive| drive.started).max().unwrap_or_default();
    let happened: Vec<TrueChange> =
        road.changes.iter().filter_map(|change| change.told_until(over)).flatten().collect();
    let moved = map.changes.iter().map(|change| MapChange {
        points: change.points.iter().map(|point| motion.apply(point)).collect(),
        ..change.clone()
    });
    score_changes(&moved.collect::<Vec<_>>(), &happened)
}

/// Root mean square, over all roads, of the median absolute error by the number of drives, metres; of several worlds with drives
/// whose receivers are off independently, it falls with the square root of that number.
fn absolute_by_drives(figures: &[(&Road, Vec<ByDrives>)]) -> Vec<(usize, f64)> {
    let mut squares: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
    for figure in figures.iter().flat_map(|(_, figures)| figures).filter(|figure| !figure.scores.is_empty()) {
        let (sum, count) = squares.entry(figure.drives).or_default();
        *sum += figure.mean(|score| score.absolute.p50.powi(2));
        *count += 1.0;
    }
    squares.into_iter().map(|(drives, (sum, count))| (drives, (sum / count).sqrt())).collect()
}

/// Share of the names in the map of one drive fewer that this map still has.
fn kept_names(road: &Road, count: usize, map: &FusedMap) -> f64 {
    let names = |map: &FusedMap| map.lanes.iter().map(|lane| lane.id).collect::<BTreeSet<_>>();
    let before = names(&fuse(&road.contributions[..count - 1], &road.anchor, &FleetParams::default()));
    before.intersection(&names(map)).count() as f64 / before.len().max(1) as f64
}

/// The lines of a map as polylines.
pub fn polylines(map: &FusedMap) -> Vec<Vec<Point3<f64>>> {
    let lines = map.lanes.iter().filter_map(|lane| {
        let points: Vec<Point3<f64>> = lane.points.iter().map(|point| point.position).collect();
        let curve = Curve::new(points.as_slice(), EndRule::Reflected)?;
        Some(sample(&curve, 0.0, curve.last_parameter(), PIECES_PER_CHORD))
    });
    lines.collect()
}
