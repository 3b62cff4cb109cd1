//! Compiles `lanemap/v1/*.proto` with protox: no `protoc` is needed on the machine.

use std::{env, error::Error, fs, path::PathBuf};

const FILES: [&str; 9] = [
    "lanemap/v1/admin_service.proto",
    "lanemap/v1/geometry.proto",
    "lanemap/v1/observation.proto",
    "lanemap/v1/lane_map.proto",
    "lanemap/v1/ingest_service.proto",
    "lanemap/v1/map_event.proto",
    "lanemap/v1/map_service.proto",
    "lanemap/v1/shared_map.proto",
    "lanemap/v1/spline_tile.proto",
];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=lanemap");
    let descriptors = protox::compile(FILES, ["."])?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(out.join("lanemap_descriptor_set.bin"), prost::Message::encode_to_vec(&descriptors))?;
    tonic_prost_build::configure().compile_fds(descriptors)?;
    Ok(())
}
