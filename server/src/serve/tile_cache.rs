//! Tiles, made once: kept as they go over the wire, plain and compressed, for as long as the cells that they show stay as
//! they are.
//!
//! A tile is kept under the versions of its cells, so that a new version of a cell makes new tiles of those that show it
//! and of no others; what is outdated is asked for no more and gives way. A tile that many ask for at once is made once.
//! Beside the tiles, the lines of cells are kept [projected](ProjectedCell), so that the next tile of a cell costs only its
//! own lines.

use std::{
    io::Write,
    sync::{Arc, OnceLock},
};

use axum::{
    body::Body,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::Response,
};
use bytes::Bytes;
use flate2::{Compression, write::GzEncoder};
use lanemap_core::fleet::CellId;
use lanemap_tiles::{
    ProjectedCell, TileId,
    spline::{FittedCell, spline_tile},
    vector_tile,
};
use prost::Message;
use quick_cache::{Weighter, sync::Cache};

use super::{entity_tag::EntityTag, in_background, problem::Problem, timeline::not_at_revision};
use crate::{
    fuse::{CellVersion, MapRevision, SharedMap},
    journal::JournalError,
};

/// Bodies up to this size go as they are: they take one packet in any case.
const LEAST_COMPRESSED: usize = 1024;
/// Level of compression: above it, time doubles for a percent of the size.
const GZIP_LEVEL: u32 = 6;
/// Attempts to make a tile of cells that change meanwhile.
const ATTEMPTS: usize = 8;

/// The kinds of tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum TileKind {
    /// `/tiles/lanes`
    Vector,
    /// `/splines`
    Spline,
}

/// A tile of some versions of its cells.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct TileVersion {
    kind: TileKind,
    tile: TileId,
    cells: Vec<(CellId, CellVersion)>,
}

/// Tiles and projected cells, as many as fit. Clones share them.
#[derive(Clone)]
pub(super) struct TileCache {
    map: SharedMap,
    made: Arc<Cache<TileVersion, Arc<MadeTile>, MemoryWeight>>,
    projected: Arc<Cache<(CellId, CellVersion), Arc<ProjectedCell>, MemoryWeight>>,
    /// The newest version of each cell that was asked for: the next one takes what did not change from it.
    fitted: Arc<Cache<CellId, Arc<FittedCell>, MemoryWeight>>,
}

/// A tile as it goes over the wire.
#[derive(Debug)]
struct MadeTile {
    tag: EntityTag,
    plain: Bytes,
    /// Made when it is asked for first; `None` where it is not worth it.
    gzip: OnceLock<Option<Bytes>>,
}

#[derive(Clone)]
struct MemoryWeight;

impl Weighter<TileVersion, Arc<MadeTile>> for MemoryWeight {
    fn weight(&self, version: &TileVersion, tile: &Arc<MadeTile>) -> u64 {
        // Compressed, it is about half as large; the rest is for what holds both.
        (tile.plain.len() * 3 / 2 + 256 + 24 * version.cells.len()) as u64
    }
}

impl Weighter<(CellId, CellVersion), Arc<ProjectedCell>> for MemoryWeight {
    fn weight(&self, _: &(CellId, CellVersion), cell: &Arc<ProjectedCell>) -> u64 {
        cell.memory_bytes() as u64
    }
}

impl Weighter<CellId, Arc<FittedCell>> for MemoryWeight {
    fn weight(&self, _: &CellId, cell: &Arc<FittedCell>) -> u64 {
        cell.memory_bytes() as u64
    }
}

/// Why a tile cannot be made.
enum MakeError {
    Store(JournalError),
    /// A cell has a newer version meanwhile, and this one is not kept.
    Outdated,
}

impl From<JournalError> for MakeError {
    fn from(error: JournalError) -> Self {
        Self::Store(error)
    }
}

impl TileCache {
    /// An empty cache of the tiles of a map, which takes at most `bytes`: half of them for tiles.
    pub(super) fn new(map: SharedMap, bytes: usize) -> Self {
        let bytes = bytes as u64;
        Self {
            map,
            made: Arc::new(Cache::with_weighter(1024, bytes / 2, MemoryWeight)),
            projected: Arc::new(Cache::with_weighter(64, bytes / 4, MemoryWeight)),
            fitted: Arc::new(Cache::with_weighter(64, bytes / 4, MemoryWeight)),
        }
    }

    /// The answer to a request for a tile.
    pub(super) async fn answer(
        &self,
        kind: TileKind,
        tile: TileId,
        media_type: &'static str,
        request: &HeaderMap,
    ) -> Result<Response, Problem> {
        for _ in 0..ATTEMPTS {
            let version = TileVersion { kind, tile, cells: self.cells(tile) };
            let tag = EntityTag::of(&version);
            if tag.is_held_by(request) {
                return Ok(tag.not_modified());
            }
            match self.made(version, tag).await {
                Ok(made) => return made.response(media_type, request).await,
                Err(MakeError::Outdated) => {}
                Err(MakeError::Store(error)) => return Err(error.into()),
            }
        }
        Err(JournalError::Store(format!("the cells of tile {tile} change faster than they can be read")).into())
    }

    /// The answer to a request for a tile of the map as it was at a revision, or nearly so: see [`SharedMap::version_near`].
    ///
    /// Which versions those are is asked of the store each time: one of which a drive was deleted is shown no more.
    pub(super) async fn answer_at(
        &self,
        kind: TileKind,
        tile: TileId,
        revision: MapRevision,
        media_type: &'static str,
        request: &HeaderMap,
    ) -> Result<Response, Problem> {
        for _ in 0..ATTEMPTS {
            let cache = self.clone();
            let cells = in_background(move || cache.cells_at(tile, revision)).await??;
            let version = TileVersion { kind, tile, cells };
            let tag = EntityTag::of(&version);
            if tag.is_held_by(request) {
                return Ok(tag.not_modified());
            }
            match self.made(version, tag).await {
                Ok(made) => return made.response(media_type, request).await,
                Err(MakeError::Outdated) => {}
                Err(MakeError::Store(error)) => return Err(error.into()),
            }
        }
        Err(JournalError::Store(format!("the cells of tile {tile} change faster than they can be read")).into())
    }

    /// The cells with lines that a tile touches, as they were at a revision.
    fn cells_at(&self, tile: TileId, revision: MapRevision) -> Result<Vec<(CellId, CellVersion)>, Problem> {
        let versions = self.map.versions_at(revision).map_err(|error| not_at_revision("revision", error))?;
        let mut cells = Vec::new();
        for cell in tile.cells_touched() {
            let Some(version) = versions.get(&cell) else { continue };
            let near = self.map.version_near(cell, *version)?.filter(|near| !near.map.lanes.is_empty());
            cells.extend(near.map(|near| (cell, CellVersion(near.map.version))));
        }
        Ok(cells)
    }

    /// The cells with lines that a tile touches, as they are now.
    fn cells(&self, tile: TileId) -> Vec<(CellId, CellVersion)> {
        let with_lines = |cell| {
            let record = self.map.record(cell).filter(|record| record.lanes > 0)?;
            Some((cell, record.version))
        };
        tile.cells_touched().into_iter().filter_map(with_lines).collect()
    }

    /// A tile, made where it is not kept. Whoever asks for a tile that is being made waits for it.
    async fn made(&self, version: TileVersion, tag: EntityTag) -> Result<Arc<MadeTile>, MakeError> {
        let make = async {
            let (cache, version) = (self.clone(), version.clone());
            let made = in_background(move || cache.make(&version)).await;
            let plain = made.map_err(|_| JournalError::Closed)??.into();
            Ok(Arc::new(MadeTile { tag, plain, gzip: OnceLock::new() }))
        };
        self.made.get_or_insert_async(&version, make).await
    }

    fn make(&self, version: &TileVersion) -> Result<Vec<u8>, MakeError> {
        match version.kind {
            TileKind::Vector => {
                let cells: Result<Vec<_>, _> = version.cells.iter().map(|cell| self.projected(*cell)).collect();
                Ok(vector_tile(version.tile, cells?.iter().map(Arc::as_ref)))
            }
            TileKind::Spline => {
                let cells: Result<Vec<_>, _> = version.cells.iter().map(|cell| self.fitted(*cell)).collect();
                Ok(spline_tile(version.tile, cells?.iter().map(Arc::as_ref)).encode_to_vec())
            }
        }
    }

    fn projected(&self, of: (CellId, CellVersion)) -> Result<Arc<ProjectedCell>, MakeError> {
        self.projected.get_or_insert_with(&of, || {
            let (cell, version) = of;
            let found = self.map.version_of(cell, version)?.ok_or(MakeError::Outdated)?;
            Ok(Arc::new(ProjectedCell::new(cell, &found.map)))
        })
    }
}

impl TileCache {
    fn fitted(&self, (cell, version): (CellId, CellVersion)) -> Result<Arc<FittedCell>, MakeError> {
        let earlier = self.fitted.get(&cell);
        if let Some(known) = earlier.as_ref().filter(|known| known.version() == version.0) {
            return Ok(Arc::clone(known));
        }
        let found = self.map.version_of(cell, version)?.ok_or(MakeError::Outdated)?;
        let fitted = Arc::new(FittedCell::new(cell, &found.map, earlier.as_deref()));
        self.fitted.insert(cell, Arc::clone(&fitted));
        Ok(fitted)
    }
}

impl MadeTile {
    async fn response(self: Arc<Self>, media_type: &'static str, request: &HeaderMap) -> Result<Response, Problem> {
        if self.plain.is_empty() {
            return Ok(self.tag.on(StatusCode::NO_CONTENT));
        }
        let gzip = if accepts_gzip(request) { self.gzip().await? } else { None };
        let is_gzip = gzip.is_some();
        let mut response = Response::new(Body::from(gzip.unwrap_or_else(|| self.plain.clone())));
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
        if is_gzip {
            headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
        }
        Ok(self.tag.on(response))
    }

    async fn gzip(self: &Arc<Self>) -> Result<Option<Bytes>, Problem> {
        if let Some(known) = self.gzip.get() {
            return Ok(known.clone());
        }
        if self.plain.len() <= LEAST_COMPRESSED {
            return Ok(None);
        }
        let tile = Arc::clone(self);
        in_background(move || tile.gzip.get_or_init(|| compressed(&tile.plain)).clone()).await
    }
}

/// The bytes compressed, where that makes them fewer.
fn compressed(plain: &[u8]) -> Option<Bytes> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::new(GZIP_LEVEL));
    // Writing to memory does not fail.
    let packed = encoder.write_all(plain).and_then(|()| encoder.finish()).ok()?;
    (packed.len() < plain.len()).then(|| packed.into())
}

/// Whether an answer may be compressed by gzip (RFC 9110, 12.5.3): named with a weight above 0, or not named beside `*`.
fn accepts_gzip(request: &HeaderMap) -> bool {
    let values = request.get_all(header::ACCEPT_ENCODING).iter().filter_map(|value| value.to_str().ok());
    let mut any = false;
    for item in values.flat_map(|value| value.split(',')) {
        let (coding, weight) = item.split_once(';').unwrap_or((item, ""));
        let weight = weight.trim().strip_prefix("q=").map_or(Some(1.0), |weight| weight.parse::<f64>().ok());
        let is_wanted = weight.is_some_and(|weight| weight > 0.0);
        match coding.trim() {
            name if name.eq_ignore_ascii_case("gzip") => return is_wanted,
            "*" => any = is_wanted,
            _ => {}
        }
    }
    any
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gzip_is_used_where_the_request_takes_it() {
        let asks = |text: &str| {
            accepts_gzip(&HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_str(text).unwrap())]))
        };
        for (text, taken) in [
            ("gzip", true),
            ("br, GZIP;q=0.2", true),
            ("gzip;q=0, *", false),
            ("*;q=0.1", true),
            ("br, zstd", false),
            ("identity", false),
            ("gzip;q=x", false),
        ] {
            assert_eq!(asks(text), taken, "{text}");
        }
        assert!(!accepts_gzip(&HeaderMap::new()));
    }
}
