//! A drive: a route through the network, the path driven on it, and the true pose at every frame.

pub mod motion;
pub mod path;
pub mod route;

pub use motion::{MotionModel, TrueState};
pub use path::Path;
pub use route::{LaneChange, Leg, Route};
