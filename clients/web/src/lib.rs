//! The lanemap viewer: a page and its scripts, embedded at build time.
