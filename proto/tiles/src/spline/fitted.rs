//! One version of a cell, ready for spline tiles: every line through as few control points as it takes, and what is known of
//! it as the small numbers that tiles carry.

use std::collections::HashMap;

use lanemap_core::fleet::{CellId, FusedLaneId};
use lanemap_proto::{lane_name::parse_lane_id, v1};
use prost::Message;
use xxhash_rust::xxh3::xxh3_64;

use super::{
    fit::{Knot, fitted},
    known::Codes,
    steps::{metres, rounded},
};
use crate::{
    mercator::world_from_wgs84,
    projected::{PlaneBox, place},
};

/// One version of a cell, ready for spline tiles.
#[derive(Debug)]
pub struct FittedCell {
    pub(super) cell: CellId,
    pub(super) version: u64,
    pub(super) lines: Vec<FittedLine>,
}

/// A line through fewer control points than it has in the map.
#[derive(Clone, Debug)]
pub(super) struct FittedLine {
    pub(super) id: FusedLaneId,
    pub(super) part: u32,
    /// Position in the order in which `LaneCategory` lists them.
    pub(super) category: u64,
    /// Percent by which the category's probability falls short of 100.
    pub(super) doubt_percent: u64,
    pub(super) drives: u32,
    pub(super) last_seen_s: i64,
    pub(super) confirmed_s: i64,
    pub(super) begins_at: Option<FittedBorder>,
    pub(super) ends_at: Option<FittedBorder>,
    pub(super) knots: Vec<(Knot, Codes)>,
    /// Where it lies on the web-mercator plane.
    pub(super) bounds: PlaneBox,
    /// Tells the line of the map that this one was made of from all others.
    made_of: u64,
}

/// Where a line crosses the border of its cell.
#[derive(Clone, Copy, Debug)]
pub(super) struct FittedBorder {
    /// Latitude and longitude, in units of 1e-9 degrees, and height in millimetres.
    pub(super) place: [i64; 3],
    /// The piece on the other side.
    pub(super) continues_in: Option<(CellId, FusedLaneId, u32)>,
}

impl FittedCell {
    /// Makes a version of a cell ready. Lines that an earlier version had are taken from there.
    #[must_use]
    pub fn new(cell: CellId, map: &v1::CellMap, earlier: Option<&Self>) -> Self {
        let known: HashMap<u64, &FittedLine> =
            earlier.into_iter().flat_map(|earlier| &earlier.lines).map(|line| (line.made_of, line)).collect();
        let lines = map.lanes.iter().filter_map(|lane| {
            let made_of = xxh3_64(&lane.encode_to_vec());
            known.get(&made_of).map(|line| (*line).clone()).or_else(|| FittedLine::new(cell, lane, made_of))
        });
        let mut lines: Vec<FittedLine> = lines.collect();
        lines.sort_by_key(|line| (line.id, line.part));
        Self { cell, version: map.version, lines }
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
        let knots: usize = self.lines.iter().map(|line| line.knots.len()).sum();
        knots * size_of::<(Knot, Codes)>() + self.lines.len() * (size_of::<FittedLine>() + 16) + size_of::<Self>()
    }
}

impl FittedLine {
    /// `None` where the line draws nothing.
    fn new(cell: CellId, lane: &v1::FusedLane, made_of: u64) -> Option<Self> {
        let id = parse_lane_id(&lane.id)?;
        let mut at_mm = [0_i64; 3];
        let points = lane.xyz_mm.chunks_exact(3).map(|step| {
            at_mm.iter_mut().zip(step).for_each(|(at, step)| *at += i64::from(*step));
            metres(at_mm)
        });
        let points: Vec<_> = points.collect();
        let mut knots: Vec<(Knot, Codes)> = Vec::new();
        for knot in fitted(&points) {
            let codes = Codes::at(lane, knot.parameter, knots.last().map(|(_, codes)| *codes));
            knots.push((knot, codes));
        }
        if knots.len() < 2 {
            return None;
        }
        let (anchor, first_seen_s) = (cell.anchor(), seconds(lane.first_seen_unix_ns));
        let on_plane: Vec<_> =
            knots.iter().map(|(knot, _)| world_from_wgs84(&anchor.wgs84_from_enu(&metres(knot.point)))).collect();
        let category = ORDER.iter().position(|category| *category == lane.category()).unwrap_or_default();
        let sure_permille = lane.category_posterior_permille.get(category).copied().unwrap_or_default().min(1_000);
        Some(Self {
            id,
            part: lane.part,
            category: category as u64,
            doubt_percent: u64::from((1_000 - sure_permille + 5) / 10),
            drives: lane.drives,
            last_seen_s: seconds(lane.last_seen_unix_ns),
            confirmed_s: first_seen_s.saturating_add(lane.confirmed_after_s.iter().min().copied().unwrap_or_default()),
            begins_at: FittedBorder::of(lane.begins_at.as_ref()),
            ends_at: FittedBorder::of(lane.ends_at.as_ref()),
            knots,
            bounds: PlaneBox::around(&on_plane),
            made_of,
        })
    }
}

impl FittedBorder {
    fn of(border: Option<&v1::LaneBorder>) -> Option<Self> {
        let exact = place(border)?;
        let name = border.and_then(|border| border.continues_in.as_ref());
        Some(Self {
            place: [
                rounded(exact.latitude_deg * 1e9),
                rounded(exact.longitude_deg * 1e9),
                rounded(exact.height_m * 1e3),
            ],
            continues_in: name.and_then(|name| Some((name.cell.parse().ok()?, parse_lane_id(&name.id)?, name.part))),
        })
    }
}

/// The categories in the order in which the wire protocol lists them.
pub(super) const ORDER: [v1::LaneCategory; 15] = [
    v1::LaneCategory::Unspecified,
    v1::LaneCategory::WhiteDashed,
    v1::LaneCategory::WhiteSolid,
    v1::LaneCategory::DoubleWhiteDashed,
    v1::LaneCategory::DoubleWhiteSolid,
    v1::LaneCategory::WhiteLeftDashedRightSolid,
    v1::LaneCategory::WhiteLeftSolidRightDashed,
    v1::LaneCategory::YellowDashed,
    v1::LaneCategory::YellowSolid,
    v1::LaneCategory::DoubleYellowDashed,
    v1::LaneCategory::DoubleYellowSolid,
    v1::LaneCategory::YellowLeftDashedRightSolid,
    v1::LaneCategory::YellowLeftSolidRightDashed,
    v1::LaneCategory::LeftCurb,
    v1::LaneCategory::RightCurb,
];

/// Whole seconds of a time, rounded down.
pub(super) fn seconds(unix_ns: i64) -> i64 {
    unix_ns.div_euclid(1_000_000_000)
}
