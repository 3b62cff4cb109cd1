//! What a frame costs to map: the whole step over a drive, and its parts.
//!
//! `cargo bench -p lanemap-tests --bench mapper`

#![allow(missing_docs, clippy::expect_used)] // criterion's macros; a benchmark that cannot set up must stop

use std::{hint::black_box, time::Duration};

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use lanemap_core::{
    Category, EndRule, Frame, FrameLimits, FrameParts, Mapper, Odometry, Params, Pose, Preset, Sequence, TimestampNs,
    association::{LaneShape, PoseUncertainty, associate_by_chamfer, associate_jointly},
    landmark::information::{BandedInformation, BandedSum, DenseTerm, Knot, Term},
    spline::{
        curve::Curve,
        foot_point::{foot_point_coarse, foot_point_refined},
    },
};
use lanemap_simulator::{
    Camera, OdometryNoise, Seed,
    detector::{Detector, DetectorModel, model::Misses},
    random::Purpose,
    road::RoadLineId,
    view::LineView,
};
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};

const LANES: u8 = 6;
const FRAMES: u32 = 200;
const STEP_M: f64 = 1.5;
const RADIUS_M: f64 = 400.0;

/// A point of a road that bends to the left, `offset_m` to the left of its middle.
fn on_road(along_m: f64, offset_m: f64) -> Point3<f64> {
    let (sin, cos) = (along_m / RADIUS_M).sin_cos();
    Point3::new((RADIUS_M - offset_m) * sin, RADIUS_M - (RADIUS_M - offset_m) * cos, 0.0)
}

/// The six lines as a vehicle faces them that is `along_m` into the road.
fn views(world_from_vehicle: &Pose, along_m: f64) -> Vec<LineView> {
    let view = |line: u8| LineView {
        line: RoadLineId(u32::from(line)),
        category: Category::WhiteDashed,
        points_vehicle: (0..75)
            .map(|k| on_road(along_m + f64::from(k), 8.75 - 3.5 * f64::from(line)))
            .map(|point| world_from_vehicle.inverse_transform_point(&point))
            .collect(),
        visible: 5..70,
        stretch: 0..75,
    };
    (0..LANES).map(view).collect()
}

/// 200 frames of a road of six lines, all in sight all the time, with the simulator's detector and odometry noise.
fn six_lane_drive(camera: &Camera) -> Vec<Frame> {
    let none_missed = Misses { ego_share: 0.0, far_share: 0.0, ..DetectorModel::default().misses };
    let model = DetectorModel { misses: none_missed, ..DetectorModel::default() };
    let seed = Seed(1);
    let mut detector = Detector::new(model, camera.sensor(), seed.stream(Purpose::Detector, 0));
    let along_m = |frame: u32| STEP_M * f64::from(frame);
    let poses: Vec<Pose> = (0..FRAMES)
        .map(|frame| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), along_m(frame) / RADIUS_M);
            Pose::from_parts(Translation3::from(on_road(along_m(frame), 0.0).coords), turn)
        })
        .collect();
    let noise = OdometryNoise { yaw_sigma_deg: 0.05, translation_sigma_m: 0.02 };
    let odometry = noise.apply(&poses, &mut seed.stream(Purpose::Odometry, 0));
    (0..FRAMES)
        .zip(poses.iter().zip(odometry))
        .map(|(frame, (pose, odometry_from_vehicle))| {
            let parts = FrameParts {
                sequence: Sequence(u64::from(frame) + 1),
                time: TimestampNs(i64::from(frame) * 100_000_000),
                odometry: Odometry { odometry_from_vehicle, motion_covariance: Some(noise.motion_covariance()) },
                gnss: None,
                detections: detector.observe(&views(pose, along_m(frame)), 0.1),
                occlusions: Vec::new(),
            };
            Frame::new(parts, &FrameLimits::default()).expect("the simulator's frames are valid")
        })
        .collect()
}

/// One iteration maps the whole drive; divide by its 200 frames for the cost of a step.
fn mapper_step(criterion: &mut Criterion) {
    let camera = Camera::default();
    let frames = six_lane_drive(&camera);
    let mut group = criterion.benchmark_group("mapper_step");
    group.sample_size(20).throughput(Throughput::Elements(u64::from(FRAMES)));
    for preset in [Preset::Default, Preset::Paper] {
        group.bench_function(BenchmarkId::new("200_frames_of_6_lanes", format!("{preset:?}")), |bencher| {
            bencher.iter_batched(
                || Mapper::new(Params::preset(preset), camera.sensor()),
                |mut mapper| {
                    for frame in &frames {
                        mapper.step(frame);
                    }
                    mapper
                },
                BatchSize::LargeInput,
            );
        });
    }
    group.finish();
}

/// Lines side by side, 3 m between points, seen by a vehicle whose pose is a little off.
fn shapes(count: u32, step_m: f64, shift_m: f64, confusion: f64) -> Vec<LaneShape> {
    (0..count)
        .map(|line| {
            let offset_m = 3.5 * (f64::from(line) - 0.5 * f64::from(count - 1)) + shift_m;
            let points = (0..).map(|k| 3.0 + step_m * f64::from(k)).take_while(|x| *x < 50.0);
            let points = points.map(|x| Point3::new(x, offset_m + 1e-3 * x * x, 0.0)).collect();
            LaneShape::seen_once(Category::WhiteDashed, points, confusion)
        })
        .collect()
}

fn association(criterion: &mut Criterion) {
    let pose = PoseUncertainty { yaw_rad: 0.005, along_m: 0.1, across_m: 0.1 };
    let mut group = criterion.benchmark_group("association_10_detections_20_lanes");
    for preset in [Preset::Default, Preset::Paper] {
        let params = Params::preset(preset).association;
        let lanes = shapes(20, 3.0, 0.0, params.category_confusion);
        let detections = shapes(10, 0.5, 0.2, params.category_confusion);
        group.bench_function(format!("{preset:?}"), |bencher| {
            bencher.iter(|| match preset {
                Preset::Default => associate_jointly(black_box(&detections), &lanes, &pose, &params).lane_of,
                Preset::Paper => associate_by_chamfer(black_box(&detections), &lanes, &pose, &params, true),
            });
        });
    }
    group.finish();
}

fn place(knot: Knot) -> Vector3<f64> {
    let x = 3.0 * knot as f64;
    Vector3::new(x, (0.01 * x).sin() * 20.0, 0.0)
}

/// What one frame says of `count` control points: each is where it should be, and all err together.
fn frame_term(first: Knot, count: usize) -> DenseTerm {
    let mut information = vec![-0.5; count * count];
    for k in 0..count {
        information[k * count + k] += count as f64;
    }
    let positions: Vec<_> = (first..).take(count).map(place).collect();
    let right = (0..count)
        .map(|row| positions.iter().enumerate().map(|(k, p)| p * information[row * count + k]).sum())
        .collect();
    DenseTerm { first, count, information, right }
}

/// A lane with a frame's term every three control points, solved.
fn long_lane<const W: usize>(count: Knot) -> BandedInformation<W> {
    let mut lane = BandedInformation::new(Point3::origin());
    for knot in 0..count {
        lane.push_tail(Point3::from(place(knot)));
        if knot > 0 {
            let target = place(knot) - place(knot - 1);
            lane.add(&Term { first: knot - 1, weights: [-1.0, 1.0, 0.0, 0.0], target, information: 1.0 });
        }
    }
    let width = Knot::try_from(W).expect("a band is narrow");
    for first in (0..=count - width).step_by(3) {
        absorb(&mut lane, &frame_term(first, W));
    }
    lane.solve();
    lane
}

fn absorb<const W: usize>(lane: &mut BandedInformation<W>, term: &DenseTerm) {
    let mut sum = BandedSum::default();
    sum.add_dense(term, lane.anchor());
    lane.absorb(&sum);
}

fn solve_at_the_tail<const W: usize>(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group(format!("banded_solve_width_{W}"));
    for count in [100, 1_000] {
        let lane = long_lane::<W>(count);
        let width = Knot::try_from(W).expect("a band is narrow");
        let term = frame_term(count - width, W);
        group.bench_function(BenchmarkId::from_parameter(count), |bencher| {
            bencher.iter_batched_ref(
                || lane.clone(),
                |lane| {
                    absorb(lane, &term);
                    lane.solve();
                },
                BatchSize::LargeInput,
            );
        });
    }
    group.finish();
}

fn banded_solve(criterion: &mut Criterion) {
    solve_at_the_tail::<4>(criterion);
    solve_at_the_tail::<28>(criterion);
}

fn foot_points(criterion: &mut Criterion) {
    let points: Vec<Point3<f64>> = (0..1_000).map(|knot| Point3::from(place(knot))).collect();
    let curve = Curve::new(points.as_slice(), EndRule::Reflected).expect("a thousand points make a curve");
    // As a frame asks: samples near the lane, and the control point nearest to each.
    let queries: Vec<(usize, Point3<f64>)> = (500..600).map(|k| (k, points[k] + Vector3::new(1.1, 0.4, 0.1))).collect();
    let mut group = criterion.benchmark_group("foot_points");
    group.throughput(Throughput::Elements(queries.len() as u64));
    group.bench_function("100_by_newton", |bencher| {
        bencher.iter(|| {
            for (nearest, query) in &queries {
                black_box(foot_point_refined(&curve, black_box(query), *nearest as f64));
            }
        });
    });
    group.bench_function("100_coarse_to_fine", |bencher| {
        bencher.iter(|| {
            for (nearest, query) in &queries {
                black_box(foot_point_coarse(&curve, black_box(query), *nearest, 3.0));
            }
        });
    });
    group.finish();
}

criterion_group! {
    name = benches;
    config = Criterion::default().warm_up_time(Duration::from_secs(1)).measurement_time(Duration::from_secs(3));
    targets = mapper_step, association, banded_solve, foot_points
}
criterion_main!(benches);
