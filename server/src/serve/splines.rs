//! `/splines/{z}/{x}/{y}`: the lines of the shared map that touch a tile, exactly, as splines.

use std::f64::consts::PI;

use axum::{
    extract::{Path, State},
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use prost::Message;

use super::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    features::on_the_earth,
    in_background,
    items::of_cell,
    problem::{Problem, repeated},
    query::Parameters,
    sessions::PROTOBUF,
    shared_lanes::coordinates,
};
use crate::{fuse::SharedMap, journal::JournalError};

/// Zooms that are served: the widest tile has 256 cells.
const ZOOMS: std::ops::RangeInclusive<u8> = 10..=22;

/// `GET /splines/{z}/{x}/{y}`
pub(super) async fn tile(
    State(state): State<ServeState>,
    Path((z, x, y)): Path<(String, String, String)>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let bounds = tile_bounds(&z, &x, &y).ok_or_else(|| Problem::NoSuchTile {
        tile: repeated(&format!("{z}/{x}/{y}")),
        limit: format!("z in {} ..= {}, x and y below 2^z", ZOOMS.start(), ZOOMS.end()),
    })?;
    let mut cells = state.map.list();
    cells.retain(|(cell, record)| record.lanes > 0 && of_cell(*cell).touches(&bounds));
    let versions: Vec<_> = cells.iter().map(|(cell, record)| (*cell, record.version)).collect();
    let tag = EntityTag::of((versions, &z, &x, &y));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let cells: Vec<CellId> = cells.into_iter().map(|(cell, _)| cell).collect();
    let body = in_background(move || spline_tile(&state.map, &cells, &bounds)).await??;
    Ok(tag.on(([(header::CONTENT_TYPE, PROTOBUF)], body.encode_to_vec())))
}

fn spline_tile(map: &SharedMap, cells: &[CellId], bounds: &Bounds) -> Result<v1::SplineTile, JournalError> {
    let mut tile = v1::SplineTile::default();
    for cell in cells {
        let Some(found) = map.get(*cell)? else { continue };
        let anchor = cell.anchor();
        let touches = |lane: &&v1::FusedLane| {
            let line = coordinates(&anchor, lane);
            line.len() > 1 && on_the_earth(line).enters(bounds)
        };
        let lanes: Vec<_> = found.map.lanes.iter().filter(touches).cloned().collect();
        if !lanes.is_empty() {
            let (cell, version, anchor) = (found.map.cell.clone(), found.map.version, found.map.anchor);
            tile.cells.push(v1::CellMap { cell, version, anchor, lanes });
        }
    }
    Ok(tile)
}

/// The borders of a tile; `None` where there is none, or it is not served.
fn tile_bounds(z: &str, x: &str, y: &str) -> Option<Bounds> {
    let zoom: u8 = z.parse().ok().filter(|zoom| ZOOMS.contains(zoom))?;
    let tiles = 1_u32 << zoom;
    let [x, y] = [x, y].map(|text| text.parse::<u32>().ok().filter(|number| *number < tiles).map(f64::from));
    let (x, y, tiles) = (x?, y?, f64::from(tiles));
    let longitude = |x: f64| x / tiles * 360.0 - 180.0;
    let latitude = |y: f64| (PI * (1.0 - 2.0 * y / tiles)).sinh().atan().to_degrees();
    Some(Bounds {
        west: longitude(x),
        south: latitude(y + 1.0),
        east: longitude(x + 1.0),
        north: latitude(y),
        heights: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_of_the_cells_zoom_has_the_cells_borders() {
        let cell = CellId::new(8_718, 5_685).unwrap();
        assert_eq!(tile_bounds("14", "8718", "5685"), Some(of_cell(cell)));
    }

    #[test]
    fn a_tile_that_is_none_is_refused() {
        for (z, x, y) in [("9", "0", "0"), ("23", "0", "0"), ("14", "16384", "0"), ("14", "-1", "0"), ("14", "0", "x")]
        {
            assert_eq!(tile_bounds(z, x, y), None, "{z}/{x}/{y}");
        }
    }
}
