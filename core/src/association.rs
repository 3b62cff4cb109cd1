//! Which detection is which lane of the map.
//!
//! [`chamfer`] + [`consistency`] + [`assignment`] are the paper's method; [`joint`] is ours, which estimates the error of the
//! pose together with the matching. Both look at [`LaneShape`]s, so that they serve the mapper and the paper's table alike.

pub mod assignment;
pub mod chamfer;
pub mod clipper;
pub mod consistency;
pub mod joint;
pub mod lmr;
pub mod shape;
pub mod shell;

pub use chamfer::associate_by_chamfer;
pub use joint::associate_jointly;
pub use shape::LaneShape;

/// Uncertainty of the pose with which detections were brought among the lanes of the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseUncertainty {
    /// Standard deviation of the heading, radians.
    pub yaw_rad: f64,
    /// Standard deviation of the position along the vehicle's x axis, metres.
    pub along_m: f64,
    /// Standard deviation of the position along the vehicle's y axis, metres.
    pub across_m: f64,
}
