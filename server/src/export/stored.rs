//! The shared map of a store that no server has open.

use std::path::Path;

use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use prost::Message;

use crate::{
    fuse::CellRecord,
    journal::{CommitterThread, Journal, JournalError, JournalOptions, cells::CellStore},
};

/// The cells of a store, read from its folder.
#[derive(Debug)]
pub struct StoredMap {
    cells: CellStore,
    /// Keep the store open.
    _journal: Journal,
    _committer: CommitterThread,
}

impl StoredMap {
    /// Opens the store in a folder, which no server may have open.
    ///
    /// # Errors
    /// No store is there, it is in use, or it cannot be read.
    pub fn open(folder: &Path) -> Result<Self, JournalError> {
        if !folder.is_dir() {
            return Err(JournalError::Store(format!("{}: there is no such folder", folder.display())));
        }
        let (journal, committer) = Journal::open(&JournalOptions::new(folder))?;
        Ok(Self { cells: journal.cells(), _journal: journal, _committer: committer })
    }

    /// The cells that have lines, in their order.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn list(&self) -> Result<Vec<CellId>, JournalError> {
        let told = self.cells.told::<CellRecord>()?.into_iter();
        let with_lines = told.filter(|(_, (_, record))| record.as_ref().is_none_or(|record| record.lanes > 0));
        Ok(with_lines.map(|(cell, _)| cell).collect())
    }

    /// The newest version of a cell; `None` where nothing was ever published of it.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn get(&self, cell: CellId) -> Result<Option<v1::CellMap>, JournalError> {
        let Some((version, _)) = self.cells.versions(cell)?.pop() else { return Ok(None) };
        let Some(bytes) = self.cells.version(cell, version)? else { return Ok(None) };
        let map = v1::CellMap::decode(bytes.as_slice());
        map.map(Some).map_err(|error| JournalError::Decode { what: format!("cell {cell}"), reason: error.to_string() })
    }
}
