//! One port for gRPC and HTTP: accepts connections, bounded in number, shakes hands with each in a task of its own, and
//! ends them gracefully.

mod first_bytes;

use std::{sync::Arc, time::Duration};

use axum::{Extension, Router};
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::{
        conn::auto::Builder,
        graceful::{GracefulShutdown, Watcher},
    },
    service::TowerToHyperService,
};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::{TcpListener, TcpStream},
    sync::Semaphore,
    time::sleep,
};
use tokio_util::sync::CancellationToken;

use crate::{
    auth::{
        layer::Connection,
        tls::{self, Tls},
    },
    config::ServerConfig,
    telemetry,
};
use first_bytes::FirstBytes;
use tower::Layer;

/// Pause after a failed accept: out of file descriptors, most likely.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Least room for what a connection reads at a time, bytes.
const LEAST_BUFFER_BYTES: usize = 64 * 1024;

/// How connections are spoken with.
struct Protocol {
    builder: Builder<TokioExecutor>,
    /// Time for the bytes that tell which version of HTTP a connection speaks.
    first_bytes: Duration,
}

/// Accepts connections until `stop`, then lets those that are open end until `deadline`.
pub(crate) async fn serve(
    listener: TcpListener,
    router: Router,
    config: &ServerConfig,
    tls: Option<Arc<Tls>>,
    stop: CancellationToken,
    deadline: impl Future<Output = ()>,
) {
    let protocol = Arc::new(Protocol { builder: connection_builder(config), first_bytes: config.header_timeout() });
    let graceful = GracefulShutdown::new();
    let abort = CancellationToken::new();
    let places = Arc::new(Semaphore::new(config.max_connections));
    loop {
        let accepted = tokio::select! {
            () = stop.cancelled() => break,
            accepted = accept(&listener, &places) => accepted,
        };
        let Some((connection, place)) = accepted else { continue };
        let serving =
            serve_connection(connection, router.clone(), Arc::clone(&protocol), tls.clone(), graceful.watcher());
        let abort = abort.clone();
        tokio::spawn(async move {
            metrics::gauge!(telemetry::CONNECTIONS).increment(1.0);
            tokio::select! {
                () = serving => {}
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

/// Shakes hands where there is TLS, and serves the connection to its end.
async fn serve_connection(
    connection: TcpStream,
    router: Router,
    protocol: Arc<Protocol>,
    tls: Option<Arc<Tls>>,
    watcher: Watcher,
) {
    let Some(tls) = tls else {
        return serve_requests(connection, Connection { identity: None }, router, &protocol, watcher).await;
    };
    match tls.accept(connection).await {
        Ok(stream) => {
            let identity = tls::identity(&stream).map(Arc::new);
            serve_requests(stream, Connection { identity }, router, &protocol, watcher).await;
        }
        Err(error) => {
            tracing::debug!(%error, "a connection did not come about");
            metrics::counter!(telemetry::HANDSHAKES_FAILED).increment(1);
        }
    }
}

async fn serve_requests(
    stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static,
    connection: Connection,
    router: Router,
    protocol: &Protocol,
    watcher: Watcher,
) {
    let service = TowerToHyperService::new(Extension(connection).layer(router));
    let stream = TokioIo::new(FirstBytes::within(protocol.first_bytes, stream));
    let serving = protocol.builder.serve_connection_with_upgrades(stream, service).into_owned();
    if let Err(error) = watcher.watch(serving).await {
        tracing::debug!(error, "a connection broke");
    }
}

fn connection_builder(config: &ServerConfig) -> Builder<TokioExecutor> {
    let mut builder = Builder::new(TokioExecutor::new());
    let streams = u32::try_from(config.max_streams_per_connection).unwrap_or(u32::MAX);
    // Wider than the router's own bounds, whose refusals say what is wrong; beyond these the connection ends.
    let header_bytes = LEAST_BUFFER_BYTES.max(2 * (config.max_header_bytes + config.max_url_bytes));
    builder.http1().timer(TokioTimer::new()).header_read_timeout(config.header_timeout()).max_buf_size(header_bytes);
    builder
        .http2()
        .max_header_list_size(u32::try_from(header_bytes).unwrap_or(u32::MAX))
        .timer(TokioTimer::new())
        .max_concurrent_streams(streams)
        .keep_alive_interval(config.keep_alive())
        .keep_alive_timeout(config.keep_alive());
    builder
}
