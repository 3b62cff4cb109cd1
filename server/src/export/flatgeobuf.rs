//! FlatGeobuf: the features of `/collections/lanes/items` in one file with a spatial index, WGS84 with heights.
//!
//! Features wait in a temporary file until the index before them is known: memory holds their boxes alone.

use std::io::Write;

use flatgeobuf::{ColumnType, FgbCrs, FgbWriter, FgbWriterOptions, GeometryType};
use geozero::{ColumnValue, FeatureProcessor, GeomProcessor, PropertyProcessor, error::GeozeroError};
use lanemap_proto::v1;
use serde_json::Value;

use super::{ExportError, Summary, cell_of};
use crate::serve::{
    line::Coordinate,
    shared_lanes::{SharedLane, shared_lane},
};

/// The columns: `id`, then the properties of a feature as GeoJSON has them. `category_posterior`, a list, is JSON.
const COLUMNS: [(&str, ColumnType); 18] = [
    ("id", ColumnType::String),
    ("lane", ColumnType::String),
    ("cell", ColumnType::String),
    ("part", ColumnType::Long),
    ("version", ColumnType::Long),
    ("category", ColumnType::String),
    ("category_code", ColumnType::Int),
    ("category_posterior", ColumnType::Json),
    ("drives", ColumnType::Long),
    ("observations", ColumnType::Long),
    ("existence", ColumnType::Double),
    ("lateral_sigma_m", ColumnType::Double),
    ("height_sigma_m", ColumnType::Double),
    ("first_seen", ColumnType::DateTime),
    ("last_seen", ColumnType::DateTime),
    ("confirmed", ColumnType::DateTime),
    ("comes_from", ColumnType::String),
    ("continues_in", ColumnType::String),
];

/// Writes the lines of cells.
///
/// # Errors
/// The output cannot be written, or a cell cannot be read.
pub fn write(
    cells: impl Iterator<Item = Result<v1::CellMap, ExportError>>,
    out: &mut dyn Write,
) -> Result<Summary, ExportError> {
    let options = FgbWriterOptions {
        write_index: true,
        detect_type: false,
        promote_to_multi: false,
        crs: FgbCrs { org: Some("EPSG"), code: 4326, name: Some("WGS 84"), ..FgbCrs::default() },
        has_z: true,
        title: Some("Lines of the shared lane map"),
        ..FgbWriterOptions::default()
    };
    let mut file =
        FgbWriter::create_with_options("lanes", GeometryType::LineString, options).map_err(|error| refused(&error))?;
    for (name, kind) in COLUMNS {
        file.add_column(name, kind, |_, _| {});
    }
    let mut summary = Summary::default();
    for map in cells {
        let map = map?;
        let anchor = cell_of(&map)?.anchor();
        for feature in map.lanes.iter().filter_map(|lane| shared_lane(&anchor, &map, lane)) {
            write_feature(&mut file, &feature, summary.lines).map_err(|error| refused(&error))?;
            summary.lines += 1;
        }
    }
    file.write(out).map_err(|error| refused(&error))?;
    Ok(summary)
}

fn refused(error: &dyn std::fmt::Display) -> ExportError {
    ExportError::Format { format: "FlatGeobuf", reason: error.to_string() }
}

fn write_feature(file: &mut FgbWriter<'_>, feature: &SharedLane, number: u64) -> Result<(), GeozeroError> {
    // A cell ends at the antimeridian; where rounding puts a part beyond it, the line runs on over 180 degrees.
    let mut coordinates: Vec<Coordinate> = Vec::with_capacity(feature.geometry.size());
    for mut coordinate in feature.geometry.parts().flatten().copied() {
        if let Some(before) = coordinates.last() {
            coordinate[0] -= 360.0 * ((coordinate[0] - before[0]) / 360.0).round();
        }
        if coordinates.last() != Some(&coordinate) {
            coordinates.push(coordinate);
        }
    }
    file.feature_begin(number)?;
    file.geometry_begin()?;
    file.linestring_begin(true, coordinates.len(), 0)?;
    for (index, [longitude, latitude, height_m]) in coordinates.into_iter().enumerate() {
        file.coordinate(longitude, latitude, Some(height_m), None, None, None, index)?;
    }
    file.linestring_end(true, 0)?;
    file.geometry_end()?;
    file.properties_begin()?;
    let properties = serde_json::to_value(&feature.properties).unwrap_or_default();
    for (index, (name, kind)) in COLUMNS.into_iter().enumerate() {
        let value = if name == "id" { Value::from(feature.id.as_str()) } else { properties[name].clone() };
        write_property(file, index, name, kind, &value)?;
    }
    file.properties_end()?;
    file.feature_end(number)
}

fn write_property(
    file: &mut FgbWriter<'_>,
    index: usize,
    name: &str,
    kind: ColumnType,
    value: &Value,
) -> Result<(), GeozeroError> {
    let text = value.as_str().unwrap_or_default();
    let json;
    let column = match (kind, value) {
        (_, Value::Null) => return Ok(()),
        (ColumnType::Long, value) => ColumnValue::Long(value.as_i64().unwrap_or_default()),
        (ColumnType::Int, value) => {
            ColumnValue::Int(value.as_i64().and_then(|value| i32::try_from(value).ok()).unwrap_or_default())
        }
        (ColumnType::Double, value) => ColumnValue::Double(value.as_f64().unwrap_or_default()),
        (ColumnType::DateTime, _) => ColumnValue::DateTime(text),
        (ColumnType::Json, value) => {
            json = value.to_string();
            ColumnValue::Json(&json)
        }
        _ => ColumnValue::String(text),
    };
    file.property(index, name, &column).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{fuse::wire::empty_cell, serve::shared_lanes::shared_lane};
    use lanemap_core::fleet::CellId;

    #[test]
    fn every_property_of_a_feature_has_a_column() {
        let cell = CellId::new(8_718, 5_685).unwrap();
        let border = v1::LaneBorder {
            place: None,
            continues_in: Some(v1::LaneName { cell: cell.to_string(), id: "b".into(), part: 0 }),
        };
        let lane = v1::FusedLane {
            id: "a".into(),
            xyz_mm: vec![0, 0, 0, 3_000, 0, 0],
            begins_at: Some(border.clone()),
            ends_at: Some(border),
            ..v1::FusedLane::default()
        };
        let map = empty_cell(cell);
        let feature = shared_lane(&cell.anchor(), &map, &lane).unwrap();
        let properties = serde_json::to_value(&feature.properties).unwrap();
        let mut columns: Vec<&str> = COLUMNS.iter().map(|(name, _)| *name).filter(|name| *name != "id").collect();
        let mut names: Vec<&str> = properties.as_object().unwrap().keys().map(String::as_str).collect();
        columns.sort_unstable();
        names.sort_unstable();
        assert_eq!(columns, names);
    }
}
