//! The banded smoother against GTSAM's iSAM2, on the same factors in the same order (`tests/golden/isam2.py` wrote them).

#![allow(clippy::unwrap_used)] // a test fails where it fails

use lanemap_core::landmark::information::{BandedInformation, Term};
use nalgebra::{Matrix3, Point3, Vector3};
use serde::Deserialize;

const POSITION_TOLERANCE_M: f64 = 1e-6;
const COVARIANCE_TOLERANCE: f64 = 1e-6;

#[derive(Deserialize)]
struct Golden {
    frames: Vec<GoldenFrame>,
}

#[derive(Deserialize)]
struct GoldenFrame {
    born: Vec<Born>,
    chords: Vec<Chord>,
    points: Vec<PointFactor>,
    estimate: Estimate,
    covariances: Vec<Marginal>,
}

#[derive(Deserialize)]
struct Born {
    index: i64,
    initial: [f64; 3],
}

#[derive(Deserialize)]
struct Chord {
    index: i64,
    delta: [f64; 3],
    sigma: f64,
}

#[derive(Deserialize)]
struct PointFactor {
    first: i64,
    weights: [f64; 4],
    point: [f64; 3],
    sigma: f64,
}

#[derive(Deserialize)]
struct Estimate {
    first: i64,
    positions: Vec<[f64; 3]>,
}

#[derive(Deserialize)]
struct Marginal {
    index: i64,
    covariance: [[f64; 3]; 3],
}

impl From<&Chord> for Term {
    fn from(chord: &Chord) -> Self {
        Self {
            first: chord.index,
            weights: [-1.0, 1.0, 0.0, 0.0],
            target: Vector3::from(chord.delta),
            information: chord.sigma.powi(-2),
        }
    }
}

impl From<&PointFactor> for Term {
    fn from(factor: &PointFactor) -> Self {
        Self {
            first: factor.first,
            weights: factor.weights,
            target: Vector3::from(factor.point),
            information: factor.sigma.powi(-2),
        }
    }
}

fn golden_frames() -> Vec<GoldenFrame> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden/isam2.json");
    let text = std::fs::read_to_string(path).unwrap();
    serde_json::from_str::<Golden>(&text).unwrap().frames
}

/// The lane after each frame, beside what iSAM2 made of it.
fn replay(mut compare: impl FnMut(&BandedInformation<4>, &GoldenFrame)) {
    let frames = golden_frames();
    let mut lane = BandedInformation::<4>::new(Point3::from(frames[0].born[0].initial));
    for frame in &frames {
        for born in &frame.born {
            if born.index < lane.head() {
                lane.push_head(Point3::from(born.initial));
            } else {
                lane.push_tail(Point3::from(born.initial));
            }
        }
        frame.chords.iter().map(Term::from).for_each(|term| lane.add(&term));
        frame.points.iter().map(Term::from).for_each(|term| lane.add(&term));
        lane.solve();
        compare(&lane, frame);
    }
}

#[test]
fn every_frame_gives_the_control_points_of_isam2() {
    let mut frames = 0;
    replay(|lane, frame| {
        assert_eq!(lane.head(), frame.estimate.first);
        assert_eq!(lane.len(), frame.estimate.positions.len());
        for (ours, theirs) in lane.positions().iter().zip(&frame.estimate.positions) {
            let distance_m = (ours - Point3::from(*theirs)).norm();
            assert!(distance_m < POSITION_TOLERANCE_M, "frame {frames}: {ours} is {distance_m} m from iSAM2's");
        }
        frames += 1;
    });
    assert_eq!(frames, 25);
}

#[test]
fn marginal_covariances_are_those_of_isam2() {
    let mut compared = 0;
    replay(|lane, frame| {
        let variances_m2 = lane.variances(0);
        for marginal in &frame.covariances {
            let place = usize::try_from(marginal.index - lane.head()).unwrap();
            let theirs = Matrix3::from(marginal.covariance);
            let ours = Matrix3::identity() * variances_m2[place];
            assert!((ours - theirs).norm() < COVARIANCE_TOLERANCE * theirs.norm(), "P_{}: {theirs}", marginal.index);
            compared += 1;
        }
    });
    assert_eq!(compared, 20);
}
