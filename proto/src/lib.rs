//! Generated types of the lanemap wire protocol, and their conversion from and to the types of `lanemap-core`.
//!
//! The `.proto` files under `lanemap/v1` are the reference: unit, frame and range of every field stand in its comment.

pub mod cell_map;
pub mod decode;
pub mod encode;
pub mod lane_name;
pub mod zenoh_keys;

/// Package `lanemap.v1`.
pub mod v1 {
    #![allow(
        missing_docs,
        unused_qualifications,
        clippy::all,
        clippy::pedantic,
        reason = "generated from the .proto files"
    )]
    tonic::include_proto!("lanemap.v1");

    /// Descriptors of every file of the package, for gRPC reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/lanemap_descriptor_set.bin"));
}
