//! Reads the shared map as splines, tile by tile (`/splines/{z}/{x}/{y}`).

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, PoisonError},
};

use lanemap_core::geometry::georeference::Wgs84;
use lanemap_proto::v1;
use lanemap_tiles::{
    TileId,
    spline::{CellSplines, read},
};
use prost::Message;

use crate::{error::ClientError, maps::MapClient};

/// Reads spline tiles and keeps them: a tile that did not change since is not sent again.
#[derive(Debug)]
pub struct SplineTiles {
    client: MapClient,
    most_kept: usize,
    kept: Mutex<Kept>,
}

/// What was read.
#[derive(Debug, Default)]
struct Kept {
    tiles: HashMap<TileId, KeptTile>,
    /// Grows with every use of a tile.
    uses: u64,
}

#[derive(Debug)]
struct KeptTile {
    tag: String,
    cells: Arc<Vec<CellSplines>>,
    last_use: u64,
}

impl SplineTiles {
    /// A reader that keeps at most so many tiles: those that were asked for last.
    #[must_use]
    pub fn new(client: MapClient, most_kept: usize) -> Self {
        Self { client, most_kept, kept: Mutex::default() }
    }

    /// The tile of a zoom at a place, degrees.
    ///
    /// # Errors
    /// A place within 5 degrees of a pole, where there are no tiles; else as [`SplineTiles::tile`].
    pub async fn at(
        &self,
        latitude_deg: f64,
        longitude_deg: f64,
        zoom: u8,
    ) -> Result<Arc<Vec<CellSplines>>, ClientError> {
        let place = Wgs84 { latitude_deg, longitude_deg, height_m: 0.0 };
        let tile = TileId::containing(zoom, &place);
        let tile = tile.ok_or(ClientError::NoSuchTile { zoom, latitude_deg, longitude_deg })?;
        self.tile(tile).await
    }

    /// The lines that touch a tile, as they are now: asks the service whether what is kept is up to date, and reads the tile
    /// where it is not.
    ///
    /// # Errors
    /// A zoom that is not served, a service that cannot be reached, or a tile that does not decode.
    pub async fn tile(&self, tile: TileId) -> Result<Arc<Vec<CellSplines>>, ClientError> {
        let known = self.known(tile);
        let held_tag = known.as_ref().map(|(tag, _)| tag.as_str());
        let answer = self.client.get_newer(&format!("/splines/{tile}"), held_tag).await?;
        let Some(answer) = answer else {
            return known
                .map(|(_, cells)| cells)
                .ok_or_else(|| ClientError::Protocol(format!("tile {tile} is said to be known, and is not")));
        };
        let unreadable = |reason: String| ClientError::Protocol(format!("tile {tile}: {reason}"));
        let message = v1::SplineTile::decode(answer.body.as_slice()).map_err(|error| unreadable(error.to_string()))?;
        let cells = Arc::new(read(&message).map_err(|error| unreadable(error.to_string()))?);
        if let Some(tag) = answer.tag {
            self.keep(tile, tag, &cells);
        }
        Ok(cells)
    }

    fn known(&self, tile: TileId) -> Option<(String, Arc<Vec<CellSplines>>)> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.uses += 1;
        let now = kept.uses;
        let known = kept.tiles.get_mut(&tile)?;
        known.last_use = now;
        Some((known.tag.clone(), Arc::clone(&known.cells)))
    }

    fn keep(&self, tile: TileId, tag: String, cells: &Arc<Vec<CellSplines>>) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.uses += 1;
        let last_use = kept.uses;
        kept.tiles.insert(tile, KeptTile { tag, cells: Arc::clone(cells), last_use });
        if kept.tiles.len() > self.most_kept {
            let oldest = kept.tiles.iter().min_by_key(|(_, kept)| kept.last_use).map(|(tile, _)| *tile);
            oldest.map(|oldest| kept.tiles.remove(&oldest));
        }
    }
}
