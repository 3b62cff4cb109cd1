//! A route: which links a vehicle takes, in which direction, on which lanes.

use crate::{
    random::{SimRng, choose, happens},
    road::{LinkIndex, RoadNetwork, reference_line::wrap},
};

/// Probability that a vehicle goes straight on where it can.
const STRAIGHT_ON: f64 = 0.55;
/// Length of a lane change, metres.
pub const LANE_CHANGE_M: f64 = 70.0;
/// Probability of a lane change within a link that has room for one.
const LANE_CHANGE: f64 = 0.3;

/// One link of a route.
#[derive(Clone, Debug, PartialEq)]
pub struct Leg {
    /// The link.
    pub link: LinkIndex,
    /// Whether it is driven in the direction of its reference line.
    pub forward: bool,
    /// Lane at the start of the link, counted from the reference line.
    pub lane: u8,
    /// Changes of lane within the link, in the order in which they are driven.
    pub changes: Vec<LaneChange>,
}

/// A change of lane within a link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LaneChange {
    /// Where it begins, metres from the link's beginning in the direction of travel.
    pub from_m: f64,
    /// The lane that it leads to, counted from the reference line.
    pub lane: u8,
}

impl Leg {
    /// Lane at the end of the link.
    #[must_use]
    pub fn end_lane(&self) -> u8 {
        self.changes.last().map_or(self.lane, |change| change.lane)
    }
}

/// Links in the order in which they are driven.
#[derive(Clone, Debug, PartialEq)]
pub struct Route {
    /// The links.
    pub legs: Vec<Leg>,
}

impl Route {
    /// A random walk through the network of at least `length_m`, or as far as there is road.
    ///
    /// Links not driven before are preferred, so that a long drive sees new road as long as there is some.
    pub fn random(network: &RoadNetwork, length_m: f64, rng: &mut SimRng) -> Self {
        let (mut link, mut forward) = start(network, rng);
        let mut times_driven = vec![0_u32; network.links().len()];
        let mut legs = Vec::new();
        let mut driven_m = 0.0;
        loop {
            times_driven[link.0] += 1;
            legs.push(leg(network, link, forward, rng));
            driven_m += network.link(link).reference.length_m();
            if driven_m >= length_m {
                return Self { legs };
            }
            match next_link(network, link, forward, &times_driven, rng) {
                Some(next) => (link, forward) = next,
                None => return Self { legs },
            }
        }
    }

    /// The same links on lanes chosen anew: another vehicle on the same road.
    #[must_use]
    pub fn on_other_lanes(&self, network: &RoadNetwork, rng: &mut SimRng) -> Self {
        Self { legs: self.legs.iter().map(|old| leg(network, old.link, old.forward, rng)).collect() }
    }
}

/// A chain of one-way links is driven from its beginning; elsewhere any link and direction will do.
fn start(network: &RoadNetwork, rng: &mut SimRng) -> (LinkIndex, bool) {
    if network.links().iter().any(|link| !link.carriageway.is_two_way()) {
        return (LinkIndex(0), true);
    }
    (LinkIndex(choose(rng, network.links().len())), happens(rng, 0.5))
}

fn leg(network: &RoadNetwork, link: LinkIndex, forward: bool, rng: &mut SimRng) -> Leg {
    let lanes = network.link(link).carriageway.forward_lanes();
    let pick = |rng: &mut SimRng| u8::try_from(choose(rng, usize::from(lanes))).unwrap_or(0);
    let lane = pick(rng);
    let end_lane = if happens(rng, LANE_CHANGE) { pick(rng) } else { lane };
    let middle_m = 0.5 * (network.link(link).reference.len() as f64 - LANE_CHANGE_M);
    let changes = if end_lane == lane { Vec::new() } else { vec![LaneChange { from_m: middle_m, lane: end_lane }] };
    Leg { link, forward, lane, changes }
}

fn next_link(
    network: &RoadNetwork,
    link: LinkIndex,
    forward: bool,
    times_driven: &[u32],
    rng: &mut SimRng,
) -> Option<(LinkIndex, bool)> {
    let here = network.link(link);
    let junction = if forward { here.to } else { here.from };
    let arriving_rad = heading_rad(network, link, forward, true);
    let mut exits: Vec<(LinkIndex, bool, f64)> = network.junctions()[junction]
        .links
        .iter()
        .filter(|next| **next != link)
        .map(|next| (*next, network.link(*next).from == junction))
        .filter(|(next, onward)| *onward || network.link(*next).carriageway.is_two_way())
        .map(|(next, onward)| (next, onward, wrap(heading_rad(network, next, onward, false) - arriving_rad).abs()))
        .collect();
    let least_driven = exits.iter().map(|(next, ..)| times_driven[next.0]).min()?;
    exits.retain(|(next, ..)| times_driven[next.0] == least_driven);
    exits.sort_by(|a, b| a.2.total_cmp(&b.2));
    let pick = if happens(rng, STRAIGHT_ON) { 0 } else { choose(rng, exits.len()) };
    Some((exits[pick].0, exits[pick].1))
}

/// Heading of travel at the end (or the start) of a link.
fn heading_rad(network: &RoadNetwork, link: LinkIndex, forward: bool, at_end: bool) -> f64 {
    let headings_rad = network.link(link).reference.headings_rad();
    let index = if forward == at_end { headings_rad.len() - 1 } else { 0 };
    headings_rad[index] + if forward { 0.0 } else { std::f64::consts::PI }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        random::{Purpose, Seed},
        road::NetworkPlan,
    };

    #[test]
    fn a_route_is_connected_and_never_turns_back() {
        let network = RoadNetwork::build(&NetworkPlan::Grid { columns: 4, rows: 4, spacing_m: 400.0 }, 0.05, Seed(3));
        let route = Route::random(&network, 5_000.0, &mut Seed(3).stream(Purpose::Route, 0));
        for pair in route.legs.windows(2) {
            let (a, b) = (network.link(pair[0].link), network.link(pair[1].link));
            let arrives = if pair[0].forward { a.to } else { a.from };
            let departs = if pair[1].forward { b.from } else { b.to };
            assert_eq!(arrives, departs);
            assert_ne!(pair[0].link, pair[1].link);
        }
        let distinct: std::collections::BTreeSet<_> = route.legs.iter().map(|leg| leg.link).collect();
        assert!(distinct.len() * 10 >= route.legs.len() * 8, "mostly new road");
    }

    #[test]
    fn a_long_road_is_driven_from_end_to_end() {
        let network = RoadNetwork::build(&NetworkPlan::Chain { length_m: 10_500.0 }, 0.05, Seed(4));
        let route = Route::random(&network, 10_000.0, &mut Seed(4).stream(Purpose::Route, 0));
        let length_m: f64 = route.legs.iter().map(|leg| network.link(leg.link).reference.length_m()).sum();
        assert!(length_m >= 10_000.0 - 1_000.0);
        assert!(route.legs.iter().all(|leg| leg.forward));
    }
}
