//! The mathematics of lanemap: one vehicle's lane detections in, a Catmull-Rom lane map out.
//!
//! [`Mapper::step`] takes one validated [`Frame`] and says what changed. The method is that of Qiao, Yu, Yin and Shen,
//! *Online Monocular Lane Mapping Using Catmull-Rom Spline* (IROS 2023); each file names its section of the paper and
//! where it differs. No tokio, clock, randomness, threads or files here: the same input gives the same bytes.

pub mod association;
pub mod category;
pub mod error;
pub mod evaluation;
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
pub use frame::{Detection, Frame, FrameLimits, FrameParts, GnssFix, Odometry, Sequence, TimestampNs};
pub use geometry::{Pose, TangentCovariance};
pub use lane_map::{ControlPoint, EndRule, LaneId, LaneMap, LocalLane, LocalWindow, MapLane};
pub use mapper::{Mapper, StepReport};
pub use params::{Params, Preset};
pub use sensor::{FieldOfView, Sensor};
