//! The smooth correction of a drive: from its own map frame to the shared one, 4 degrees of freedom that change along
//! the way.
//!
//! At knots `k` along the trajectory lie the rigid transforms `T_k(p) = c'_k + R_z(psi_k) (p - c_k)`: `c_k` is the place of the
//! knot in the drive's frame, `c'_k` in the shared one, `psi_k` the turn between the two. A point that was seen from arc
//! length `s` between knots `k` and `k + 1` goes to `(1 - w) T_k(p) + w T_{k+1}(p)`, `w = (s - s_k) / (s_{k+1} - s_k)`:
//! linear in `c'`, continuous, and rigid where the two knots agree.

use nalgebra::{Point3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::{contribution::TrajectoryPoint, params::FleetParams};

/// One knot of a correction.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CorrectionKnot {
    /// Way from the start of the drive, metres.
    pub arc_m: f64,
    /// Place on the trajectory, map frame of the drive, metres.
    pub map: Point3<f64>,
    /// The same place in the shared frame, metres.
    pub shared: Point3<f64>,
    /// Turn about the vertical from the drive's frame to the shared one, radians.
    pub yaw_rad: f64,
}

/// The correction of one drive; at least one knot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Correction {
    pub(super) knots: Vec<CorrectionKnot>,
}

impl CorrectionKnot {
    /// `T_k(p)`.
    #[must_use]
    pub fn apply(&self, point_map: &Point3<f64>) -> Point3<f64> {
        self.shared + turned(&(point_map - self.map), self.yaw_rad.sin_cos())
    }

    /// Derivative of `T_k(p)` by `psi_k`, horizontally.
    pub(super) fn by_yaw(&self, point_map: &Point3<f64>) -> Vector2<f64> {
        let offset = point_map - self.map;
        let (sin, cos) = self.yaw_rad.sin_cos();
        Vector2::new(-sin * offset.x - cos * offset.y, cos * offset.x - sin * offset.y)
    }
}

impl Correction {
    /// The correction that puts the frame of a drive into the shared one as a whole, turned by `yaw_rad`.
    pub(super) fn rigid(
        trajectory: &[TrajectoryPoint],
        yaw_rad: f64,
        shared_from_map: impl Fn(&Point3<f64>) -> Point3<f64>,
        params: &FleetParams,
    ) -> Self {
        let knots = knot_indices(trajectory, params.correction_knot_m).into_iter().map(|index| {
            let point = &trajectory[index];
            CorrectionKnot {
                arc_m: point.arc_m,
                map: point.position,
                shared: shared_from_map(&point.position),
                yaw_rad,
            }
        });
        Self { knots: knots.collect() }
    }

    /// The knots, in the order of travel.
    #[must_use]
    pub fn knots(&self) -> &[CorrectionKnot] {
        &self.knots
    }

    /// Index of the knot before an arc length, and the weight of the one after it.
    pub(super) fn locate(&self, arc_m: f64) -> (usize, f64) {
        let after = self.knots.partition_point(|knot| knot.arc_m <= arc_m);
        if after == 0 {
            return (0, 0.0);
        }
        if after == self.knots.len() {
            return (after - 1, 0.0);
        }
        let (before, next) = (&self.knots[after - 1], &self.knots[after]);
        (after - 1, (arc_m - before.arc_m) / (next.arc_m - before.arc_m))
    }

    /// A point (map frame of the drive, metres) that was seen from an arc length of the way, in the shared frame.
    #[must_use]
    pub fn apply(&self, point_map: &Point3<f64>, arc_m: f64) -> Point3<f64> {
        let (knot, weight) = self.locate(arc_m);
        let before = self.knots[knot].apply(point_map);
        if weight == 0.0 {
            return before;
        }
        before + (self.knots[knot + 1].apply(point_map) - before) * weight
    }

    /// A direction in the drive's frame at an arc length, in the shared one.
    pub(super) fn turn(&self, direction: &Vector3<f64>, arc_m: f64) -> Vector3<f64> {
        turned(direction, self.yaw_rad(arc_m).sin_cos())
    }

    /// Turn from the drive's frame to the shared one at an arc length, radians.
    #[must_use]
    pub fn yaw_rad(&self, arc_m: f64) -> f64 {
        let (knot, weight) = self.locate(arc_m);
        let before = self.knots[knot].yaw_rad;
        if weight == 0.0 { before } else { before + (self.knots[knot + 1].yaw_rad - before) * weight }
    }
}

/// Applies a correction to places one after the other: what is the same between two knots is found once for all of them.
#[derive(Clone, Debug)]
pub(super) struct CorrectionWalk<'a> {
    correction: &'a Correction,
    /// The knot before, and the sine and cosine of its turn and of that of the next.
    knot: usize,
    turns: [(f64, f64); 2],
}

impl<'a> CorrectionWalk<'a> {
    pub(super) fn new(correction: &'a Correction) -> Self {
        Self { correction, knot: 0, turns: Self::turns(correction, 0) }
    }

    fn turns(correction: &Correction, knot: usize) -> [(f64, f64); 2] {
        let next = (knot + 1).min(correction.knots.len() - 1);
        [knot, next].map(|knot| correction.knots[knot].yaw_rad.sin_cos())
    }

    /// Goes to the knot before an arc length.
    fn go_to(&mut self, arc_m: f64) {
        let knots = &self.correction.knots;
        let holds = |knot: usize| {
            (knot == 0 || knots[knot].arc_m <= arc_m) && (knot + 1 == knots.len() || arc_m < knots[knot + 1].arc_m)
        };
        if !holds(self.knot) {
            (self.knot, _) = self.correction.locate(arc_m);
            self.turns = Self::turns(self.correction, self.knot);
        }
    }

    /// As [`Correction::apply`].
    pub(super) fn place(&mut self, point_map: &Point3<f64>, arc_m: f64) -> Point3<f64> {
        self.go_to(arc_m);
        let knots = &self.correction.knots;
        let at = |knot: &CorrectionKnot, turn: (f64, f64)| knot.shared + turned(&(point_map - knot.map), turn);
        let before = &knots[self.knot];
        let place = at(before, self.turns[0]);
        match knots.get(self.knot + 1) {
            Some(next) if arc_m > before.arc_m => {
                let share = (arc_m - before.arc_m) / (next.arc_m - before.arc_m);
                place + (at(next, self.turns[1]) - place) * share
            }
            _ => place,
        }
    }

    /// As [`Correction::apply`], and the direction in the shared frame, of length 1 to within the change of turn between two knots.
    pub(super) fn apply(
        &mut self,
        point_map: &Point3<f64>,
        direction: &Vector3<f64>,
        arc_m: f64,
    ) -> (Point3<f64>, Vector3<f64>) {
        self.go_to(arc_m);
        let knots = &self.correction.knots;
        let at = |knot: &CorrectionKnot, turn: (f64, f64)| {
            (knot.shared + turned(&(point_map - knot.map), turn), turned(direction, turn))
        };
        let before = &knots[self.knot];
        let (place, heading) = at(before, self.turns[0]);
        match knots.get(self.knot + 1) {
            Some(next) if arc_m > before.arc_m => {
                let share = (arc_m - before.arc_m) / (next.arc_m - before.arc_m);
                let (next_place, next_heading) = at(next, self.turns[1]);
                (place + (next_place - place) * share, heading + (next_heading - heading) * share)
            }
            _ => (place, heading),
        }
    }
}

/// A direction turned about the vertical.
fn turned(direction: &Vector3<f64>, (sin, cos): (f64, f64)) -> Vector3<f64> {
    Vector3::new(cos * direction.x - sin * direction.y, sin * direction.x + cos * direction.y, direction.z)
}

/// Indices of the trajectory points at which a correction has knots: the first, and one every `spacing_m`.
pub(super) fn knot_indices(trajectory: &[TrajectoryPoint], spacing_m: f64) -> Vec<usize> {
    let mut knots = vec![0];
    for (index, point) in trajectory.iter().enumerate() {
        if point.arc_m - trajectory[knots[knots.len() - 1]].arc_m >= spacing_m {
            knots.push(index);
        }
    }
    knots
}
