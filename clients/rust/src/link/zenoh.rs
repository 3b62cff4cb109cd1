//! The way to a service over zenoh; [`lanemap_proto::zenoh_keys`] says what lies under which key.
//!
//! Every stream has a zenoh session of its own, so that nothing of a stream that broke is left in the way of the next.
//! Zenoh waits on its own threads and needs tokio's multi-thread runtime; what may wait for the network is done on
//! blocking threads.

use std::{
    hash::{BuildHasher, RandomState},
    time::Duration,
};

use lanemap_proto::{
    v1::{self, stream_observations_request::Message as Request, stream_observations_response::Message as Response},
    zenoh_keys::{Attachment, REQUEST_ENCODING, SERVER, StreamNonce, VehicleKeys, attachment_with_token},
};
use prost::Message;
use tokio::sync::mpsc;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};
use zenoh::{
    Config, Session, Wait,
    liveliness::LivelinessToken,
    pubsub::Subscriber,
    qos::{CongestionControl, Reliability},
    sample::{Sample, SampleKind},
};
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt, AdvancedSubscriber, AdvancedSubscriberBuilderExt, CacheConfig,
    MissDetectionConfig, RecoveryConfig,
};

use super::ConnectOptions;
use crate::{backlog::on_blocking_thread, credentials::Credentials, error::ClientError};

/// Answers that may wait to be taken. Poses beyond are dropped; anything else beyond ends the stream.
const ANSWERS: usize = 4096;
/// Messages put together at most.
const BATCH: usize = 16;
/// Messages that the service may fetch once more where the transport lost them.
const CACHED_REQUESTS: usize = 256;
/// How soon the service can tell that the last message was lost.
const HEARTBEAT: Duration = Duration::from_millis(500);
/// A start that is not answered so long is sent again by a new stream: the service may have missed it.
pub(super) const ACCEPTED_WITHIN: Duration = Duration::from_secs(5);

/// The way to a router, or to a server that is one.
#[derive(Clone, Debug)]
pub(crate) struct ZenohLink {
    endpoint: String,
    config: Config,
    credentials: Credentials,
}

/// What is heard on one stream, and what must live as long as it.
pub(crate) struct ZenohAnswers {
    heard: mpsc::Receiver<Result<Response, ClientError>>,
    _open: Open,
}

/// What a stream has declared; given up without waiting when it is dropped.
struct Open {
    session: Session,
    _acks: AdvancedSubscriber<()>,
    _poses: Subscriber<()>,
    _server: Subscriber<()>,
}

/// A stream's sending side.
struct Sender {
    publisher: AdvancedPublisher<'static>,
    alive: LivelinessToken,
    nonce: StreamNonce,
    /// Shown with the first message.
    token: Option<String>,
    next: u64,
}

impl ZenohLink {
    pub(crate) fn new(endpoint: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        let credentials = options.credentials.clone();
        Ok(Self { endpoint: endpoint.to_owned(), config: config(endpoint, options)?, credentials })
    }

    /// Asks whether there is a router at the address.
    pub(crate) async fn reach(&self) -> Result<(), ClientError> {
        let session = self.open().await?;
        // It was there; a farewell that fails changes nothing.
        let _ = session.close().await;
        Ok(())
    }

    async fn open(&self) -> Result<Session, ClientError> {
        let mut config = self.config.clone();
        if let Some((user, password)) = self.credentials.login().await? {
            let login = serde_json::json!({ "user": user, "password": password }).to_string();
            // The message could hold the password.
            let refused = |_| ClientError::Credentials("zenoh does not take this user and password".to_owned());
            config.insert_json5("transport/auth/usrpwd", &login).map_err(refused)?;
        }
        let unreachable = |error| ClientError::Unreachable(format!("{}: {error}", self.endpoint));
        zenoh::open(config).await.map_err(unreachable)
    }

    pub(crate) fn may_renew_token(&self) -> bool {
        self.credentials.may_renew()
    }

    /// Opens a stream of the drive that `start` names, and sends it and then `messages`.
    pub(crate) async fn stream(
        &self,
        start: v1::StreamObservationsRequest,
        messages: mpsc::Receiver<v1::StreamObservationsRequest>,
    ) -> Result<ZenohAnswers, ClientError> {
        let keys = match &start.message {
            Some(Request::Start(start)) => VehicleKeys::new(&start.fleet_id, &start.vehicle_id),
            _ => return Err(ClientError::Protocol("a stream begins with its start".to_owned())),
        };
        let token = self.credentials.bearer().await?;
        let session = self.open().await?;
        // Randomly seeded, as the standard library's hash maps are.
        let nonce = StreamNonce(RandomState::new().hash_one(0));
        let (hear, heard) = mpsc::channel(ANSWERS);
        let failed = |error: zenoh::Error| ClientError::Unreachable(format!("zenoh: {error}"));
        // Answers first: the one to the start must not be missed.
        let open = listen(&session, &keys, nonce, &hear).await.map_err(failed)?;
        let sender = Sender::declare(&session, &keys, nonce, token).await.map_err(failed)?;
        tokio::spawn(sender.send_all(start, messages, hear));
        Ok(ZenohAnswers { heard, _open: open })
    }
}

impl ZenohAnswers {
    /// The next answer; `None` where the service has closed the stream well.
    pub(crate) async fn next(&mut self) -> Result<Option<Response>, ClientError> {
        match self.heard.recv().await {
            Some(Ok(Response::Closed(closed))) => ending(closed),
            Some(answer) => answer.map(Some),
            None => Err(Status::unavailable("zenoh was closed").into()),
        }
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        let session = self.session.clone();
        // Closing says farewell to the network, which may not be there. Outside a runtime nobody is left to wait either.
        if let Ok(runtime) = tokio::runtime::Handle::try_current() {
            runtime.spawn_blocking(move || session.close().wait());
        }
    }
}

async fn listen(
    session: &Session,
    keys: &VehicleKeys,
    nonce: StreamNonce,
    hear: &mpsc::Sender<Result<Response, ClientError>>,
) -> zenoh::Result<Open> {
    let take = |hear: mpsc::Sender<_>| move |sample: Sample| take(&sample, nonce, &hear);
    let acks = session
        .declare_subscriber(keys.acks())
        .callback(take(hear.clone()))
        .recovery(RecoveryConfig::default().heartbeat())
        .await?;
    let poses = session.declare_subscriber(keys.pose()).callback(take(hear.clone())).await?;
    let gone = hear.clone();
    let server = session
        .liveliness()
        .declare_subscriber(SERVER)
        .history(true)
        .callback(move |sample| {
            if sample.kind() == SampleKind::Delete {
                // A channel that is full or closed belongs to a stream that is lost anyway.
                let _ = gone.try_send(Err(Status::unavailable("the service is gone").into()));
            }
        })
        .await?;
    Ok(Open { session: session.clone(), _acks: acks, _poses: poses, _server: server })
}

/// Takes an answer; called by zenoh, which must not be kept waiting.
fn take(sample: &Sample, nonce: StreamNonce, hear: &mpsc::Sender<Result<Response, ClientError>>) {
    let attachment = sample.attachment().and_then(|bytes| Attachment::parse(&bytes.to_bytes()).ok());
    if attachment.is_none_or(|attachment| attachment.nonce != nonce) {
        return; // An answer to another stream of the vehicle.
    }
    let answer = match v1::StreamObservationsResponse::decode(&*sample.payload().to_bytes()) {
        Ok(v1::StreamObservationsResponse { message: Some(answer) }) => Ok(answer),
        // What a newer service says and this client does not know.
        Ok(v1::StreamObservationsResponse { message: None }) => return,
        Err(error) => Err(ClientError::Protocol(error.to_string())),
    };
    let is_pose = matches!(answer, Ok(Response::Pose(_) | Response::LocalMap(_)));
    // The last places are for what must be heard.
    if is_pose && hear.capacity() < ANSWERS / 2 {
        return;
    }
    // Where even those are taken the stream is not read any more; what is not heard is not acked, and sent again.
    let _ = hear.try_send(answer);
}

impl Sender {
    async fn declare(
        session: &Session,
        keys: &VehicleKeys,
        nonce: StreamNonce,
        token: Option<String>,
    ) -> zenoh::Result<Self> {
        let alive = session.liveliness().declare_token(keys.alive(nonce)).await?;
        let publisher = session
            .declare_publisher(keys.observations())
            .encoding(REQUEST_ENCODING)
            .congestion_control(CongestionControl::Block)
            .reliability(Reliability::Reliable)
            .cache(CacheConfig::default().max_samples(CACHED_REQUESTS))
            .sample_miss_detection(MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT))
            .publisher_detection()
            .await?;
        Ok(Self { publisher, alive, nonce, token, next: 0 })
    }

    /// Sends messages until there are no more, and then tells the service so by giving the stream's token up: what was
    /// sent is still answered.
    async fn send_all(
        mut self,
        start: v1::StreamObservationsRequest,
        mut messages: mpsc::Receiver<v1::StreamObservationsRequest>,
        hear: mpsc::Sender<Result<Response, ClientError>>,
    ) {
        let mut batch = vec![start];
        while !batch.is_empty() {
            let put = on_blocking_thread(move || self.put(&batch).map(|()| self)).await;
            match put {
                Ok(sender) => self = sender,
                Err(error) => {
                    // Nobody listens where the stream was given up.
                    let _ = hear.try_send(Err(Status::unavailable(format!("zenoh: {error}")).into()));
                    return;
                }
            }
            batch = Vec::new();
            messages.recv_many(&mut batch, BATCH).await;
        }
        let alive = self.alive;
        if let Err(error) = on_blocking_thread(move || alive.undeclare().wait()).await {
            let _ = hear.try_send(Err(Status::unavailable(format!("zenoh: {error}")).into()));
        }
        // The publisher's cache is there for the service until the stream is closed.
        hear.closed().await;
    }

    fn put(&mut self, messages: &[v1::StreamObservationsRequest]) -> zenoh::Result<()> {
        for message in messages {
            let attachment = Attachment { nonce: self.nonce, number: self.next };
            self.next += 1;
            let attachment = match self.token.take() {
                Some(token) => attachment_with_token(attachment, &token),
                None => attachment.to_string(),
            };
            self.publisher.put(message.encode_to_vec()).attachment(attachment).wait()?;
        }
        Ok(())
    }
}

/// How the service closed a stream.
fn ending(closed: v1::StreamClosed) -> Result<Option<Response>, ClientError> {
    let code = match Code::from_i32(closed.code) {
        Code::Ok => return Ok(None),
        // A message that did not arrive, or a token that came late: the next stream sends again.
        Code::DataLoss | Code::FailedPrecondition => Code::Unavailable,
        code => code,
    };
    let details = ErrorDetails::with_retry_info(closed.retry_after_ms.map(Duration::from_millis));
    Err(Status::with_error_details(code, closed.message, details).into())
}

fn config(endpoint: &str, options: &ConnectOptions) -> Result<Config, ClientError> {
    let milliseconds = |duration: Duration| duration.as_millis().max(1).to_string();
    let mut settings = vec![
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", serde_json::json!([endpoint]).to_string()),
        ("connect/timeout_ms", milliseconds(options.open_timeout)),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/delay", "0".to_owned()),
        ("transport/link/tx/lease", milliseconds(options.keep_alive)),
    ];
    if endpoint.starts_with("tls/") {
        let credentials = &options.credentials;
        let text = |path: &std::path::Path| serde_json::Value::from(path.to_string_lossy()).to_string();
        let missing =
            || ClientError::Credentials(format!("{endpoint} needs TLS: no certificate of its signer (ca) is given"));
        let ca = credentials.ca.as_ref().ok_or_else(missing)?;
        settings.push(("transport/link/tls/root_ca_certificate", text(ca)));
        if let Some(identity) = &credentials.identity {
            settings.push(("transport/link/tls/enable_mtls", "true".to_owned()));
            settings.push(("transport/link/tls/connect_certificate", text(&identity.cert)));
            settings.push(("transport/link/tls/connect_private_key", text(&identity.key)));
        }
    }
    let mut config = Config::default();
    for (name, value) in settings {
        let refused = |error: zenoh::Error| ClientError::Address {
            url: endpoint.to_owned(),
            reason: format!("zenoh does not take {name} = {value}: {error}"),
        };
        config.insert_json5(name, &value).map_err(refused)?;
    }
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_that_was_closed_says_whether_to_come_back() {
        assert_eq!(ending(v1::StreamClosed::default()).unwrap(), None);
        let closed = |code: Code, retry_after_ms| v1::StreamClosed {
            code: code.into(),
            message: "reason".to_owned(),
            retry_after_ms,
        };
        let superseded = ending(closed(Code::Aborted, None)).unwrap_err();
        assert!(!superseded.is_transient() && superseded.to_string().contains("reason"));
        let lost = ending(closed(Code::DataLoss, None)).unwrap_err();
        assert!(lost.is_transient());
        let busy = ending(closed(Code::ResourceExhausted, Some(1500))).unwrap_err();
        assert!(busy.is_transient());
        assert_eq!(busy.retry_after(), Some(Duration::from_millis(1500)));
    }
}
