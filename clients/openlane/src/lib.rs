//! Reads and writes drives as OpenLane folders.
