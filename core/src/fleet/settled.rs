//! Settled: a map that stays as it is while live drives are laid on it.
//!
//! Solving for all drives together takes the longer the more of them there are, and a live one says something new several times a
//! second. Between two such solutions a draft shows it as it lies on the map of the others, whose corrections are held:
//!
//! `C = argmin |odometry|^2 + |fixes|^2 + sum rho(n . C(p) - mu) / s^2`,
//!
//! `mu` the lines of the others with the information of all of them, as a fold leaves it ([`base`](super::base)), here without
//! the inflation that a fold pays for being final. What the drive saw becomes a mean of that and of what it says; what it saw
//! first is drawn at once. All else stays where it is; beside what it saw a line runs on (`continuity`), by less with every knot.
//!
//! Not guaranteed: the map that fusing all of them gives. A draft moves no other drive, and what became of a road in the drives that
//! are settled is taken as known when a live drive misses something. It is to be followed by a fusion of all.

use super::{
    base::Base,
    contribution::Contribution,
    fusion::{FusedDrive, FusedMap, fuse_onto},
    params::FleetParams,
};
use crate::geometry::georeference::Anchor;

/// A fused map that live drives may be laid on.
#[derive(Clone, Debug, PartialEq)]
pub struct Settled {
    /// Its lines, held where they are.
    pub(super) base: Base,
    /// Its drives that were not folded.
    pub(super) drives: Vec<FusedDrive>,
    /// Number of those that were.
    pub(super) folded_drives: u32,
}

impl Settled {
    /// Length of its lines, metres.
    #[must_use]
    pub fn line_m(&self, params: &FleetParams) -> f64 {
        self.base.knots() as f64 * params.line_knot_m
    }

    /// About how much memory it takes, bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.base.bytes()
    }
}

/// The map with live drives, in the order of their seniority, laid on it.
#[must_use]
pub fn draft(settled: &Settled, live: &[&Contribution], anchor: &Anchor, params: &FleetParams) -> FusedMap {
    let mut map = fuse_onto(&settled.base, live, anchor, params);
    map.drives.splice(..0, settled.drives.iter().cloned());
    map.folded_drives = settled.folded_drives;
    map
}
