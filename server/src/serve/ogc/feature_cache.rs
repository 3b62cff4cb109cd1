//! Features as they were written for earlier requests, in bounded memory, and what is told of cells without reading them.

use std::{
    collections::BTreeMap,
    fmt,
    sync::{Arc, Mutex, PoisonError},
};

use lanemap_core::{TimestampNs, fleet::CellId};
use quick_cache::{Weighter, sync::Cache};

use super::{cell_features::CellFeatures, cells, collection::MapCollection, control_points, lanes};
use crate::{
    fuse::{CellVersion, SharedMap},
    journal::JournalError,
    serve::bounds::Bounds,
};

/// Of which cell, in which version, for which collection.
type Key = (MapCollection, CellId, CellVersion);

/// The features that were written. Clones share them.
#[derive(Clone)]
pub(in crate::serve) struct FeatureCache {
    shared: Arc<Shared>,
}

struct Shared {
    features: Cache<Key, Arc<CellFeatures>, Weight>,
    /// One per cell, of the newest version that anybody asked for: bounded as the cells are.
    told: Mutex<BTreeMap<CellId, Told>>,
}

/// What is told of one version of a cell.
#[derive(Clone, Copy, Debug)]
pub(in crate::serve) struct Told {
    version: CellVersion,
    pub(in crate::serve) lanes: usize,
    pub(in crate::serve) control_points: usize,
    /// Borders of its lines.
    pub(in crate::serve) bounds: Option<Bounds>,
    /// First and last time at which any of them was seen.
    pub(in crate::serve) seen: Option<(TimestampNs, TimestampNs)>,
}

#[derive(Clone)]
struct Weight;

impl Weighter<Key, Arc<CellFeatures>> for Weight {
    fn weight(&self, _: &Key, features: &Arc<CellFeatures>) -> u64 {
        features.memory_bytes() as u64
    }
}

impl fmt::Debug for FeatureCache {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("FeatureCache").finish_non_exhaustive()
    }
}

impl FeatureCache {
    /// Nothing yet, and at most so many bytes.
    pub(in crate::serve) fn new(bytes: usize) -> Self {
        let features = Cache::with_weighter(256, bytes as u64, Weight);
        Self { shared: Arc::new(Shared { features, told: Mutex::default() }) }
    }

    /// The features of a cell in one version; `None` where that is not kept. Not for a task of the runtime.
    pub(in crate::serve) fn get(
        &self,
        map: &SharedMap,
        collection: MapCollection,
        cell: CellId,
        version: CellVersion,
    ) -> Result<Option<Arc<CellFeatures>>, JournalError> {
        let key = (collection, cell, version);
        let is_newest = map.record(cell).is_some_and(|record| record.version == version);
        if is_newest && let Some(found) = self.shared.features.get(&key) {
            return Ok(Some(found));
        }
        // Of a replaced version the store is asked each time: one of which a drive was deleted is read no more.
        let Some(kept) = map.version_of(cell, version)? else {
            self.shared.features.remove(&key);
            return Ok(None);
        };
        let written = || {
            let features = match collection {
                MapCollection::Lanes => lanes::features(cell, &kept.map),
                MapCollection::ControlPoints => control_points::features(cell, &kept.map),
                MapCollection::Cells => cells::features(cell, &kept.map),
            };
            Ok::<_, JournalError>(Arc::new(features))
        };
        self.shared.features.get_or_insert_with(&key, written).map(Some)
    }

    /// What is told of a cell in one version; `None` where that is not kept. Not for a task of the runtime.
    pub(in crate::serve) fn told(
        &self,
        map: &SharedMap,
        cell: CellId,
        version: CellVersion,
    ) -> Result<Option<Told>, JournalError> {
        if let Some(told) = self.told_already(cell, version) {
            return Ok(Some(told));
        }
        let Some(features) = self.get(map, MapCollection::Lanes, cell, version)? else { return Ok(None) };
        let points = features.entries().iter().filter_map(|entry| features.map.lanes.get(entry.lane));
        let told = Told {
            version,
            lanes: features.len(),
            control_points: points.map(|lane| lane.xyz_mm.len() / 3).sum(),
            bounds: features.bounds(),
            seen: features.seen(),
        };
        let mut all = self.shared.told.lock().unwrap_or_else(PoisonError::into_inner);
        if all.get(&cell).is_none_or(|before| before.version <= version) {
            all.insert(cell, told);
        }
        Ok(Some(told))
    }

    /// The same, where it was told before.
    pub(in crate::serve) fn told_already(&self, cell: CellId, version: CellVersion) -> Option<Told> {
        let all = self.shared.told.lock().unwrap_or_else(PoisonError::into_inner);
        all.get(&cell).copied().filter(|told| told.version == version)
    }
}
