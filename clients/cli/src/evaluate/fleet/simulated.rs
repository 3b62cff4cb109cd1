//! Simulated fleets: their drives, mapped, and their true lines.

use lanemap_core::fleet::DriveId;
use lanemap_simulator::{
    Seed,
    fleet::{ChangePlan, Fleet, FleetScenario, PoisonPlan, TrafficModel},
};
use nalgebra::Point3;

use super::{
    FleetArgs, Road, SimulatedFleet,
    contributed::contribution,
    loop_closure::true_ways,
    true_change::{SeenChange, ways},
};
use crate::evaluate::parallel;

/// As many worlds as are asked for, each with its drives mapped.
pub fn worlds(args: &FleetArgs, kind: SimulatedFleet) -> anyhow::Result<Vec<Road>> {
    let most = args.counts.iter().copied().max();
    let seeds: Vec<u64> = (args.seed..args.seed + args.worlds).collect();
    let fleets = seeds.iter().map(|seed| (*seed, scenario(args, kind, most).fleet(Seed(*seed))));
    let fleets: Vec<(u64, Fleet)> = fleets.collect();
    let asked = args.changes > 0 || args.traffic;
    fleets.iter().map(|(seed, fleet)| world(kind, *seed, fleet, asked)).collect()
}

fn scenario(args: &FleetArgs, kind: SimulatedFleet, most: Option<u32>) -> FleetScenario {
    let named = match kind {
        SimulatedFleet::StraightRoad => FleetScenario::straight_road(),
        SimulatedFleet::WindingRoad => FleetScenario::winding_road(),
        SimulatedFleet::Loop => FleetScenario::closed_loop(),
        SimulatedFleet::SmallTown => FleetScenario::small_town(40),
        SimulatedFleet::Town => FleetScenario::town(200),
    };
    FleetScenario {
        drives: most.unwrap_or(named.drives),
        poison: PoisonPlan { gross_share: args.gross, adversarial_share: args.adversarial },
        changes: changes(args.changes, most.unwrap_or(named.drives)),
        traffic: if args.traffic { TrafficModel::town() } else { named.traffic },
        ..named
    }
}

/// So many stretches of line that vanish, appear, move and are repainted, in the middle half of the drives.
fn changes(each: u32, drives: u32) -> ChangePlan {
    let middle = ChangePlan::some(drives / 4, 3 * drives / 4);
    ChangePlan { vanished: each, appeared: each, moved: each, repainted: each, zones: 0, ..middle }
}

fn world(kind: SimulatedFleet, seed: u64, fleet: &Fleet, asked: bool) -> anyhow::Result<Road> {
    let numbers: Vec<u32> = (0..fleet.scenario().drives).collect();
    let contributions = parallel::for_each(&numbers, |number| {
        let drive = fleet.drive(*number);
        Ok(contribution(DriveId(u64::from(*number)), drive.sensor(), drive.frames()))
    })?;
    let ways = if asked { ways(fleet) } else { Vec::new() };
    let changes = fleet.changes().iter().map(|change| SeenChange::new(change, &ways)).collect();
    let truth = fleet.truth_at(fleet.start_of(fleet.scenario().drives)).lines;
    let truth: Vec<Vec<Point3<f64>>> = truth.into_iter().map(|line| line.points).collect();
    Ok(Road {
        name: format!("{kind:?}, seed {seed}"),
        contributions: contributions.into_iter().flatten().collect(),
        truth,
        anchor: fleet.georeference().anchor,
        changes,
        changes_asked: asked,
        true_ways: if kind == SimulatedFleet::Loop { true_ways(fleet) } else { Vec::new() },
    })
}
