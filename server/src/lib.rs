//! The lanemap service: ingest, sessions, journal, the shared map, HTTP.
//!
//! A frame's way: [`ingest`] decodes and validates it, a session's actor ([`session`]) puts it into the [`journal`], acks
//! it once it is durable, and only then hands it to the mapper. What the mapper knows is published as whole versions of
//! a map ([`session::Sessions`]); what all drives say together is fused into one map in the background ([`fuse`]). [`serve`]
//! and the gRPC map service read both.
//!
//! A library without a `main`: the `lanemap` command and the tests start it with [`Server::start`].

pub mod admin;
pub mod auth;
pub mod change_feed;
pub mod config;
pub mod error;
pub mod export;
pub mod fuse;
#[doc(hidden)]
pub mod fuzzing;
pub mod ingest;
pub mod journal;
mod listener;
pub mod map_service;
pub mod privacy;
pub mod serve;
pub mod server;
pub mod session;
pub mod telemetry;

pub use config::{ConfigError, ConfigOverrides, ServerConfig};
pub use server::{RunningServer, Server, StartError};
