//! The zenoh side of ingest: the same conversation as over gRPC, carried by keys.
//!
//! # The wire
//! Keys, encodings and attachments are in [`lanemap_proto::zenoh_keys`]; payloads are protobuf.
//!
//! 1. The vehicle chooses a random nonce for the stream, declares the liveliness token `.../@alive/{nonce}`, subscribes
//!    to `.../acks` and `.../pose`, and puts `SessionStart` on `.../observations` as message 0. Where no `accepted` with
//!    its nonce comes back in time, it begins anew with another nonce.
//! 2. It puts frames, then `SessionEnd`, as messages 1, 2, 3 and so on, at most `max_frames_in_flight` of them unacked.
//!    `CongestionControl::Block` and `Reliability::Reliable`; zenoh-ext's `AdvancedPublisher` with a cache of that many
//!    samples and `sample_miss_detection` lets the server fetch what the transport lost. A publisher that does not number
//!    its samples so should not go through a router that stamps them with its time: zenoh-ext would go by the stamps of
//!    that router, whose order several vehicles can break, and drop what comes late.
//! 3. The server puts `accepted`, `ack`, `refusal` and `ended` on `.../acks`, `pose` and `local_map` on `.../pose`, each
//!    with the stream's nonce and a running number of its own per key. Acks are cumulative; poses may be dropped where
//!    the vehicle is slow. `.../acks` is an `AdvancedPublisher` too: subscribe with recovery, and nothing is missed.
//! 4. `closed{code, message}` is the last message of a stream, whatever ended it: 0 after `ended`, 10 ABORTED where a
//!    newer stream of the drive took over, 14 UNAVAILABLE where the server shuts down or knows no such stream (it was
//!    started anew), 8 `RESOURCE_EXHAUSTED` where more was sent than may be in flight, 15 `DATA_LOSS` where a message did
//!    not arrive, 16 UNAUTHENTICATED where a bearer token is missing, wrong or has run out, 7 `PERMISSION_DENIED` where
//!    `SessionStart` names another vehicle than the key, 9 `FAILED_PRECONDITION` where the stream has no liveliness token,
//!    3 `INVALID_ARGUMENT` for what is no message, 6 `ALREADY_EXISTS` where another vehicle's stream has the nonce.
//!    Whatever was not acked is sent again on a new stream.
//! 5. A message whose attachment cannot be read is answered by `closed` with nonce 0.
//! 6. When the vehicle's token goes, its stream is closed as a broken gRPC stream is. While the server takes
//!    observations it holds the token `lanemap/v1/@server`.
//!
//! # The map
//! Beside the conversation the server publishes the shared map, and answers queries of it: see [`map`].
//!
//! Who may use which keys, and how a token travels, stands in [`access`].
//!
//! Callbacks of zenoh never wait: they put into bounded queues. What publishes may wait for a slow vehicle, and does so
//! beside the runtime's workers, one stream at a time.

use std::{sync::Arc, time::Duration};

use lanemap_proto::zenoh_keys;
use tokio::time::timeout;
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tracing::{instrument::WithSubscriber, subscriber::NoSubscriber};
use zenoh::{
    Session,
    handlers::Callback,
    liveliness::LivelinessToken,
    pubsub::Subscriber,
    sample::{Sample, SampleKind},
};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, RecoveryConfig};

use super::conversation::Conversations;
use crate::{
    auth::{Authenticator, reload::CredentialError},
    config::{ServerConfig, ZenohMode},
    fuse::SharedMap,
};

pub mod access;
mod answers;
mod inbound;
mod link_security;
mod map;
mod streams;
mod transport_config;
mod turned_away;

use map::MapInZenoh;
use streams::Streams;

/// How long a lost message is waited for. What follows it waits meanwhile, so it is short.
const RECOVERY_TIMEOUT: Duration = Duration::from_secs(2);
/// How long a publisher that went silent is remembered.
const RETENTION: Duration = Duration::from_mins(1);
/// Time for the session's last words to its links.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(2);

/// Why the zenoh side does not start.
#[derive(Debug, thiserror::Error)]
pub enum ZenohError {
    /// A setting does not read as zenoh's configuration.
    #[error("zenoh's configuration: {name} = {value}: {reason}")]
    Config {
        /// The name within zenoh's own configuration.
        name: &'static str,
        /// Its value, as JSON.
        value: String,
        /// What zenoh says.
        reason: String,
    },
    /// A file of names, passwords or certificates cannot be used.
    #[error(transparent)]
    Credentials(#[from] CredentialError),
    /// The session cannot be opened, e.g. because the address is taken or no router answers.
    #[error("opening the zenoh session: {0}")]
    Open(String),
    /// A subscription or a token cannot be declared.
    #[error("declaring {what} in zenoh: {reason}")]
    Declare {
        /// What.
        what: &'static str,
        /// What zenoh says.
        reason: String,
    },
}

/// The server's session in zenoh, and what it declared there.
pub(crate) struct ZenohIngest {
    session: Session,
    _observations: AdvancedSubscriber<()>,
    _alive: Subscriber<()>,
    _server: LivelinessToken,
    _map: Option<MapInZenoh>,
}

impl ZenohIngest {
    /// Opens the session and takes observations from now on. Tasks of streams are `tracked`.
    pub(crate) async fn open(
        config: &Arc<ServerConfig>,
        conversations: Conversations,
        authenticator: Arc<Authenticator>,
        tracked: TaskTracker,
        map: &SharedMap,
        shutdown: CancellationToken,
    ) -> Result<Self, ZenohError> {
        let transport = transport_config::transport_config(config)?;
        // Zenoh logs its configuration while it opens, the password with which it connects included. It opens before
        // the first poll of what `open` gives: hence a future around it.
        let opening = async { zenoh::open(transport).await }.with_subscriber(NoSubscriber::default());
        let session = opening.await.map_err(|error| ZenohError::Open(error.to_string()))?;
        let map = if config.publishes_map_over_zenoh() {
            Some(MapInZenoh::declare(&session, map, &tracked, shutdown)?)
        } else {
            None
        };
        let streams = Arc::new(Streams::new(config, conversations, authenticator, session.clone(), tracked));
        let observations = subscribe_to_observations(&session, Arc::clone(&streams))?;
        let alive = subscribe_to_tokens(&session, streams)?;
        let token = session.liveliness().declare_token(zenoh_keys::SERVER);
        let server = token.await.map_err(declaring("the server's token"))?;
        let (mode, listen, connect) = (config.zenoh_mode, &config.zenoh_listen, &config.zenoh_connect);
        match mode {
            ZenohMode::Router => tracing::info!(%mode, %listen, "taking observations over zenoh"),
            ZenohMode::Client | ZenohMode::Off => tracing::info!(%mode, %connect, "taking observations over zenoh"),
        }
        Ok(Self { session, _observations: observations, _alive: alive, _server: server, _map: map })
    }

    /// Leaves zenoh; vehicles see the server's token go. Streams must have ended before.
    pub(crate) async fn close(self) {
        let Self { session, .. } = self;
        match timeout(CLOSE_TIMEOUT, session.close()).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!(%error, "the zenoh session did not close cleanly"),
            Err(_) => tracing::warn!("the zenoh session did not close in time"),
        }
    }
}

fn subscribe_to_observations(session: &Session, streams: Arc<Streams>) -> Result<AdvancedSubscriber<()>, ZenohError> {
    use zenoh::Wait;
    let take = Callback::from(move |sample: Sample| streams.take(&sample));
    session
        .declare_subscriber(zenoh_keys::EVERY_OBSERVATIONS)
        .with(take)
        .recovery(RecoveryConfig::default().retention_period(RETENTION).heartbeat())
        .query_timeout(RECOVERY_TIMEOUT)
        .wait()
        .map_err(declaring("the subscription to observations"))
}

fn subscribe_to_tokens(session: &Session, streams: Arc<Streams>) -> Result<Subscriber<()>, ZenohError> {
    use zenoh::Wait;
    let note = move |sample: Sample| {
        if sample.kind() == SampleKind::Delete {
            streams.vehicle_gone(sample.key_expr().as_str());
        }
    };
    let tokens = session.liveliness().declare_subscriber(zenoh_keys::EVERY_ALIVE);
    tokens.callback(note).wait().map_err(declaring("the subscription to liveliness tokens"))
}

fn declaring(what: &'static str) -> impl FnOnce(zenoh::Error) -> ZenohError {
    move |error| ZenohError::Declare { what, reason: error.to_string() }
}
