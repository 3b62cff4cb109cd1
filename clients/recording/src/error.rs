//! What can be wrong with a recording. Each error names the file, and the place in it.

use std::path::{Path, PathBuf};

use lanemap_openlane::OpenLaneError;
use thiserror::Error;

/// Why a recording cannot be read or written.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// A file or folder cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file is of a kind that is not read here.
    #[error("{}: {found}; a recording is a folder of segment-* folders, an MCAP file or a ROS 1 bag (version 2.0)", path.display())]
    Unknown {
        /// The file.
        path: PathBuf,
        /// What it is instead.
        found: String,
    },
    /// A folder holds no drive.
    #[error("{}: holds no drive: no segment-* folder, no .mcap and no .bag file", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// No drive has such a name.
    #[error("{}: has no drive whose name contains {name}", path.display())]
    NoSuchDrive {
        /// Where it was looked for.
        path: PathBuf,
        /// The text asked for.
        name: String,
    },
    /// The file ends before its end mark: it was cut, or its writer died.
    #[error("{}: cut short: {problem} at byte {offset}; what lies before it is whole", path.display())]
    Cut {
        /// The file.
        path: PathBuf,
        /// Where the last thing that is not whole begins.
        offset: u64,
        /// What is not whole.
        problem: String,
    },
    /// A part of the file is not as its format wants it.
    #[error("{}: at byte {offset}: {problem}", path.display())]
    Record {
        /// The file.
        path: PathBuf,
        /// Where the part begins.
        offset: u64,
        /// What is wrong, with value and limit.
        problem: String,
    },
    /// The file is in order, but lacks what makes it a drive.
    #[error("{}: {problem}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is missing, and what is there instead.
        problem: String,
    },
    /// An OpenLane folder is not in order.
    #[error(transparent)]
    OpenLane(#[from] OpenLaneError),
}

impl RecordingError {
    pub(crate) fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }

    pub(crate) fn record(path: &Path, offset: u64, problem: impl Into<String>) -> Self {
        Self::Record { path: path.to_owned(), offset, problem: problem.into() }
    }

    pub(crate) fn content(path: &Path, problem: impl Into<String>) -> Self {
        Self::Content { path: path.to_owned(), problem: problem.into() }
    }
}
