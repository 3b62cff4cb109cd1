//! A server to be killed by tests: its argument is the folder of its store; it prints its address and serves.

use std::path::PathBuf;

use anyhow::Context;
use lanemap_server::{Server, ServerConfig};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let data_dir = PathBuf::from(std::env::args_os().nth(1).context("the folder of the store is missing")?);
    // Snapshots come often, so that kills hit them too.
    let snapshot_every_frames = 50;
    let listen = ([127, 0, 0, 1], 0).into();
    let config = ServerConfig { listen, data_dir, snapshot_every_frames, ..ServerConfig::default() };
    let server = Server::start(config).await?;
    println!("{}", server.url());
    server.stopped().await;
    Ok(())
}
