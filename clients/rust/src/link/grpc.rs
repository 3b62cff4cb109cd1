//! The way to a service over gRPC.

use std::time::Duration;

use lanemap_proto::v1::{
    self, admin_service_client::AdminServiceClient, ingest_service_client::IngestServiceClient,
    map_service_client::MapServiceClient,
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{
    Request, Streaming,
    metadata::{Ascii, MetadataValue},
    transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity},
};

use super::ConnectOptions;
use crate::{
    credentials::{Credentials, Tls},
    error::{ClientError, with_sources},
};

/// Largest answer taken, bytes: a local map is far smaller.
const MAX_ANSWER_BYTES: usize = 64 * 1024 * 1024;
/// Longest wait for a TCP connection; a network that swallows packets is tried again rather than waited for.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// A connection that is made when it is needed, and made anew when it broke.
#[derive(Clone, Debug)]
pub(crate) struct GrpcLink {
    endpoint: Endpoint,
    channel: Channel,
    credentials: Credentials,
}

impl GrpcLink {
    pub(crate) async fn new(url: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        let address =
            |error: &dyn std::error::Error| ClientError::Address { url: url.to_owned(), reason: with_sources(error) };
        let mut endpoint = Endpoint::from_shared(url.to_owned())
            .map_err(|error| address(&error))?
            .connect_timeout(CONNECT_TIMEOUT.min(options.open_timeout))
            .tcp_nodelay(true)
            .http2_keep_alive_interval(options.keep_alive)
            .keep_alive_timeout(options.keep_alive)
            .keep_alive_while_idle(true);
        if url.starts_with("https") {
            let tls = client_tls(options.credentials.tls(url).await?).timeout(options.open_timeout);
            endpoint = endpoint.tls_config(tls).map_err(|error| ClientError::Credentials(with_sources(&error)))?;
        }
        let channel = endpoint.connect_lazy();
        Ok(Self { endpoint, channel, credentials: options.credentials.clone() })
    }

    pub(crate) async fn reach(&mut self) -> Result<(), ClientError> {
        self.channel = self.endpoint.connect().await?;
        Ok(())
    }

    pub(crate) async fn stream(
        &self,
        messages: mpsc::Receiver<v1::StreamObservationsRequest>,
    ) -> Result<Streaming<v1::StreamObservationsResponse>, ClientError> {
        let request = self.signed(ReceiverStream::new(messages)).await?;
        let mut client = IngestServiceClient::new(self.channel.clone()).max_decoding_message_size(MAX_ANSWER_BYTES);
        Ok(client.stream_observations(request).await?.into_inner())
    }

    pub(crate) async fn forget(&self, request: v1::ForgetRequest) -> Result<v1::ForgetResponse, ClientError> {
        let request = self.signed(request).await?;
        Ok(AdminServiceClient::new(self.channel.clone()).forget(request).await?.into_inner())
    }

    pub(crate) async fn watch(
        &self,
        request: v1::WatchChangesRequest,
    ) -> Result<Streaming<v1::WatchChangesResponse>, ClientError> {
        let request = self.signed(request).await?;
        Ok(self.maps().watch_changes(request).await?.into_inner())
    }

    pub(crate) async fn changes(&self, request: v1::GetChangesRequest) -> Result<v1::CellChanges, ClientError> {
        let request = self.signed(request).await?;
        let answer = self.maps().get_changes(request).await?.into_inner();
        answer.changes.ok_or_else(|| ClientError::Protocol("an answer without changes".to_owned()))
    }

    pub(crate) async fn cell(&self, request: v1::GetCellRequest) -> Result<v1::CellMap, ClientError> {
        let request = self.signed(request).await?;
        let answer = self.maps().get_cell(request).await?.into_inner();
        answer.map.ok_or_else(|| ClientError::Protocol("an answer without a cell".to_owned()))
    }

    fn maps(&self) -> MapServiceClient<Channel> {
        MapServiceClient::new(self.channel.clone()).max_decoding_message_size(MAX_ANSWER_BYTES)
    }

    /// A request with the token, where there is one.
    async fn signed<T>(&self, message: T) -> Result<Request<T>, ClientError> {
        let mut request = Request::new(message);
        if let Some(token) = self.credentials.bearer().await? {
            request.metadata_mut().insert("authorization", bearer(&token)?);
        }
        Ok(request)
    }

    pub(crate) fn may_renew_token(&self) -> bool {
        self.credentials.may_renew()
    }
}

fn client_tls(tls: Tls) -> ClientTlsConfig {
    let mut config = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(tls.ca));
    if let Some((cert, key)) = tls.identity {
        config = config.identity(Identity::from_pem(cert, key));
    }
    if let Some(name) = tls.server_name {
        config = config.domain_name(name);
    }
    config
}

fn bearer(token: &str) -> Result<MetadataValue<Ascii>, ClientError> {
    let mut value: MetadataValue<Ascii> = format!("Bearer {token}")
        .parse()
        .map_err(|_| ClientError::Credentials("the token holds characters that no header can".to_owned()))?;
    value.set_sensitive(true);
    Ok(value)
}
