//! `/splines/{z}/{x}/{y}`: the lines of the shared map that touch a tile, as splines to compute with
//! ([`lanemap_tiles::spline`]).

use axum::{
    extract::{Path, State},
    http::{HeaderMap, Uri},
    response::Response,
};
use lanemap_tiles::spline::SPLINE_ZOOMS;

use super::{
    problem::Problem,
    query::Parameters,
    sessions::PROTOBUF,
    tile_cache::{TileCache, TileKind},
    tiles::named,
};

/// `GET /splines/{z}/{x}/{y}`
pub(super) async fn tile(
    State(cache): State<TileCache>,
    Path((z, x, y)): Path<(String, String, String)>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    Parameters::read(&uri, &[])?;
    let tile = named([&z, &x, &y], SPLINE_ZOOMS)?;
    cache.answer(TileKind::Spline, tile, PROTOBUF, &headers).await
}
