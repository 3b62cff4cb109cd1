//! Frames and shapes: rigid transforms, the earth, polylines.

pub mod georeference;
pub mod polyline;
pub mod pose;

pub use pose::{Pose, TangentCovariance};
