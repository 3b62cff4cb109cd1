//! End-to-end promises of lanemap, one file per promise, and what they share: a server on a free port, drives to
//! stream, and a stream that says exactly what it is told to say.

// A test's plumbing fails loudly; clippy's exemption for tests covers `#[test]` functions only.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::missing_panics_doc)]

pub mod authorities;
pub mod bags;
pub mod drives;
pub mod endpoints;
pub mod events;
pub mod fleets;
pub mod folders;
pub mod http;
pub mod proxy;
pub mod python;
pub mod raw_stream;
pub mod raw_zenoh;
pub mod servers;
pub mod simulated;
pub mod tokens;
