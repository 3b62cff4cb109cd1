//! Signals that end a service: SIGINT (Ctrl-C) and SIGTERM. A second one ends the process at once. SIGHUP has it read its
//! files anew.

use anyhow::Context;

/// Exit code of a process that a second signal cut short: 128 + SIGINT, as shells have it.
const CUT_SHORT: i32 = 130;

/// A future that waits for the first signal. Signals are caught from this call on.
#[cfg(unix)]
pub fn stop_signals() -> anyhow::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut interrupt = signal(SignalKind::interrupt()).context("SIGINT cannot be caught")?;
    let mut terminate = signal(SignalKind::terminate()).context("SIGTERM cannot be caught")?;
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
        tracing::info!("stopping; a second signal stops at once");
        tokio::spawn(async move {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
            std::process::exit(CUT_SHORT);
        });
    })
}

/// A future that waits for the first Ctrl-C.
#[cfg(not(unix))]
pub fn stop_signals() -> anyhow::Result<impl Future<Output = ()>> {
    Ok(async {
        let _ = tokio::signal::ctrl_c().await;
        tracing::info!("stopping; a second signal stops at once");
        tokio::spawn(async {
            let _ = tokio::signal::ctrl_c().await;
            std::process::exit(CUT_SHORT);
        });
    })
}

/// A future that acts at each SIGHUP, for ever. The signal is caught from this call on.
#[cfg(unix)]
pub fn at_each_hangup(act: impl Fn()) -> anyhow::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut hangup = signal(SignalKind::hangup()).context("SIGHUP cannot be caught")?;
    Ok(async move {
        while hangup.recv().await.is_some() {
            act();
        }
    })
}

/// A future that does nothing: there is no SIGHUP here.
#[cfg(not(unix))]
pub fn at_each_hangup(_act: impl Fn()) -> anyhow::Result<impl Future<Output = ()>> {
    Ok(std::future::pending())
}
