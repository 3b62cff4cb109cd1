//! Messages that come packed are held to a smaller limit than others: what unpacks them, its growing memory and the packed
//! bytes beside it, takes no more than the largest message does that comes as it is.

use std::{
    convert::Infallible,
    task::{Context, Poll, ready},
};

use futures::future::Either;
use tonic::{
    body::Body,
    codec::CompressionEncoding,
    codegen::{Service, http},
    server::NamedService,
};

use super::IngestGrpc;
use lanemap_proto::v1::ingest_service_server::IngestServiceServer;

/// The part of `max_message_bytes` that a packed message may unpack to: one in so many. Memory that grows by doubling has
/// its old half beside the new one for a moment.
const PACKED_SHARE: usize = 2;

/// The ingest service, once for messages as they are and once for packed ones.
#[derive(Clone)]
pub(crate) struct BoundedIngest {
    plain: IngestServiceServer<IngestGrpc>,
    packed: IngestServiceServer<IngestGrpc>,
}

impl BoundedIngest {
    pub(crate) fn new(ingest: IngestGrpc, max_message_bytes: usize) -> Self {
        let plain = IngestServiceServer::new(ingest.clone()).max_decoding_message_size(max_message_bytes);
        let packed = IngestServiceServer::new(ingest)
            .max_decoding_message_size((max_message_bytes / PACKED_SHARE).max(1))
            // Not zstd: a sender chooses how much memory unpacking it takes, up to 128 MiB, whatever the limit is.
            .accept_compressed(CompressionEncoding::Gzip);
        Self { plain, packed }
    }
}

impl NamedService for BoundedIngest {
    const NAME: &'static str = IngestServiceServer::<IngestGrpc>::NAME;
}

type Answer<S> = <S as Service<http::Request<Body>>>::Future;

impl Service<http::Request<Body>> for BoundedIngest {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Either<Answer<IngestServiceServer<IngestGrpc>>, Answer<IngestServiceServer<IngestGrpc>>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        let ready = |service: &mut IngestServiceServer<IngestGrpc>, context: &mut Context<'_>| {
            <_ as Service<http::Request<Body>>>::poll_ready(service, context)
        };
        ready!(ready(&mut self.plain, context))?;
        ready(&mut self.packed, context)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        let encoding = request.headers().get("grpc-encoding");
        if encoding.is_none_or(|encoding| encoding == "identity") {
            Either::Left(self.plain.call(request))
        } else {
            Either::Right(self.packed.call(request))
        }
    }
}
