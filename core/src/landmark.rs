//! One lane of the map: how it grows, what is known of its control points, whether it exists, and what it is painted as.

pub mod category;
pub mod clean_up;
pub mod duplicate;
pub mod existence;
pub mod extent;
pub mod foot_walk;
pub mod growth;
pub mod index;
pub mod information;
pub mod lane;
pub mod line_terms;

pub use lane::Landmark;
