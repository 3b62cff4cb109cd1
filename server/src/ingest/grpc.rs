//! The gRPC side of ingest: carries messages in and answers out.

mod packed;

use lanemap_proto::v1::{self, ingest_service_server::IngestService};
use tonic::{Request, Response, Status, Streaming};

use super::{OutboxStream, conversation::Conversations};
use crate::auth::peer_of;
pub(crate) use packed::BoundedIngest;

/// The ingest service.
#[derive(Clone)]
pub struct IngestGrpc {
    conversations: Conversations,
}

impl IngestGrpc {
    pub(crate) fn new(conversations: Conversations) -> Self {
        Self { conversations }
    }
}

#[tonic::async_trait]
impl IngestService for IngestGrpc {
    type StreamObservationsStream = OutboxStream;

    async fn stream_observations(
        &self,
        request: Request<Streaming<v1::StreamObservationsRequest>>,
    ) -> Result<Response<OutboxStream>, Status> {
        let peer = peer_of(request.extensions())?;
        Ok(Response::new(self.conversations.begin(peer, request.into_inner())))
    }

    async fn upload_observations(
        &self,
        request: Request<v1::UploadObservationsRequest>,
    ) -> Result<Response<v1::UploadObservationsResponse>, Status> {
        let peer = peer_of(request.extensions())?;
        Ok(Response::new(self.conversations.upload(&peer, request.into_inner()).await?))
    }
}
