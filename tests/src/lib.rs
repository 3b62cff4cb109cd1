//! End-to-end promises of lanemap, one file per promise.
