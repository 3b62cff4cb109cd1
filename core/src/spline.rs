//! Catmull-Rom splines: basis, curves with two rules for their ends, foot points, sampling.

pub mod basis;
pub mod curve;
pub mod foot_point;
pub mod sampling;

pub use curve::{ControlPolygon, Curve, CurveWalk, Segment, Support};
pub use foot_point::{FootPoint, foot_point_coarse, foot_point_refined};
