//! PMTiles: the vector tiles of `/tiles/lanes` in one file, to be served from any disk.
//!
//! Format: PMTiles 3. Tiles are made by [`lanemap_tiles`], as they are for requests, packed with gzip, in the order of
//! their numbers along the Hilbert curve (a clustered archive), equal ones once. Every cell is held, made ready for drawing.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::{self, Seek, SeekFrom, Write},
    ops::RangeInclusive,
};

use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use lanemap_tiles::{FieldType, LAYERS, ProjectedCell, TileId, vector_tile};
use pmtiles::{PmTilesWriter, TileCoord, TileType};
use serde_json::json;

use super::{ExportError, Summary, cell_of};

/// Zooms of an archive: at 16 a unit of a tile is a decimetre, and viewers draw that larger.
pub const ZOOMS: RangeInclusive<u8> = 12..=16;
/// Zoom of the tiles that are cells.
const CELL_ZOOM: u8 = 14;

/// Writes cells as tiles of some zooms.
///
/// # Errors
/// The output cannot be written, or a cell cannot be read.
pub fn write(
    cells: impl Iterator<Item = Result<v1::CellMap, ExportError>>,
    zooms: RangeInclusive<u8>,
    out: &mut dyn Write,
) -> Result<Summary, ExportError> {
    let mut summary = Summary::default();
    let mut projected: BTreeMap<CellId, ProjectedCell> = BTreeMap::new();
    for map in cells {
        let map = map?;
        summary.lines += map.lanes.len() as u64;
        if !map.lanes.is_empty() {
            let cell = cell_of(&map)?;
            projected.insert(cell, ProjectedCell::new(cell, &map));
        }
    }
    // The archive's header, which comes first, is known last.
    let mut file = tempfile::tempfile()?;
    summary.tiles = write_archive(&projected, zooms, &mut file)?;
    file.seek(SeekFrom::Start(0))?;
    io::copy(&mut file, out)?;
    Ok(summary)
}

fn refused(error: &dyn std::fmt::Display) -> ExportError {
    ExportError::Format { format: "PMTiles", reason: error.to_string() }
}

fn write_archive(
    cells: &BTreeMap<CellId, ProjectedCell>,
    zooms: RangeInclusive<u8>,
    file: &mut std::fs::File,
) -> Result<u64, ExportError> {
    let [west, south, east, north] = bounds(cells.keys()).unwrap_or_default();
    let mut archive = PmTilesWriter::new(TileType::Mvt)
        .min_zoom(*zooms.start())
        .max_zoom(*zooms.end())
        .bounds(west, south, east, north)
        .center(0.5 * (west + east), 0.5 * (south + north))
        .center_zoom(CELL_ZOOM.clamp(*zooms.start(), *zooms.end()))
        .metadata(metadata(&zooms).to_string())
        .create(file)
        .map_err(|error| refused(&error))?;
    let mut written = 0;
    for zoom in zooms {
        for (_, tile) in tiles(cells, zoom)? {
            let near = tile.cells_touched();
            let bytes = vector_tile(tile, near.iter().filter_map(|cell| cells.get(cell)));
            if !bytes.is_empty() {
                let coordinate = TileCoord::new(tile.z(), tile.x(), tile.y()).map_err(|error| refused(&error))?;
                archive.add_tile(coordinate, &bytes).map_err(|error| refused(&error))?;
                written += 1;
            }
        }
    }
    archive.finalize().map_err(|error| refused(&error))?;
    Ok(written)
}

/// The tiles of a zoom that may show something, in the order of their numbers.
fn tiles(cells: &BTreeMap<CellId, ProjectedCell>, zoom: u8) -> Result<BTreeMap<u64, TileId>, ExportError> {
    let mut near: BTreeSet<(u32, u32)> = BTreeSet::new();
    let count = 1_u32 << zoom;
    for cell in cells.keys() {
        let (first, last) = (|number: u32| shifted(number, zoom), |number: u32| shifted(number + 1, zoom).max(1) - 1);
        let span = |number: u32| first(number)..=last(number).max(first(number));
        // A tile shows what lies a little beyond its border.
        for x in span(cell.x()) {
            for y in span(cell.y()) {
                for (beside_x, beside_y) in (0..3).flat_map(|dx| (0..3).map(move |dy| (dx, dy))) {
                    let column = (x + count + beside_x - 1) % count;
                    if let Some(row) = (y + beside_y).checked_sub(1).filter(|row| *row < count) {
                        near.insert((column, row));
                    }
                }
            }
        }
    }
    let mut ordered = BTreeMap::new();
    for (x, y) in near {
        let number: pmtiles::TileId = TileCoord::new(zoom, x, y).map_err(|error| refused(&error))?.into();
        if let Some(tile) = TileId::new(zoom, x, y) {
            ordered.insert(number.value(), tile);
        }
    }
    Ok(ordered)
}

/// A column or row of cells among those of a zoom.
fn shifted(number: u32, zoom: u8) -> u32 {
    if zoom >= CELL_ZOOM { number << (zoom - CELL_ZOOM) } else { number >> (CELL_ZOOM - zoom) }
}

/// West, south, east, north of cells.
fn bounds<'a>(cells: impl Iterator<Item = &'a CellId>) -> Option<[f64; 4]> {
    let boxes = cells.map(|cell| {
        let bounds = cell.bounds();
        [bounds.west, bounds.south, bounds.east, bounds.north]
    });
    boxes.reduce(|a, b| [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])])
}

/// What describes the tiles.
fn metadata(zooms: &RangeInclusive<u8>) -> serde_json::Value {
    let layers = LAYERS.iter().filter(|layer| layer.from_zoom <= *zooms.end()).map(|layer| {
        let fields: BTreeMap<&str, &str> =
            layer.fields.iter().map(|field| (field.name, type_name(field.kind))).collect();
        json!({
            "id": layer.name,
            "description": layer.description,
            "minzoom": layer.from_zoom.max(*zooms.start()),
            "maxzoom": zooms.end(),
            "fields": fields,
        })
    });
    json!({
        "name": "lanemap",
        "description": "The lines of the shared lane map",
        "type": "overlay",
        "format": "pbf",
        "vector_layers": layers.collect::<Vec<_>>(),
    })
}

fn type_name(kind: FieldType) -> &'static str {
    match kind {
        FieldType::Text => "String",
        FieldType::Number => "Number",
    }
}
