//! The shared map in the formats of others, without HTTP: plain functions from cells to bytes.
//!
//! | format | what is in it |
//! |---|---|
//! | [`geojson`] | the features of `/collections/lanes/items`, as they are served |
//! | [`flatgeobuf`] | the same, with a spatial index |
//! | [`pmtiles`] | the vector tiles of `/tiles/lanes`, all in one file |
//! | [`lanelet2`] | [lanes](road) between the lines, as lanelets that follow and adjoin each other |
//! | [`opendrive`] | the same lanes, as roads whose reference lines are the splines themselves |
//!
//! A module of the server and not a crate of its own, because what is exported is what is served: features and tiles are
//! made by the code that answers requests, so that an export cannot differ from an answer. The command line calls the
//! same functions on the cells that it reads from a store, or from another server.
//!
//! GeoJSON and FlatGeobuf take their cells one by one and stay small however large the map is. A tile shows lines of several
//! cells, and lanes lie between lines of several: PMTiles, Lanelet2 and OpenDRIVE hold the whole map that they write.

mod bridge;
mod chain;
mod direction;
pub mod flatgeobuf;
pub mod geojson;
pub mod junction;
pub mod lanelet2;
pub mod map_line;
pub mod opendrive;
pub mod plane;
pub mod pmtiles;
pub mod road;
mod stored;

use std::io::Write;

use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use thiserror::Error;

pub use self::stored::StoredMap;
use crate::{
    journal::JournalError,
    serve::{bounds::Bounds, items, shared_lanes},
};

/// A format in which the map can be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Format {
    /// GeoJSON, RFC 7946.
    GeoJson,
    /// FlatGeobuf 3.
    FlatGeobuf,
    /// PMTiles 3 with vector tiles.
    PmTiles,
    /// OSM XML as Lanelet2 reads it.
    Lanelet2,
    /// ASAM OpenDRIVE 1.7.
    OpenDrive,
}

impl Format {
    /// Every format.
    pub const ALL: [Self; 5] = [Self::GeoJson, Self::FlatGeobuf, Self::PmTiles, Self::Lanelet2, Self::OpenDrive];

    /// Its name, as `?format=` and `--format` have it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::GeoJson => "geojson",
            Self::FlatGeobuf => "flatgeobuf",
            Self::PmTiles => "pmtiles",
            Self::Lanelet2 => "lanelet2",
            Self::OpenDrive => "opendrive",
        }
    }

    /// What its files end in, without the dot.
    #[must_use]
    pub const fn suffix(self) -> &'static str {
        match self {
            Self::GeoJson => "geojson",
            Self::FlatGeobuf => "fgb",
            Self::PmTiles => "pmtiles",
            Self::Lanelet2 => "osm",
            Self::OpenDrive => "xodr",
        }
    }

    /// Its media type.
    #[must_use]
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::GeoJson => "application/geo+json",
            Self::FlatGeobuf => "application/vnd.flatgeobuf",
            Self::PmTiles => "application/vnd.pmtiles",
            Self::Lanelet2 => "application/vnd.openstreetmap.data+xml",
            Self::OpenDrive => "application/xml",
        }
    }

    /// The format of a name.
    #[must_use]
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.name() == name)
    }

    /// The format of a file's suffix.
    #[must_use]
    pub fn of_suffix(suffix: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.suffix() == suffix)
    }

    /// The names of all formats, for messages.
    #[must_use]
    pub fn names() -> String {
        Self::ALL.map(Self::name).join(", ")
    }
}

/// The side of the road on which vehicles drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum TrafficSide {
    /// As in most of the world.
    #[default]
    Right,
    /// As in Japan or the United Kingdom.
    Left,
}

/// How lanes are read out of lines, for the formats that have lanes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct LaneOptions {
    /// The side on which vehicles drive.
    pub traffic: TrafficSide,
}

/// Why a map could not be exported.
#[derive(Debug, Error)]
pub enum ExportError {
    /// The output cannot be written.
    #[error("the output cannot be written: {0}")]
    Output(#[from] std::io::Error),
    /// A cell cannot be read.
    #[error("a cell cannot be read: {0}")]
    Cell(String),
    /// The library that writes a format refuses.
    #[error("{format} cannot be written: {reason}")]
    Format {
        /// The format.
        format: &'static str,
        /// What the library says.
        reason: String,
    },
}

impl From<JournalError> for ExportError {
    fn from(error: JournalError) -> Self {
        Self::Cell(error.to_string())
    }
}

/// What was exported.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    /// Pieces of lines.
    pub lines: u64,
    /// Lanelets, or sections of lanes; 0 in formats without lanes.
    pub lanes: u64,
    /// Tiles; 0 in formats without tiles.
    pub tiles: u64,
}

/// Writes cells in a format. Cells come in their order, each once.
///
/// # Errors
/// The output cannot be written, or a cell cannot be read.
pub fn write(
    format: Format,
    cells: impl Iterator<Item = Result<v1::CellMap, ExportError>>,
    options: LaneOptions,
    out: &mut dyn Write,
) -> Result<Summary, ExportError> {
    match format {
        Format::GeoJson => geojson::write(cells, out),
        Format::FlatGeobuf => flatgeobuf::write(cells, out),
        Format::PmTiles => pmtiles::write(cells, pmtiles::ZOOMS, out),
        Format::Lanelet2 => lanelet2::write(&map_line::read(cells)?, options, out),
        Format::OpenDrive => opendrive::write(&map_line::read(cells)?, options, out),
    }
}

/// The lines of a cell that enter a box, each whole.
///
/// # Errors
/// The cell's name is none.
pub fn within(mut map: v1::CellMap, bounds: &Bounds) -> Result<v1::CellMap, ExportError> {
    let cell = cell_of(&map)?;
    map.lanes.retain(|lane| shared_lanes::enters(cell, lane, bounds));
    Ok(map)
}

/// Whether lines of a cell may enter a box.
#[must_use]
pub fn may_enter(cell: CellId, bounds: &Bounds) -> bool {
    items::of_cell(cell).loosened().touches(bounds)
}

/// The cell of a map, which its name tells.
fn cell_of(map: &v1::CellMap) -> Result<CellId, ExportError> {
    map.cell.parse().map_err(|error| ExportError::Cell(format!("{error}")))
}
