//! One lane of the map: how it grows, what is known of its control points, whether it exists, and what it is painted as.

pub mod information;
