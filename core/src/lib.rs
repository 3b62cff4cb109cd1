//! The mathematics of lanemap: one vehicle's lane detections in, a Catmull-Rom lane map out.
//!
//! [`Mapper::step`] takes one validated [`Frame`] and says what changed. The method is that of Qiao, Yu, Yin and Shen,
//! *Online Monocular Lane Mapping Using Catmull-Rom Spline* (IROS 2023); each file names its section of the paper and
//! where it differs. No tokio, clock, randomness, threads or files here: the same input gives the same bytes.
//!
//! The way of a frame through [`Mapper::step`]:
//!
//! 1. [`tracking::prediction`]: the last pose is carried on by odometry, with its uncertainty.
//! 2. [`observation`]: each detection is cropped, fitted with cubics in a frame of its own, and sampled.
//! 3. [`association`]: which detection is which lane of the map; `default` estimates the error of the pose along with it.
//! 4. [`tracking::pose_update`]: the pose at which the matched lanes lie on those of the map.
//! 5. [`landmark::growth`]: lanes grow by what was seen beyond their ends; what was matched with none begins a lane.
//! 6. [`landmark::information`]: the new terms are added and only what they change is solved; [`landmark::line_terms`] says
//!    how the samples of one line err together.
//! 7. [`landmark::extent`], [`landmark::existence`], [`landmark::category`], [`landmark::duplicate`]: where a line ends,
//!    whether it is there, what it is painted as, and whether it is two.
//!
//! [`Params`] holds every number of both presets; [`evaluation`] measures as the paper does, and strictly.
//!
//! ```
//! use lanemap_core::*;
//! use nalgebra::Point3;
//!
//! let mut mapper = Mapper::new(Params::preset(Preset::Default), Sensor::default());
//! for step in 0..20u32 {
//!     let line = (1..12).map(|k| Point3::new(5.0 * f64::from(k), 1.8, 0.0)).collect();
//!     let odometry_from_vehicle = Pose::translation(f64::from(step), 0.0, 0.0);
//!     let parts = FrameParts {
//!         sequence: Sequence(u64::from(step) + 1),
//!         time: TimestampNs(i64::from(step) * 100_000_000),
//!         odometry: Odometry { odometry_from_vehicle, motion_covariance: None },
//!         gnss: None,
//!         detections: vec![Detection { category: Category::WhiteSolid, points_vehicle: line }],
//!         occlusions: Vec::new(),
//!     };
//!     mapper.step(&Frame::new(parts, &FrameLimits::default())?);
//! }
//! let map = mapper.lane_map();
//! assert_eq!(map.lanes.len(), 1);
//! assert!(map.lanes[0].polyline(0.5).iter().all(|point| (point.y - 1.8).abs() < 0.01));
//! # Ok::<(), FrameError>(())
//! ```

pub mod association;
pub mod category;
pub mod error;
pub mod evaluation;
pub mod fleet;
pub mod frame;
pub mod geometry;
pub mod landmark;
pub mod lane_map;
pub mod mapper;
pub mod observation;
pub mod params;
pub mod sensor;
pub mod spline;
pub mod tracking;

pub use category::Category;
pub use error::{FrameError, PoseError, SnapshotError};
pub use frame::{Detection, Frame, FrameLimits, FrameParts, GnssFix, Occlusion, Odometry, Sequence, TimestampNs};
pub use geometry::{Pose, TangentCovariance};
pub use lane_map::{CategoryStretch, ControlPoint, EndRule, LaneId, LaneMap, LocalLane, LocalWindow, MapLane};
pub use mapper::{Mapper, StepReport};
pub use params::{Params, Preset};
pub use sensor::{FieldOfView, Sensor};
