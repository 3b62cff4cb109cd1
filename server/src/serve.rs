//! The HTTP side: maps for consumers, health and metrics for operators.
//!
//! | address | answer |
//! |---|---|
//! | `/sessions` | the drives, newest first: state, version, where they are; `limit` |
//! | `/sessions/{id}/lanes.geojson` | the lanes of one drive in WGS84; `?crs=local`: in metres |
//! | `/sessions/live` | where the vehicles are that stream now; `bbox`, `limit` |
//! | `/sessions/{id}/trace.geojson` | where the vehicle of a drive was, and when; `?crs=local`: in metres |
//! | `/sessions/{id}/lanes.pb` | the same lanes as splines, protobuf `lanemap.v1.LaneMap` |
//! | `/collections/lanes/items` | the lines of the shared map; `bbox`, `limit` |
//! | `/collections/drives/items` | the lanes of all georeferenced drives, each as it alone saw them; `bbox`, `limit` |
//! | `/cells` | the cells of the shared map: version, quality, whether they are up to date; `limit` |
//! | `/cells/{id}` | one of them |
//! | `/cells/{id}/lanes.geojson` | its lines in WGS84 |
//! | `/cells/{id}/lanes.pb` | the same as splines, protobuf `lanemap.v1.CellMap` |
//! | `/cells/{id}/lanes/{lane}/history` | how one of its lines came to be, over the versions that are kept |
//! | `/differences` | where the map is another one than at a revision: `since`, `bbox` |
//! | `/timeline` | when the map changed: revisions to go back to; `steps` |
//! | `/cells/{id}/changes`, `/cells/{id}/changes.pb` | what changed since a version: `since` |
//! | `/tiles/lanes`, `/tiles/lanes/{z}/{x}/{y}` | the lines of the shared map as vector tiles: TileJSON, MVT |
//! | `/changes` | what changes, as it changes, as server-sent events: `since`, `bbox`, `cell`, `content=lines` |
//! | `/exports/{id}` | a cell for other programs: GeoJSON, FlatGeobuf, PMTiles, Lanelet2, OpenDRIVE; `format`, or a suffix |
//! | `/styles/lanes.json` | a MapLibre style that draws them as paint |
//! | `/splines/{z}/{x}/{y}` | the lines that touch a tile, as splines, protobuf `lanemap.v1.SplineTile` |
//! | `/viewer` | a page that draws them |
//! | `/healthz`, `/readyz`, `/metrics` | for operators |
//!
//! Answers carry strong entity tags; refusals are RFC 9457 problem documents.

pub mod bounds;
mod cells;
mod changes;
mod difference;
mod drive_items;
mod encoding;
pub mod entity_tag;
mod exports;
pub mod extents;
pub mod features;
pub(crate) mod items;
mod lane_history;
mod limits;
pub mod line;
pub mod link_base;
mod operation;
mod page;
pub mod problem;
mod query;
#[cfg(test)]
pub(crate) mod sample;
mod session_trace;
mod sessions;
pub(crate) mod shared_lanes;
mod splines;
mod style;
mod tile_cache;
mod tiles;
mod timeline;
mod vehicles;
mod viewer;

use std::{sync::Arc, time::Duration};

use axum::{
    Router,
    extract::FromRef,
    http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header},
    middleware,
    response::{IntoResponse, Redirect, Response},
    routing::get,
};
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::{Semaphore, watch};
use tokio_util::sync::CancellationToken;
use tower_http::cors::{AllowHeaders, CorsLayer};

use self::{
    extents::Extents,
    limits::Limits,
    link_base::{LinkBase, LinkSettings},
    problem::{Problem, repeated},
    tile_cache::TileCache,
};
use crate::{
    auth::layer::require_read, change_feed::ChangeFeeds, config::ServerConfig, fuse::SharedMap, session::Sessions,
};

/// Time for which a browser need not ask again whether it may ask.
const ONE_DAY: Duration = Duration::from_hours(24);

/// What the HTTP handlers read.
#[derive(Clone)]
pub struct ServeState {
    /// The published maps.
    pub sessions: Sessions,
    /// The shared map.
    pub map: SharedMap,
    /// Streams of its changes.
    pub feeds: ChangeFeeds,
    /// Renders `/metrics`.
    pub metrics: PrometheusHandle,
    /// Whether the service takes traffic; falls first when it shuts down.
    pub ready: watch::Receiver<Readiness>,
    /// Cancelled when the service shuts down: answers that stay open (server-sent events) must end.
    pub shutdown: CancellationToken,
    /// The settings.
    pub config: Arc<ServerConfig>,
}

/// Whether the service takes traffic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Readiness {
    /// It does.
    Ready,
    /// It does not, and why.
    NotReady(String),
}

/// State of the handlers: what they are given, and what they keep.
#[derive(Clone)]
struct Shared {
    state: ServeState,
    extents: Extents,
    tiles: TileCache,
    links: LinkSettings,
}

impl FromRef<Shared> for LinkSettings {
    fn from_ref(shared: &Shared) -> Self {
        shared.links.clone()
    }
}

impl FromRef<Shared> for ServeState {
    fn from_ref(shared: &Shared) -> Self {
        shared.state.clone()
    }
}

impl FromRef<Shared> for TileCache {
    fn from_ref(shared: &Shared) -> Self {
        shared.tiles.clone()
    }
}

impl FromRef<Shared> for Extents {
    fn from_ref(shared: &Shared) -> Self {
        shared.extents.drop_removed(&shared.state.sessions);
        shared.extents.clone()
    }
}

/// Every HTTP route of the service, and the answer to requests that no route takes.
///
/// Maps and metrics are for those who may read them; the viewer's page and the style, which hold none, and health are for
/// all.
pub fn router(state: ServeState) -> Router {
    let (links, limits) = (LinkSettings::of(&state.config), Arc::new(Limits::of(&state.config)));
    let tiles = TileCache::new(state.map.clone(), state.config.max_cached_tile_bytes);
    let readers = Router::new()
        .route("/sessions", get(sessions::list))
        .route("/sessions/{id}/lanes.geojson", get(sessions::lanes_geojson))
        .route("/sessions/live", get(vehicles::live))
        .route("/sessions/{id}/trace.geojson", get(session_trace::trace_geojson))
        .route("/sessions/{id}/lanes.pb", get(sessions::lanes_protobuf))
        .route(items::PATH, get(items::items))
        .route(drive_items::PATH, get(drive_items::items))
        .route("/cells", get(cells::list))
        .route("/cells/{id}", get(cells::one))
        .route("/cells/{id}/lanes.geojson", get(cells::lanes_geojson))
        .route("/cells/{id}/lanes.pb", get(cells::lanes_protobuf))
        .route("/cells/{id}/lanes/{lane}/history", get(lane_history::history))
        .route("/differences", get(difference::differences))
        .route("/timeline", get(timeline::timeline))
        .route("/cells/{id}/changes", get(cells::changes_json))
        .route("/cells/{id}/changes.pb", get(cells::changes_protobuf))
        .route("/changes", get(changes::changes))
        .route("/exports/{id}", get(exports::cell))
        .route("/splines/{z}/{x}/{y}", get(splines::tile))
        .route(tiles::PATH, get(tiles::tile_json))
        .route("/tiles/lanes/{z}/{x}/{y}", get(tiles::tile))
        .route("/metrics", get(operation::metrics))
        .route_layer(middleware::from_fn(require_read));
    Router::new()
        .merge(readers)
        .route(style::PATH, get(style::style))
        .route("/viewer", get(viewer::page))
        .route("/viewer/", get(|base: LinkBase| async move { Redirect::permanent(&base.link("/viewer")) }))
        .route("/viewer/{name}", get(viewer::file))
        .route("/healthz", get(operation::healthz))
        .route("/readyz", get(operation::readyz))
        .fallback(no_such_path)
        .method_not_allowed_fallback(method_not_allowed)
        .layer(encoding::layer())
        .layer(middleware::from_fn(encoding::tell_apart))
        .layer(middleware::from_fn_with_state(limits, limits::keep))
        .layer(middleware::from_fn(limits::head_as_get))
        .layer(cross_origin())
        .with_state(Shared { state, extents: Extents::default(), tiles, links })
}

/// Pages of any origin may read what its user may.
fn cross_origin() -> CorsLayer {
    let told = [header::ETAG, header::LINK, header::ALLOW, header::RETRY_AFTER, header::WWW_AUTHENTICATE];
    // A `*` for headers would leave out `authorization`: browsers want it by name. Answers are the same for every origin,
    // so that they vary with none.
    CorsLayer::permissive().allow_headers(AllowHeaders::mirror_request()).expose_headers(told).vary([]).max_age(ONE_DAY)
}

/// HTTP status and a problem document for HTTP; for gRPC, which reads trailers only, its own "unimplemented".
async fn no_such_path(uri: Uri, headers: HeaderMap) -> Response {
    let is_grpc = headers
        .get(header::CONTENT_TYPE)
        .is_some_and(|content_type| content_type.as_bytes().starts_with(b"application/grpc"));
    if is_grpc {
        let unimplemented = [
            (header::CONTENT_TYPE, HeaderValue::from_static("application/grpc")),
            (header::HeaderName::from_static("grpc-status"), HeaderValue::from_static("12")),
        ];
        return (StatusCode::OK, unimplemented).into_response();
    }
    Problem::NoSuchPath { path: repeated(uri.path()) }.into_response()
}

async fn method_not_allowed(method: Method) -> Problem {
    Problem::MethodNotAllowed { method }
}

/// Most answers that are made at a time; more wait, so that many readers of large maps cost no more memory than these.
const MOST_AT_A_TIME: usize = 16;
static PLACES: Semaphore = Semaphore::const_new(MOST_AT_A_TIME);

/// Runs work that takes milliseconds where it delays no other request.
async fn in_background<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Problem> {
    let _place = PLACES.acquire().await.map_err(|_| Problem::Internal)?;
    tokio::task::spawn_blocking(work).await.map_err(|error| {
        tracing::error!(%error, "an answer could not be made");
        Problem::Internal
    })
}
