//! The HTTP side: maps for consumers, health and metrics for operators.
//!
//! | address | answer |
//! |---|---|
//! | `/sessions` | the drives, newest first: state, version, where they are; `limit` |
//! | `/sessions/{id}/lanes.geojson` | the lanes of one drive in WGS84; `?crs=local`: in metres |
//! | `/sessions/live` | where the vehicles are that stream now; `bbox`, `limit` |
//! | `/sessions/{id}/trace.geojson` | where the vehicle of a drive was, and when; `?crs=local`: in metres |
//! | `/sessions/{id}/lanes.pb` | the same lanes as splines, protobuf `lanemap.v1.LaneMap` |
//! | `/`, `/conformance`, `/api`, `/collections` | OGC API - Features: where everything begins, and its description |
//! | `/collections/lanes/items` | the lines of the shared map; `bbox`, `datetime`, `limit`, filters |
//! | `/collections/control_points/items` | their control points, likewise |
//! | `/collections/cells/items` | the cells as polygons, with the quality of their lines, likewise |
//! | `/collections/drives/items` | the lanes of all georeferenced drives, each as it alone saw them, likewise |
//! | `/collections/{collection}/items/{id}` | one of them |
//! | `/cells` | the cells of the shared map: version, quality, whether they are up to date; `limit` |
//! | `/cells/{id}` | one of them |
//! | `/cells/{id}/lanes.geojson` | its lines in WGS84 |
//! | `/cells/{id}/lanes.pb` | the same as splines, protobuf `lanemap.v1.CellMap` |
//! | `/cells/{id}/lanes/{lane}/history` | how one of its lines came to be, over the versions that are kept |
//! | `/differences` | where the map is another one than at a revision: `since`, `bbox` |
//! | `/timeline` | when the map changed: revisions to go back to; `steps` |
//! | `/cells/{id}/changes`, `/cells/{id}/changes.pb` | what changed since a version: `since` |
//! | `/tiles/lanes`, `/tiles/lanes/{z}/{x}/{y}` | the lines of the shared map as vector tiles: TileJSON, MVT |
//! | `/cells/{id}/events` | what happened to its road, and to the names of its lines: `since`, `limit` |
//! | `/events` | the same of all cells, the newest first: `bbox`, `since`, `kind`, `limit` |
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
mod events;
mod exports;
pub mod extents;
pub mod features;
mod form;
mod html;
pub(crate) mod items;
mod lane_history;
mod limits;
pub mod line;
pub mod link_base;
mod map_events;
mod ogc;
mod openapi;
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
    ogc::{
        collection::{COLLECTIONS, Collection},
        drive_walks::DriveWalks,
        feature_cache::FeatureCache,
        landing,
    },
    openapi::{Api, Routes, operations},
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
    cache: FeatureCache,
    walks: DriveWalks,
    links: LinkSettings,
    api: Arc<Api>,
}

impl FromRef<Shared> for FeatureCache {
    fn from_ref(shared: &Shared) -> Self {
        shared.cache.clone()
    }
}

impl FromRef<Shared> for DriveWalks {
    fn from_ref(shared: &Shared) -> Self {
        shared.walks.clone()
    }
}

impl FromRef<Shared> for Arc<Api> {
    fn from_ref(shared: &Shared) -> Self {
        Arc::clone(&shared.api)
    }
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
    let cache = FeatureCache::new(state.config.max_cached_feature_bytes);
    let walks = DriveWalks::new(state.config.max_cached_map_bytes);
    let (readers, described) = for_readers().into_parts();
    let (for_all, described_for_all) = for_all().into_parts();
    let api = Arc::new(Api::of(&[described_for_all, described].concat()));
    Router::new()
        .merge(readers.route_layer(middleware::from_fn(require_read)))
        .merge(for_all)
        .fallback(no_such_path)
        .method_not_allowed_fallback(method_not_allowed)
        .layer(encoding::layer())
        .layer(middleware::from_fn(encoding::tell_apart))
        .layer(middleware::from_fn_with_state(limits, limits::keep))
        .layer(middleware::from_fn(limits::head_as_get))
        .layer(cross_origin())
        .with_state(Shared { state, extents: Extents::default(), tiles, cache, walks, links, api })
}

/// What those may ask who may read: maps and metrics. Each route is described where it is added: see [`openapi`].
fn for_readers() -> Routes {
    COLLECTIONS
        .iter()
        .fold(Routes::new().get("/collections", landing::collections, operations::collections()), collection)
        .get("/cells", cells::list, operations::cells())
        .get("/cells/{id}", cells::one, operations::cell())
        .get("/cells/{id}/lanes.geojson", cells::lanes_geojson, operations::cell_lanes_geojson())
        .get("/cells/{id}/lanes.pb", cells::lanes_protobuf, operations::cell_lanes_protobuf())
        .get("/cells/{id}/changes", cells::changes_json, operations::cell_changes_json())
        .get("/cells/{id}/changes.pb", cells::changes_protobuf, operations::cell_changes_protobuf())
        .get("/cells/{id}/events", events::events, operations::cell_events())
        .get("/cells/{id}/lanes/{lane}/history", lane_history::history, operations::lane_history())
        .get("/changes", changes::changes, operations::changes())
        .get("/events", map_events::events, operations::map_events())
        .get("/differences", difference::differences, operations::differences())
        .get("/timeline", timeline::timeline, operations::timeline())
        .get("/exports/{id}", exports::cell, operations::export())
        .get("/splines/{z}/{x}/{y}", splines::tile, operations::spline_tile())
        .get(tiles::PATH, tiles::tile_json, operations::tile_json())
        .get("/tiles/lanes/{z}/{x}/{y}", tiles::tile, operations::vector_tile())
        .get("/sessions", sessions::list, operations::sessions())
        .get("/sessions/live", vehicles::live, operations::live_vehicles())
        .get("/sessions/{id}/trace.geojson", session_trace::trace_geojson, operations::session_trace())
        .get("/sessions/{id}/lanes.geojson", sessions::lanes_geojson, operations::session_lanes_geojson())
        .get("/sessions/{id}/lanes.pb", sessions::lanes_protobuf, operations::session_lanes_protobuf())
        .get("/metrics", operation::metrics, operations::metrics())
}

/// What anybody may ask: what there is to ask, health, and the viewer's page, which holds no map.
fn for_all() -> Routes {
    Routes::new()
        .get("/", landing::landing, operations::landing())
        .get("/conformance", landing::conformance, operations::conformance())
        .get("/api", landing::api, operations::api())
        .get("/healthz", operation::healthz, operations::health())
        .get("/readyz", operation::readyz, operations::readiness())
        .get(style::PATH, style::style, operations::style())
        .undescribed("/viewer", get(viewer::page))
        .undescribed("/viewer/", get(|base: LinkBase| async move { Redirect::permanent(&base.link("/viewer")) }))
        .undescribed("/viewer/{name}", get(viewer::file))
}

/// The routes of one collection.
fn collection(routes: Routes, of: &Collection) -> Routes {
    let of = *of;
    let path = format!("/collections/{}", of.id);
    let routes = routes.get(
        path,
        move |state, extents, cache, base, uri, headers| {
            landing::collection(of, state, extents, cache, base, uri, headers)
        },
        operations::collection(&of),
    );
    let (items_path, item_path) = (of.items_path(), format!("{}/{{id}}", of.items_path()));
    let (of_items, of_item) = (operations::items(&of), operations::item(&of));
    let Some(kind) = of.of_map else {
        return routes.get(items_path, drive_items::items, of_items).get(item_path, drive_items::item, of_item);
    };
    routes
        .get(
            items_path,
            move |state, cache, base, uri, headers| items::items((of, kind), state, cache, base, uri, headers),
            of_items,
        )
        .get(
            item_path,
            move |state, cache, base, id, uri, headers| items::item((of, kind), state, cache, base, id, uri, headers),
            of_item,
        )
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
