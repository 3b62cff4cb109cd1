//! Meetings: what speaks against laying a drive where those drove that it meets.
//!
//! A place of its way, moved by `m` to the left, is as likely as
//!
//! `log L(m) = share * log(e) * exp(-(m - x)^2 / 2 s^2)`,
//!
//! where `x` is the move that lays it on the way of a drive of the other direction, unless one of its own direction went there,
//! too: a road of one lane is used both ways. A stretch of way of one window is one witness.

use nalgebra::Vector2;

use crate::fleet::{
    correction::Correction,
    prepared::PreparedPass,
    ways::{WAY_STEP_M, WayPoint, Ways},
};

/// Likelihood of driving where others come from ahead, of one witness.
const ONCOMING: f64 = 0.05;
/// Scatter of ways about the middle of their lane, metres.
const SCATTER_M: f64 = 0.7;
/// Distance within which ways are of one lane, metres.
const ONE_LANE_M: f64 = 1.2;
/// Least cosine of the angle between ways along one road.
const LEAST_COSINE: f64 = 0.9;
/// Distance in height of another level of the road, metres.
const LEVEL_M: f64 = 8.0;

/// A place of a drive's way, with the ways of others beside it.
#[derive(Clone)]
pub(super) struct Meeting {
    pub(super) arc_m: f64,
    /// To the left of travel, shared frame.
    pub(super) normal: Vector2<f64>,
    /// Moves to the left onto ways of its own direction, metres.
    along: Vec<f64>,
    /// Onto ways of the other direction.
    against: Vec<f64>,
}

/// The places of a pass at which drives of the other direction went by.
pub(super) fn meetings(pass: &PreparedPass<'_>, correction: &Correction, ways: &Ways, reach_m: f64) -> Vec<Meeting> {
    let places = WayPoint::along(pass.way, correction).map(|(arc_m, own)| {
        let normal = own.normal();
        let mut meeting = Meeting { arc_m, normal, along: Vec::new(), against: Vec::new() };
        for other in ways.near(&own.place, reach_m + WAY_STEP_M) {
            let offset = other.place - own.place;
            let cosine = other.direction.dot(&own.direction);
            let beside = offset.xy().dot(&own.direction).abs() <= WAY_STEP_M && offset.z.abs() < LEVEL_M;
            if beside && cosine.abs() > LEAST_COSINE {
                let moves = if cosine > 0.0 { &mut meeting.along } else { &mut meeting.against };
                moves.push(offset.xy().dot(&normal));
            }
        }
        meeting
    });
    places.filter(|meeting| !meeting.against.is_empty()).collect()
}

impl Meeting {
    /// Log-likelihood of the way that is moved to the left, as a share of a witness of `witness_m` of way.
    pub(super) fn support(&self, move_m: f64, witness_m: f64) -> f64 {
        let nearest = |moves: &[f64]| moves.iter().map(|at| (move_m - at).abs()).fold(f64::INFINITY, f64::min);
        let (along_m, against_m) = (nearest(&self.along), nearest(&self.against));
        if along_m < ONE_LANE_M.min(against_m) {
            return 0.0;
        }
        let ratio = against_m / SCATTER_M;
        WAY_STEP_M / witness_m * ONCOMING.ln() * (-0.5 * ratio * ratio).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn meeting(along: &[f64], against: &[f64]) -> Meeting {
        Meeting { arc_m: 0.0, normal: Vector2::y(), along: along.to_vec(), against: against.to_vec() }
    }

    #[test]
    fn the_way_of_those_that_come_from_ahead_is_unlikely_and_that_beside_it_is_not() {
        let meeting = meeting(&[0.2], &[3.6]);
        assert!(meeting.support(3.5, 60.0) < -0.5);
        assert!(meeting.support(0.0, 60.0) > -1e-3);
        assert!(meeting.support(7.0, 60.0) > -1e-3);
    }

    #[test]
    fn a_lane_that_is_used_both_ways_may_be_driven_both_ways() {
        assert!(meeting(&[0.3], &[0.4]).support(0.0, 60.0).abs() < 1e-12);
        assert!(meeting(&[], &[0.4]).support(0.4, 60.0) < -0.5);
    }
}
