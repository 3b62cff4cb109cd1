//! What a frame costs before it is mapped: decoding and validation, and becoming durable.
//!
//! `cargo bench -p lanemap-server --bench ingest`

#![allow(missing_docs, clippy::expect_used)] // criterion's macros; a benchmark that cannot set up must stop

use std::hint::black_box;

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use futures::future::join_all;
use lanemap_core::{
    Category, Detection, Frame, FrameLimits, FrameParts, Odometry, Sequence, TimestampNs, geometry::Pose,
};
use lanemap_proto::{encode, v1};
use lanemap_server::{
    ingest::decode::{self, PointFrame},
    journal::{Journal, JournalFrame, JournalOptions, frame_bytes},
    session::SessionId,
};
use nalgebra::Point3;
use prost::Message;

/// Six lines of eight points, as the detectors of the shared drives report them: the frame of a 6-lane road.
fn frame(sequence: u64) -> Frame {
    let ranges = [5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0];
    let line = |index: u8| Detection {
        category: Category::WhiteDashed,
        points_vehicle: ranges.map(|x| Point3::new(x, 3.5 * f64::from(index) - 8.75 + 1e-3 * x * x, -0.35)).to_vec(),
    };
    let odometry = Odometry { odometry_from_vehicle: Pose::identity(), motion_covariance: None };
    let parts = FrameParts {
        sequence: Sequence(sequence),
        time: TimestampNs(sequence.cast_signed()),
        odometry,
        gnss: None,
        detections: (0..6).map(line).collect(),
        occlusions: Vec::new(),
    };
    Frame::new(parts, &FrameLimits::default()).expect("a frame of plain numbers is valid")
}

fn decoding(criterion: &mut Criterion) {
    let bytes = encode::frame(&frame(1)).encode_to_vec();
    let limits = FrameLimits::default();
    let mut group = criterion.benchmark_group("decode");
    group.throughput(Throughput::Elements(1));
    group.bench_function("6_lines_of_8_points", |bencher| {
        bencher.iter(|| {
            let message = v1::Frame::decode(black_box(bytes.as_slice())).expect("it was encoded so");
            decode::frame(&message, &PointFrame::Vehicle, &limits).expect("it was valid")
        });
    });
    group.finish();
}

/// Durable frames per second where `sessions` vehicles each wait for the ack of one frame before the next.
fn journal(criterion: &mut Criterion) {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");
    let folder = tempfile::tempdir().expect("a folder");
    let (journal, _thread) = Journal::open(&JournalOptions::new(folder.path())).expect("an empty store opens");
    let mut group = criterion.benchmark_group("journal_durable");
    group.sample_size(20);
    let mut sequence = 0;
    for sessions in [1_u64, 100, 1000] {
        let ids: Vec<_> = (1..=sessions).map(|unix_ms| SessionId::next(None, 0, unix_ms)).collect();
        group.throughput(Throughput::Elements(sessions));
        group.bench_function(format!("one_frame_each_of_{sessions}_sessions"), |bencher| {
            bencher.iter_batched(
                || {
                    sequence += 1;
                    let bytes = frame_bytes(&frame(sequence)).expect("a frame has bytes");
                    ids.iter()
                        .map(|id| (*id, vec![JournalFrame { sequence: Sequence(sequence), bytes: bytes.clone() }]))
                        .collect()
                },
                |frames: Vec<_>| {
                    let appends = frames.into_iter().map(|(id, frames)| journal.append(id, frames));
                    runtime.block_on(join_all(appends)).into_iter().for_each(|append| append.expect("it is durable"));
                },
                BatchSize::PerIteration,
            );
        });
    }
    group.finish();
}

criterion_group!(benches, decoding, journal);
criterion_main!(benches);
