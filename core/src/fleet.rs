//! One map from many drives: what each drive contributes, how drives are aligned with each other, and how their lanes
//! become the lines of one map.
//!
//! [`fuse`] is a pure function of the contributions, whatever their order of arrival:
//!
//! 1. [`correction`]: every drive gets a smooth correction of 4 degrees of freedom, at first from its GNSS fixes alone.
//! 2. [`placement`]: in the order of their starts, drives are laid on the lines of those before: a search over lateral
//!    shifts, which must be unique to be believed.
//! 3. [`matching`]: which stretch of a drive's lane lies on which line; what lies on none begins or extends one.
//! 4. [`alignment`]: all corrections and all lines in one sparse least-squares problem, robust, solved by Cholesky.
//! 5. [`base`]: the oldest drives are folded, so that a place costs no more the more often it is driven.
//! 6. [`change`]: what is there no more, what is new, and what was moved, from who saw what and who missed it.
//! 7. [`line`]: every knot of a line is the weighted mean of what each drive says of it: one drive, one witness.

pub mod alignment;
pub mod base;
pub mod cell;
pub mod change;
pub mod contribution;
pub mod correction;
pub mod fusion;
mod growth;
pub mod line;
pub mod matching;
pub mod params;
mod persistence;
pub mod placement;
mod prepared;
mod shown;
mod sparse;
pub mod trace;

pub use base::Base;
pub use cell::CellId;
pub use change::{ChangeKind, MapChange};
pub use contribution::{Contribution, DriveId, TrajectoryPoint};
pub use correction::Correction;
pub use fusion::{FusedDrive, FusedMap, by_seniority, fold, fuse, fuse_onto, split_to_fold};
pub use line::{FusedLane, FusedLaneId, FusedPoint};
pub use params::FleetParams;
pub use trace::Trace;
