//! One session per drive of a vehicle: its actor, and the maps that sessions publish.
//!
//! The [`registry`] finds or begins the session of a drive; its [`actor`] owns the only [`Mapper`](lanemap_core::Mapper)
//! of that drive and lives as long as the vehicle streams, and a little longer.

pub(crate) mod actor;
pub(crate) mod drive;
pub mod forget;
pub mod id;
pub(crate) mod in_flight;
mod mapping_turns;
pub mod published;
mod recent;
pub(crate) mod registry;
pub(crate) mod reorder;
pub mod way;

pub use crate::journal::{SessionKey, SessionRecord, SessionSetup};
pub use id::SessionId;
pub use published::{MapVersion, PublishedMap, SessionState, SessionSummary, Sessions};
pub use way::{Way, WayPoint};
