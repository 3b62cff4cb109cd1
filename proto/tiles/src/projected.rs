//! One version of a cell, ready to be drawn: its lines on the web-mercator plane, with what tiles tell of them.
//!
//! Made once per version and kept while tiles of it are drawn. A tile looks at the boxes of all lines (some hundreds), then of
//! all pieces of [`SPAN`] control points of those that may enter it; the search costs microseconds.

use std::sync::OnceLock;

use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use nalgebra::{Point2, Point3};
use xxhash_rust::xxh3::xxh3_64;

use crate::{
    dashes::dashes,
    lattice::{Borders, PlaneCurve},
    mercator::world_from_wgs84,
    overview::{OVERVIEW_ZOOMS, Overview},
    stretches::{Stretch, stretches},
};

/// Control points from one box to the next.
pub(crate) const SPAN: usize = 16;
/// Most bits of a feature's id: what a JavaScript number holds exactly.
const ID_BITS: u64 = 53;

/// One version of a cell, ready to be drawn.
#[derive(Debug)]
pub struct ProjectedCell {
    cell: CellId,
    name: String,
    version: u64,
    lines: Vec<ProjectedLine>,
    overviews: [OnceLock<Overview>; OVERVIEW_ZOOMS],
}

/// A line of a cell on the plane.
#[derive(Debug)]
pub(crate) struct ProjectedLine {
    points: Vec<Point2<f64>>,
    borders: Borders,
    whole: PlaneBox,
    /// Boxes of the spline from every [`SPAN`]th control point to the next one.
    spans: Vec<PlaneBox>,
    pub(crate) stretches: Vec<Stretch>,
    /// What is painted of it, as parameters of its spline; none where it is not dashed.
    pub(crate) dashes: Vec<[f64; 2]>,
    pub(crate) known: LineKnown,
}

/// What is known of a line as a whole; names as in the layer `lanes`.
#[derive(Debug)]
pub(crate) struct LineKnown {
    pub(crate) id: u64,
    pub(crate) lane: String,
    pub(crate) part: u32,
    pub(crate) category: String,
    pub(crate) category_code: i32,
    pub(crate) drives: u32,
    pub(crate) observations: u64,
    pub(crate) existence: f64,
    pub(crate) lateral_sigma_m: f64,
    pub(crate) height_sigma_m: f64,
    pub(crate) first_seen_s: i64,
    pub(crate) last_seen_s: i64,
    pub(crate) confirmed_s: i64,
}

/// A box on the plane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlaneBox {
    low: Point2<f64>,
    high: Point2<f64>,
}

impl PlaneBox {
    /// The box around a spline: that of its control points, and as far again as a Catmull-Rom spline may swing out of them (a
    /// segment lies in the hull of its Bezier points, a sixth of the neighbours' distance off).
    pub(crate) fn around(points: &[Point2<f64>]) -> Self {
        let (mut low, mut high) = (points[0], points[0]);
        for point in points {
            (low, high) = (low.inf(point), high.sup(point));
        }
        let swing = (high - low) / 6.0;
        Self { low: low - swing, high: high + swing }
    }

    pub(crate) fn new(low: Point2<f64>, high: Point2<f64>) -> Self {
        Self { low, high }
    }

    pub(crate) fn touches(&self, other: &Self) -> bool {
        (0..2).all(|axis| self.low[axis] <= other.high[axis] && other.low[axis] <= self.high[axis])
    }
}

impl ProjectedCell {
    /// Projects a version of a cell.
    #[must_use]
    pub fn new(cell: CellId, map: &v1::CellMap) -> Self {
        Self {
            cell,
            name: cell.to_string(),
            version: map.version,
            lines: map.lanes.iter().filter_map(|lane| ProjectedLine::new(cell, lane)).collect(),
            overviews: Default::default(),
        }
    }

    /// The cell.
    #[must_use]
    pub fn cell(&self) -> CellId {
        self.cell
    }

    /// Its version.
    #[must_use]
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Memory that it takes, bytes, about.
    #[must_use]
    pub fn memory_bytes(&self) -> usize {
        let line = |line: &ProjectedLine| {
            // Of what is drawn from afar there is at most a vertex per control point and zoom.
            let points = line.points.len() * (size_of::<Point2<f64>>() + 2 * OVERVIEW_ZOOMS * size_of::<i64>());
            let spans = line.spans.len() * size_of::<PlaneBox>();
            let dashes = line.dashes.len() * size_of::<[f64; 2]>();
            points + spans + dashes + line.stretches.len() * size_of::<Stretch>() + size_of::<ProjectedLine>() + 128
        };
        self.lines.iter().map(line).sum::<usize>() + size_of::<Self>()
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    pub(crate) fn lines(&self) -> &[ProjectedLine] {
        &self.lines
    }

    /// What is drawn of the cell below [`crate::WHOLE_FROM`].
    pub(crate) fn overview(&self, zoom: u8) -> &Overview {
        let index = usize::from(zoom - crate::VECTOR_ZOOMS.start());
        self.overviews[index].get_or_init(|| Overview::of(&self.lines, zoom))
    }
}

impl ProjectedLine {
    /// `None` where it has too few control points to be drawn.
    fn new(cell: CellId, lane: &v1::FusedLane) -> Option<Self> {
        let points = plane_points(cell, lane);
        if points.len() < 2 {
            return None;
        }
        let borders =
            Borders { first: place(lane.begins_at.as_ref()).is_some(), last: place(lane.ends_at.as_ref()).is_some() };
        let last = points.len() - 1;
        let spans = (0..last).step_by(SPAN).map(|from| {
            // The control points beside a span shape it, too.
            PlaneBox::around(&points[from.saturating_sub(1)..=(from + SPAN + 1).min(last)])
        });
        Some(Self {
            borders,
            whole: PlaneBox::around(&points),
            spans: spans.collect(),
            stretches: stretches(lane, points.len()),
            dashes: if is_dashed(lane.category()) { dashes(&points, borders, side_m(cell)) } else { Vec::new() },
            known: LineKnown::of(cell, lane),
            points,
        })
    }

    pub(crate) fn curve(&self) -> PlaneCurve<'_> {
        PlaneCurve { points: &self.points, borders: self.borders }
    }

    pub(crate) fn last(&self) -> usize {
        self.points.len() - 1
    }

    /// The spans of control points, as `from..=to`, that may enter a box; joined where they follow each other.
    pub(crate) fn spans_within(&self, bounds: &PlaneBox, found: &mut Vec<[usize; 2]>) {
        found.clear();
        if !self.whole.touches(bounds) {
            return;
        }
        for (index, span) in self.spans.iter().enumerate() {
            if span.touches(bounds) {
                let (from, to) = (index * SPAN, ((index + 1) * SPAN).min(self.last()));
                match found.last_mut() {
                    Some(before) if before[1] == from => before[1] = to,
                    _ => found.push([from, to]),
                }
            }
        }
    }
}

/// Whether some of a line is dashes.
fn is_dashed(category: v1::LaneCategory) -> bool {
    category.as_str_name().contains("DASHED")
}

/// What the side of the plane is on the ground at a cell, metres: of the sphere that web mercator takes the earth for.
fn side_m(cell: CellId) -> f64 {
    2.0 * std::f64::consts::PI * 6_378_137.0 * cell.anchor().place().latitude_deg.to_radians().cos()
}

/// The control points of a line on the plane. An end on the cell's border is exactly where its neighbour has it.
fn plane_points(cell: CellId, lane: &v1::FusedLane) -> Vec<Point2<f64>> {
    let anchor = cell.anchor();
    let middle = world_from_wgs84(&anchor.place());
    let beside = |mut world: Point2<f64>| {
        // On the cell's side of the antimeridian.
        world.x -= (world.x - middle.x).round();
        world
    };
    let mut at_mm = [0_i64; 3];
    let points = lane.xyz_mm.chunks_exact(3).map(|step| {
        at_mm.iter_mut().zip(step).for_each(|(at, step)| *at += i64::from(*step));
        let [x, y, z] = at_mm.map(|mm| mm as f64 * 1e-3);
        beside(world_from_wgs84(&anchor.wgs84_from_enu(&Point3::new(x, y, z))))
    });
    let mut points: Vec<Point2<f64>> = points.collect();
    if let (Some(first), Some(place)) = (points.first_mut(), place(lane.begins_at.as_ref())) {
        *first = beside(world_from_wgs84(&place));
    }
    if let (Some(last), Some(place)) = (points.last_mut(), place(lane.ends_at.as_ref())) {
        *last = beside(world_from_wgs84(&place));
    }
    points
}

pub(crate) fn place(border: Option<&v1::LaneBorder>) -> Option<lanemap_core::geometry::georeference::Wgs84> {
    let place = border?.place?;
    Some(lanemap_core::geometry::georeference::Wgs84 {
        latitude_deg: place.latitude_deg,
        longitude_deg: place.longitude_deg,
        height_m: place.height_m,
    })
}

impl LineKnown {
    fn of(cell: CellId, lane: &v1::FusedLane) -> Self {
        let confirmed_s = lane.confirmed_after_s.iter().min().copied().unwrap_or_default();
        Self {
            id: feature_id(&format!("{cell}.{}.{}", lane.id, lane.part)),
            lane: lane.id.clone(),
            part: lane.part,
            category: category_name(lane.category()),
            category_code: lane.category,
            drives: lane.drives,
            observations: lane.observations,
            existence: rounded_to_thousandths(mean(&lane.existence_permille) / 1e3),
            lateral_sigma_m: median(&lane.lateral_sigma_mm) / 1e3,
            height_sigma_m: median(&lane.height_sigma_mm) / 1e3,
            first_seen_s: seconds(lane.first_seen_unix_ns),
            last_seen_s: seconds(lane.last_seen_unix_ns),
            confirmed_s: seconds(lane.first_seen_unix_ns).saturating_add(confirmed_s),
        }
    }
}

/// The id of a feature that is named by a text: at most 53 bits, so that every client can hold it.
pub(crate) fn feature_id(name: &str) -> u64 {
    xxh3_64(name.as_bytes()) >> (64 - ID_BITS)
}

/// The wire protocol's name of a category without its prefix, in lower case.
fn category_name(category: v1::LaneCategory) -> String {
    match category {
        v1::LaneCategory::Unspecified => "unknown".to_owned(),
        named => named.as_str_name().trim_start_matches("LANE_CATEGORY_").to_ascii_lowercase(),
    }
}

fn seconds(unix_ns: i64) -> i64 {
    unix_ns.div_euclid(1_000_000_000)
}

pub(crate) fn mean(values: &[u32]) -> f64 {
    values.iter().map(|value| f64::from(*value)).sum::<f64>() / values.len().max(1) as f64
}

fn median(values: &[u32]) -> f64 {
    let mut values = values.to_vec();
    values.sort_unstable();
    values.get(values.len() / 2).map_or(0.0, |value| f64::from(*value))
}

pub(crate) fn rounded_to_thousandths(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}

#[cfg(test)]
mod tests {
    use lanemap_core::Category;

    use super::*;

    #[test]
    fn categories_are_named_as_in_openlane_in_snake_case() {
        let name = |category: Category| category_name(lanemap_proto::encode::category(category));
        assert_eq!(name(Category::Unknown), "unknown");
        assert_eq!(name(Category::WhiteLeftDashedRightSolid), "white_left_dashed_right_solid");
        assert_eq!(name(Category::RightCurb), "right_curb");
    }

    #[test]
    fn ids_of_features_fit_into_a_javascript_number() {
        let ids: std::collections::BTreeSet<u64> =
            (0..10_000).map(|number| feature_id(&format!("cell.{number}"))).collect();
        assert_eq!(ids.len(), 10_000);
        assert!(ids.iter().all(|id| *id < 1 << 53));
    }
}
