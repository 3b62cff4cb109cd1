//! What it costs to fuse a cell: all of its drives anew, and again after one of them, which is live, has grown.
//!
//! `cargo bench -p lanemap-simulator --bench fusing`

#![allow(missing_docs, clippy::expect_used)] // criterion's macros; a benchmark that cannot set up must stop

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use lanemap_core::{
    Mapper, Params, Preset,
    fleet::{
        Base, CellId, Contribution, DriveId, FleetParams, Keep, Trace, by_seniority, cell::cut, draft, fold, fuse,
        fuse_from, split_to_fold,
    },
    geometry::{Pose, georeference::Georeference},
};
use lanemap_simulator::{
    Seed,
    fleet::{Fleet, FleetDrive, FleetScenario},
};

/// What a drive says of its cells.
fn contributions(drive: &FleetDrive<'_>, fleet: &Fleet) -> Vec<(CellId, Contribution)> {
    let mut mapper = Mapper::new(Params::preset(Preset::Default), drive.sensor());
    let mut trace = Trace::default();
    for frame in drive.frames() {
        let report = mapper.step(&frame);
        trace.observe(&frame, &report.map_from_vehicle);
    }
    let whole = trace.contribution(DriveId(u64::from(drive.number())), drive.sensor(), &mapper.lane_map());
    let enu_from_map: Pose = fleet.georeference().enu_from_map * drive.world_from_odometry();
    cut(&whole.expect("it has frames"), &Georeference { anchor: fleet.georeference().anchor, enu_from_map })
}

/// The cell in which most of a fleet's way lies.
fn fullest_cell(scenario: &FleetScenario) -> (CellId, Vec<Contribution>) {
    let fleet = scenario.fleet(Seed(1));
    let all: Vec<(CellId, Contribution)> = fleet.drives().flat_map(|drive| contributions(&drive, &fleet)).collect();
    let points_in =
        |cell: CellId| all.iter().filter(|(of, _)| *of == cell).map(|(_, drive)| drive.trajectory.len()).sum::<usize>();
    let fullest = all.iter().map(|(cell, _)| *cell).max_by_key(|cell| (points_in(*cell), *cell)).expect("a cell");
    (fullest, all.into_iter().filter(|(cell, _)| *cell == fullest).map(|(_, drive)| drive).collect())
}

/// A road of 1 km, and a town, with so many drives.
fn scenarios() -> [(&'static str, FleetScenario); 3] {
    let road = |drives| FleetScenario { drives, ..FleetScenario::winding_road() };
    [
        ("road_10", road(10)),
        ("road_50", road(50)),
        ("town_120", FleetScenario { drives: 120, ..FleetScenario::small_town(40) }),
    ]
}

fn fusing(criterion: &mut Criterion) {
    let params = FleetParams::default();
    let mut group = criterion.benchmark_group("fuse");
    group.sample_size(10);
    for (name, scenario) in scenarios() {
        let (cell, contributions) = fullest_cell(&scenario);
        let anchor = cell.anchor();
        group.bench_function(BenchmarkId::new("anew", name), |bencher| {
            bencher.iter(|| fuse(black_box(&contributions), &anchor, &params));
        });
        // As the service has it: the oldest folded, and all but the youngest, which grows, laid already.
        let ordered = by_seniority(&contributions);
        let (mut base, mut rest) = (Base::default(), ordered.as_slice());
        while let Some((oldest, younger)) = split_to_fold(rest, &anchor, &params) {
            base = fold(&base, oldest, &anchor, &params);
            rest = younger;
        }
        let keep = Keep { beginning_before: Some(rest.len() - 1), settled: false };
        let beginning = fuse_from(None, &base, rest, &anchor, &params, keep).beginning;
        group.bench_function(BenchmarkId::new("one_drive_grown", name), |bencher| {
            let go_on = || fuse_from(beginning.as_ref(), black_box(&base), rest, &anchor, &params, Keep::default());
            bencher.iter(go_on);
        });
        // The same until all are solved together: on the map of the others as it stands.
        let (live, others) = rest.split_last().expect("the scenario has drives");
        let keep = Keep { beginning_before: None, settled: true };
        let settled = fuse_from(None, &base, others, &anchor, &params, keep).settled.expect("it was asked for");
        group.bench_function(BenchmarkId::new("one_drive_drafted", name), |bencher| {
            bencher.iter(|| draft(black_box(&settled), &[live], &anchor, &params));
        });
    }
    group.finish();
}

criterion_group!(benches, fusing);
criterion_main!(benches);
