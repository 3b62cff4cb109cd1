//! How well a fused map lies on the true one: absolutely, and relatively, after one rigid motion of the whole map.
//!
//! Both maps are sampled every half metre. Each sample of the fused map has the true sample nearest to it in plan; their offset
//! is split by the direction of the true line. The rigid motion (a shift, a turn about the vertical, a lift) is fitted on
//! the lateral offsets by reweighted least squares, again and again from the nearest pairs that it gives. Relative errors
//! are what is left after it; absolute ones are measured between the same pairs without it.
//!
//! A map of few drives lies as far off as their receivers, more than half a lane, where the nearest line is often the one
//! beside. The fit therefore begins from shifts all around, and the one that lays most of the map on the truth goes on.
//!
//! Not guaranteed: on parallel lines alone, all equally far apart, the map may be laid one line off.

use std::collections::HashMap;

use nalgebra::{Matrix3, Point3, Vector2, Vector3};

use super::quantile;

/// Way between two samples, metres.
const STEP_M: f64 = 0.5;
/// Offset at which a fused sample has no true one, metres.
const GATE_M: f64 = 1.5;
/// Offset within which a fused sample counts as right, and a true one as covered, metres.
const RIGHT_M: f64 = 0.5;
/// Offset along the line at which a sample lies beyond its end, metres.
const ALONG_M: f64 = 1.0;

/// Median and 95 % quantile, metres.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Quantiles {
    /// Half are at most so large.
    pub p50: f64,
    /// 95 of a hundred are at most so large.
    pub p95: f64,
}

/// How well a fused map lies on the true one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FleetScore {
    /// Lateral errors after the rigid motion.
    pub relative: Quantiles,
    /// Errors of the height after it.
    pub relative_height: Quantiles,
    /// Lateral errors without it.
    pub absolute: Quantiles,
    /// Errors of the height without it.
    pub absolute_height: Quantiles,
    /// Share of the true lines' length that the map has.
    pub coverage: f64,
    /// Share of the map's length that is on a true line.
    pub precision: f64,
    /// Length of the map's lines, metres.
    pub length_m: f64,
    /// The rigid motion that lays the map on the truth.
    pub motion: RigidMotion,
}

/// A sample of a line: place and direction in plan.
#[derive(Clone, Copy)]
struct Sample {
    place: Point3<f64>,
    direction: Vector2<f64>,
}

struct Samples {
    all: Vec<Sample>,
    cells: HashMap<(i64, i64), Vec<usize>>,
}

/// A turn about the vertical at a pivot, a shift and a lift.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RigidMotion {
    pivot: Point3<f64>,
    shift: Vector3<f64>,
    yaw_rad: f64,
}

/// Scores a fused map, as polylines, against the true lines. `None` where either has no length.
#[must_use]
pub fn score_fleet(map: &[Vec<Point3<f64>>], truth: &[Vec<Point3<f64>>]) -> Option<FleetScore> {
    let (fused, truth) = (sampled(map), Samples::new(sampled(truth)));
    if fused.is_empty() || truth.all.is_empty() {
        return None;
    }
    let motion = fit(&fused, &truth);
    let (mut relative, mut absolute) = (Errors::default(), Errors::default());
    let mut right = 0;
    let mut moved = Vec::with_capacity(fused.len());
    for sample in &fused {
        let place = motion.apply(&sample.place);
        moved.push(Sample { place, ..*sample });
        let Some(true_sample) = truth.nearest(&place, GATE_M) else { continue };
        let (along_m, across_m) = split(place - true_sample.place, true_sample.direction);
        if along_m.abs() > ALONG_M {
            continue;
        }
        right += usize::from(across_m.abs() <= RIGHT_M);
        relative.add(across_m, place.z - true_sample.place.z);
        let offset = sample.place - true_sample.place;
        absolute.add(split(offset, true_sample.direction).1, offset.z);
    }
    let map_samples = Samples::new(moved);
    let covered = truth.all.iter().filter(|sample| map_samples.nearest(&sample.place, 2.0 * RIGHT_M).is_some()).count();
    Some(FleetScore {
        relative: relative.across(),
        relative_height: relative.heights(),
        absolute: absolute.across(),
        absolute_height: absolute.heights(),
        coverage: covered as f64 / truth.all.len() as f64,
        precision: right as f64 / fused.len() as f64,
        length_m: fused.len() as f64 * STEP_M,
        motion,
    })
}

#[derive(Default)]
struct Errors {
    across_m: Vec<f64>,
    height_m: Vec<f64>,
}

impl Errors {
    fn add(&mut self, across_m: f64, height_m: f64) {
        self.across_m.push(across_m.abs());
        self.height_m.push(height_m.abs());
    }

    fn across(&mut self) -> Quantiles {
        quantiles(&mut self.across_m)
    }

    fn heights(&mut self) -> Quantiles {
        quantiles(&mut self.height_m)
    }
}

fn quantiles(values: &mut [f64]) -> Quantiles {
    let mut at = |share: f64| quantile(values, share);
    Quantiles { p50: at(0.5), p95: at(0.95) }
}

fn sampled(lines: &[Vec<Point3<f64>>]) -> Vec<Sample> {
    let mut samples = Vec::new();
    for pair in lines.iter().flat_map(|line| line.windows(2)) {
        let piece = pair[1] - pair[0];
        let Some(direction) = piece.xy().try_normalize(1e-9) else { continue };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a count, positive and small")]
        let count = (piece.norm() / STEP_M).ceil().max(1.0) as usize;
        let sample = |k: usize| Sample { place: pair[0] + piece * (k as f64 / count as f64), direction };
        samples.extend((0..count).map(sample));
    }
    samples
}

/// Parts of an offset along a direction and to the left of it.
fn split(offset: Vector3<f64>, direction: Vector2<f64>) -> (f64, f64) {
    (offset.xy().dot(&direction), direction.perp(&offset.xy()))
}

impl Samples {
    const CELL_M: f64 = 4.0;

    fn new(all: Vec<Sample>) -> Self {
        let mut cells: HashMap<(i64, i64), Vec<usize>> = HashMap::new();
        for (index, sample) in all.iter().enumerate() {
            cells.entry(Self::cell(&sample.place)).or_default().push(index);
        }
        Self { all, cells }
    }

    #[expect(clippy::cast_possible_truncation, reason = "metres of a map")]
    fn cell(place: &Point3<f64>) -> (i64, i64) {
        ((place.x / Self::CELL_M).floor() as i64, (place.y / Self::CELL_M).floor() as i64)
    }

    /// The sample nearest to a place in plan, if within a radius of at most a cell.
    fn nearest(&self, place: &Point3<f64>, radius_m: f64) -> Option<&Sample> {
        let (x, y) = Self::cell(place);
        let around = (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| (x, y)));
        let near = around.filter_map(|cell| self.cells.get(&cell)).flatten().map(|index| &self.all[*index]);
        // Of samples on two levels of the road the one at the right height counts.
        let distance = |sample: &Sample| {
            let offset = sample.place - place;
            offset.xy().norm() + 0.05 * (offset.z.abs() - 3.0).max(0.0)
        };
        let best = near.min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        ((best.place - place).xy().norm() <= radius_m).then_some(best)
    }
}

impl RigidMotion {
    /// Where it moves a place.
    #[must_use]
    pub fn apply(&self, place: &Point3<f64>) -> Point3<f64> {
        let offset = place - self.pivot;
        let (sin, cos) = self.yaw_rad.sin_cos();
        let turned = Vector3::new(cos * offset.x - sin * offset.y, sin * offset.x + cos * offset.y, offset.z);
        self.pivot + turned + self.shift
    }
}

/// The rigid motion that lays the map best on the truth.
fn fit(map: &[Sample], truth: &Samples) -> RigidMotion {
    /// Steps to each side between the shifts from which it is sought.
    const STEPS: [f64; 5] = [0.0, -1.5, 1.5, -3.0, 3.0];
    /// Every how many samples one is used to choose among them.
    const STRIDE: usize = 10;
    let middle = map.iter().map(|sample| sample.place.coords).sum::<Vector3<f64>>() / map.len() as f64;
    let still = RigidMotion { pivot: middle.into(), shift: Vector3::zeros(), yaw_rad: 0.0 };
    let few: Vec<Sample> = map.iter().step_by(STRIDE).copied().collect();
    let starts = STEPS.iter().flat_map(|x| STEPS.iter().map(move |y| Vector3::new(*x, *y, 0.0)));
    let ends = starts.map(|shift| refined(RigidMotion { shift, ..still }, &few, truth));
    // Of equally good ones the first, which moves least.
    let best = ends.map(|motion| (right_share(&motion, &few, truth), motion)).reduce(|best, next| {
        const CLEARLY: f64 = 0.01;
        if next.0 > best.0 + CLEARLY { next } else { best }
    });
    refined(best.map_or(still, |(_, motion)| motion), map, truth)
}

/// Share of the samples that a motion lays on a true line.
fn right_share(motion: &RigidMotion, map: &[Sample], truth: &Samples) -> f64 {
    let right = map.iter().filter(|sample| {
        let place = motion.apply(&sample.place);
        truth.nearest(&place, GATE_M).is_some_and(|nearest| {
            let (along_m, across_m) = split(place - nearest.place, nearest.direction);
            along_m.abs() <= ALONG_M && across_m.abs() <= RIGHT_M
        })
    });
    right.count() as f64 / map.len().max(1) as f64
}

/// A rigid motion, better from round to round.
fn refined(mut motion: RigidMotion, map: &[Sample], truth: &Samples) -> RigidMotion {
    const ROUNDS: usize = 25;
    for round in 0..ROUNDS {
        let gate_m = if round < ROUNDS / 2 { 3.0 } else { 1.0 };
        // Weakly held: a straight road tells nothing of a shift along it.
        let mut left = Matrix3::identity() * 1e-3;
        let mut right = Vector3::zeros();
        let mut lifts = Vec::new();
        for sample in map {
            let place = motion.apply(&sample.place);
            let Some(nearest) = truth.nearest(&place, gate_m) else { continue };
            let (along_m, across_m) = split(place - nearest.place, nearest.direction);
            if along_m.abs() > ALONG_M {
                continue;
            }
            let normal = Vector2::new(-nearest.direction.y, nearest.direction.x);
            let lever = (place - motion.pivot).xy();
            let row = Vector3::new(normal.x, normal.y, Vector2::new(-lever.y, lever.x).dot(&normal));
            let weight = 1.0 / (0.1 + across_m * across_m);
            left += row * row.transpose() * weight;
            right -= row * (across_m * weight);
            lifts.push(nearest.place.z - place.z);
        }
        let Some(step) = left.cholesky().map(|factor| factor.solve(&right)) else { break };
        motion.yaw_rad += step.z;
        motion.shift += Vector3::new(step.x, step.y, quantile(&mut lifts, 0.5));
    }
    motion
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(shift: Vector3<f64>) -> Vec<Vec<Point3<f64>>> {
        let at = |x: f64, y: f64| Point3::new(x, y, 0.01 * x) + shift;
        let along = (0..60).map(|k| at(2.0 * f64::from(k), 0.001 * f64::from(k * k))).collect();
        let across = (0..60).map(|k| at(40.0, 10.0 + 2.0 * f64::from(k))).collect();
        vec![along, across]
    }

    #[test]
    fn a_map_that_is_shifted_as_a_whole_is_wrong_absolutely_and_right_relatively() {
        let score = score_fleet(&lines(Vector3::new(0.8, -0.6, 0.3)), &lines(Vector3::zeros())).unwrap();
        assert!(score.relative.p95 < 0.02, "{score:?}");
        assert!(score.absolute.p50 > 0.55 && score.absolute.p95 < 0.85, "{score:?}");
        assert!((score.absolute_height.p50 - 0.3).abs() < 0.02 && score.relative_height.p95 < 0.02);
        assert!(score.coverage > 0.99 && score.precision > 0.98);
    }

    #[test]
    fn a_map_that_lies_nearer_to_the_lines_beside_is_laid_on_its_own() {
        let across = |y: f64| (0..60).map(|k| Point3::new(30.0, y + 2.0 * f64::from(k), 0.0)).collect::<Vec<_>>();
        let along = |y: f64| (0..60).map(|k| Point3::new(2.0 * f64::from(k), y, 0.0)).collect::<Vec<_>>();
        let truth: Vec<Vec<Point3<f64>>> = [0.0, 3.5, 7.0].map(along).into_iter().chain([across(10.0)]).collect();
        let shifted = |line: &Vec<Point3<f64>>| line.iter().map(|point| point + Vector3::new(1.5, 2.3, 0.0)).collect();
        let score = score_fleet(&truth.iter().map(shifted).collect::<Vec<_>>(), &truth).unwrap();
        assert!(score.relative.p95 < 0.02 && score.precision > 0.98, "{score:?}");
        assert!(score.absolute.p95 > 2.2, "{score:?}");
    }

    #[test]
    fn what_is_missing_lowers_coverage_and_what_is_invented_lowers_precision() {
        let truth = lines(Vector3::zeros());
        let half = score_fleet(&truth[..1], &truth).unwrap();
        assert!((half.coverage - 0.5).abs() < 0.07 && half.precision > 0.98, "{half:?}");
        let mut map = truth.clone();
        map.push((0..60).map(|k| Point3::new(2.0 * f64::from(k), -20.0, 0.0)).collect());
        let invented = score_fleet(&map, &truth).unwrap();
        assert!((invented.precision - 2.0 / 3.0).abs() < 0.05 && invented.coverage > 0.99, "{invented:?}");
        assert!(score_fleet(&[], &truth).is_none());
    }
}
