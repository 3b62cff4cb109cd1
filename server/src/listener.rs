//! One port for gRPC and HTTP: accepts connections, bounded in number, and ends them gracefully.

use std::{sync::Arc, time::Duration};

use axum::Router;
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::{conn::auto::Builder, graceful::GracefulShutdown},
    service::TowerToHyperService,
};
use tokio::{
    net::{TcpListener, TcpStream},
    sync::Semaphore,
    time::sleep,
};
use tokio_util::sync::CancellationToken;

use crate::{config::ServerConfig, telemetry};

/// Pause after a failed accept: out of file descriptors, most likely.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Accepts connections until `stop`, then lets those that are open end until `deadline`.
pub(crate) async fn serve(
    listener: TcpListener,
    router: Router,
    config: &ServerConfig,
    stop: CancellationToken,
    deadline: impl Future<Output = ()>,
) {
    let builder = connection_builder(config);
    let graceful = GracefulShutdown::new();
    let abort = CancellationToken::new();
    let places = Arc::new(Semaphore::new(config.max_connections));
    loop {
        let accepted = tokio::select! {
            () = stop.cancelled() => break,
            accepted = accept(&listener, &places) => accepted,
        };
        let Some((connection, place)) = accepted else { continue };
        let service = TowerToHyperService::new(router.clone());
        let serving = builder.serve_connection_with_upgrades(TokioIo::new(connection), service).into_owned();
        let serving = graceful.watch(serving);
        let abort = abort.clone();
        tokio::spawn(async move {
            metrics::gauge!(telemetry::CONNECTIONS).increment(1.0);
            tokio::select! {
                served = serving => if let Err(error) = served {
                    tracing::debug!(error, "a connection broke");
                },
                () = abort.cancelled() => {}
            }
            metrics::gauge!(telemetry::CONNECTIONS).decrement(1.0);
            drop(place);
        });
    }
    drop(listener);
    let ended = tokio::select! {
        () = graceful.shutdown() => true,
        () = deadline => false,
    };
    if !ended {
        tracing::warn!("some connections were still open at the end of the grace time and are cut");
        abort.cancel();
    }
}

async fn accept(
    listener: &TcpListener,
    places: &Arc<Semaphore>,
) -> Option<(TcpStream, tokio::sync::OwnedSemaphorePermit)> {
    let place = Arc::clone(places).acquire_owned().await.ok()?;
    match listener.accept().await {
        Ok((connection, _)) => {
            if let Err(error) = connection.set_nodelay(true) {
                tracing::debug!(%error, "a connection keeps Nagle's delay");
            }
            Some((connection, place))
        }
        Err(error) => {
            tracing::warn!(%error, "a connection was not accepted");
            sleep(ACCEPT_PAUSE).await;
            None
        }
    }
}

fn connection_builder(config: &ServerConfig) -> Builder<TokioExecutor> {
    let mut builder = Builder::new(TokioExecutor::new());
    let streams = u32::try_from(config.max_live_sessions).unwrap_or(u32::MAX).saturating_add(64);
    builder.http1().timer(TokioTimer::new()).header_read_timeout(Duration::from_secs(30));
    builder
        .http2()
        .timer(TokioTimer::new())
        .max_concurrent_streams(streams)
        .keep_alive_interval(config.keep_alive())
        .keep_alive_timeout(config.keep_alive());
    builder
}
