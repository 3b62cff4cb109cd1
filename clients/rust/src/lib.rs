//! Rust client of the lanemap service: stream observations, read maps.
