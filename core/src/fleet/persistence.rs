//! Persistence: whether a stretch of line is there, from the drives that saw it, that missed it, and that could not see it.
//!
//! A two-state filter per knot, after Rosen, Mason and Leonard, *Towards Lifelong Feature-Based Mapping in Semi-Static
//! Environments* (ICRA 2016), with a constant hazard per drive in place of their survival prior. With `p` the
//! probability that the paint is there, each drive in the order of time first lets it come or go, `p <- p (1 - h) + (1 - p) b`, and
//! then speaks: `odds(p) *= P(what it says | there) / P(what it says | not there)`. A drive that did not have the knot
//! in view says nothing.
//!
//! A drive has a knot in view if its camera was within range and angle of it, unhidden, at [`LEAST_VIEWS`] places of its way.

use nalgebra::{Point3, Vector3};

use serde::{Deserialize, Serialize};

use super::{contribution::DriveId, correction::Correction, line::Lines, prepared::PreparedPass};
use crate::{frame::TimestampNs, sensor::Sensor};

/// What a drive says of a knot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Evidence {
    /// It has it among its lanes.
    Seen,
    /// It had it in view, and has no such lane.
    Missed,
}

/// Probability that a line that is there is among a drive's lanes, near the vehicle's own lane.
const SEEN_NEAR: f64 = 0.9;
/// The same farther to the side.
const SEEN_FAR: f64 = 0.65;
/// Probability that a drive has a lane where there is none.
const SEEN_GHOST: f64 = 0.05;
/// Probability that a line goes, and that one comes, between two drives.
const HAZARD: f64 = 0.01;
/// Probability from which on a knot is believed to be there.
const STANDS: f64 = 0.75;
/// Probability below which it is believed to be gone.
const GONE: f64 = 0.5;
/// Passes that must have missed a knot before it can be said to have come.
const LEAST_MISSED: u32 = 2;
/// Distance to the side from which a line counts as far, metres.
const FAR_M: f64 = 6.0;
/// Nearest and farthest place ahead at which a line is expected to be seen, metres.
const AHEAD_M: std::ops::Range<f64> = 5.0..35.0;
/// Farthest place to the side at which a line is expected to be seen, metres.
const SIDE_M: f64 = 13.0;
/// Places of the way from which a knot must be in view.
pub(super) const LEAST_VIEWS: u16 = 3;

/// How one drive had each knot in view.
#[derive(Clone, Debug)]
pub(super) struct Views {
    /// Per line and knot: from how many places, and the least distance to the side.
    pub(super) of: Vec<Vec<(u16, f32)>>,
}

/// Who says something of a knot, and when: a drive and its start.
pub(super) type Speaker = (TimestampNs, DriveId);

/// Belief that a knot is there, and what became of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Belief {
    pub(super) probability: f64,
    /// Passes that saw it.
    seen: u32,
    /// Passes that missed it since.
    missed: u32,
    /// Passes that missed it before any saw it.
    missed_before: u32,
    /// Whether it was believed to be there, and not since to be gone.
    stands: bool,
    /// Start of the last drive that saw it.
    pub(super) confirmed: Option<TimestampNs>,
    /// The last change, and the drive that made it believed.
    pub(super) change: Option<(Turn, Speaker)>,
}

/// What becomes of a knot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Turn {
    /// It is there, where it was not.
    Came,
    /// It is there no more.
    Went,
}

impl Default for Belief {
    /// Before any drive.
    fn default() -> Self {
        Self { probability: 0.5, seen: 0, missed: 0, missed_before: 0, stands: false, confirmed: None, change: None }
    }
}

impl Belief {
    /// Takes what the next drive says.
    pub(super) fn hear(&mut self, evidence: Evidence, to_the_side_m: f64, speaker: Speaker) {
        let coming = self.probability * (1.0 - HAZARD) + (1.0 - self.probability) * HAZARD;
        let seen = self.chance_of_sight(if to_the_side_m < FAR_M { SEEN_NEAR } else { SEEN_FAR });
        let (there, not_there) = match evidence {
            Evidence::Seen => (seen, SEEN_GHOST),
            Evidence::Missed => (1.0 - seen, 1.0 - SEEN_GHOST),
        };
        self.probability = coming * there / (coming * there + (1.0 - coming) * not_there);
        match evidence {
            Evidence::Seen => {
                self.seen += 1;
                self.confirmed = Some(speaker.0);
            }
            Evidence::Missed if self.seen == 0 => self.missed_before += 1,
            Evidence::Missed => self.missed += 1,
        }
        self.turn(speaker);
    }

    /// Probability that a pass sees it if it is there: by how often it was seen, once several have. A worn line, or one
    /// across the oncoming lane, is missed often by all.
    fn chance_of_sight(&self, usual: f64) -> f64 {
        const KNOWN: u32 = 3;
        const WEIGHT: f64 = 4.0;
        if self.seen < KNOWN {
            return usual;
        }
        let passes = f64::from(self.seen + self.missed);
        ((f64::from(self.seen) + WEIGHT * usual) / (passes + WEIGHT)).clamp(0.25, 0.97)
    }

    /// Notes a change, once it is believed. That a line is there is none where nobody passed before.
    fn turn(&mut self, speaker: Speaker) {
        if !self.stands && self.probability >= STANDS {
            self.stands = true;
            let was_missing = self.missed_before >= LEAST_MISSED || self.change.is_some();
            self.change = was_missing.then_some((Turn::Came, speaker));
        } else if self.stands && self.probability < GONE {
            self.stands = false;
            // What one drive saw was not believed by others: it was never there.
            self.change = (self.seen > 1).then_some((Turn::Went, speaker));
        }
    }
}

/// Which knots a pass had in view.
pub(super) fn views(pass: &PreparedPass<'_>, sensor: &Sensor, correction: &Correction, lines: &Lines) -> Views {
    let mut of: Vec<Vec<(u16, f32)>> = lines.lines.iter().map(|line| vec![(0, f32::MAX); line.points.len()]).collect();
    for point in pass.way {
        let place = correction.apply(&point.position, point.arc_m);
        let (sin, cos) = (point.yaw_rad + correction.yaw_rad(point.arc_m)).sin_cos();
        let middle = place + Vector3::new(cos, sin, 0.0) * (0.5 * (AHEAD_M.start + AHEAD_M.end));
        lines.for_each_knot_near(&middle, 20.0, |line, knot, at: &Point3<f64>| {
            let offset = at - place;
            let ahead = cos * offset.x + sin * offset.y;
            let left = -sin * offset.x + cos * offset.y;
            if !AHEAD_M.contains(&ahead) || left.abs() > SIDE_M || offset.z.abs() > 3.0 {
                return;
            }
            if sensor.sees(&Point3::new(ahead, left, offset.z)) && !point.hides(ahead, left, sensor) {
                let (views, side_m) = &mut of[line][knot];
                *views += 1;
                #[expect(clippy::cast_possible_truncation, reason = "metres to the side")]
                let left_m = left.abs() as f32;
                *side_m = side_m.min(left_m);
            }
        });
    }
    Views { of }
}

#[cfg(test)]
mod tests {
    use super::*;

    use Evidence::{Missed, Seen};

    fn after(evidence: &[Evidence]) -> Belief {
        let mut belief = Belief::default();
        for (number, evidence) in (0..).zip(evidence) {
            belief.hear(*evidence, 2.0, (TimestampNs(number), DriveId(0)));
        }
        belief
    }

    #[test]
    fn one_drive_suffices_until_others_miss_what_it_saw() {
        assert!(after(&[Seen]).probability > 0.9);
        assert!(after(&[Seen, Missed, Missed]).probability < 0.5);
        assert!(after(&[Seen, Seen, Missed, Seen]).probability > 0.9);
        assert_eq!(after(&[Seen, Missed, Missed]).change, None, "a ghost is no change");
    }

    #[test]
    fn a_line_that_goes_is_given_up_within_three_drives_and_one_that_comes_is_noticed_within_two() {
        let mut drives = vec![Seen; 30];
        drives.extend([Missed; 3]);
        let (turn, (when, _)) = after(&drives).change.unwrap();
        assert!(turn == Turn::Went && when.0 < 33);
        let mut drives = vec![Missed; 10];
        drives.extend([Seen; 2]);
        let (turn, (when, _)) = after(&drives).change.unwrap();
        assert!(turn == Turn::Came && when.0 < 12);
        assert_eq!(after(&[Seen; 5]).change, None);
    }
}
