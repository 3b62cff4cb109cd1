//! The detector's statistics over long, straight, flat roads, against the figures of its model.

use lanemap_core::{Category, Detection};
use nalgebra::Point3;

use super::*;
use crate::{
    camera::Camera,
    random::{Purpose, Seed},
};

const DT_S: f64 = 0.1;

/// A straight line at a distance to the left, visible from 6 to 70 m ahead of the vehicle.
fn straight(line: u32, left_m: f64) -> LineView {
    let points_vehicle: Vec<_> = (0..90).map(|x| Point3::new(f64::from(x), left_m, -0.35)).collect();
    LineView { line: RoadLineId(line), category: Category::WhiteDashed, points_vehicle, visible: 6..71, stretch: 6..71 }
}

fn detector(model: DetectorModel, drive: u32) -> Detector {
    Detector::new(model, Camera::default().sensor(), Seed(9).stream(Purpose::Detector, drive))
}

/// Lateral and vertical error at a row, by drive of one frame each; `None` where the line is missed or too short.
fn errors_at_row(model: DetectorModel, row_m: f64, drives: u32) -> Vec<[f64; 2]> {
    let offset = Camera::default().sensor().ground_offset();
    (0..drives)
        .filter_map(|drive| {
            let detections = detector(model, drive).observe(&[straight(0, 1.75)], DT_S);
            let point = detections.first()?.points_vehicle.iter().find(|p| (p.x - offset.x - row_m).abs() < 1e-9)?;
            Some([point.y - 1.75, point.z + 0.35])
        })
        .collect()
}

fn sigma(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count() as f64;
    (values.map(|value| value * value).sum::<f64>() / count).sqrt()
}

fn without_ghosts_and_misses() -> DetectorModel {
    let mut model = DetectorModel::default();
    model.ghosts.births_per_frame = 0.0;
    model.misses.ego_share = 0.0;
    model.misses.far_share = 0.0;
    model.reach.range_m = 100.0;
    model
}

#[test]
fn errors_at_50_m_are_half_a_metre_aside_and_a_third_up_and_small_nearby() {
    let mut model = without_ghosts_and_misses();
    model.difficulty_spread = 0.0;
    model.pitch_sigma_rad = 0.0;
    model.yaw_sigma_rad = 0.0;
    let far = errors_at_row(model, 50.0, 6_000);
    assert!((sigma(far.iter().map(|e| e[0])) - 0.5).abs() < 0.03);
    assert!((sigma(far.iter().map(|e| e[1])) - 0.35).abs() < 0.02);
    let near = errors_at_row(model, 5.0, 6_000);
    assert!(sigma(near.iter().map(|e| e[0])) < 0.15);
}

#[test]
fn pitch_and_yaw_errors_are_shared_by_the_lines_of_a_frame() {
    let mut model = without_ghosts_and_misses();
    model.lateral = crate::noise::RangeSigmas { offset_m: 0.0, slope_m: 0.0, bend_m: 0.0 };
    model.vertical = model.lateral;
    model.white_sigma_m = 0.0;
    let mut heights = Vec::new();
    for drive in 0..3_000 {
        let detections = detector(model, drive).observe(&[straight(0, 1.75), straight(1, -1.75)], DT_S);
        let at_50 = |detection: &Detection| detection.points_vehicle[6].coords;
        let (left, right) = (at_50(&detections[0]), at_50(&detections[1]));
        assert!((left.z - right.z).abs() < 1e-9 && (left.y - right.y - 3.5).abs() < 1e-9);
        heights.push(left.z + 0.35);
    }
    let expected_m = 50.0 * 0.29_f64.to_radians();
    assert!((sigma(heights.iter().copied()) / expected_m - 1.0).abs() < 0.05);
}

#[test]
fn errors_are_alike_over_a_tenth_of_a_second_and_nearly_forgotten_after_two() {
    let mut model = without_ghosts_and_misses();
    model.pitch_sigma_rad = 0.0;
    model.yaw_sigma_rad = 0.0;
    let (mut now_next, mut now_later, mut square) = (0.0, 0.0, 0.0);
    for drive in 0..3_000 {
        let mut detector = detector(model, drive);
        let series: Vec<f64> =
            (0..21).map(|_| detector.observe(&[straight(0, 1.75)], DT_S)[0].points_vehicle[6].y - 1.75).collect();
        now_next += series[0] * series[1];
        now_later += series[0] * series[20];
        square += series[0] * series[0];
    }
    let (next, later) = (now_next / square, now_later / square);
    assert!((0.75..0.95).contains(&next), "{next}");
    assert!((0.08..0.28).contains(&later), "the constant share remains: {later}");
}

#[test]
fn lines_are_missed_as_often_as_stated_and_in_bursts() {
    let mut model = DetectorModel::default();
    model.ghosts.births_per_frame = 0.0;
    for (left_m, share) in [(1.75, 0.07), (12.0, 0.55)] {
        let mut detector = detector(model, 0);
        let view = [straight(0, left_m)];
        let seen: Vec<bool> = (0..60_000).map(|_| !detector.observe(&view, DT_S).is_empty()).collect();
        let missed = seen.iter().filter(|seen| !**seen).count() as f64;
        let bursts = seen.windows(2).filter(|pair| pair[0] && !pair[1]).count() as f64;
        assert!((missed / seen.len() as f64 - share).abs() < 0.02, "{left_m} m");
        assert!((missed / bursts - 6.0).abs() < 0.6);
    }
}

#[test]
fn categories_are_wrong_as_often_as_stated() {
    let mut detector = detector(without_ghosts_and_misses(), 0);
    let wrong = (0..60_000)
        .filter(|_| detector.observe(&[straight(0, 1.75)], DT_S)[0].category != Category::WhiteDashed)
        .count() as f64;
    assert!((wrong / 60_000.0 - 0.07).abs() < 0.01);
}

#[test]
fn ghosts_live_about_four_frames_beside_the_line() {
    let mut model = without_ghosts_and_misses();
    model.ghosts.births_per_frame = 0.02;
    let mut detector = detector(model, 0);
    let (mut frames, mut births, mut before) = (0_usize, 0_usize, 0_usize);
    for _ in 0..60_000 {
        let ghosts = detector.observe(&[straight(0, 1.75)], DT_S).len() - 1;
        births += usize::from(ghosts > before);
        frames += ghosts;
        before = ghosts;
    }
    let life = frames as f64 / births as f64;
    assert!((3.3..4.7).contains(&life), "{life}");
}

#[test]
fn one_seed_repeats_and_another_drive_differs() {
    let run = |drive| {
        let mut detector = detector(DetectorModel::default(), drive);
        (0..50).map(|_| detector.observe(&[straight(0, 1.75), straight(1, -1.75)], DT_S)).collect::<Vec<_>>()
    };
    assert_eq!(run(0), run(0));
    assert_ne!(run(0), run(1));
}
