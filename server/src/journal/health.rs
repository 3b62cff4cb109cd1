//! Whether the journal takes writes, and what it does to take them again.

use std::{fmt, path::PathBuf};

use super::JournalError;

/// Room that a store needs to be opened anew, bytes.
const LEAST_TO_REOPEN_BYTES: u64 = 16 * 1024 * 1024;

/// Whether the journal takes writes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum JournalHealth {
    /// It does.
    Writing,
    /// The disk has less room than is kept free; writes are taken again when it has more.
    NoRoom {
        /// Bytes free on the disk.
        free_bytes: u64,
        /// Bytes that are kept free.
        minimum_bytes: u64,
    },
    /// A write failed; the store is being opened anew.
    Failed {
        /// What the store said.
        reason: String,
    },
}

impl JournalHealth {
    /// Whether writes are taken.
    #[must_use]
    pub fn is_writing(&self) -> bool {
        *self == Self::Writing
    }

    /// Refuses where no writes are taken.
    ///
    /// # Errors
    /// Why none are taken.
    pub fn check(&self) -> Result<(), JournalError> {
        match self {
            Self::Writing => Ok(()),
            Self::NoRoom { free_bytes, minimum_bytes } => {
                Err(JournalError::NoRoom { free_bytes: *free_bytes, minimum_bytes: *minimum_bytes })
            }
            Self::Failed { reason } => Err(JournalError::Store(reason.clone())),
        }
    }

    /// What a failed write says of the journal; `None` where it says nothing.
    pub(super) fn after(error: &JournalError) -> Option<Self> {
        match error {
            JournalError::NoRoom { free_bytes, minimum_bytes } => {
                Some(Self::NoRoom { free_bytes: *free_bytes, minimum_bytes: *minimum_bytes })
            }
            JournalError::Store(reason) => Some(Self::Failed { reason: reason.clone() }),
            JournalError::Decode { .. } | JournalError::Closed => None,
        }
    }
}

impl fmt::Display for JournalHealth {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.check() {
            Ok(()) => formatter.write_str("the journal takes writes"),
            Err(error) => error.fmt(formatter),
        }
    }
}

/// The room on the disk under a folder, and how much of it is kept free.
///
/// The reserve is what the embedded store needs to go on when a disk fills up: it writes its tables in the background,
/// after the frames in them were acked.
#[derive(Clone, Debug)]
pub(super) struct DiskReserve {
    folder: PathBuf,
    minimum_bytes: u64,
}

impl DiskReserve {
    pub(super) fn new(folder: PathBuf, minimum_bytes: u64) -> Self {
        Self { folder, minimum_bytes }
    }

    /// Refuses where less room is free than is kept.
    pub(super) fn check(&self) -> Result<(), JournalError> {
        self.check_above(self.minimum_bytes)
    }

    /// Refuses until there is an eighth more room than is kept, so that a disk at its limit does not flicker, and enough to
    /// open a store anew that ran into the end of a disk of which nothing is kept.
    pub(super) fn check_refilled(&self) -> Result<(), JournalError> {
        self.check_above((self.minimum_bytes + self.minimum_bytes / 8).max(LEAST_TO_REOPEN_BYTES))
    }

    fn check_above(&self, least_bytes: u64) -> Result<(), JournalError> {
        if least_bytes == 0 {
            return Ok(());
        }
        let disk = rustix::fs::statvfs(&self.folder).map_err(|error| JournalError::Store(error.to_string()))?;
        let free_bytes = disk.f_bavail.saturating_mul(disk.f_frsize);
        if free_bytes < least_bytes {
            return Err(JournalError::NoRoom { free_bytes, minimum_bytes: self.minimum_bytes });
        }
        Ok(())
    }
}
