//! What truly happened to a simulated road, and which drives could tell.
//!
//! A place of a change is asked for where at least [`LEAST_DRIVES`] drives passed it before and as many since, with it beside
//! their way, at most [`IN_VIEW_M`] to the side: farther out the simulated detector misses most of what is there. Where a line
//! moved, the ends at which it leaves its old course, by less than [`LEAST_MOVE_M`], are not asked for.

use lanemap_core::{Category, TimestampNs, evaluation::TrueChange};
use lanemap_simulator::fleet::{ChangeKind, Fleet, RoadChange};
use nalgebra::Point3;

/// Drives that must have passed a place before the change, and since.
const LEAST_DRIVES: usize = 3;
/// Farthest place to the side of a way that its drive could tell of, metres.
const IN_VIEW_M: f64 = 10.0;
/// Least distance by which a line moved, where that is asked for, metres.
const LEAST_MOVE_M: f64 = 0.5;

/// The way of one drive.
pub struct Way {
    start: TimestampNs,
    places: Vec<Point3<f64>>,
}

/// A change, with who had its places in view.
pub struct SeenChange {
    time: TimestampNs,
    went: Vec<SeenPlace>,
    came: Vec<SeenPlace>,
    repainted: Vec<SeenPlace>,
    /// What the repainted places are now.
    category: Category,
}

struct SeenPlace {
    place: Point3<f64>,
    /// Starts of the drives that had it in view.
    in_view: Vec<TimestampNs>,
    /// Whether the line really changed here.
    changed: bool,
}

/// The true ways of a fleet, a place every few frames.
pub fn ways(fleet: &Fleet) -> Vec<Way> {
    const STRIDE: usize = 8;
    let way = fleet.drives().map(|drive| {
        let states = drive.states().iter().step_by(STRIDE);
        let places = states.map(|state| state.world_from_vehicle.translation.vector.into()).collect();
        Way { start: drive.start(), places }
    });
    way.collect()
}

impl SeenChange {
    pub fn new(change: &RoadChange, ways: &[Way]) -> Self {
        let seen = |line: &[Point3<f64>], other: &[Point3<f64>]| {
            let seen = line.iter().map(|place| SeenPlace {
                place: *place,
                in_view: ways.iter().filter(|way| way.has_in_view(place)).map(|way| way.start).collect(),
                changed: other.iter().all(|other| (other - place).xy().norm() >= LEAST_MOVE_M),
            });
            seen.collect()
        };
        let time = change.time;
        match change.kind {
            ChangeKind::Repainted { to, .. } => {
                Self { time, went: Vec::new(), came: Vec::new(), repainted: seen(&change.after, &[]), category: to }
            }
            _ => Self {
                time,
                went: seen(&change.before, &change.after),
                came: seen(&change.after, &change.before),
                repainted: Vec::new(),
                category: Category::Unknown,
            },
        }
    }

    /// The change as the drives up to `over` could tell it: what is asked for, and the rest. `None` if it is still to come.
    pub fn told_until(&self, over: TimestampNs) -> Option<[TrueChange; 2]> {
        let is_asked = |seen: &&SeenPlace| {
            let drives = || seen.in_view.iter().filter(|start| **start <= over);
            let before = drives().filter(|start| **start < self.time).count();
            seen.changed && before >= LEAST_DRIVES && drives().count() - before >= LEAST_DRIVES
        };
        let part = |asked: bool| {
            let of = |places: &[SeenPlace]| {
                places.iter().filter(|seen| is_asked(seen) == asked).map(|seen| seen.place).collect::<Vec<_>>()
            };
            let all = self.went.iter().chain(&self.came).chain(&self.repainted).filter(|seen| is_asked(seen) == asked);
            let all: Vec<&SeenPlace> = all.collect();
            let in_view = all.get(all.len() / 2).map_or_else(Vec::new, |middle| middle.in_view.clone());
            let repainted = (of(&self.repainted), self.category);
            TrueChange { time: self.time, went: of(&self.went), came: of(&self.came), repainted, in_view, asked }
        };
        (self.time < over).then(|| [part(true), part(false)])
    }
}

impl Way {
    /// Whether a place lies beside the way, not farther than can be seen.
    fn has_in_view(&self, place: &Point3<f64>) -> bool {
        self.places.windows(2).any(|pair| {
            let along = (pair[1] - pair[0]).xy();
            let offset = (place - pair[0]).xy();
            let share = offset.dot(&along) / along.norm_squared().max(1e-9);
            // Over a little more than the step: beside a bend no place is left out.
            (-0.2..=1.2).contains(&share) && (offset - along * share).norm() <= IN_VIEW_M
        })
    }
}

#[cfg(test)]
mod tests {
    use lanemap_simulator::{
        Seed,
        fleet::{ChangePlan, FleetRoutes, FleetScenario},
    };

    use super::*;

    #[test]
    fn a_change_is_asked_for_once_three_drives_passed_it_since_and_not_beyond_where_they_went() {
        let changes =
            ChangePlan { vanished: 1, appeared: 0, moved: 0, repainted: 0, zones: 0, ..ChangePlan::some(4, 4) };
        let routes = FleetRoutes::Shared { length_m: 1_000.0, both_directions: false };
        let fleet = FleetScenario { drives: 10, changes, routes, ..FleetScenario::straight_road() }.fleet(Seed(3));
        let ways = ways(&fleet);
        let change = SeenChange::new(&fleet.changes()[0], &ways);
        assert!(change.told_until(fleet.start_of(3)).is_none());
        let [asked, rest] = change.told_until(fleet.start_of(5)).unwrap();
        assert!(asked.went.is_empty() && !rest.went.is_empty() && !rest.asked);
        let [asked, rest] = change.told_until(fleet.start_of(9)).unwrap();
        assert_eq!(asked.went.len() + rest.went.len(), fleet.changes()[0].before.len());
        let beyond = |place: &&Point3<f64>| ways.iter().filter(|way| way.has_in_view(place)).count() < 6;
        assert_eq!(asked.went.iter().filter(beyond).count(), 0);
    }
}
