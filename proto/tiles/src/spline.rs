//! Spline tiles: written from the cells of a map, and read into curves to compute with. The format is described, bit by bit, in
//! `lanemap/v1/spline_tile.proto`.
//!
//! ```
//! use lanemap_core::fleet::CellId;
//! use lanemap_proto::v1;
//! use lanemap_tiles::{TileId, spline::{FittedCell, read, spline_tile}};
//!
//! # let cell = CellId::new(8_718, 5_685).expect("it is below 2^14");
//! # let lane = v1::FusedLane {
//! #     id: "0000000000000005-00000000000000a7-1-0-0".into(), drives: 1,
//! #     xyz_mm: vec![0, 0, 500_000, 3_000, 40, 0, 3_000, 20, 0, 3_000, 0, 0],
//! #     lateral_sigma_mm: vec![80; 4], height_sigma_mm: vec![60; 4], existence_permille: vec![950; 4],
//! #     ..v1::FusedLane::default()
//! # };
//! # let map = v1::CellMap { cell: cell.to_string(), version: 3, lanes: vec![lane], anchor: None };
//! let tile = TileId::new(14, cell.x(), cell.y()).expect("a cell is a tile of zoom 14");
//! let fitted = FittedCell::new(cell, &map, None); // once per version of a cell
//! let message = spline_tile(tile, [&fitted]);
//!
//! for line in &read(&message)?[0].lines {
//!     for point in line.curve.sample(1.0) {
//!         let (position, sigma_m) = (point.position, line.lateral_sigma_m_at(&point));
//!         assert!(position.x <= 9.0 + 1e-9 && (0.07..0.09).contains(&sigma_m));
//!     }
//! }
//! # Ok::<(), lanemap_tiles::spline::SplineTileError>(())
//! ```

mod bits;
mod code;
mod curve;
mod fit;
mod fitted;
mod known;
mod steps;

use lanemap_core::{
    TimestampNs,
    fleet::{CellId, DriveId, FusedLaneId},
    geometry::georeference::{Anchor, Wgs84},
};
use lanemap_proto::{lane_name::lane_id_text, v1};
use nalgebra::Point2;
use thiserror::Error;

use self::{
    bits::{BitReader, BitWriter},
    code::{Before, CellCode, CodedLine, Witness, best_orders},
    fitted::{FittedBorder, FittedLine, ORDER},
    known::sigma_m,
    steps::{metres, rounded},
};
pub use self::{
    curve::{CurvePoint, SplineCurve},
    fitted::FittedCell,
};
use crate::{TileId, projected::PlaneBox};

/// Zooms of spline tiles: the widest has 16 cells.
pub const SPLINE_ZOOMS: std::ops::RangeInclusive<u8> = 12..=TileId::MOST_ZOOM;
/// How far beyond its side a tile looks for lines, in sides: covers what a curve may leave the box of its control points by.
const MARGIN: f64 = 1e-3;

/// The lines of one version of a cell that touch a tile.
#[derive(Clone, Debug)]
pub struct CellSplines {
    /// The cell.
    pub cell: CellId,
    /// Its version.
    pub version: u64,
    /// Origin of its frame (east, north, up).
    pub anchor: Anchor,
    /// The lines.
    pub lines: Vec<SplineLine>,
}

/// A line to compute with.
#[derive(Clone, Debug)]
pub struct SplineLine {
    /// Its name, as in `CellMap`.
    pub id: FusedLaneId,
    /// Which piece of the line within the cell.
    pub part: u32,
    /// Most probable category.
    pub category: v1::LaneCategory,
    /// Probability of that category, in `[0, 1]`.
    pub category_probability: f64,
    /// Drives that saw some of it.
    pub drives: u32,
    /// Time of the last frame that saw it, seconds since the Unix epoch.
    pub last_seen_unix_s: i64,
    /// Start of the last drive that saw its stalest control point, seconds since the Unix epoch.
    pub confirmed_unix_s: i64,
    /// Where it comes over the border of the cell.
    pub begins_at: Option<SplineBorder>,
    /// Where it leaves over the border of the cell.
    pub ends_at: Option<SplineBorder>,
    /// Its course, in the cell's frame, metres.
    pub curve: SplineCurve,
    /// Standard deviation across the line at each control point, metres.
    pub lateral_sigma_m: Vec<f64>,
    /// Standard deviation of the height at each control point, metres.
    pub height_sigma_m: Vec<f64>,
    /// Probability that the line is there at each control point, in `[0, 1]`.
    pub existence: Vec<f64>,
}

/// Where a line crosses the border of its cell.
#[derive(Clone, Debug, PartialEq)]
pub struct SplineBorder {
    /// The place: the same bits in both cells where they have the line in common.
    pub place: Wgs84,
    /// The piece on the other side: its cell, name and part.
    pub continues_in: Option<(CellId, FusedLaneId, u32)>,
}

/// Why a spline tile cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum SplineTileError {
    /// A field that has no value which the format allows.
    #[error("{field} of cell {cell:?} of a spline tile: {reason}")]
    Field {
        /// The field.
        field: &'static str,
        /// The cell, as the tile names it.
        cell: String,
        /// What is wrong.
        reason: String,
    },
    /// A string of bits that is none of lines.
    #[error("the bits of line {line} of cell {cell:?} of a spline tile are no line")]
    Bits {
        /// The cell.
        cell: String,
        /// Number of the line, from 0.
        line: u32,
    },
}

impl SplineLine {
    /// The line's name as other interfaces write it.
    #[must_use]
    pub fn id_text(&self) -> String {
        lane_id_text(&self.id)
    }

    /// Standard deviation across the line at a point of its curve, metres.
    #[must_use]
    pub fn lateral_sigma_m_at(&self, point: &CurvePoint) -> f64 {
        between(&self.lateral_sigma_m, point)
    }

    /// Standard deviation of the height at a point of its curve, metres.
    #[must_use]
    pub fn height_sigma_m_at(&self, point: &CurvePoint) -> f64 {
        between(&self.height_sigma_m, point)
    }

    /// Probability that the line is there, at a point of its curve.
    #[must_use]
    pub fn existence_at(&self, point: &CurvePoint) -> f64 {
        between(&self.existence, point)
    }
}

fn between(values: &[f64], point: &CurvePoint) -> f64 {
    let (from, to) = (values[point.piece], values[point.piece + 1]);
    from + (to - from) * point.share
}

/// The lines that touch a tile, whole, of the cells that it [touches](TileId::cells_touched), in their order.
#[must_use]
pub fn spline_tile<'a>(tile: TileId, cells: impl IntoIterator<Item = &'a FittedCell>) -> v1::SplineTile {
    let cells = cells.into_iter().filter_map(|cell| {
        let bounds = bounds_of(tile, cell.cell);
        let lines: Vec<&FittedLine> = cell.lines.iter().filter(|line| line.bounds.touches(&bounds)).collect();
        (!lines.is_empty()).then(|| message(cell, &lines))
    });
    v1::SplineTile { cells: cells.collect() }
}

/// The box of a tile, as a cell sees it.
fn bounds_of(tile: TileId, cell: CellId) -> PlaneBox {
    let side = 1.0 / f64::from(1_u32 << tile.z());
    let [x, y] = [tile.x(), tile.y()].map(|number| f64::from(number) * side);
    let column = f64::from(cell.x()) / f64::from(1_u32 << lanemap_core::fleet::cell::ZOOM);
    // On the same side of the antimeridian.
    let low = Point2::new(x + (column - x).round(), y);
    PlaneBox::new(low.map(|axis| axis - MARGIN * side), low.map(|axis| axis + (1.0 + MARGIN) * side))
}

fn message(cell: &FittedCell, lines: &[&FittedLine]) -> v1::SplineCell {
    let beyond = |border: &Option<FittedBorder>| Some(Witness::of(&border.as_ref()?.continues_in?.1));
    let named = |line: &&FittedLine| {
        [Some(Witness::of(&line.id)), beyond(&line.begins_at), beyond(&line.ends_at)].into_iter().flatten()
    };
    let mut witnesses: Vec<Witness> = lines.iter().flat_map(named).collect();
    witnesses.sort_unstable();
    witnesses.dedup();
    let place = cell.cell.anchor().place();
    let (left_order, up_order) = best_orders(lines);
    let code = CellCode { cell: cell.cell, anchor: billionths(&place), witnesses, left_order, up_order };
    let (mut before, mut bits) = (Before::default(), BitWriter::default());
    for line in lines {
        code.write(line, &mut before, &mut bits);
    }
    let mut started = 0;
    let steps = code.witnesses.iter().map(|witness| {
        let step = witness.started.0.wrapping_sub(started);
        started = witness.started.0;
        step
    });
    v1::SplineCell {
        cell: cell.cell.to_string(),
        version: cell.version,
        anchor: Some(v1::GeodeticPosition {
            latitude_deg: place.latitude_deg,
            longitude_deg: place.longitude_deg,
            height_m: place.height_m,
        }),
        witness_started_unix_ns: steps.collect(),
        witness_drives: code.witnesses.iter().map(|witness| witness.drive.0).collect(),
        count: u32::try_from(lines.len()).unwrap_or(u32::MAX),
        left_order,
        up_order,
        lines: bits.finish(),
    }
}

fn billionths(place: &Wgs84) -> [i64; 2] {
    [place.latitude_deg, place.longitude_deg].map(|degrees| rounded(degrees * 1e9))
}

/// Reads a spline tile.
///
/// # Errors
/// A cell that is none, or bits that are no lines: the tile is damaged, or of a later version of the format.
pub fn read(tile: &v1::SplineTile) -> Result<Vec<CellSplines>, SplineTileError> {
    tile.cells.iter().map(read_cell).collect()
}

fn read_cell(message: &v1::SplineCell) -> Result<CellSplines, SplineTileError> {
    let wrong = |field, reason: String| SplineTileError::Field { field, cell: message.cell.clone(), reason };
    let cell: CellId = message.cell.parse().map_err(|error| wrong("cell", format!("{error}")))?;
    let anchor = message.anchor.ok_or_else(|| wrong("anchor", "it is missing".to_owned()))?;
    let anchor =
        Wgs84 { latitude_deg: anchor.latitude_deg, longitude_deg: anchor.longitude_deg, height_m: anchor.height_m };
    let is_place = |value: f64, most: f64| value.abs() <= most;
    if !(is_place(anchor.latitude_deg, 90.0) && is_place(anchor.longitude_deg, 180.0) && anchor.height_m.is_finite()) {
        return Err(wrong("anchor", "it is no place on the earth".to_owned()));
    }
    for (field, order) in [("left_order", message.left_order), ("up_order", message.up_order)] {
        if order > 30 {
            return Err(wrong(field, format!("{order} is above 30")));
        }
    }
    let code = CellCode {
        cell,
        anchor: billionths(&anchor),
        witnesses: witnesses(message),
        left_order: message.left_order,
        up_order: message.up_order,
    };
    let (mut before, mut bits) = (Before::default(), BitReader::new(&message.lines));
    let line = |line| {
        let coded = code.read(&mut before, &mut bits).and_then(CodedLine::into_line);
        coded.ok_or_else(|| SplineTileError::Bits { cell: message.cell.clone(), line })
    };
    let lines = (0..message.count).map(line).collect::<Result<_, _>>()?;
    Ok(CellSplines { cell, version: message.version, anchor: Anchor::new(anchor), lines })
}

fn witnesses(message: &v1::SplineCell) -> Vec<Witness> {
    let mut started = 0_i64;
    let starts = message.witness_started_unix_ns.iter().map(|step| {
        started = started.wrapping_add(*step);
        TimestampNs(started)
    });
    let witnesses = starts.zip(&message.witness_drives);
    witnesses.map(|(started, drive)| Witness { started, drive: DriveId(*drive) }).collect()
}

impl CodedLine {
    /// `None` where it is no line.
    fn into_line(self) -> Option<SplineLine> {
        let border = |border: Option<FittedBorder>| {
            border.map(|FittedBorder { place: [latitude, longitude, height_mm], continues_in }| SplineBorder {
                place: Wgs84 {
                    latitude_deg: latitude as f64 / 1e9,
                    longitude_deg: longitude as f64 / 1e9,
                    height_m: height_mm as f64 / 1e3,
                },
                continues_in,
            })
        };
        let codes = || self.points.iter().map(|(_, codes)| codes);
        Some(SplineLine {
            id: self.id,
            part: self.part,
            category: *ORDER.get(usize::try_from(self.category).ok()?)?,
            category_probability: 1.0 - self.doubt_percent.min(100) as f64 / 100.0,
            drives: self.drives,
            last_seen_unix_s: self.last_seen_s,
            confirmed_unix_s: self.confirmed_s,
            begins_at: border(self.begins_at),
            ends_at: border(self.ends_at),
            lateral_sigma_m: codes().map(|codes| sigma_m(codes.lateral)).collect(),
            height_sigma_m: codes().map(|codes| sigma_m(codes.height)).collect(),
            existence: codes().map(|codes| codes.existence as f64 / 100.0).collect(),
            curve: SplineCurve::new(self.points.iter().map(|(point, _)| metres(*point)).collect())?,
        })
    }
}

#[cfg(test)]
mod tests;
