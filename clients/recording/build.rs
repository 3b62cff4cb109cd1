//! Compiles Foxglove's well-known schemas with protox: no `protoc` is needed on the machine.

use std::{env, error::Error, fs, path::PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=foxglove");
    let descriptors = protox::compile(["scene.proto"], ["foxglove"])?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(out.join("foxglove_descriptor_set.bin"), prost::Message::encode_to_vec(&descriptors))?;
    prost_build::Config::new().compile_fds(descriptors)?;
    Ok(())
}
