//! The lanemap service: ingest, sessions, journal, HTTP.
