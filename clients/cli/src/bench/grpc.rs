//! The gRPC side of the load: few connections, many streams, and messages that are bytes already.

use anyhow::Context;
use bytes::{Buf, BufMut, Bytes};
use tonic::{
    Request, Status, Streaming,
    client::Grpc,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
    codegen::http::uri::PathAndQuery,
    transport::{Channel, Endpoint},
};

use super::flow::Outgoing;

/// Streams on one connection, before another is opened.
const STREAMS_PER_CONNECTION: u32 = 128;
/// Flow-control windows: pings are few and answers never wait.
const CONNECTION_WINDOW_BYTES: u32 = 4 * 1024 * 1024;
const STREAM_WINDOW_BYTES: u32 = 256 * 1024;

/// Passes messages through as they are.
#[derive(Clone, Copy, Debug, Default)]
pub struct RawCodec;

impl Codec for RawCodec {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        *self
    }

    fn decoder(&mut self) -> Self {
        *self
    }
}

impl Encoder for RawCodec {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, item: Bytes, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put(item);
        Ok(())
    }
}

impl Decoder for RawCodec {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(buffer.copy_to_bytes(buffer.remaining())))
    }
}

/// Connections to a service.
#[derive(Debug)]
pub struct Connections {
    channels: Vec<Channel>,
    path: PathAndQuery,
}

impl Connections {
    /// Connects as often as so many streams ask for.
    pub async fn open(url: &str, streams: u32, path: &'static str) -> anyhow::Result<Self> {
        let mut channels = Vec::new();
        for _ in 0..streams.div_ceil(STREAMS_PER_CONNECTION) {
            let endpoint = Endpoint::from_shared(url.to_owned())?
                .tcp_nodelay(true)
                .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
                .initial_stream_window_size(STREAM_WINDOW_BYTES);
            channels.push(endpoint.connect().await.with_context(|| format!("no server at {url}"))?);
        }
        Ok(Self { channels, path: PathAndQuery::from_static(path) })
    }

    /// Opens a stream of one vehicle; its answers as bytes.
    pub async fn stream(&self, vehicle: u32, outgoing: Outgoing) -> Result<Streaming<Bytes>, Status> {
        let channel = &self.channels[vehicle as usize % self.channels.len()];
        let mut grpc = Grpc::new(channel.clone());
        grpc.ready().await.map_err(|error| Status::unavailable(error.to_string()))?;
        let response = grpc.streaming(Request::new(outgoing), self.path.clone(), RawCodec).await?;
        Ok(response.into_inner())
    }
}
