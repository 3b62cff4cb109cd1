//! The streams that are open in zenoh: which message belongs to which, and in what order.
//!
//! Everything here is called from zenoh's callbacks and never waits.

use std::{
    collections::{HashMap, hash_map::Entry},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use lanemap_proto::zenoh_keys::{Attachment, StreamNonce, VehicleKey, VehicleKeys, parse_with_token};
use tokio::{runtime::Handle, time::sleep};
use tokio_util::task::TaskTracker;
use tonic::{Code, Status};
use zenoh::{Session, bytes::ZBytes, sample::Sample};

use super::{
    answers,
    inbound::{self, Bounds, Inbound, InboundSender},
    turned_away::{TurnedAway, Usher},
};
use crate::{
    auth::{Authenticator, VehicleName},
    config::ServerConfig,
    error::Error,
    ingest::conversation::Conversations,
    telemetry,
};

/// Time within which a stream's liveliness token must be seen.
const TOKEN_GRACE: Duration = Duration::from_secs(5);

/// The streams that are open.
pub(super) struct Streams {
    open: Arc<Mutex<Table>>,
    conversations: Conversations,
    authenticator: Arc<Authenticator>,
    key_is_proof: bool,
    session: Session,
    usher: Usher,
    bounds: Bounds,
    most: usize,
    runtime: Handle,
    tracked: TaskTracker,
}

type Table = HashMap<StreamNonce, Stream>;

struct Stream {
    /// The key on which it came.
    observations: String,
    next_number: u64,
    /// `None` where it takes no more, and only its last answers are awaited.
    inbound: Option<InboundSender>,
}

/// Takes a stream out of the table when its task is gone, however it went.
struct Closing {
    open: Arc<Mutex<Table>>,
    nonce: StreamNonce,
}

impl Streams {
    /// No stream yet. Must be called within the runtime that is to run them.
    pub(super) fn new(
        config: &ServerConfig,
        conversations: Conversations,
        authenticator: Arc<Authenticator>,
        session: Session,
        tracked: TaskTracker,
    ) -> Self {
        let bounds = Bounds {
            // Start and end travel beside the frames.
            messages: config.max_frames_in_flight + 2,
            message_bytes: config.max_message_bytes,
            waiting_bytes: config.max_message_bytes,
        };
        Self {
            open: Arc::default(),
            conversations,
            authenticator,
            key_is_proof: config.zenoh_key_is_proof(),
            usher: Usher::start(session.clone()),
            session,
            bounds,
            most: config.max_live_sessions,
            runtime: Handle::current(),
            tracked,
        }
    }

    /// Takes a message: into its stream, or, as message 0, into a new one.
    pub(super) fn take(&self, sample: &Sample) {
        let key = sample.key_expr().as_str();
        // The subscription's key ends so.
        let acks = || format!("{}/acks", key.strip_suffix("/observations").unwrap_or(key));
        let attachment = sample.attachment().map(ZBytes::to_bytes).unwrap_or_default();
        let (attachment, token) = match parse_with_token(&attachment) {
            Ok(read) => read,
            Err(error) => {
                let why = invalid(&error);
                return self.usher.turn_away(TurnedAway { acks: acks(), nonce: StreamNonce(0), why });
            }
        };
        if let Err(why) = self.pass_on(key, attachment, token, sample.payload()) {
            self.usher.turn_away(TurnedAway { acks: acks(), nonce: attachment.nonce, why });
        }
    }

    fn pass_on(
        &self,
        key: &str,
        Attachment { nonce, number }: Attachment,
        token: Option<&str>,
        message: &ZBytes,
    ) -> Result<(), Status> {
        let mut open = locked(&self.open);
        let room = open.len() < self.most;
        match open.entry(nonce) {
            Entry::Occupied(stream) if stream.get().observations == key => {
                stream.into_mut().take(number, message);
                Ok(())
            }
            Entry::Occupied(_) => Err(Status::new(Code::AlreadyExists, "this nonce is taken; choose another")),
            Entry::Vacant(_) if number > 0 => {
                let why = "the server knows no such stream; it may have been started anew: begin another stream";
                Err(Status::new(Code::Unavailable, why))
            }
            Entry::Vacant(_) if !room => {
                let why = format!("the server has {limit} streams, limit: {limit}", limit = self.most);
                Err(Status::new(Code::ResourceExhausted, why))
            }
            Entry::Vacant(vacant) => {
                let vehicle = VehicleKey::parse(key).map_err(|error| invalid(&error))?;
                let vehicle = VehicleName::new(vehicle.fleet, vehicle.vehicle);
                let (sender, inbound) = inbound::channel(self.bounds);
                let stream = Stream { observations: key.to_owned(), next_number: 0, inbound: Some(sender) };
                vacant.insert(stream).take(number, message);
                drop(open);
                self.begin(nonce, vehicle, token.map(str::to_owned), inbound);
                Ok(())
            }
        }
    }

    /// Begins a stream in a task of its own, which also checks the token: that takes longer than a callback may.
    fn begin(&self, nonce: StreamNonce, vehicle: VehicleName, token: Option<String>, inbound: Inbound) {
        let closing = Closing { open: Arc::clone(&self.open), nonce };
        let keys = VehicleKeys::new(&vehicle.fleet, &vehicle.vehicle);
        let (authenticator, key_is_proof) = (Arc::clone(&self.authenticator), self.key_is_proof);
        let (conversations, session, usher) = (self.conversations.clone(), self.session.clone(), self.usher.clone());
        let stream = async move {
            let peer = match authenticator.peer_on_key(vehicle, key_is_proof, token.as_deref()) {
                Ok(peer) => peer,
                Err(error) => {
                    metrics::counter!(telemetry::CREDENTIALS_REFUSED).increment(1);
                    let why = Error::Unauthenticated(error).into();
                    return usher.turn_away(TurnedAway { acks: keys.acks(), nonce, why });
                }
            };
            let answers = conversations.begin(peer, inbound);
            let watch = closing.close_without_token(session.clone(), keys.alive(nonce));
            tokio::select! {
                () = answers::publish(session, keys, nonce, answers) => {}
                () = watch => {}
            }
        };
        self.tracked.spawn_on(stream, &self.runtime);
    }

    /// A vehicle's liveliness token is gone: its stream takes what came before, and ends.
    pub(super) fn vehicle_gone(&self, token: &str) {
        let Some(nonce) = VehicleKey::parse(token).ok().and_then(|key| key.alive_nonce()) else { return };
        let root = token.split("/@alive/").next().unwrap_or_default();
        let mut open = locked(&self.open);
        let stream =
            open.get_mut(&nonce).filter(|stream| stream.observations.strip_suffix("/observations") == Some(root));
        if let Some(stream) = stream {
            stream.inbound = None;
        }
    }
}

impl Stream {
    /// Takes the next message. One that came before is passed over; one that is missing ends the stream.
    fn take(&mut self, number: u64, message: &ZBytes) {
        let Some(inbound) = &self.inbound else { return };
        if number < self.next_number {
            metrics::counter!(telemetry::ZENOH_REPEATED).increment(1);
            return;
        }
        let taken = if number == self.next_number {
            inbound.send(message.clone())
        } else {
            let why =
                format!("message {} did not arrive, {number} did: send again what is not acked", self.next_number);
            Err(Status::new(Code::DataLoss, why))
        };
        self.next_number += 1;
        if let Err(why) = taken {
            metrics::counter!(telemetry::ZENOH_BROKEN, "code" => format!("{:?}", why.code())).increment(1);
            if let Some(inbound) = self.inbound.take() {
                inbound.break_off(why);
            }
        }
    }
}

impl Closing {
    /// Ends the stream where its liveliness token is not there, for nobody could tell when its vehicle is gone. Waits
    /// for ever where it is.
    async fn close_without_token(&self, session: Session, token: String) {
        if !has_token(&session, &token).await {
            sleep(TOKEN_GRACE).await;
            if !has_token(&session, &token).await {
                let why = format!("the stream has no liveliness token within {} s", TOKEN_GRACE.as_secs());
                let mut open = locked(&self.open);
                let inbound = open.get_mut(&self.nonce).and_then(|stream| stream.inbound.take());
                if let Some(inbound) = inbound {
                    inbound.break_off(Status::new(Code::FailedPrecondition, why));
                }
            }
        }
        std::future::pending::<()>().await;
    }
}

impl Drop for Closing {
    fn drop(&mut self) {
        locked(&self.open).remove(&self.nonce);
    }
}

async fn has_token(session: &Session, token: &str) -> bool {
    let tokens = session.liveliness().get(token).timeout(TOKEN_GRACE).await;
    match tokens {
        Ok(tokens) => tokens.recv_async().await.is_ok_and(|reply| reply.result().is_ok()),
        Err(error) => {
            tracing::debug!(%error, "a liveliness token cannot be asked for");
            false
        }
    }
}

fn invalid(error: &dyn std::error::Error) -> Status {
    Status::new(Code::InvalidArgument, error.to_string())
}

fn locked(table: &Mutex<Table>) -> MutexGuard<'_, Table> {
    table.lock().unwrap_or_else(PoisonError::into_inner)
}
