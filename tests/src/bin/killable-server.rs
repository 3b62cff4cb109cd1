//! A server to be killed by tests: its arguments are the folder of its store and the address to listen on; other settings
//! it takes from the environment, as `lanemap serve` does. It prints its address and serves.

use std::{env, path::PathBuf};

use anyhow::Context;
use lanemap_server::{ConfigOverrides, Server, ServerConfig};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let mut arguments = env::args().skip(1);
    let data_dir = PathBuf::from(arguments.next().context("the folder of the store is missing")?);
    let listen = arguments.next().context("the address is missing")?.parse()?;
    let flags = ConfigOverrides {
        listen: Some(listen),
        data_dir: Some(data_dir),
        // Snapshots come often, so that kills hit them too.
        snapshot_every_frames: Some(50),
        ..ConfigOverrides::default()
    };
    let config = ServerConfig::load(None, flags)?;
    let server = Server::start(config).await?;
    println!("{}", server.url());
    server.stopped().await;
    Ok(())
}
