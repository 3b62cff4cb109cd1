//! What a cell was like, and what happened in it since: its kept versions, the changes between them, and its events.

use std::sync::Arc;

use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use prost::Message;

use super::{ChangesError, KeptVersion, ReadError, SharedMap};
use crate::{
    fuse::{
        CellVersion,
        events::CellEvent,
        wire::{changes, empty_cell},
    },
    journal::JournalError,
};

impl SharedMap {
    /// One version of a cell, where it is kept: replaced versions are for `cell_versions_kept_s`, at most 128 of a cell, and
    /// none that has a deleted drive in it. Version 0 is empty. Reads the store where it is not in the cache.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn version_of(&self, cell: CellId, version: CellVersion) -> Result<Option<Arc<KeptVersion>>, JournalError> {
        let Some(record) = self.record(cell).filter(|record| version <= record.version) else { return Ok(None) };
        if version == record.version
            && let Some(newest) = self.get(cell)?.filter(|newest| newest.map.version == version.0)
        {
            return Ok(Some(Arc::new(KeptVersion { map: Arc::clone(&newest.map), bytes: newest.bytes.clone() })));
        }
        // Whether it is kept is asked of the store each time: a version of which a drive was deleted is read no more.
        let store = self.shared.store.load_full().ok_or(JournalError::Closed)?;
        if version.0 > 0 && !store.has_version(cell, version.0)? {
            self.shared.past.remove(&(cell, version));
            return Ok(None);
        }
        let read = || {
            let map = self.version(cell, version.0)?.ok_or(ReadError::Outdated)?;
            let bytes = map.encode_to_vec().into();
            Ok(Arc::new(KeptVersion { map: Arc::new(map), bytes }))
        };
        match self.shared.past.get_or_insert_with(&(cell, version), read) {
            Ok(found) => Ok(Some(found)),
            Err(ReadError::Store(error)) => Err(error),
            Err(ReadError::Outdated) => Ok(None),
        }
    }

    /// The versions of a cell that are kept, the oldest first, and when each was published, milliseconds since the Unix epoch.
    /// Reads the store.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn kept_versions(&self, cell: CellId) -> Result<Vec<(CellVersion, u64)>, JournalError> {
        let store = self.shared.store.load_full().ok_or(JournalError::Closed)?;
        Ok(store
            .versions(cell)?
            .into_iter()
            .map(|(version, published_ms)| (CellVersion(version), published_ms))
            .collect())
    }

    /// A version of a cell, or the nearest before it that is kept, or else the oldest that is: what the cell was like, for
    /// whoever looks back. Reads the store.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn version_near(&self, cell: CellId, version: CellVersion) -> Result<Option<Arc<KeptVersion>>, JournalError> {
        if let Some(found) = self.version_of(cell, version)? {
            return Ok(Some(found));
        }
        let kept = self.kept_versions(cell)?;
        let near = kept.iter().rev().find(|(kept, _)| *kept <= version).or(kept.first());
        near.map_or(Ok(None), |(near, _)| self.version_of(cell, *near))
    }

    /// One version of a cell, where it is kept; version 0 is empty.
    pub(super) fn version(&self, cell: CellId, version: u64) -> Result<Option<v1::CellMap>, JournalError> {
        if version == 0 {
            return Ok(Some(empty_cell(cell)));
        }
        let store = self.shared.store.load_full().ok_or(JournalError::Closed)?;
        let Some(bytes) = store.version(cell, version)? else { return Ok(None) };
        let map = v1::CellMap::decode(bytes.as_slice());
        map.map(Some).map_err(|error| JournalError::Decode { what: format!("cell {cell}"), reason: error.to_string() })
    }

    /// What changed in a cell since a version. Reads the store.
    ///
    /// # Errors
    /// No such cell, a version that is not kept, or a store that cannot be read.
    pub fn changes_since(&self, cell: CellId, since: u64) -> Result<v1::CellChanges, ChangesError> {
        let newest = self.get(cell)?.ok_or(ChangesError::NoSuchCell { cell })?;
        let now = newest.map.version;
        let before = if since <= now { self.version(cell, since)? } else { None };
        let Some(before) = before else {
            let store = self.shared.store.load_full().ok_or(JournalError::Closed)?;
            let oldest = store.versions(cell)?.first().map_or(now, |(version, _)| *version);
            return Err(ChangesError::NotKept { cell, since, oldest, newest: now });
        };
        Ok(changes(&before, &newest.map))
    }

    /// What changed in a cell between two versions; all its lines, from version 0, where the older is not kept. `None`
    /// where the newer is not. Reads the store.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn changes_between(
        &self,
        cell: CellId,
        from: CellVersion,
        to: CellVersion,
    ) -> Result<Option<v1::CellChanges>, JournalError> {
        let Some(after) = self.version_of(cell, to)? else { return Ok(None) };
        Ok(Some(match self.version_of(cell, from)? {
            Some(before) => changes(&before.map, &after.map),
            None => changes(&empty_cell(cell), &after.map),
        }))
    }

    /// The events that the versions of a cell after one and up to another told last, in the order of their numbers. Reads
    /// the store where there are any: most versions tell of none.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn events_between(
        &self,
        cell: CellId,
        after: CellVersion,
        until: CellVersion,
    ) -> Result<Vec<CellEvent>, JournalError> {
        if self.record(cell).is_none_or(|record| record.told_in <= after) {
            return Ok(Vec::new());
        }
        let mut events = self.events(cell)?;
        events.retain(|event| event.version > after && event.version <= until);
        Ok(events)
    }

    /// What happened in a cell, as far as it is kept, in the order of its numbers. Reads the store.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn events(&self, cell: CellId) -> Result<Vec<CellEvent>, JournalError> {
        self.shared.store.load_full().ok_or(JournalError::Closed)?.events(cell)
    }
}
