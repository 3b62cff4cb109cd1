//! A server to be killed by tests: its arguments are the folder of its store and the address to listen on; it prints
//! its address and serves.

use std::{env, path::PathBuf};

use anyhow::Context;
use lanemap_server::{Server, ServerConfig};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let mut arguments = env::args().skip(1);
    let data_dir = PathBuf::from(arguments.next().context("the folder of the store is missing")?);
    let listen = arguments.next().context("the address is missing")?.parse()?;
    // Snapshots come often, so that kills hit them too.
    let snapshot_every_frames = 50;
    let config = ServerConfig { listen, data_dir, snapshot_every_frames, ..ServerConfig::default() };
    let server = Server::start(config).await?;
    println!("{}", server.url());
    server.stopped().await;
    Ok(())
}
