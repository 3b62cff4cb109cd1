//! The lanemap service: ingest, sessions, journal, HTTP.

pub mod serve;
pub mod session;
