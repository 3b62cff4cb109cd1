//! Recorded drives: MCAP files, ROS 1 bags and OpenLane folders, read alike, and MCAP written.
//!
//! ```no_run
//! use lanemap_recording::{ReadOptions, open};
//!
//! # fn main() -> Result<(), lanemap_recording::RecordingError> {
//! for mut drive in open("drive.mcap", &ReadOptions::default())? {
//!     println!("{}: {} frames", drive.name(), drive.len());
//!     for frame in drive.frames() {
//!         match frame {
//!             Ok(frame) => println!("{} lines", frame.parts.detections.len()),
//!             Err(fault) => eprintln!("{}: {}", fault.frame, fault.error),
//!         }
//!     }
//! }
//! # Ok(())
//! # }
//! ```
//!
//! Files are not trusted: lengths are held against limits and against what the file has, checksums are checked, and what
//! cannot be read is an error that names file, place, value and limit. Memory stays below a few times [`MAX_RECORD_BYTES`]
//! beside an index of some ten bytes per frame of a bag.

pub mod bag;
mod drive;
mod error;
mod input;
pub mod mcap;
mod open;
mod openlane;

pub use self::bag::BagDrive;
pub use self::mcap::{DriveStart, McapDrive, McapRecorder};
pub use drive::{BagOptions, Camera, FrameFault, Frames, ReadOptions, RecordedDrive, RecordedFrame};
pub use error::RecordingError;
pub use open::open;

/// Largest record of a file, and largest chunk once decompressed, bytes.
pub const MAX_RECORD_BYTES: u64 = 64 << 20;
