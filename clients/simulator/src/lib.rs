//! Synthetic roads, drives and a lane detector with realistic errors.
