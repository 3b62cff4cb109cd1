//! Alignment: the corrections of drives and the places of lines, in one robust least-squares problem.
//!
//! Unknown are, per drive, the knots of its [`Correction`], what all its GNSS fixes have in common and what all its odometry
//! has in common, and, per station of a line, where the line lies across. Minimised is the sum of
//!
//! * `|c'_{k+1} - c'_k - (1 + a) R_k (c_{k+1} - c_k)|^2 / (q d) + (psi_{k+1} - psi_k - t d)^2 / (q_psi d) + a^2 / s_a^2 +
//!   t^2 / s_t^2`: odometry between knots, whose scale and turn are off by the same `a` and `t` all through a drive,
//! * `|C(p) + b - g|^2 / s_g^2 + |b|^2 / s_b^2`: fixes `g`, and their bias `b`, which is a drive's own,
//! * `rho(n . C(p) - mu) / s^2`: a lane's sample against the station `mu` of its line, along the line's normal `n`.
//!
//! `rho` is that of Geman and `McClure`, whose weight is `(c^2 / (c^2 + r^2))^2`. Heights are a problem of their own, with one unknown per knot:
//! to first order they do not depend on the rest. Gauss-Newton; the normal equations are sparse. Since every drive has a
//! bias of its own and none is the truth, the map lies at the mean of what their receivers say, and its
//! variance falls with their number.
//!
//! Not guaranteed: the right minimum. It is found where matching is right for most; [`placement`](super::placement) sees to that.

use nalgebra::{Point3, Vector2};

use super::{
    chain::ChainEquations,
    correction::Correction,
    prepared::Restraints,
    sparse::{Chain, Elimination, Equations, JointEquations},
};

/// Where a sample should lie along its normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Target {
    /// On a line that stays where it is, given as the position along the normal, metres.
    Fixed(f64),
    /// On a station that is itself unknown.
    Station(usize),
}

/// A sample of a drive's lane that lies on a line.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sighting {
    pub(super) drive: usize,
    pub(super) arc_m: f64,
    /// Map frame of the drive.
    pub(super) map: Point3<f64>,
    /// Normal of the line, shared frame.
    pub(super) normal: Vector2<f64>,
    pub(super) across: Target,
    pub(super) height: Target,
    pub(super) lateral_variance_m2: f64,
    pub(super) height_variance_m2: f64,
}

/// The residuals at which robust weights have fallen to a quarter, metres: large while drives do not yet lie where they
/// belong, and smaller from step to step (graduated non-convexity).
#[derive(Clone, Copy, Debug)]
pub(super) struct RobustScales {
    /// Of sightings across; in height twice that.
    pub(super) lanes_m: f64,
    /// Of fixes, from the median of the drive's.
    pub(super) fixes_m: f64,
}

/// Unknowns: of each drive those of its knots, then those that they have in common; then the stations.
struct Layout {
    chains: Vec<Chain>,
    per_knot: usize,
    common: usize,
    /// First station.
    stations: usize,
    unknowns: usize,
}

/// Normal equations in the form that suits the problem.
enum Solver {
    Chain(ChainEquations),
    Joint(JointEquations),
}

/// The orders in which the horizontal problem and that of the heights are eliminated, kept from one alignment of the same drives to the
/// next.
#[derive(Debug, Default)]
pub(super) struct Eliminations {
    across: Elimination,
    height: Elimination,
}

impl Equations for Solver {
    fn add(&mut self, row: &[(usize, f64)], value: f64, weight: f64) {
        match self {
            Self::Chain(chain) => chain.add(row, value, weight),
            Self::Joint(joint) => joint.add(row, value, weight),
        }
    }
}

impl Solver {
    fn solve(self, elimination: &mut Elimination) -> Option<Vec<f64>> {
        match self {
            Self::Chain(chain) => chain.solve(),
            Self::Joint(joint) => joint.solve(elimination),
        }
    }
}

const GAUSS_NEWTON_STEPS: usize = 2;
/// Holds what nothing else holds, 1/m^2.
const WEAK: f64 = 1e-9;

/// Solves for the correction of one drive, whose sightings are of lines that stay where they are.
pub(super) fn align_one(drive: &Restraints, correction: &mut Correction, sightings: &[Sighting], scales: RobustScales) {
    align(&[drive], std::slice::from_mut(correction), sightings, 0, scales, &mut Eliminations::default());
}

/// Solves for the corrections of `drives` (as many corrections), with `stations` stations.
pub(super) fn align(
    drives: &[&Restraints],
    corrections: &mut [Correction],
    sightings: &[Sighting],
    stations: usize,
    scales: RobustScales,
    eliminations: &mut Eliminations,
) {
    let located = Located::of(drives, corrections, sightings);
    let problem = Problem { drives, sightings, located: &located, stations, scales };
    for _ in 0..GAUSS_NEWTON_STEPS {
        align_horizontally(&problem, corrections, &mut eliminations.across);
    }
    align_heights(&problem, corrections, &mut eliminations.height);
}

/// What is asked of an alignment.
struct Problem<'a> {
    drives: &'a [&'a Restraints],
    sightings: &'a [Sighting],
    located: &'a Located,
    stations: usize,
    scales: RobustScales,
}

/// The knot before a place of a way, and the weight of the one after it.
type Between = (usize, f64);

/// Where along the corrections everything lies: this does not change while they are solved for.
struct Located {
    /// Of each drive.
    fixes: Vec<Vec<Between>>,
    sightings: Vec<Between>,
}

impl Located {
    fn of(drives: &[&Restraints], corrections: &[Correction], sightings: &[Sighting]) -> Self {
        let fixes = drives.iter().zip(corrections);
        let fixes =
            fixes.map(|(drive, correction)| drive.fixes.iter().map(|fix| correction.locate(fix.arc_m)).collect());
        let sightings = sightings.iter().map(|sighting| corrections[sighting.drive].locate(sighting.arc_m));
        Self { fixes: fixes.collect(), sightings: sightings.collect() }
    }
}

/// The weight that Geman and `McClure` give a residual.
pub(super) fn robust_weight(residual_m: f64, scale_m: f64) -> f64 {
    let ratio = scale_m * scale_m / (scale_m * scale_m + residual_m * residual_m);
    ratio * ratio
}

impl Layout {
    fn new(corrections: &[Correction], per_knot: usize, common: usize, stations: usize) -> Self {
        let mut next = 0;
        let chains = corrections.iter().map(|correction| {
            let first = next;
            next += correction.knots.len() * per_knot + common;
            Chain { first, knots: correction.knots.len() }
        });
        let chains: Vec<Chain> = chains.collect();
        Self { chains, per_knot, common, stations: next, unknowns: next + stations }
    }

    /// No row yet.
    fn equations(&self) -> Solver {
        let stations = self.unknowns - self.stations;
        if self.chains.len() == 1 && stations == 0 {
            Solver::Chain(ChainEquations::new(self.unknowns - self.common, self.unknowns, WEAK))
        } else {
            Solver::Joint(JointEquations::new(&self.chains, self.per_knot, self.common, stations, WEAK))
        }
    }

    /// First unknown of a drive.
    fn first(&self, drive: usize) -> usize {
        self.chains[drive].first
    }
}

/// The coefficients of one equation: of few unknowns.
#[derive(Clone, Copy, Debug, Default)]
struct Row {
    entries: [(usize, f64); 7],
    len: usize,
}

impl Row {
    fn push(&mut self, unknown: usize, coefficient: f64) {
        self.entries[self.len] = (unknown, coefficient);
        self.len += 1;
    }

    fn entries(&self) -> &[(usize, f64)] {
        &self.entries[..self.len]
    }
}

/// A correction with the sine and cosine of the turn of each knot.
struct Turned<'a> {
    correction: &'a Correction,
    turns: Vec<(f64, f64)>,
}

/// A place under the correction, and how it moves with the turns of the knots beside it.
struct Moving {
    between: Between,
    place: Vector2<f64>,
    by_yaw: [Vector2<f64>; 2],
}

impl<'a> Turned<'a> {
    fn new(correction: &'a Correction) -> Self {
        Self { correction, turns: correction.knots.iter().map(|knot| knot.yaw_rad.sin_cos()).collect() }
    }

    fn moving(&self, map: &Point3<f64>, between: Between) -> Moving {
        let (knot, weight) = between;
        let at = |knot: usize| {
            let (own, (sin, cos)) = (&self.correction.knots[knot], self.turns[knot]);
            let offset = (map - own.map).xy();
            let turned = Vector2::new(cos * offset.x - sin * offset.y, sin * offset.x + cos * offset.y);
            (own.shared.coords.xy() + turned, Vector2::new(-turned.y, turned.x))
        };
        let (before, by_first) = at(knot);
        if weight == 0.0 {
            return Moving { between, place: before, by_yaw: [by_first, Vector2::zeros()] };
        }
        let (after, by_second) = at(knot + 1);
        Moving { between, place: before + (after - before) * weight, by_yaw: [by_first, by_second] }
    }
}

impl Moving {
    /// Derivatives of the place along an axis by the unknowns of the knots beside it.
    fn row_along(&self, first: usize, axis: &Vector2<f64>) -> Row {
        let (knot, weight) = self.between;
        let mut row = Row::default();
        for (knot, weight, by_yaw) in [(knot, 1.0 - weight, self.by_yaw[0]), (knot + 1, weight, self.by_yaw[1])] {
            if weight > 0.0 {
                let at = first + 3 * knot;
                for (unknown, part) in [(at, axis.x), (at + 1, axis.y)] {
                    // Of an axis to the east or the north.
                    if part != 0.0 {
                        row.push(unknown, weight * part);
                    }
                }
                row.push(at + 2, weight * by_yaw.dot(axis));
            }
        }
        row
    }
}

fn align_horizontally(problem: &Problem<'_>, corrections: &mut [Correction], elimination: &mut Elimination) {
    let Problem { drives, sightings, located, stations, scales } = *problem;
    // In common: 2 of the bias, 1 of odometry's scale, 1 of its turn.
    let layout = Layout::new(corrections, 3, 4, stations);
    let mut equations = layout.equations();
    let turned: Vec<Turned<'_>> = corrections.iter().map(Turned::new).collect();
    for (index, (drive, turned)) in drives.iter().zip(&turned).enumerate() {
        let first = layout.first(index);
        add_odometry(&mut equations, first, drive, turned.correction);
        add_fixes(&mut equations, first, drive, turned, &located.fixes[index], scales.fixes_m);
    }
    let moving = sightings.iter().zip(&located.sightings);
    let moving = moving.map(|(sighting, between)| turned[sighting.drive].moving(&sighting.map, *between));
    let moving: Vec<Moving> = moving.collect();
    // The scale of a residual against a station needs the station's place now: the median of its sightings.
    let places = sightings.iter().zip(&moving).map(|(sighting, moving)| moving.place.dot(&sighting.normal));
    let places: Vec<f64> = places.collect();
    let residuals = residuals(&places, sightings.iter().map(|sighting| sighting.across), stations);
    for (((sighting, moving), place), residual) in sightings.iter().zip(&moving).zip(places).zip(residuals) {
        let mut row = moving.row_along(layout.first(sighting.drive), &sighting.normal);
        let value = match sighting.across {
            Target::Fixed(target) => target - place,
            Target::Station(station) => {
                row.push(layout.stations + station, -1.0);
                -place
            }
        };
        let weight = robust_weight(residual, scales.lanes_m) / sighting.lateral_variance_m2;
        equations.add(row.entries(), value, weight);
    }
    let Some(step) = equations.solve(elimination) else { return };
    for (correction, chain) in corrections.iter_mut().zip(&layout.chains) {
        for (knot, step) in correction.knots.iter_mut().zip(step[chain.first..].chunks_exact(3)) {
            knot.shared.x += step[0];
            knot.shared.y += step[1];
            knot.yaw_rad += step[2];
        }
    }
}

fn add_odometry(equations: &mut impl Equations, first: usize, drive: &Restraints, correction: &Correction) {
    let scale = first + 3 * correction.knots.len() + 2;
    let turning = scale + 1;
    for (index, (pair, step)) in correction.knots.windows(2).zip(&drive.steps).enumerate() {
        let (before, after) = (first + 3 * index, first + 3 * (index + 1));
        let predicted = pair[0].apply(&pair[1].map);
        let residual = (pair[1].shared - predicted).xy();
        let by_yaw = pair[0].by_yaw(&pair[1].map);
        let by_scale = (predicted - pair[0].shared).xy();
        let weight = 1.0 / step.position_m2;
        for (axis, residual, by_yaw, by_scale) in
            [(0, residual.x, by_yaw.x, by_scale.x), (1, residual.y, by_yaw.y, by_scale.y)]
        {
            let row = [(after + axis, 1.0), (before + axis, -1.0), (before + 2, -by_yaw), (scale, -by_scale)];
            equations.add(&row, -residual, weight);
        }
        let turn = pair[1].yaw_rad - pair[0].yaw_rad;
        let way_m = pair[1].arc_m - pair[0].arc_m;
        equations.add(&[(after + 2, 1.0), (before + 2, -1.0), (turning, -way_m)], -turn, 1.0 / step.yaw_rad2);
    }
    equations.add(&[(scale, 1.0)], 0.0, drive.drift_sigma.scale.powi(-2));
    equations.add(&[(turning, 1.0)], 0.0, drive.drift_sigma.turn_rad_per_m.powi(-2));
}

fn add_fixes(
    equations: &mut impl Equations,
    first: usize,
    drive: &Restraints,
    turned: &Turned<'_>,
    located: &[Between],
    robust_scale_m: f64,
) {
    if drive.fixes.is_empty() {
        return;
    }
    let bias = first + 3 * turned.correction.knots.len();
    let moving = drive.fixes.iter().zip(located).map(|(fix, between)| turned.moving(&fix.map, *between));
    let moving: Vec<Moving> = moving.collect();
    let offsets: Vec<Vector2<f64>> =
        drive.fixes.iter().zip(&moving).map(|(fix, moving)| fix.shared.coords.xy() - moving.place).collect();
    let common = median(&offsets);
    for ((fix, moving), offset) in drive.fixes.iter().zip(&moving).zip(&offsets) {
        let [sigma_m, _] = fix.sigma_m;
        let weight = robust_weight((offset - common).norm(), robust_scale_m) / (sigma_m * sigma_m);
        for (axis, bias, value) in [(Vector2::x(), bias, offset.x), (Vector2::y(), bias + 1, offset.y)] {
            let mut row = moving.row_along(first, &axis);
            row.push(bias, 1.0);
            equations.add(row.entries(), value, weight);
        }
    }
    for unknown in [bias, bias + 1] {
        equations.add(&[(unknown, 1.0)], 0.0, drive.bias_sigma_m[0].powi(-2));
    }
}

/// The median of each coordinate.
fn median(offsets: &[Vector2<f64>]) -> Vector2<f64> {
    let of = |axis: usize| {
        let mut values: Vec<f64> = offsets.iter().map(|offset| offset[axis]).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    Vector2::new(of(0), of(1))
}

/// How far each sighting lies from its target; from the median of its station, where that is unknown.
fn residuals(places: &[f64], targets: impl Iterator<Item = Target> + Clone, stations: usize) -> Vec<f64> {
    let mut at_station: Vec<Vec<f64>> = vec![Vec::new(); stations];
    for (place, target) in places.iter().zip(targets.clone()) {
        if let Target::Station(station) = target {
            at_station[station].push(*place);
        }
    }
    let middle = at_station.iter_mut().map(|places| {
        places.sort_by(f64::total_cmp);
        match places.len() {
            0 => 0.0,
            count => 0.5 * (places[(count - 1) / 2] + places[count / 2]),
        }
    });
    let middle: Vec<f64> = middle.collect();
    let residual = |(place, target): (&f64, Target)| match target {
        Target::Fixed(target) => place - target,
        Target::Station(station) => place - middle[station],
    };
    places.iter().zip(targets).map(residual).collect()
}

fn align_heights(problem: &Problem<'_>, corrections: &mut [Correction], elimination: &mut Elimination) {
    let Problem { drives, sightings, located, stations, scales } = *problem;
    let layout = Layout::new(corrections, 1, 1, stations);
    let mut equations = layout.equations();
    for (index, (drive, correction)) in drives.iter().zip(corrections.iter()).enumerate() {
        let first = layout.first(index);
        for (knot, (pair, step)) in correction.knots.windows(2).zip(&drive.steps).enumerate() {
            let residual = (pair[1].shared.z - pair[0].shared.z) - (pair[1].map.z - pair[0].map.z);
            equations.add(&[(first + knot + 1, 1.0), (first + knot, -1.0)], -residual, 1.0 / step.height_m2);
        }
        add_fixed_heights(&mut equations, first, drive, correction, &located.fixes[index]);
    }
    let places = sightings.iter().zip(&located.sightings);
    let places = places.map(|(sighting, between)| height(&corrections[sighting.drive], sighting.map.z, *between));
    let places: Vec<f64> = places.collect();
    let residuals = residuals(&places, sightings.iter().map(|sighting| sighting.height), stations);
    let seen = sightings.iter().zip(&located.sightings).zip(&places).zip(residuals);
    for (((sighting, between), place), residual) in seen {
        let mut row = row_of_height(layout.first(sighting.drive), *between);
        let value = match sighting.height {
            Target::Fixed(target) => target - place,
            Target::Station(station) => {
                row.push(layout.stations + station, -1.0);
                -place
            }
        };
        let weight = robust_weight(residual, 2.0 * scales.lanes_m) / sighting.height_variance_m2;
        equations.add(row.entries(), value, weight);
    }
    let Some(step) = equations.solve(elimination) else { return };
    for (correction, chain) in corrections.iter_mut().zip(&layout.chains) {
        for (knot, step) in correction.knots.iter_mut().zip(&step[chain.first..]) {
            knot.shared.z += step;
        }
    }
}

/// Height under a correction: turns are about the vertical.
fn height(correction: &Correction, map_z: f64, (knot, weight): Between) -> f64 {
    let at = |knot: usize| correction.knots[knot].shared.z + (map_z - correction.knots[knot].map.z);
    let before = at(knot);
    if weight == 0.0 { before } else { before + (at(knot + 1) - before) * weight }
}

fn row_of_height(first: usize, (knot, weight): Between) -> Row {
    let mut row = Row::default();
    row.push(first + knot, 1.0 - weight);
    if weight > 0.0 {
        row.push(first + knot + 1, weight);
    }
    row
}

fn add_fixed_heights(
    equations: &mut impl Equations,
    first: usize,
    drive: &Restraints,
    correction: &Correction,
    located: &[Between],
) {
    if drive.fixes.is_empty() {
        return;
    }
    let bias = first + correction.knots.len();
    for (fix, between) in drive.fixes.iter().zip(located) {
        let [_, sigma_m] = fix.sigma_m;
        let mut row = row_of_height(first, *between);
        row.push(bias, 1.0);
        let offset = fix.shared.z - height(correction, fix.map.z, *between);
        equations.add(row.entries(), offset, 1.0 / (sigma_m * sigma_m));
    }
    equations.add(&[(bias, 1.0)], 0.0, drive.bias_sigma_m[1].powi(-2));
}
