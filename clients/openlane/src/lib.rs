//! Reads and writes drives as OpenLane folders.
//!
//! A drive is a folder `segment-NAME` of annotations, one `TIMESTAMP.json` per frame, beside `results/segment-NAME` with
//! what a detector saw in the same frames (or `annotations/segment-NAME`, as in OpenLane's own example). The two kinds of
//! file differ: annotation points are `[3][n]` in the camera frame (x front, y left, z up), result points `[n][3]` in the
//! ground frame (x right, y front, z up, straight below the camera at the height of the vehicle's origin).
//! [`DriveFrame`] brings both to the vehicle frame.
//!
//! ```no_run
//! use lanemap_core::{Frame, FrameLimits, Sequence};
//! use lanemap_openlane::Drives;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! for drive in Drives::list("drives", &["ps-001".to_owned()])? {
//!     for (number, frame) in drive.frames().enumerate() {
//!         let frame = frame?;
//!         let pose = frame.annotation.pose()?;
//!         let parts = frame.frame_parts(Sequence(number as u64 + 1), pose, None);
//!         let _valid = Frame::new(parts, &FrameLimits::default())?;
//!     }
//! }
//! # Ok(())
//! # }
//! ```

mod annotation;
mod detection_file;
mod error;
mod folder;
mod intrinsic;
mod json;
mod odometry_noise;
mod timestamp;
mod writer;

pub use annotation::{AnnotatedLane, Annotation};
pub use detection_file::{DetectedLane, DetectionFile};
pub use error::OpenLaneError;
pub use folder::{DriveFolder, DriveFrame, Drives};
pub use intrinsic::Intrinsic;
pub use odometry_noise::{MotionNoise, apply_motion_noise, draw_motion_noise, noisy_odometry};
pub use timestamp::{timestamp_from_stem, timestamp_stem};
pub use writer::{write_annotation, write_result};
