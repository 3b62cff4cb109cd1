//! `lanemap bench echo`: the same bytes over the same transport, and nothing done with them.

use std::{
    convert::Infallible,
    net::Ipv4Addr,
    process::ExitCode,
    task::{Context, Poll},
};

use clap::Args;
use tokio::net::TcpListener;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{
    Request, Response, Status, Streaming,
    body::Body,
    codegen::{BoxFuture, Service, http},
    server::{Grpc, NamedService, StreamingService},
    transport::Server,
};

use super::{
    grpc::{Connections, RawCodec},
    ingest::{self, LoadArgs},
    server_process::ServerProcess,
    tally::Tally,
    vehicle::Link,
};

/// The only method of the echo.
const ECHO: &str = "/lanemap.bench.Echo/Echo";

/// The load.
#[derive(Args, Debug)]
pub struct EchoArgs {
    #[command(flatten)]
    load: LoadArgs,
}

/// Runs the load against an echo in a process of its own.
pub fn run(args: &EchoArgs) -> anyhow::Result<ExitCode> {
    let tapes = args.load.tapes()?;
    let server = ServerProcess::echo()?;
    ingest::runtime()?.block_on(async {
        let link = Link::Echo(Connections::open(&server.url, args.load.vehicles, ECHO).await?);
        let memory = || async { server.rss_mb().ok() };
        ingest::load(&args.load, "echo", link, tapes, Tally::new()?, memory).await
    })
}

/// Serves the echo on any free port, until the process is ended.
#[tokio::main]
pub async fn serve() -> anyhow::Result<ExitCode> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await?;
    println!("echoing at http://{}", listener.local_addr()?);
    Server::builder().tcp_nodelay(true).add_service(Echo).serve_with_incoming(TcpListenerStream::new(listener)).await?;
    Ok(ExitCode::SUCCESS)
}

/// Sends back every message of a stream.
#[derive(Clone, Copy, Debug)]
struct Echo;

impl NamedService for Echo {
    const NAME: &'static str = "lanemap.bench.Echo";
}

impl StreamingService<bytes::Bytes> for Echo {
    type Response = bytes::Bytes;
    type ResponseStream = Streaming<bytes::Bytes>;
    type Future = std::future::Ready<Result<Response<Self::ResponseStream>, Status>>;

    fn call(&mut self, request: Request<Streaming<bytes::Bytes>>) -> Self::Future {
        std::future::ready(Ok(Response::new(request.into_inner())))
    }
}

impl Service<http::Request<Body>> for Echo {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<Self::Response, Infallible>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        Box::pin(async move { Ok(Grpc::new(RawCodec).streaming(Echo, request).await) })
    }
}
