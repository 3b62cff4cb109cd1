//! What is painted across a road, and how lanes open and close along it.
//!
//! Offsets are metres to the left of the reference line, in its direction. On a two-way road traffic keeps to the right
//! of the reference line; a one-way carriageway lies wholly to the right of it. An extra lane opens on the right over a
//! taper, `offset = -(w n) - w S((s - a) / taper)` with the smooth step `S(t) = 3 t^2 - 2 t^3`: the edge line leaves
//! and a dashed line begins where it left (a split); at the far end the edge comes back and the dashed line ends in
//! it (a merge).

use lanemap_core::Category;

use crate::random::{SimRng, choose, happens, uniform};

/// Width of a lane, metres.
pub const LANE_WIDTH_M: f64 = 3.5;
/// Length over which an extra lane opens or closes, metres.
const TAPER_M: f64 = 45.0;
/// A line that forks off another is painted once they are this far apart, metres.
const FORK_GAP_M: f64 = 0.25;

/// How lanes lie on a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Carriageway {
    /// Traffic both ways, this many lanes each.
    TwoWay {
        /// Lanes in each direction.
        lanes_each: u8,
    },
    /// Traffic in the direction of the reference line only.
    OneWay {
        /// Lanes.
        lanes: u8,
    },
}

impl Carriageway {
    /// Lanes in the direction of the reference line, which are those to its right.
    #[must_use]
    pub fn forward_lanes(self) -> u8 {
        match self {
            Self::TwoWay { lanes_each } => lanes_each,
            Self::OneWay { lanes } => lanes,
        }
    }

    /// Whether one may drive against the reference line.
    #[must_use]
    pub fn is_two_way(self) -> bool {
        matches!(self, Self::TwoWay { .. })
    }
}

/// An extra lane on the right of a link, between two distances along it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExtraLane {
    /// Where it begins to open, metres.
    pub from_m: f64,
    /// Where it has closed again, metres.
    pub to_m: f64,
}

impl ExtraLane {
    /// How far it is open at a distance, in `[0, 1]`.
    #[must_use]
    pub fn openness(&self, s_m: f64) -> f64 {
        smooth_step((s_m - self.from_m) / TAPER_M).min(smooth_step((self.to_m - s_m) / TAPER_M))
    }
}

/// One painted line or curb of a link.
#[derive(Clone, Copy, Debug)]
pub struct PaintedLine {
    /// Kind, as seen in the direction of the reference line.
    pub category: Category,
    /// Offset without the extra lane, metres.
    offset_m: f64,
    /// The extra lane that moves this line outward, if any.
    moved_by: Option<ExtraLane>,
    /// Where it is painted, metres along the link.
    from_m: f64,
    to_m: f64,
}

impl PaintedLine {
    /// A line at one offset from `from_m` to `to_m` along its road.
    pub(crate) fn new(category: Category, offset_m: f64, from_m: f64, to_m: f64) -> Self {
        Self { category, offset_m, moved_by: None, from_m, to_m }
    }

    /// Offset at a distance along the link, or `None` where it is not painted.
    #[must_use]
    pub fn offset_at_m(&self, s_m: f64) -> Option<f64> {
        if s_m < self.from_m || s_m > self.to_m {
            return None;
        }
        let moved_m = self.moved_by.map_or(0.0, |extra| LANE_WIDTH_M * extra.openness(s_m));
        Some(self.offset_m - moved_m)
    }
}

/// Paints a link of a length, from left to right.
pub fn paint(carriageway: Carriageway, length_m: f64, extra: Option<ExtraLane>, rng: &mut SimRng) -> Vec<PaintedLine> {
    let whole = |category, offset_m| PaintedLine { category, offset_m, moved_by: None, from_m: 0.0, to_m: length_m };
    let curbs = happens(rng, 0.4);
    let left_edge = if curbs { Category::LeftCurb } else { Category::WhiteSolid };
    let right_edge = if curbs { Category::RightCurb } else { Category::WhiteSolid };
    let mut lines = Vec::new();
    match carriageway {
        Carriageway::TwoWay { lanes_each } => {
            lines.push(whole(left_edge, LANE_WIDTH_M * f64::from(lanes_each)));
            for lane in (1..lanes_each).rev() {
                lines.push(whole(Category::WhiteDashed, LANE_WIDTH_M * f64::from(lane)));
            }
            let centre = [Category::YellowDashed, Category::YellowSolid, Category::DoubleYellowSolid];
            lines.push(whole(centre[choose(rng, centre.len())], 0.0));
        }
        Carriageway::OneWay { .. } => lines.push(whole(Category::YellowSolid, 0.0)),
    }
    let forward_lanes = carriageway.forward_lanes();
    for lane in 1..forward_lanes {
        lines.push(whole(Category::WhiteDashed, -LANE_WIDTH_M * f64::from(lane)));
    }
    let edge_m = -LANE_WIDTH_M * f64::from(forward_lanes);
    if let Some(extra) = extra {
        let (from_m, to_m) = fork_span(&extra);
        lines.push(PaintedLine { category: Category::WhiteDashed, offset_m: edge_m, moved_by: None, from_m, to_m });
    }
    lines.push(PaintedLine { moved_by: extra, ..whole(right_edge, edge_m) });
    lines
}

/// Chooses whether a link has an extra lane, and where: now and then, on links long enough for it.
pub fn choose_extra_lane(length_m: f64, rng: &mut SimRng) -> Option<ExtraLane> {
    if length_m < 5.0 * TAPER_M || !happens(rng, 0.5) {
        return None;
    }
    let from_m = uniform(rng, 0.1, 0.3) * length_m;
    let to_m = uniform(rng, 0.7, 0.9) * length_m;
    Some(ExtraLane { from_m, to_m })
}

/// Where the edge is far enough from its old place for a line between them.
fn fork_span(extra: &ExtraLane) -> (f64, f64) {
    let open = FORK_GAP_M / LANE_WIDTH_M;
    let mut share = 0.0;
    while smooth_step(share) < open {
        share += 0.01;
    }
    (extra.from_m + share * TAPER_M, extra.to_m - share * TAPER_M)
}

/// `3 t^2 - 2 t^3` between 0 and 1, constant outside.
#[must_use]
pub fn smooth_step(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};

    #[test]
    fn an_extra_lane_forks_off_the_edge_and_merges_back_into_it() {
        let extra = ExtraLane { from_m: 50.0, to_m: 300.0 };
        let mut rng = Seed(7).stream(Purpose::Network, 0);
        let lines = paint(Carriageway::OneWay { lanes: 2 }, 400.0, Some(extra), &mut rng);
        let [.., inner, edge] = lines.as_slice() else { panic!("no lines") };
        let gap_m = |s_m: f64| Some(inner.offset_at_m(s_m)? - edge.offset_at_m(s_m)?);
        assert_eq!(gap_m(40.0), None, "not painted before the fork");
        assert!((gap_m(inner.from_m).unwrap() - FORK_GAP_M).abs() < 0.1, "begins where the edge leaves");
        assert!((gap_m(170.0).unwrap() - LANE_WIDTH_M).abs() < 1e-9);
        assert!((gap_m(inner.to_m).unwrap() - FORK_GAP_M).abs() < 0.1, "ends where the edge comes back");
        assert!((edge.offset_at_m(10.0).unwrap() - edge.offset_at_m(390.0).unwrap()).abs() < 1e-9);
    }
}
