//! GeoJSON (RFC 7946): the features of `/collections/lanes/items`, one on a line, written as they come.

use std::io::Write;

use lanemap_proto::v1;

use super::{ExportError, Summary, cell_of};
use crate::serve::shared_lanes::shared_lane;

/// Writes the lines of cells as one feature collection. Holds one cell at a time.
///
/// # Errors
/// The output cannot be written, or a cell cannot be read.
pub fn write(
    cells: impl Iterator<Item = Result<v1::CellMap, ExportError>>,
    out: &mut dyn Write,
) -> Result<Summary, ExportError> {
    let mut summary = Summary::default();
    out.write_all(b"{\"type\":\"FeatureCollection\",\"features\":[")?;
    for map in cells {
        let map = map?;
        let anchor = cell_of(&map)?.anchor();
        for feature in map.lanes.iter().filter_map(|lane| shared_lane(&anchor, &map, lane)) {
            out.write_all(if summary.lines == 0 { b"\n" } else { b",\n" })?;
            serde_json::to_writer(&mut *out, &feature).map_err(std::io::Error::from)?;
            summary.lines += 1;
        }
    }
    out.write_all(b"\n]}\n")?;
    Ok(summary)
}
