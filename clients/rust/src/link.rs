//! The way to a service: gRPC or zenoh, by the address. Both carry the same messages.

mod grpc;

use std::time::Duration;

use lanemap_proto::v1::{self, stream_observations_response::Message as Response};
use tokio::sync::mpsc;

use crate::{credentials::Credentials, error::ClientError};
use grpc::GrpcLink;

/// Messages between the session and the network.
const REQUESTS: usize = 16;

/// How connections are made and watched.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConnectOptions {
    /// TLS and token.
    pub credentials: Credentials,
    /// A connection over which nothing came for so long is asked whether it lives, and given up after as long again.
    pub keep_alive: Duration,
    /// Longest wait for a connection, and for a session to be accepted on it.
    pub open_timeout: Duration,
}

impl Default for ConnectOptions {
    /// Neither TLS nor token; 20 s and 20 s.
    fn default() -> Self {
        let seconds = Duration::from_secs(20);
        Self { credentials: Credentials::default(), keep_alive: seconds, open_timeout: seconds }
    }
}

/// The way to one service. Clones share it.
#[derive(Clone, Debug)]
pub(crate) enum Link {
    Grpc(GrpcLink),
}

/// One open stream.
pub(crate) struct Stream {
    requests: Option<mpsc::Sender<v1::StreamObservationsRequest>>,
    answers: Answers,
}

enum Answers {
    Grpc(tonic::Streaming<v1::StreamObservationsResponse>),
}

impl Link {
    /// The way to `url`; nothing is sent yet.
    pub(crate) async fn new(url: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        if url.starts_with("http://") || url.starts_with("https://") {
            return Ok(Self::Grpc(GrpcLink::new(url, options).await?));
        }
        Err(ClientError::Address { url: url.to_owned(), reason: "neither http:// nor https://".to_owned() })
    }

    /// Connects now, rather than when the first session needs it.
    pub(crate) async fn reach(&mut self) -> Result<(), ClientError> {
        match self {
            Self::Grpc(link) => link.reach().await,
        }
    }

    /// Opens a stream of a drive; `start` is its first message.
    pub(crate) async fn open(&self, start: v1::StreamObservationsRequest) -> Result<Stream, ClientError> {
        match self {
            Self::Grpc(link) => {
                let (requests, messages) = mpsc::channel(REQUESTS);
                requests.send(start).await.map_err(|_| ClientError::Ended)?;
                let answers = link.stream(messages).await?;
                Ok(Stream { requests: Some(requests), answers: Answers::Grpc(answers) })
            }
        }
    }

    /// Whether a stream that was refused for its token may succeed with the one that is there by then.
    pub(crate) fn may_renew_token(&self) -> bool {
        match self {
            Self::Grpc(link) => link.may_renew_token(),
        }
    }
}

impl Stream {
    /// Room for one message; waits for ever where the sending side is closed: the answers tell why.
    pub(crate) fn reserve(&self) -> impl Future<Output = mpsc::OwnedPermit<v1::StreamObservationsRequest>> + use<> {
        let requests = self.requests.clone();
        async move {
            if let Some(requests) = requests
                && let Ok(permit) = requests.reserve_owned().await
            {
                return permit;
            }
            std::future::pending().await
        }
    }

    /// Sends no more.
    pub(crate) fn close_sending(&mut self) {
        self.requests = None;
    }

    /// The next answer; `None` where the service has ended the stream well.
    pub(crate) async fn answer(&mut self) -> Result<Option<Response>, ClientError> {
        loop {
            let Answers::Grpc(answers) = &mut self.answers;
            match answers.message().await? {
                Some(v1::StreamObservationsResponse { message: Some(answer) }) => return Ok(Some(answer)),
                // What a newer service says and this client does not know.
                Some(v1::StreamObservationsResponse { message: None }) => {}
                None => return Ok(None),
            }
        }
    }
}
