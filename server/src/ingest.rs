//! The door: what vehicles send is decoded and validated here, or refused with a reason.

pub mod decode;
mod grpc;
mod outbox;
mod refusal;

pub use grpc::IngestGrpc;
pub use outbox::{Outbox, OutboxStream};
pub use refusal::Refusal;
