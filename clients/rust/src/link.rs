//! The way to a service: gRPC or zenoh, by the address. Both carry the same messages.

mod grpc;
mod zenoh;

use std::time::Duration;

use lanemap_proto::v1::{self, stream_observations_response::Message as Response};
use tokio::{sync::mpsc, time::timeout};
use tonic::Status;

use crate::{credentials::Credentials, error::ClientError};
pub(crate) use grpc::GrpcLink;
use zenoh::{ACCEPTED_WITHIN, ZenohAnswers, ZenohLink};

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
    Grpc(Box<GrpcLink>),
    Zenoh(Box<ZenohLink>),
}

/// One open stream.
pub(crate) struct Stream {
    requests: Option<mpsc::Sender<v1::StreamObservationsRequest>>,
    answers: Answers,
    /// Whether anything was answered.
    answered: bool,
}

enum Answers {
    Grpc(Box<tonic::Streaming<v1::StreamObservationsResponse>>),
    Zenoh(Box<ZenohAnswers>),
}

impl Link {
    /// The way to `url`; nothing is sent yet.
    pub(crate) async fn new(url: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        if url.starts_with("http://") || url.starts_with("https://") {
            return Ok(Self::Grpc(Box::new(GrpcLink::new(url, options).await?)));
        }
        if url.starts_with("tcp/") || url.starts_with("tls/") {
            return Ok(Self::Zenoh(Box::new(ZenohLink::new(url, options)?)));
        }
        let reason = "neither http://, https:// (gRPC) nor tcp/, tls/ (zenoh)".to_owned();
        Err(ClientError::Address { url: url.to_owned(), reason })
    }

    /// Connects now, rather than when the first session needs it.
    pub(crate) async fn reach(&mut self) -> Result<(), ClientError> {
        match self {
            Self::Grpc(link) => link.reach().await,
            Self::Zenoh(link) => link.reach().await,
        }
    }

    /// Opens a stream of a drive; `start` is its first message.
    pub(crate) async fn open(&self, start: v1::StreamObservationsRequest) -> Result<Stream, ClientError> {
        let (requests, messages) = mpsc::channel(REQUESTS);
        let answers = match self {
            Self::Grpc(link) => {
                requests.send(start).await.map_err(|_| ClientError::Ended)?;
                Answers::Grpc(Box::new(link.stream(messages).await?))
            }
            Self::Zenoh(link) => Answers::Zenoh(Box::new(link.stream(start, messages).await?)),
        };
        Ok(Stream { requests: Some(requests), answers, answered: false })
    }

    /// Whether a stream that was refused for its token may succeed with the one that is there by then.
    pub(crate) fn may_renew_token(&self) -> bool {
        match self {
            Self::Grpc(link) => link.may_renew_token(),
            Self::Zenoh(link) => link.may_renew_token(),
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
        match &mut self.answers {
            Answers::Grpc(answers) => loop {
                match answers.message().await? {
                    Some(v1::StreamObservationsResponse { message: Some(answer) }) => return Ok(Some(answer)),
                    // What a newer service says and this client does not know.
                    Some(v1::StreamObservationsResponse { message: None }) => {}
                    None => return Ok(None),
                }
            },
            Answers::Zenoh(answers) if self.answered => answers.next().await,
            Answers::Zenoh(answers) => {
                let unanswered = |_| ClientError::from(Status::unavailable("the service did not answer the start"));
                let answer = timeout(ACCEPTED_WITHIN, answers.next()).await.map_err(unanswered)??;
                self.answered = true;
                Ok(answer)
            }
        }
    }
}
