//! The door: what vehicles send is decoded and validated here, or refused with a reason.
//!
//! Transports carry messages; what becomes of a message is the same for all of them.

pub(crate) mod conversation;
pub mod decode;
mod grpc;
mod outbox;
mod refusal;
mod upload;
pub mod zenoh;

pub(crate) use grpc::BoundedIngest;
pub use grpc::IngestGrpc;
pub use outbox::{Outbox, OutboxStream};
pub use refusal::Refusal;
pub use zenoh::ZenohError;
