//! Two lanes of the map that are one line of the road: found by their distance, told from a double line by who sees them.
//!
//! Ours; the authors delete the shorter of two lanes that overlap within 1.75 m, at the end of the drive,
//! so that real neighbours die. Here a younger lane that runs along an older one is its duplicate only if the detector
//! shows one *or* the other: frames that show one alone speak for it, and frames that show both speak against it, twice as much.
//! A young lane may be a ghost beside the older one: until it is established, frames that show both count only once the
//! two were suspected. Of an established one misses come in bursts, and at its ends it cannot be seen: only frames count that
//! could have shown it, and two that were seen together for long are two, unless they lie in one place.
//! The younger lane's information is added to the older one; nothing is deleted.
//! Not guaranteed: two lines of which the detector mostly shows one are taken for one.

use super::{Landmark, foot_walk::FootWalk, information::Knot};
use crate::{lane_map::LaneId, params::LandmarkParams};

/// Share of the younger lane that must lie along the older one.
const LEAST_SHARE: f64 = 0.7;
/// Greatest mean distance of the two, metres.
const GREATEST_DISTANCE_M: f64 = 0.6;
/// Frames that must speak for a duplicate, net of those against.
const VERDICT: i32 = 3;
/// Bound on the frames against: one of a pair is missed for seconds on end.
const MOST_AGAINST: i32 = -60;
/// The same of two in one place: a detector that shows a line twice for a while does not make it two.
const MOST_AGAINST_ONE_PLACE: i32 = -6;
/// Mean distance below which two lanes lie in one place, metres.
const ONE_PLACE_M: f64 = 0.15;
/// Frames that must have seen a lane for it to be established.
const ESTABLISHED: u32 = 20;
/// Least chance of being seen at which it says something that an established lane is not.
const LEAST_CHANCE: f64 = 0.5;

/// Mean distance of two lanes, metres, where the part of one near `young_near` runs along `old`, so that the two may be one.
#[must_use]
pub fn run_together(
    young: &Landmark,
    young_near: (Knot, Knot),
    old: &Landmark,
    old_near: (Knot, Knot),
    params: &LandmarkParams,
) -> Option<f64> {
    let (share, distance_m) = overlap(young, young_near, old, old_near, params)?;
    (share > LEAST_SHARE && distance_m < GREATEST_DISTANCE_M).then_some(distance_m)
}

/// Share of the control points near `young_near` that lie along `old`, and their mean distance, metres.
fn overlap(
    young: &Landmark,
    young_near: (Knot, Knot),
    old: &Landmark,
    old_near: (Knot, Knot),
    params: &LandmarkParams,
) -> Option<(f64, f64)> {
    let curve = old.curve(params.ends)?;
    let mut walk = FootWalk::new(old, &curve, old_near, params);
    let (from, to) = (young.index_of(young_near.0), young.index_of(young_near.1));
    let (mut along, mut sum) = (0u32, 0.0);
    for index in from..=to {
        if let Some(foot) = walk.foot_point(&young.positions()[index]) {
            along += 1;
            sum += foot.distance_m;
        }
    }
    (along > 0).then(|| (f64::from(along) / (to - from + 1) as f64, sum / f64::from(along)))
}

/// Whether a frame says something of two lanes that may be one; `unseen` is the chance of seeing the one that it does not show.
#[must_use]
pub fn is_telling(young: &Landmark, old: LaneId, unseen: Option<f64>) -> bool {
    let is_established = young.observations >= ESTABLISHED;
    match unseen {
        Some(chance) => !is_established || chance >= LEAST_CHANCE,
        None => is_established || young.rival.is_some_and(|(rival, _)| rival == old),
    }
}

/// Counts one frame for or against two lanes, so far from each other, being one; whether the verdict is reached.
pub fn judge(young: &mut Landmark, old: LaneId, both_seen: bool, distance_m: f64) -> bool {
    let count = match young.rival {
        Some((lane, count)) if lane == old => count,
        _ => 0,
    };
    let most_against = if distance_m < ONE_PLACE_M { MOST_AGAINST_ONE_PLACE } else { MOST_AGAINST };
    let count = if both_seen { (count - 2).max(most_against) } else { count + 1 };
    young.rival = Some((old, count));
    count >= VERDICT
}
