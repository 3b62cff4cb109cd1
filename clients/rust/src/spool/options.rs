//! Where a spool lies, how large it may grow, and when it is forced to disk.

use std::{path::PathBuf, time::Duration};

/// A spool on disk for the frames of a vehicle: what is sent outlives the process, and the connection.
///
/// `folder` holds one folder for each drive, `FLEET/VEHICLE/DRIVE`; a drive's folder goes when the drive has ended and
/// all of it is acked. One process at a time writes a drive's folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SpoolOptions {
    /// The folder; created where it does not exist.
    pub folder: PathBuf,
    /// Most bytes of all drives in `folder` together, at least [`SpoolOptions::MIN_BYTES`]. What other processes add to
    /// other drives after this one opened its own is not seen.
    pub max_bytes: u64,
    /// What becomes of a frame for which there is no room.
    pub when_full: WhenFull,
    /// When bytes are forced to disk.
    pub sync: SpoolSync,
}

/// What becomes of a frame for which there is no room. Nothing that was taken is ever dropped to make some.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum WhenFull {
    /// [`Session::send`](crate::Session::send) waits until acks have made room.
    #[default]
    Block,
    /// [`Session::send`](crate::Session::send) fails with [`SpoolError::Full`](crate::SpoolError::Full), and the frame is
    /// not taken.
    Refuse,
}

/// When spooled bytes are forced to disk. Whatever is chosen, a frame that `send` has taken survives `kill -9` of the
/// client: this is about the machine's power.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SpoolSync {
    /// By the operating system only: power loss costs what it had not written, on Linux up to half a minute.
    System,
    /// So long after the first unsynced frame, beside the stream of frames: power loss costs at most that much.
    Within(Duration),
    /// Before `send` returns: power loss costs nothing that was taken.
    EveryFrame,
}

impl SpoolOptions {
    /// Least bound on a spool: 64 KiB.
    pub const MIN_BYTES: u64 = 64 * 1024;

    /// A spool of up to 1 GiB, which blocks when full and is synced within a second.
    #[must_use]
    pub fn new(folder: impl Into<PathBuf>) -> Self {
        Self {
            folder: folder.into(),
            max_bytes: 1024 * 1024 * 1024,
            when_full: WhenFull::Block,
            sync: SpoolSync::Within(Duration::from_secs(1)),
        }
    }

    /// Length from which a segment is not added to any more: small enough that acks free room piece by piece.
    pub(crate) fn segment_bytes(&self) -> u64 {
        (self.max_bytes / 8).min(8 * 1024 * 1024)
    }
}
