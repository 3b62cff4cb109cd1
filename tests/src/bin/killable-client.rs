//! A client to be killed by tests: its arguments are the service's address, the folder of its spool, and the seed and the
//! number of frames of the drive that it streams, and after which of them it waits to be killed; 0: never. It prints
//! `taken N`, or the session's name once the drive is delivered.

use std::{env, time::Duration};

use anyhow::Context;
use lanemap_client::{ConnectOptions, IngestClient, Reconnect, SessionStart, SpoolOptions};
use lanemap_core::Sequence;
use lanemap_tests::drives;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [url, spool, seed, frames, pause_after] = arguments.as_slice() else {
        anyhow::bail!("the arguments are: URL SPOOL SEED FRAMES PAUSE_AFTER");
    };
    let drive = drives::simulated(seed.parse()?, frames.parse()?);
    let pause_after = Sequence(pause_after.parse().context("PAUSE_AFTER is no number")?);
    let reconnect = Reconnect { longest_pause: Duration::from_millis(500), ..Reconnect::forever() };
    let start = SessionStart { spool: Some(SpoolOptions::new(spool)), reconnect, ..drive.start() };
    let client = IngestClient::offline(url, ConnectOptions::default()).await?;
    let (mut session, _events) = client.begin_session(start).await?;
    let last = session.last_spooled();
    for frame in drive.frames.iter().filter(|frame| Some(frame.sequence()) > last) {
        session.send(frame).await?;
        if frame.sequence() == pause_after {
            println!("taken {}", pause_after.0);
            std::future::pending::<()>().await;
        }
    }
    session.wait_opened().await?;
    let id = session.id().to_owned();
    session.finish().await?;
    println!("{id}");
    Ok(())
}
