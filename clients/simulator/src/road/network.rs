//! A road network: junctions, links between them, and every painted line in space.

use lanemap_core::Category;
use nalgebra::{Point2, Point3};

use crate::{
    random::{Purpose, Seed},
    road::{
        cross_section::{Carriageway, LANE_WIDTH_M, choose_extra_lane, paint},
        plan::{NetworkPlan, PlannedLink},
        reference_line::ReferenceLine,
        terrain::Terrain,
    },
};

/// Distance of a link's mouth from the middle of the junction: no line is painted inside, metres.
pub const MOUTH_M: f64 = 17.0;

/// Number of a painted line within its network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RoadLineId(pub u32);

/// Index of a link within its network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LinkIndex(pub usize);

/// A place where links meet.
#[derive(Clone, Debug)]
pub struct Junction {
    /// Where it is, metres.
    pub place: Point2<f64>,
    /// Links that begin or end here.
    pub links: Vec<LinkIndex>,
}

/// A road between two junctions.
#[derive(Clone, Debug)]
pub struct Link {
    /// Index of the junction at which the reference line begins.
    pub from: usize,
    /// Index of the junction at which it ends.
    pub to: usize,
    /// The reference line, from mouth to mouth.
    pub reference: ReferenceLine,
    /// Lanes and their directions.
    pub carriageway: Carriageway,
    /// Width of its lanes, metres.
    pub lane_width_m: f64,
    /// What kind of road it is.
    pub kind: LinkKind,
    /// Lines of this link; a line that runs on over several links is named by each of them.
    pub lines: Vec<RoadLineId>,
}

/// What kind of road a link is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkKind {
    /// A street or road like any other.
    Street,
    /// A part of a roundabout's ring, between two of its arms.
    Ring,
    /// A part of a motorway's carriageway, with an extra lane on the right at its ends where ramps join or leave.
    Motorway {
        /// A ramp comes in at its beginning.
        ramp_joins: bool,
        /// A ramp goes off at its end.
        ramp_leaves: bool,
    },
    /// A ramp between a motorway and another road.
    Ramp,
}

impl LinkKind {
    /// How much faster than in a street one drives here.
    #[must_use]
    pub fn speed_scale(self) -> f64 {
        match self {
            Self::Street | Self::Ring => 1.0,
            Self::Ramp => 1.4,
            Self::Motorway { .. } => 2.0,
        }
    }
}

/// A painted line or a curb in space.
#[derive(Clone, Debug)]
pub struct RoadLine {
    /// Number within the network.
    pub id: RoadLineId,
    /// Kind, as seen in the direction of the points.
    pub category: Category,
    /// Points about one metre apart, in the direction of the link's reference line, world frame, metres.
    pub points: Vec<Point3<f64>>,
}

impl RoadLine {
    /// Whether it comes back to where it begins.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        match self.points.as_slice() {
            [first, .., last] => (first - last).norm() < 1e-6,
            _ => false,
        }
    }
}

/// Roads on hilly land. World frame: east, north, up, metres.
#[derive(Clone, Debug)]
pub struct RoadNetwork {
    terrain: Terrain,
    junctions: Vec<Junction>,
    links: Vec<Link>,
    lines: Vec<RoadLine>,
}

impl RoadNetwork {
    /// Builds a network. `max_grade` is the steepest slope of the land (0.06 is 6 %).
    #[must_use]
    pub fn build(plan: &NetworkPlan, max_grade: f64, seed: Seed) -> Self {
        let terrain = Terrain::random(max_grade, &mut seed.stream(Purpose::Terrain, 0));
        let mut rng = seed.stream(Purpose::Network, 0);
        let (places, planned) = plan.place(&mut rng);
        let junctions = places.into_iter().map(|place| Junction { place, links: Vec::new() }).collect();
        let mut network = Self { terrain, junctions, links: Vec::new(), lines: Vec::new() };
        for link in planned {
            let reference = network.reference_line(&link);
            let length_m = reference.length_m();
            let extra = choose_extra_lane(length_m, &mut rng);
            let painted = paint(link.carriageway, length_m, extra, &mut rng);
            let index = LinkIndex(network.links.len());
            let first = network.lines.len();
            for line in &painted {
                let points = network.points_along(&reference, |s_m| line.offset_at_m(s_m));
                let id = RoadLineId(u32::try_from(network.lines.len()).unwrap_or(u32::MAX));
                network.lines.push(RoadLine { id, category: line.category, points });
            }
            let lines = network.lines[first..].iter().map(|line| line.id).collect();
            network.junctions[link.from].links.push(index);
            network.junctions[link.to].links.push(index);
            network.links.push(Link {
                from: link.from,
                to: link.to,
                reference,
                carriageway: link.carriageway,
                lane_width_m: LANE_WIDTH_M,
                kind: LinkKind::Street,
                lines,
            });
        }
        network
    }

    /// A network without any road yet.
    #[must_use]
    pub(crate) fn on(terrain: Terrain) -> Self {
        Self { terrain, junctions: Vec::new(), links: Vec::new(), lines: Vec::new() }
    }

    /// Adds a junction; gives its index.
    pub(crate) fn add_junction(&mut self, place: Point2<f64>) -> usize {
        self.junctions.push(Junction { place, links: Vec::new() });
        self.junctions.len() - 1
    }

    /// Adds a line through places in plan, which come to lie on the land.
    pub(crate) fn add_line(&mut self, category: Category, places: &[Point2<f64>]) -> RoadLineId {
        let id = RoadLineId(u32::try_from(self.lines.len()).unwrap_or(u32::MAX));
        let on_land = |place: &Point2<f64>| Point3::new(place.x, place.y, self.terrain.height_m(place));
        self.lines.push(RoadLine { id, category, points: places.iter().map(on_land).collect() });
        id
    }

    /// Adds a link; its junctions and lines are there already.
    pub(crate) fn add_link(&mut self, link: Link) -> LinkIndex {
        let index = LinkIndex(self.links.len());
        for junction in [link.from, link.to] {
            if !self.junctions[junction].links.contains(&index) {
                self.junctions[junction].links.push(index);
            }
        }
        self.links.push(link);
        index
    }

    /// The land.
    #[must_use]
    pub fn terrain(&self) -> &Terrain {
        &self.terrain
    }

    /// Junctions.
    #[must_use]
    pub fn junctions(&self) -> &[Junction] {
        &self.junctions
    }

    /// Links.
    #[must_use]
    pub fn links(&self) -> &[Link] {
        &self.links
    }

    /// A link by its index.
    #[must_use]
    pub fn link(&self, index: LinkIndex) -> &Link {
        &self.links[index.0]
    }

    /// Every painted line, in the order of its number.
    #[must_use]
    pub fn lines(&self) -> &[RoadLine] {
        &self.lines
    }

    /// A line by its number.
    #[must_use]
    pub fn line(&self, id: RoadLineId) -> &RoadLine {
        &self.lines[id.0 as usize]
    }

    fn reference_line(&self, link: &PlannedLink) -> ReferenceLine {
        let (a, b) = (self.junctions[link.from].place, self.junctions[link.to].place);
        let along = (b - a).normalize();
        ReferenceLine::between(a + along * MOUTH_M, b - along * MOUTH_M, &link.bends)
    }

    fn points_along(&self, reference: &ReferenceLine, offset_at_m: impl Fn(f64) -> Option<f64>) -> Vec<Point3<f64>> {
        let step_m = reference.length_m() / (reference.len() - 1) as f64;
        (0..reference.len())
            .filter_map(|index| {
                let place = reference.offset_point(index, offset_at_m(index as f64 * step_m)?);
                Some(Point3::new(place.x, place.y, self.terrain.height_m(&place)))
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_has_its_junctions_its_links_and_lines_on_the_land() {
        let plan = NetworkPlan::Grid { columns: 3, rows: 3, spacing_m: 420.0 };
        let network = RoadNetwork::build(&plan, 0.05, Seed(1));
        assert_eq!((network.junctions().len(), network.links().len()), (9, 12));
        for line in network.lines() {
            assert!(line.points.len() > 50);
            for point in &line.points {
                assert!((network.terrain().height_m(&point.xy()) - point.z).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_network_has_splits_merges_and_several_categories() {
        let plan = NetworkPlan::Grid { columns: 4, rows: 4, spacing_m: 420.0 };
        let network = RoadNetwork::build(&plan, 0.05, Seed(2));
        let categories: std::collections::BTreeSet<_> = network.lines().iter().map(|line| line.category).collect();
        assert!(categories.len() >= 6, "{categories:?}");
        let shorter = network.links().iter().filter(|link| {
            let lengths = link.lines.iter().map(|id| network.line(*id).points.len());
            lengths.clone().min() < lengths.max().map(|longest| longest * 9 / 10)
        });
        assert!(shorter.count() >= 4, "links with a lane that opens and closes");
    }
}
