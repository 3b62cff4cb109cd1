//! Where the vehicle is: prediction by odometry, correction by the lanes of the map.

pub mod motion;
pub mod pose_update;
pub mod prediction;

pub use pose_update::{Correspondence, MatchedLane, update_pose};
pub use prediction::PoseEstimate;
