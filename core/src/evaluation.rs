//! The three measures of the paper's tables: map quality, pose error, association.

pub mod ground_frame;

pub use ground_frame::GroundFrame;
