//! Drives as [MCAP](https://mcap.dev) files.
//!
//! A drive is one file: a message of `lanemap.v1.SessionStart` first, then one of `lanemap.v1.Frame` for each frame, both
//! protobuf, with their descriptors as schemas, so that Foxglove, `mcap` and any protobuf library read them without ours.
//! Beside them, for the eye, `foxglove.SceneUpdate` (the detected lines), `foxglove.FrameTransform` (the odometry) and
//! `foxglove.LocationFix`; the reader passes over these, as over any other channel.

mod descriptors;
mod reader;
mod records;
mod scene;
mod writer;

pub use reader::McapDrive;
pub use writer::{DriveStart, McapRecorder};

/// Name of the schema of a drive's start.
pub(crate) const START_SCHEMA: &str = "lanemap.v1.SessionStart";
/// Name of the schema of its frames.
pub(crate) const FRAME_SCHEMA: &str = "lanemap.v1.Frame";
