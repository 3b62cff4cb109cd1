//! Drives as ROS 1 bags (version 2.0) with the messages of the paper's authors.
//!
//! Their `openlane_bag` writes, for each frame under one stamp, `/gt_pose_wc` (`geometry_msgs/PoseStamped`, the camera in
//! the world) and `/lanes_gt` and `/lanes_predict` (`openlane_bag/LaneList`, points in the camera frame: x front, y left,
//! z up). Names and types of fields are taken from the definitions that the bag holds, so that other packages' messages of
//! that shape are read as well:
//!
//! * poses: a message with a header and, at any depth of fields named `pose`, a `position` and an `orientation`;
//! * lanes: a message with a header and a list of lanes, each with a list of points of `x`, `y`, `z`, and a `category`.
//!
//! A bag says nothing of the camera's mount; see [`BagOptions`](crate::BagOptions).

mod definition;
mod drive;
mod lanes;
mod records;
mod view;

pub use definition::{DefinitionError, Definitions};
pub use drive::BagDrive;

/// First bytes of a bag.
pub(crate) const MAGIC: &[u8] = b"#ROSBAG V2.0\n";
