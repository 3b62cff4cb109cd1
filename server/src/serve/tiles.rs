//! `/tiles/lanes`: the shared map as vector tiles, and the TileJSON that describes them. What is in a tile is said by
//! [`lanemap_tiles`].

use std::collections::BTreeMap;

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderMap, Uri},
    response::Response,
};
use lanemap_core::fleet::CellId;
use lanemap_tiles::{FieldType, LAYERS, TileId, VECTOR_ZOOMS};
use serde::Serialize;

use super::{
    ServeState,
    entity_tag::EntityTag,
    items::of_cell,
    link_base::LinkBase,
    problem::{Problem, repeated},
    query::Parameters,
    tile_cache::{TileCache, TileKind},
};

use crate::fuse::MapRevision;

/// Media type of a vector tile.
pub(super) const VECTOR_TILE: &str = "application/vnd.mapbox-vector-tile";
/// Path of the TileJSON; tiles lie below it.
pub(super) const PATH: &str = "/tiles/lanes";

/// TileJSON 3.0.0.
#[derive(Debug, Serialize)]
struct TileJson {
    tilejson: &'static str,
    name: &'static str,
    description: &'static str,
    scheme: &'static str,
    tiles: [String; 1],
    minzoom: u8,
    maxzoom: u8,
    /// West, south, east, north of all lines.
    #[serde(skip_serializing_if = "Option::is_none")]
    bounds: Option<[f64; 4]>,
    /// Longitude, latitude and zoom to begin with.
    #[serde(skip_serializing_if = "Option::is_none")]
    center: Option<[f64; 3]>,
    vector_layers: Vec<VectorLayer>,
}

#[derive(Debug, Serialize)]
struct VectorLayer {
    id: &'static str,
    description: &'static str,
    minzoom: u8,
    maxzoom: u8,
    fields: BTreeMap<&'static str, &'static str>,
}

/// `GET /tiles/lanes/{z}/{x}/{y}`, also with `.mvt` or `.pbf` behind it; `revision`: as the map was.
pub(super) async fn tile(
    State(cache): State<TileCache>,
    Path((z, x, y)): Path<(String, String, String)>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let revision = Parameters::read(&uri, &["revision"])?.get("revision", str::parse::<MapRevision>)?;
    let row = y.strip_suffix(".mvt").or_else(|| y.strip_suffix(".pbf")).unwrap_or(&y);
    let tile = named([&z, &x, row], VECTOR_ZOOMS)?;
    match revision {
        None => cache.answer(TileKind::Vector, tile, VECTOR_TILE, &headers).await,
        Some(revision) => cache.answer_at(TileKind::Vector, tile, revision, VECTOR_TILE, &headers).await,
    }
}

/// The tile of an address, where its zoom is served.
pub(super) fn named(address: [&str; 3], zooms: std::ops::RangeInclusive<u8>) -> Result<TileId, Problem> {
    let text = address.join("/");
    let tile = text.parse().ok().filter(|tile: &TileId| zooms.contains(&tile.z()));
    tile.ok_or_else(|| Problem::NoSuchTile {
        tile: repeated(&text),
        limit: format!("z in {} ..= {}, x and y below 2^z", zooms.start(), zooms.end()),
    })
}

/// `GET /tiles/lanes`
pub(super) async fn tile_json(
    State(state): State<ServeState>,
    base: LinkBase,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let bounds = bounds(state.map.list().into_iter().filter(|(_, record)| record.lanes > 0).map(|(cell, _)| cell));
    let template = base.link(&format!("{PATH}/{{z}}/{{x}}/{{y}}"));
    let tag = EntityTag::of((&template, bounds.map(|bounds| bounds.map(f64::to_bits))));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    Ok(tag.on(Json(described(template, bounds))))
}

/// What is told of the tiles that an address template gives.
fn described(template: String, bounds: Option<[f64; 4]>) -> TileJson {
    let layers = LAYERS.iter().map(|layer| VectorLayer {
        id: layer.name,
        description: layer.description,
        minzoom: layer.from_zoom,
        maxzoom: *VECTOR_ZOOMS.end(),
        fields: layer.fields.iter().map(|field| (field.name, type_name(field.kind))).collect(),
    });
    TileJson {
        tilejson: "3.0.0",
        name: "lanemap",
        description: "The lines of the shared map",
        scheme: "xyz",
        tiles: [template],
        minzoom: *VECTOR_ZOOMS.start(),
        maxzoom: *VECTOR_ZOOMS.end(),
        bounds,
        center: bounds.map(|[west, south, east, north]| [0.5 * (west + east), 0.5 * (south + north), 15.0]),
        vector_layers: layers.collect(),
    }
}

fn type_name(kind: FieldType) -> &'static str {
    match kind {
        FieldType::Number => "Number",
        FieldType::Text => "String",
    }
}

/// The box around some cells: west, south, east, north. A map on both sides of the antimeridian goes round the earth:
/// TileJSON knows no box that crosses it.
pub(super) fn bounds(cells: impl Iterator<Item = CellId>) -> Option<[f64; 4]> {
    cells
        .map(of_cell)
        .map(|cell| [cell.west, cell.south, cell.east, cell.north])
        .reduce(|all, cell| [all[0].min(cell[0]), all[1].min(cell[1]), all[2].max(cell[2]), all[3].max(cell[3])])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bounds_hold_every_cell() {
        let cells = [(8_718, 5_685), (8_720, 5_680)].map(|(x, y)| CellId::new(x, y).unwrap());
        let [west, south, east, north] = bounds(cells.into_iter()).unwrap();
        for cell in cells.map(of_cell) {
            assert!(west <= cell.west && south <= cell.south && east >= cell.east && north >= cell.north);
        }
        assert_eq!(bounds(std::iter::empty()), None);
    }

    #[test]
    fn a_tile_that_is_none_or_not_served_is_refused() {
        for address in [["11", "0", "0"], ["21", "0", "0"], ["14", "16384", "0"], ["14", "-1", "0"], ["14", "0", "x"]] {
            assert!(named(address, VECTOR_ZOOMS).is_err(), "{address:?}");
        }
    }

    #[test]
    fn every_property_of_the_tiles_is_described() {
        let described = described("http://host/tiles/lanes/{z}/{x}/{y}".into(), None);
        let fields: Vec<usize> = described.vector_layers.iter().map(|layer| layer.fields.len()).collect();
        assert_eq!(fields, LAYERS.map(|layer| layer.fields.len()));
    }
}
