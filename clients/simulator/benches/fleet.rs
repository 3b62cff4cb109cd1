//! How fast a fleet is simulated: frames a second of drives through a town of 10 km^2 with traffic and changes.

#![allow(missing_docs)] // criterion_group! makes a public function

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lanemap_simulator::{
    FleetScenario, Seed,
    fleet::{ChangePlan, Fleet},
};

fn fleet() -> Fleet {
    FleetScenario { changes: ChangePlan::some(50, 150), ..FleetScenario::town(200) }.fleet(Seed(1))
}

fn town(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("fleet");
    group.sample_size(10);
    group.bench_function("build a town of 10 km^2", |bencher| bencher.iter(fleet));
    let fleet = fleet();
    let drives = || (80..88).map(|number| fleet.drive(number));
    let frames: usize = drives().map(|drive| drive.states().len()).sum();
    group.throughput(Throughput::Elements(frames as u64));
    group.bench_function("frames of drives", |bencher| {
        bencher.iter(|| drives().map(|drive| drive.frames().count()).sum::<usize>());
    });
    group.finish();
}

criterion_group!(benches, town);
criterion_main!(benches);
