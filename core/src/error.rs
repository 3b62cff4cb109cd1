//! What can be wrong with the input of the mapper. Each error names the field, the value and the limit.

use thiserror::Error;

/// Why a matrix is not a pose.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum PoseError {
    /// An entry is NaN or infinite.
    #[error("has an entry that is not finite: {value}")]
    NotFinite {
        /// The offending entry.
        value: f64,
    },
    /// The upper left block is not orthonormal with determinant 1.
    #[error(
        "is not a rotation: largest entry of R R^T - I is {deviation:.3e}, limit {limit:.0e}, determinant must be +1"
    )]
    NotARotation {
        /// Largest entry of `R R^T - I`.
        deviation: f64,
        /// Largest deviation accepted.
        limit: f64,
    },
    /// The last row of a homogeneous matrix is not `0 0 0 1`.
    #[error("has a last row other than 0 0 0 1")]
    LastRow,
}

/// Why a frame cannot enter the mapper.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum FrameError {
    /// A number is NaN or infinite.
    #[error("{field} is not finite: {value}")]
    NotFinite {
        /// Path of the field in the frame, e.g. `detections[2].points[17].y`.
        field: String,
        /// The offending number.
        value: f64,
    },
    /// A number lies outside its range.
    #[error("{field} = {value} is outside {minimum} ..= {maximum}")]
    OutOfRange {
        /// Path of the field in the frame.
        field: String,
        /// The offending number.
        value: f64,
        /// Least value accepted.
        minimum: f64,
        /// Greatest value accepted.
        maximum: f64,
    },
    /// A list is longer than allowed.
    #[error("{field} has {count} entries, limit {limit}")]
    TooMany {
        /// Path of the list in the frame.
        field: String,
        /// Its length.
        count: usize,
        /// Greatest length accepted.
        limit: usize,
    },
    /// A pose is not one.
    #[error("{field} {source}")]
    Pose {
        /// Path of the field in the frame.
        field: String,
        /// What is wrong with it.
        source: PoseError,
    },
    /// A covariance is not symmetric positive semi-definite.
    #[error("{field} is not a covariance: {reason}")]
    Covariance {
        /// Path of the field in the frame.
        field: String,
        /// What is wrong with it.
        reason: &'static str,
    },
}

/// Why bytes are not a snapshot of a mapper.
#[derive(Debug, Error)]
pub enum SnapshotError {
    /// The bytes were written by another version of the format.
    #[error("snapshot has format version {found}, this build reads {expected}")]
    Version {
        /// Version found in the bytes.
        found: u16,
        /// Version that this build reads.
        expected: u16,
    },
    /// The bytes do not decode.
    #[error("snapshot does not decode: {0}")]
    Decode(#[from] postcard::Error),
}
