//! One map from many drives: what each drive contributes, how drives are aligned with each other, and how their lanes
//! become the lines of one map.
//!
//! [`fuse`] is a pure function of the contributions, whatever their order of arrival:
//!
//! 1. [`correction`]: every drive gets a smooth correction of 4 degrees of freedom, at first from its GNSS fixes alone.
//! 2. [`placement`]: in the order of their starts, drives are laid on the lines of those before: a search over lateral
//!    shifts, which must be unique to be believed (`ways` tell the lanes of the two directions apart). Whenever their number has
//!    doubled, they are solved for together (`fusion`). What was made of the oldest is kept where only younger ones change
//!    ([`beginning`]).
//! 3. [`matching`]: which stretch of a drive's lane lies on which line; what lies on none begins or extends one, and two that
//!    a drive saw as one are joined (`growth`, `joining`).
//! 4. [`alignment`]: all corrections and all lines in one sparse least-squares problem, robust, solved by Cholesky; how far
//!    receivers (`receivers`) and drives (`credibility`) are believed is learned on the way.
//! 5. [`base`]: where drives crowd, the oldest are folded (`crowding`), so that a place costs no more the more often it is driven;
//!    where a cell is full, [`redundancy`] says which drives are missed least.
//! 6. [`change`]: what is there no more, what is new, and what was moved, from who saw what and who missed it
//!    (`persistence`, `moved`), the most likely history of each stretch (`history`), and that of its paint (`repainted`).
//! 7. [`mod@line`]: every knot of a line is the weighted mean of what each drive says of it: one drive, one witness; where
//!    witnesses come and go, the line runs on as they say its shape is (`continuity`).
//!
//! Until there is time to fuse all drives, [`draft`] shows live ones on what is [`settled`] of the others.
//!
//! ```
//! use lanemap_core::{fleet::*, geometry::georeference::{Anchor, Georeference, Wgs84}, *};
//! use nalgebra::Point3;
//!
//! // A drive along two lines, by a receiver that is off by `bias_m` to the north.
//! let anchor = Anchor::new(Wgs84 { latitude_deg: 48.0, longitude_deg: 11.0, height_m: 500.0 });
//! let contribution = |number: u64, bias_m: f64| {
//!     let mut mapper = Mapper::new(Params::preset(Preset::Default), Sensor::default());
//!     let mut trace = Trace::default();
//!     let receiver = Georeference { anchor, enu_from_map: Pose::translation(0.0, bias_m, 0.0) };
//!     for step in 0..60_u32 {
//!         let line = |y: f64| (1..12).map(|k| Point3::new(5.0 * f64::from(k), y, 0.0)).collect();
//!         let detection = |category, y| Detection { category, points_vehicle: line(y) };
//!         let odometry_from_vehicle = Pose::translation(2.0 * f64::from(step), 0.0, 0.0);
//!         let parts = FrameParts {
//!             sequence: Sequence(u64::from(step) + 1),
//!             time: TimestampNs((i64::from(step) + 1_000 * number as i64) * 100_000_000),
//!             odometry: Odometry { odometry_from_vehicle, motion_covariance: None },
//!             gnss: Some(receiver.fix_at(&odometry_from_vehicle, 1.5, 2.0)),
//!             detections: vec![detection(Category::WhiteSolid, 1.8), detection(Category::WhiteDashed, -1.8)],
//!             occlusions: vec![],
//!         };
//!         let frame = Frame::new(parts, &FrameLimits::default()).unwrap();
//!         let report = mapper.step(&frame);
//!         trace.observe(&frame, &report.map_from_vehicle);
//!     }
//!     trace.contribution(DriveId(number), Sensor::default(), &mapper.lane_map()).unwrap()
//! };
//! let drives = [contribution(1, 0.8), contribution(2, -0.6)];
//! let map = fuse(&drives, &anchor, &FleetParams::default());
//! assert_eq!(map.lanes.len(), 2);
//! // The two receivers are believed alike: the map lies between them.
//! let left = map.lanes.iter().find(|lane| lane.category == Category::WhiteSolid).unwrap();
//! assert!(left.points.iter().all(|point| (point.position.y - 1.9).abs() < 0.1 && point.drives == 2));
//! ```

pub mod alignment;
pub mod base;
pub mod beginning;
mod bridging;
pub mod cell;
mod chain;
pub mod change;
mod continuity;
pub mod contribution;
pub mod correction;
mod credibility;
mod crowding;
mod double_line;
pub mod fusion;
mod georeferenced;
mod growth;
mod history;
mod joining;
pub mod line;
pub mod localization;
pub mod matching;
mod moved;
pub mod params;
mod persistence;
pub mod placement;
mod potts;
mod prepared;
mod receivers;
pub mod redundancy;
mod repainted;
pub mod settled;
mod shown;
mod sparse;
pub mod trace;
mod ways;

pub use base::Base;
pub use beginning::Beginning;
pub use cell::CellId;
pub use change::{ChangeKind, MapChange};
pub use contribution::{Contribution, DriveId, PlacedBy, TrajectoryPoint};
pub use correction::Correction;
pub use fusion::{
    Fused, FusedDrive, FusedMap, Keep, are_enough_apart, by_seniority, fold, fuse, fuse_from, fuse_onto, split_to_fold,
};
pub use line::{FusedLane, FusedLaneId, FusedPoint};
pub use params::FleetParams;
pub use redundancy::{Visits, missed_least};
pub use settled::{Settled, draft};
pub use trace::Trace;
