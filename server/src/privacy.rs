//! What the service may know and show of who drove where.
//!
//! * Vehicle ids, fleet ids and the clients' names of drives become keyed digests ([`pseudonym`]) where a stream opens.
//!   The store holds digests only; whoever has it but not the [`key`] cannot tell which vehicle it was, nor try names out.
//! * Readers of maps see a session id, which is new for every drive and made of no vehicle's name: it tells nothing of
//!   two drives of one vehicle, and only the hour in which it began.
//! * Where a trip starts and ends may be cut ([`trip_cut`]): what is cut is acked and in no map.
//! * What is deleted on request is gone from the maps, the journal and the files of the store
//!   ([`crate::session::forget`]).

pub mod key;
pub mod pseudonym;
pub mod trip_cut;

pub use key::{KeyError, PrivacyKey};
pub use pseudonym::{DrivePseudonym, Pseudonyms, VehiclePseudonym};
pub use trip_cut::TripCut;
