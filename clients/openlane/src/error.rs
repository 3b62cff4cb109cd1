//! What can be wrong with an OpenLane folder. Each error names the file.

use std::path::PathBuf;

use thiserror::Error;

/// Why a drive cannot be read or written.
#[derive(Debug, Error)]
pub enum OpenLaneError {
    /// A file or folder cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file is larger than any frame is.
    #[error("{}: has {bytes} bytes, limit {limit}", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
        /// Greatest size accepted.
        limit: u64,
    },
    /// A file is cut short or is not JSON.
    #[error("{}: is not whole JSON: {source}", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// Where and why parsing stopped.
        source: serde_json::Error,
    },
    /// A field is missing or has another shape than OpenLane's.
    #[error("{}: {field} {problem}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// Path of the field in the file, e.g. `lane_lines[2].xyz`.
        field: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The annotation has no `pose` (OpenLane before v1.2), so the frame has no place in the world.
    #[error("{}: has no pose (OpenLane before v1.2); a drive needs one in every frame", path.display())]
    NoPose {
        /// The annotation.
        path: PathBuf,
    },
    /// A file is not named by a timestamp.
    #[error("{}: is not named by a timestamp of 18 digits", path.display())]
    FileName {
        /// The file.
        path: PathBuf,
    },
    /// No drive of that name is there.
    #[error("{}: has no drive {name}", root.display())]
    NoSuchDrive {
        /// The folder searched.
        root: PathBuf,
        /// The name asked for.
        name: String,
    },
}
