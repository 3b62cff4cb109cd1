//! What the fuzz targets do with their bytes. A target must not panic, must not take more memory than its limits say, and
//! must hold the promises that it asserts.
//!
//! `tests/fuzz` hands these functions to libFuzzer; the tests of this crate run each over its committed corpus.

// A promise that does not hold is what a fuzzer looks for.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::missing_panics_doc)]

mod frame;
mod openlane;
mod order;
mod recordings;
mod session;
mod zenoh_keys;

pub use frame::frame;
pub use openlane::openlane;
pub use order::order;
pub use recordings::{bag, mcap, message_definition};
pub use session::session;
pub use zenoh_keys::zenoh_keys;

/// A target.
pub type Target = fn(&[u8]);

/// Every target by the name of its corpus.
pub const TARGETS: [(&str, Target); 8] = [
    ("bag", bag),
    ("frame", frame),
    ("mcap", mcap),
    ("message_definition", message_definition),
    ("openlane", openlane),
    ("order", order),
    ("session", session),
    ("zenoh_keys", zenoh_keys),
];
