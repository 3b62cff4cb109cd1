//! Incremental equals batch (faer) and GTSAM's iSAM2, whatever grows where.

use faer::{Mat, linalg::solvers::Solve};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// Every term so far, for a batch solution that shares no code with the incremental one.
#[derive(Default)]
struct Batch {
    terms: Vec<Term>,
}

impl Batch {
    fn normal_equations(&self, head: Knot, count: usize) -> (Mat<f64>, Mat<f64>) {
        let (mut h, mut b) = (Mat::zeros(count, count), Mat::zeros(count, 3));
        for term in &self.terms {
            for (i, wi) in term.weights.iter().enumerate().filter(|(_, w)| **w != 0.0) {
                let row = usize::try_from(term.first - head).unwrap() + i;
                for (j, wj) in term.weights.iter().enumerate().filter(|(_, w)| **w != 0.0) {
                    h[(row, usize::try_from(term.first - head).unwrap() + j)] += term.information * wi * wj;
                }
                for axis in 0..3 {
                    b[(row, axis)] += term.information * wi * term.target[axis];
                }
            }
        }
        (h, b)
    }
}

fn chord(first: Knot, delta: Vector3<f64>) -> Term {
    Term { first, weights: [-1.0, 1.0, 0.0, 0.0], target: delta, information: 1.0 }
}

fn spline_term(rng: &mut ChaCha8Rng, first: Knot, near: Vector3<f64>) -> Term {
    let noise = Vector3::new(rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5), rng.random_range(-0.2..0.2));
    let weights = crate::spline::basis::weights(rng.random_range(0.0..1.0));
    Term { first, weights, target: near + noise, information: rng.random_range(0.1..100.0) }
}

fn place(knot: Knot) -> Vector3<f64> {
    let s = knot as f64 * 3.0;
    Vector3::new(s, 0.002 * s * s, 0.01 * s)
}

/// Grows a lane at random at both ends and compares with the batch after every solution.
fn grow_and_compare<const W: usize>(seed: u64, frames: usize) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut lane = BandedInformation::<W>::new(Point3::from(place(0)));
    let mut batch = Batch::default();
    let add = |lane: &mut BandedInformation<W>, batch: &mut Batch, term: Term| {
        lane.add(&term);
        batch.terms.push(term);
    };
    for knot in 0..6 {
        lane.push_tail(Point3::from(place(knot)));
        if knot > 0 {
            add(&mut lane, &mut batch, chord(knot - 1, place(knot) - place(knot - 1)));
        }
    }
    for _ in 0..frames {
        for _ in 0..rng.random_range(0..3) {
            let tail = lane.knot(lane.len() - 1);
            lane.push_tail(Point3::from(place(tail + 1)));
            add(&mut lane, &mut batch, chord(tail, place(tail + 1) - place(tail)));
        }
        if rng.random_bool(0.3) {
            let head = lane.head();
            lane.push_head(Point3::from(place(head - 1)));
            add(&mut lane, &mut batch, chord(head - 1, place(head) - place(head - 1)));
        }
        for _ in 0..rng.random_range(1..30) {
            let first = rng.random_range(lane.head()..=lane.knot(lane.len() - 4));
            let term = spline_term(&mut rng, first, place(first) * 0.5 + place(first + 3) * 0.5);
            add(&mut lane, &mut batch, term);
        }
        lane.solve();
        let (h, b) = batch.normal_equations(lane.head(), lane.len());
        let expected = h.llt(faer::Side::Lower).unwrap().solve(&b);
        let inverse = h.llt(faer::Side::Lower).unwrap().solve(Mat::<f64>::identity(lane.len(), lane.len()));
        let scale = expected.norm_max();
        for (i, position) in lane.positions().iter().enumerate() {
            for axis in 0..3 {
                assert!((position[axis] - expected[(i, axis)]).abs() < 1e-9 * scale);
            }
        }
        for (i, variance) in lane.variances(0).iter().enumerate() {
            assert!((variance - inverse[(i, i)]).abs() < 1e-9 * inverse[(i, i)]);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn incremental_equals_batch_under_random_growth_at_both_ends(seed in any::<u64>()) {
        grow_and_compare::<4>(seed, 20);
        grow_and_compare::<28>(seed, 20);
    }
}

/// A long lane with data everywhere, as a drive leaves it.
fn long_lane(count: Knot) -> BandedInformation<4> {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut lane = BandedInformation::new(Point3::origin());
    for knot in 0..count {
        lane.push_tail(Point3::from(place(knot)));
        if knot > 0 {
            lane.add(&chord(knot - 1, place(knot) - place(knot - 1)));
        }
        if knot >= 3 {
            lane.add(&spline_term(&mut rng, knot - 3, place(knot - 2)));
        }
    }
    lane.solve();
    lane
}

#[test]
fn a_change_in_the_middle_of_a_long_lane_dies_out_to_the_last_bit() {
    let mut lane = long_lane(2_000);
    let before = lane.clone();
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    lane.add(&spline_term(&mut rng, 1_000, place(1_001)));
    let (first, last) = lane.touched.unwrap();
    let (end, reached) = lane.refactorise(first, last);
    assert!(end < 1_400, "refactorised up to row {end}");
    lane.substitute_back(end, reached);
    assert_eq!(lane.positions[100], before.positions[100]);
    assert_ne!(lane.positions[1_001], before.positions[1_001]);
}

#[test]
fn a_restored_lane_has_the_same_bits_and_goes_on_with_the_same_bits() {
    let mut lane = long_lane(300);
    let bytes = postcard::to_stdvec(&lane).unwrap();
    let mut restored: BandedInformation<4> = postcard::from_bytes(&bytes).unwrap();
    assert_eq!(restored.factor, lane.factor);
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let term = spline_term(&mut rng, 250, place(251));
    for information in [&mut lane, &mut restored] {
        information.add(&term);
        information.solve();
    }
    assert_eq!(restored.positions, lane.positions);
}
