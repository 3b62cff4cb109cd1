//! One session per drive of a vehicle, and the maps that sessions publish.

pub mod id;
pub mod published;

pub use id::SessionId;
pub use published::{MapVersion, PublishedMap, SessionState, Sessions};
