//! The ways that a fleet drives: each drive its own, or all along one route.
//!
//! A random way chooses at every junction among the roads that go on, the straighter and the less driven by it before the
//! likelier: `w = exp(-(turn / 1 rad)^2) + 0.25`, divided by `1 + 4 n` after `n` times. Lanes are chosen anew in every
//! link, but where links join without a seam the vehicle stays in its lane; ramps are left and entered by the extra lane.
//! Changes of lane come at random places with room for them.

use std::ops::Range;

use crate::{
    drive::{LaneChange, Leg, Route, route::LANE_CHANGE_M},
    random::{Purpose, Seed, SimRng, choose, happens, uniform},
    road::{LinkIndex, LinkKind, RoadNetwork, reference_line::wrap},
};

/// Where the change into the lane of a ramp is done, metres before the ramp leaves; and the mirror image where it joins.
const RAMP_CHANGE_M: f64 = 60.0;

/// Which ways the drives of a fleet take.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FleetRoutes {
    /// Each drive a way of its own.
    Random {
        /// Length of a drive, metres.
        length_m: f64,
    },
    /// All drives the way of the first, each on lanes of its own.
    Shared {
        /// Length of a drive, metres; shorter where the road ends.
        length_m: f64,
        /// Whether every second drive takes it the other way, where all of it may be driven both ways.
        both_directions: bool,
    },
}

impl FleetRoutes {
    /// Length of a drive, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        match self {
            Self::Random { length_m } | Self::Shared { length_m, .. } => *length_m,
        }
    }

    /// The route of drive `number`, a little longer than asked, so that the last frames have road ahead of them.
    pub(crate) fn route(&self, network: &RoadNetwork, changes_per_km: f64, seed: Seed, number: u32) -> Route {
        let rng = &mut seed.stream(Purpose::Route, number + 1);
        let links = match *self {
            Self::Random { length_m } => random_way(network, length_m + 150.0, rng),
            Self::Shared { length_m, both_directions } => {
                let way = random_way(network, length_m + 150.0, &mut seed.stream(Purpose::Route, 0));
                let reversible = way.iter().all(|(link, _)| network.link(*link).carriageway.is_two_way());
                if both_directions && reversible && number % 2 == 1 { turned_back(&way) } else { way }
            }
        };
        Route { legs: on_lanes(network, &links, changes_per_km, rng) }
    }
}

fn turned_back(way: &[(LinkIndex, bool)]) -> Vec<(LinkIndex, bool)> {
    way.iter().rev().map(|(link, forward)| (*link, !forward)).collect()
}

/// Links and directions of a random way of at least `length_m`, or as far as there is road.
fn random_way(network: &RoadNetwork, length_m: f64, rng: &mut SimRng) -> Vec<(LinkIndex, bool)> {
    let (mut link, mut forward) = start(network, rng);
    let mut times_driven = vec![0_u32; network.links().len()];
    let (mut way, mut driven_m) = (Vec::new(), 0.0);
    loop {
        times_driven[link.0] += 1;
        way.push((link, forward));
        driven_m += network.link(link).reference.length_m();
        if driven_m >= length_m {
            return way;
        }
        match next(network, &way, &times_driven, rng) {
            Some(onward) => (link, forward) = onward,
            None => return way,
        }
    }
}

/// A road that ends is driven from its beginning; elsewhere a way begins on any street.
fn start(network: &RoadNetwork, rng: &mut SimRng) -> (LinkIndex, bool) {
    let streets: Vec<usize> =
        (0..network.links().len()).filter(|index| network.links()[*index].kind == LinkKind::Street).collect();
    if streets.len() < 2 {
        return (LinkIndex(0), true);
    }
    (LinkIndex(streets[choose(rng, streets.len())]), happens(rng, 0.5))
}

/// The links that go on where a link ends, and the direction in which they are driven; never back the same way.
pub(crate) fn onward(network: &RoadNetwork, link: LinkIndex, forward: bool) -> Vec<(LinkIndex, bool)> {
    let here = network.link(link);
    let junction = if forward { here.to } else { here.from };
    let mut found = Vec::new();
    for next in &network.junctions()[junction].links {
        let (road, is_the_same) = (network.link(*next), *next == link);
        if road.from == junction && (forward || !is_the_same) {
            found.push((*next, true));
        }
        if road.to == junction && road.carriageway.is_two_way() && !(forward && is_the_same) {
            found.push((*next, false));
        }
    }
    found
}

fn next(
    network: &RoadNetwork,
    way: &[(LinkIndex, bool)],
    times_driven: &[u32],
    rng: &mut SimRng,
) -> Option<(LinkIndex, bool)> {
    let (link, forward) = *way.last()?;
    let mut exits = onward(network, link, forward);
    exits.retain(|exit| !leaves_a_ring_where_it_came_in(network, way, exit.0));
    exits.retain(|exit| !(joined_here(network, way) && network.link(exit.0).kind == LinkKind::Ramp));
    let arriving_rad = heading_rad(network, link, forward, true);
    let weights: Vec<f64> = exits
        .iter()
        .map(|(next, onward)| {
            let times = f64::from(times_driven[next.0]);
            if network.link(*next).kind == LinkKind::Ring || network.link(link).kind == LinkKind::Ring {
                return 1.0 / (1.0 + times);
            }
            let turn_rad = wrap(heading_rad(network, *next, *onward, false) - arriving_rad);
            ((-turn_rad * turn_rad).exp() + 0.25) / (1.0 + 4.0 * times)
        })
        .collect();
    let mut drawn = uniform(rng, 0.0, weights.iter().sum());
    for (exit, weight) in exits.iter().zip(&weights) {
        drawn -= weight;
        if drawn < 0.0 {
            return Some(*exit);
        }
    }
    exits.last().copied()
}

/// Whether `exit` is the road by which the way came into the roundabout that it is in.
fn leaves_a_ring_where_it_came_in(network: &RoadNetwork, way: &[(LinkIndex, bool)], exit: LinkIndex) -> bool {
    let in_ring = |(link, _): &&(LinkIndex, bool)| network.link(*link).kind == LinkKind::Ring;
    let arcs = way.iter().rev().take_while(in_ring).count();
    arcs > 0 && way.len() > arcs && way[way.len() - arcs - 1].0 == exit
}

/// Whether the last link of the way was entered by a ramp: one does not leave by another at its end.
fn joined_here(network: &RoadNetwork, way: &[(LinkIndex, bool)]) -> bool {
    matches!(way, [.., (before, _), _] if network.link(*before).kind == LinkKind::Ramp)
}

/// Heading of travel at the end (or the start) of a link.
fn heading_rad(network: &RoadNetwork, link: LinkIndex, forward: bool, at_end: bool) -> f64 {
    let headings_rad = network.link(link).reference.headings_rad();
    let index = if forward == at_end { headings_rad.len() - 1 } else { 0 };
    headings_rad[index] + if forward { 0.0 } else { std::f64::consts::PI }
}

/// The lanes on which a way is driven.
fn on_lanes(network: &RoadNetwork, way: &[(LinkIndex, bool)], changes_per_km: f64, rng: &mut SimRng) -> Vec<Leg> {
    let mut legs: Vec<Leg> = Vec::with_capacity(way.len());
    for (index, (link, forward)) in way.iter().enumerate() {
        let road = network.link(*link);
        let lanes = road.carriageway.forward_lanes();
        let length_m = road.reference.length_m();
        let mut changes = Vec::new();
        let (mut from_m, mut to_m) = (60.0, length_m - LANE_CHANGE_M - 30.0);
        let lane = match legs.last() {
            Some(before) if is_ramp(network, before.link) && is_motorway(network, *link) => {
                changes.push(LaneChange { from_m: RAMP_CHANGE_M, lane: lanes - 1 });
                from_m = RAMP_CHANGE_M + LANE_CHANGE_M + 60.0;
                lanes
            }
            Some(before) if runs_on(network, before.link, *link) => before.end_lane().min(lanes - 1),
            _ => u8::try_from(choose(rng, usize::from(lanes))).unwrap_or(0),
        };
        let leaves = is_motorway(network, *link) && way.get(index + 1).is_some_and(|next| is_ramp(network, next.0));
        if leaves {
            to_m = length_m - 2.0 * (RAMP_CHANGE_M + LANE_CHANGE_M);
        }
        if lanes > 1 && changes_per_km > 0.0 {
            let now = changes.last().map_or(lane, |change: &LaneChange| change.lane);
            changes.extend(random_changes(now, lanes, from_m..to_m, 1e3 / changes_per_km, rng));
        }
        if leaves {
            changes.push(LaneChange { from_m: length_m - RAMP_CHANGE_M - LANE_CHANGE_M, lane: lanes });
        }
        legs.push(Leg { link: *link, forward: *forward, lane, changes });
    }
    legs
}

/// Changes to a neighbouring lane that begin within a stretch (metres), about `apart_m` apart.
fn random_changes(lane: u8, lanes: u8, stretch: Range<f64>, apart_m: f64, rng: &mut SimRng) -> Vec<LaneChange> {
    let wait_m = |rng: &mut SimRng| -uniform(rng, 1e-9, 1.0).ln() * apart_m;
    let (mut lane, mut from_m) = (lane, stretch.start + wait_m(rng));
    let mut changes = Vec::new();
    while from_m < stretch.end {
        let to_the_left = lane > 0 && (lane + 1 == lanes || happens(rng, 0.5));
        lane = if to_the_left { lane - 1 } else { lane + 1 };
        changes.push(LaneChange { from_m, lane });
        from_m += LANE_CHANGE_M + 20.0 + wait_m(rng);
    }
    changes
}

fn is_ramp(network: &RoadNetwork, link: LinkIndex) -> bool {
    network.link(link).kind == LinkKind::Ramp
}

fn is_motorway(network: &RoadNetwork, link: LinkIndex) -> bool {
    matches!(network.link(link).kind, LinkKind::Motorway { .. })
}

/// Whether one link runs on into the other without a seam, so that a vehicle stays in its lane.
fn runs_on(network: &RoadNetwork, before: LinkIndex, after: LinkIndex) -> bool {
    before == after || (is_motorway(network, before) && is_motorway(network, after))
}
