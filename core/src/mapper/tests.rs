//! Promises of the whole mapper.
