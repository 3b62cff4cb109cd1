//! Two lanes of the map that are one line of the road: found by their distance, told from a double line by who sees them.
//!
//! Ours; the authors delete the shorter of two lanes that overlap within 1.75 m, at the end of the drive,
//! so that real neighbours die. Here a younger lane that runs along an older one is its duplicate only if the detector
//! shows one *or* the other: frames that show one alone speak for it, frames that show both speak against it. The younger
//! lane's information is added to the older one; nothing is deleted.

use super::{Landmark, foot_walk::FootWalk, information::Knot};
use crate::{lane_map::LaneId, params::LandmarkParams};

/// Share of the younger lane that must lie along the older one.
const LEAST_SHARE: f64 = 0.7;
/// Greatest mean distance of the two, metres.
const GREATEST_DISTANCE_M: f64 = 0.6;
/// Frames that must speak for a duplicate, net of those against.
const VERDICT: i32 = 3;
/// Bound on the frames against, so that a real pair may later be seen to be one.
const MOST_AGAINST: i32 = -6;

/// Whether the part of a lane near `young_near` runs along `old`, so that the two may be one.
#[must_use]
pub fn run_together(
    young: &Landmark,
    young_near: (Knot, Knot),
    old: &Landmark,
    old_near: (Knot, Knot),
    params: &LandmarkParams,
) -> bool {
    overlap(young, young_near, old, old_near, params)
        .is_some_and(|(share, distance_m)| share > LEAST_SHARE && distance_m < GREATEST_DISTANCE_M)
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

/// Counts one frame for or against two lanes being one; whether the verdict is reached.
pub fn judge(young: &mut Landmark, old: LaneId, both_seen: bool) -> bool {
    let count = match young.rival {
        Some((lane, count)) if lane == old => count,
        _ => 0,
    };
    let count = if both_seen { (count - 2).max(MOST_AGAINST) } else { count + 1 };
    young.rival = Some((old, count));
    count >= VERDICT
}
