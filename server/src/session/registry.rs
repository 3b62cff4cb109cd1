//! Finds or begins the session of a drive, and keeps one actor per session.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::{SystemTime, UNIX_EPOCH},
};

use futures::{StreamExt, future, stream};
use lanemap_proto::v1::RefusalReason;
use tokio::{
    sync::{Mutex as AsyncMutex, OwnedSemaphorePermit, Semaphore, mpsc, oneshot},
    task::JoinHandle,
};
use tokio_util::{
    sync::{CancellationToken, DropGuard},
    task::TaskTracker,
};
use tonic::Status;

use super::{
    SessionId, SessionKey, SessionRecord, SessionState,
    actor::{Actor, Attach, Attached, Command, StreamNumber, Surroundings},
    drive::Loaded,
    forget::Forgotten,
    mapping_turns::MappingTurns,
};
use crate::{
    error::Error,
    ingest::{Outbox, Refusal, decode::Start},
    journal::JournalError,
    privacy::{DrivePseudonym, Pseudonyms, VehiclePseudonym},
    telemetry,
};

/// How often a stream tries to reach an actor that is just leaving.
const ATTEMPTS: usize = 3;

/// Why a stream cannot be opened.
#[derive(Debug)]
pub(crate) enum OpenError {
    /// The start is not in order; the stream goes on.
    Refused(Refusal),
    /// The stream must end.
    Failed(Error),
}

impl From<Error> for OpenError {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

impl From<OpenError> for Status {
    fn from(error: OpenError) -> Self {
        match error {
            OpenError::Refused(refusal) => Error::Refused(Box::new(refusal)).into(),
            OpenError::Failed(error) => error.into(),
        }
    }
}

/// All sessions of the store. Clones share them.
#[derive(Clone)]
pub(crate) struct SessionRegistry {
    pub(super) shared: Arc<Shared>,
}

pub(super) struct Shared {
    pub(super) surroundings: Surroundings,
    pub(super) slots: Mutex<HashMap<DrivePseudonym, Place>>,
    pub(super) forgotten: Mutex<Forgotten>,
    /// Held by the deletion that is under way.
    pub(super) forgetting: AsyncMutex<()>,
    last_id: Mutex<Option<SessionId>>,
    live: Arc<Semaphore>,
    streams: AtomicU64,
    actors: TaskTracker,
    mapping_turns: MappingTurns,
}

/// Where a drive is kept.
pub(super) struct Place {
    pub(super) vehicle: VehiclePseudonym,
    pub(super) slot: Arc<AsyncMutex<Slot>>,
}

/// One drive: vacant until its record is durable.
#[derive(Default)]
pub(super) struct Slot {
    pub(super) record: Option<SessionRecord>,
    pub(super) actor: Option<ActorHandle>,
}

pub(super) struct ActorHandle {
    pub(super) commands: mpsc::Sender<Command>,
    /// The outbox of the newest stream, finished when a newer one opens.
    pub(super) outbox: Outbox,
    pub(super) task: JoinHandle<()>,
}

/// A stream's hold on its session.
pub(crate) struct Attachment {
    pub(crate) session: SessionId,
    pub(crate) at: Attached,
    commands: mpsc::Sender<Command>,
    stream: StreamNumber,
    _gone: DropGuard,
    _live: LivePermit,
}

impl SessionRegistry {
    /// Reads every session of the store and publishes its map.
    ///
    /// A session that cannot be read is reported and left as it is; the others are served.
    pub(crate) async fn recover(surroundings: Surroundings) -> Result<Self, JournalError> {
        let journal = surroundings.journal.clone();
        let (records, forgotten) = blocking(move || Ok((journal.records()?, journal.forgotten()?))).await?;
        let mut slots = HashMap::with_capacity(records.len());
        let last_id = records.last().map(|record| record.id);
        let recovering = stream::iter(&records).map(|record| recover_one(&surroundings, record));
        let holding: Vec<Loaded> = recovering.buffer_unordered(cores()).filter_map(future::ready).collect().await;
        for record in records {
            let slot = Slot { record: Some(record.clone()), ..Slot::default() };
            slots.insert(record.drive, Place { vehicle: record.vehicle, slot: Arc::new(AsyncMutex::new(slot)) });
        }
        metrics::gauge!(telemetry::SESSIONS).set(slots.len() as f64);
        let shared = Shared {
            live: Arc::new(Semaphore::new(surroundings.config.max_live_sessions)),
            surroundings,
            slots: Mutex::new(slots),
            forgotten: Mutex::new(Forgotten::new(forgotten)),
            forgetting: AsyncMutex::default(),
            last_id: Mutex::new(last_id),
            streams: AtomicU64::new(0),
            actors: TaskTracker::new(),
            mapping_turns: MappingTurns::new(),
        };
        for loaded in holding {
            shared.resume(loaded);
        }
        Ok(Self { shared: Arc::new(shared) })
    }

    /// Opens a stream of a drive: begins the drive or resumes it, and supersedes a stream that is still open.
    pub(crate) async fn open(&self, start: &Start, outbox: &Outbox) -> Result<Attachment, OpenError> {
        let live = self.live_permit().map_err(OpenError::Refused)?;
        let slot = self.slot(start)?;
        let mut slot = slot.lock().await;
        // It may have been deleted while this waited for it.
        self.check_not_forgotten(self.pseudonyms().drive(&start.key))?;
        let record = self.record(&mut slot, start).await?;
        if let Some(actor) = &slot.actor {
            actor.outbox.finish(Err(Error::Superseded.into()));
        }
        for _ in 0..ATTEMPTS {
            let commands = self.actor(&mut slot, &record, outbox).await?;
            let stream = StreamNumber(self.shared.streams.fetch_add(1, Ordering::Relaxed));
            let gone = CancellationToken::new();
            if let Some(at) = attach(&commands, stream, start, outbox, &gone).await {
                let session = record.id;
                return Ok(Attachment { session, at, commands, stream, _gone: gone.drop_guard(), _live: live });
            }
        }
        Err(OpenError::Failed(Error::SessionGone))
    }

    /// Waits until every actor has saved its drive and left.
    pub(crate) async fn stopped(&self) {
        self.shared.actors.close();
        self.shared.actors.wait().await;
    }

    fn live_permit(&self) -> Result<LivePermit, Refusal> {
        let maximum = self.shared.surroundings.config.max_live_sessions;
        let permit = Arc::clone(&self.shared.live).try_acquire_owned();
        permit.map(LivePermit::new).map_err(|_| capacity("streams", maximum))
    }

    fn check_not_forgotten(&self, drive: DrivePseudonym) -> Result<(), Error> {
        if self.forgotten().contains(drive) { Err(Error::Forgotten) } else { Ok(()) }
    }

    pub(super) fn pseudonyms(&self) -> &Pseudonyms {
        &self.shared.surroundings.pseudonyms
    }

    pub(super) fn remove(&self, drive: DrivePseudonym) {
        let mut slots = locked(&self.shared.slots);
        slots.remove(&drive);
        metrics::gauge!(telemetry::SESSIONS).set(slots.len() as f64);
    }

    fn slot(&self, start: &Start) -> Result<Arc<AsyncMutex<Slot>>, OpenError> {
        let drive = self.pseudonyms().drive(&start.key);
        let vehicle = self.pseudonyms().vehicle(&start.key.fleet, &start.key.vehicle);
        let maximum = self.shared.surroundings.config.max_sessions;
        let mut slots = locked(&self.shared.slots);
        self.check_not_forgotten(drive)?;
        if let Some(place) = slots.get(&drive) {
            return Ok(Arc::clone(&place.slot));
        }
        if slots.len() >= maximum {
            return Err(OpenError::Refused(capacity("drives", maximum)));
        }
        let slot = Arc::<AsyncMutex<Slot>>::default();
        slots.insert(drive, Place { vehicle, slot: Arc::clone(&slot) });
        metrics::gauge!(telemetry::SESSIONS).set(slots.len() as f64);
        Ok(slot)
    }

    /// The record of a drive, made durable where the drive is new.
    async fn record(&self, slot: &mut Slot, start: &Start) -> Result<SessionRecord, OpenError> {
        if let Some(record) = &slot.record {
            if let Some(refusal) = contradiction(record, start) {
                return Err(OpenError::Refused(refusal));
            }
            return Ok(record.clone());
        }
        let record = self.new_record(start);
        let journal = &self.shared.surroundings.journal;
        journal.put_record(record.clone()).await.map_err(Error::from)?;
        slot.record = Some(record.clone());
        Ok(record)
    }

    fn new_record(&self, start: &Start) -> SessionRecord {
        let SessionKey { fleet, vehicle, .. } = &start.key;
        let (drive, vehicle) = (self.pseudonyms().drive(&start.key), self.pseudonyms().vehicle(fleet, vehicle));
        SessionRecord {
            id: self.next_id(drive),
            drive,
            vehicle,
            setup: start.setup.clone(),
            cut: self.shared.surroundings.config.trip_cut(),
            ended: false,
        }
    }

    fn next_id(&self, drive: DrivePseudonym) -> SessionId {
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let unix_ms = u64::try_from(since_epoch.as_millis()).unwrap_or(0);
        let noise = self.pseudonyms().noise(drive, since_epoch.as_nanos());
        let mut last = locked(&self.shared.last_id);
        let id = SessionId::next(*last, unix_ms, noise);
        *last = Some(id);
        id
    }

    /// The session's actor; started anew where there is none, or where the one before has left.
    async fn actor(
        &self,
        slot: &mut Slot,
        record: &SessionRecord,
        outbox: &Outbox,
    ) -> Result<mpsc::Sender<Command>, Error> {
        if let Some(mut actor) = slot.actor.take() {
            if !actor.commands.is_closed() {
                actor.outbox = outbox.clone();
                let commands = actor.commands.clone();
                slot.actor = Some(actor);
                return Ok(commands);
            }
            // It saves the drive before it ends; the next one reads what it saved. A panic was reported by the runtime.
            let _ = actor.task.await;
        }
        if self.shared.surroundings.shutdown.is_cancelled() {
            return Err(Error::ShuttingDown);
        }
        let journal = self.shared.surroundings.journal.clone();
        // The record may have ended since the slot was filled: the store knows.
        let (session, record) = (record.id, record.clone());
        let loaded = blocking(move || Loaded::read(&journal, record)).await;
        let loaded = loaded.map_err(|error| unreadable(session, &error))?;
        slot.record = Some(loaded.record.clone());
        let actor = self.shared.begin_actor(loaded, outbox.clone());
        let commands = actor.commands.clone();
        slot.actor = Some(actor);
        Ok(commands)
    }
}

impl Shared {
    fn begin_actor(&self, loaded: Loaded, outbox: Outbox) -> ActorHandle {
        let (commands, waiting) = mpsc::channel(self.surroundings.config.max_frames_in_flight);
        let actor =
            Actor::new(self.surroundings.clone(), loaded, waiting, self.actors.clone(), self.mapping_turns.clone());
        ActorHandle { commands, outbox, task: self.actors.spawn(actor.run()) }
    }

    /// Gives a drive an actor before any stream does.
    fn resume(&self, loaded: Loaded) {
        let record = loaded.record.clone();
        let actor = self.begin_actor(loaded, Outbox::new().0);
        let slot = Slot { record: Some(record.clone()), actor: Some(actor) };
        let place = Place { vehicle: record.vehicle, slot: Arc::new(AsyncMutex::new(slot)) };
        locked(&self.slots).insert(record.drive, place);
    }
}

impl Attachment {
    /// Hands a command to the actor; waits where the session's queue is full.
    pub(crate) async fn send(&self, command: impl FnOnce(StreamNumber) -> Command) -> Result<(), Error> {
        self.commands.send(command(self.stream)).await.map_err(|_| Error::SessionGone)
    }
}

/// A place among the live streams.
struct LivePermit {
    _permit: OwnedSemaphorePermit,
}

impl LivePermit {
    fn new(permit: OwnedSemaphorePermit) -> Self {
        metrics::gauge!(telemetry::SESSIONS_LIVE).increment(1.0);
        Self { _permit: permit }
    }
}

impl Drop for LivePermit {
    fn drop(&mut self) {
        metrics::gauge!(telemetry::SESSIONS_LIVE).decrement(1.0);
    }
}

async fn attach(
    commands: &mpsc::Sender<Command>,
    stream: StreamNumber,
    start: &Start,
    outbox: &Outbox,
    gone: &CancellationToken,
) -> Option<Attached> {
    let (attached, at) = oneshot::channel();
    let (outbox, gone) = (outbox.clone(), gone.clone());
    let attach = Attach { stream, outbox, wants_local_map: start.wants_local_map, gone, attached };
    commands.send(Command::Attach(attach)).await.ok()?;
    at.await.ok()
}

/// Publishes what the store knows of a session; one that cannot be read is reported and left as it is.
///
/// Gives the drive where it holds frames: they are not to be held for ever.
async fn recover_one(surroundings: &Surroundings, record: &SessionRecord) -> Option<Loaded> {
    let (session, journal) = (record.id, surroundings.journal.clone());
    let state = if record.ended { SessionState::Closed } else { SessionState::Idle };
    let loading = record.clone();
    let read = blocking(move || {
        let loaded = Loaded::read(&journal, loading)?;
        let published = (!loaded.drive.is_hidden()).then(|| loaded.drive.published(session, state));
        Ok((published, loaded.drive.holds_frames().then_some(loaded)))
    });
    match read.await {
        Ok((published, holding)) => {
            if let Some(published) = published {
                surroundings.sessions.publish(published);
            }
            holding
        }
        Err(error) => {
            tracing::error!(%session, %error, "the session cannot be served");
            None
        }
    }
}

pub(super) fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

fn unreadable(session: SessionId, error: &JournalError) -> Error {
    Error::Unreadable { session, reason: error.to_string() }
}

fn contradiction(record: &SessionRecord, start: &Start) -> Option<Refusal> {
    let (before, now) = (&record.setup, &start.setup);
    if before.preset != now.preset {
        let limit = format!("{:?}, as the drive began", before.preset);
        return Some(Refusal::new(RefusalReason::Contradiction, "start.preset", format!("{:?}", now.preset), limit));
    }
    if before.sensor != now.sensor {
        let limit = "the sensor with which the drive began";
        return Some(Refusal::new(RefusalReason::Contradiction, "start.sensor", "another sensor", limit));
    }
    None
}

fn capacity(what: &str, maximum: usize) -> Refusal {
    Refusal::new(
        RefusalReason::Capacity,
        "start",
        format!("one more of {maximum} {what}"),
        format!("at most {maximum}"),
    )
}

/// Runs what reads the disk or maps many frames beside the runtime; a panic there is an error here.
pub(super) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, JournalError> + Send + 'static,
) -> Result<T, JournalError> {
    let outcome = tokio::task::spawn_blocking(work).await;
    outcome.unwrap_or_else(|error| {
        Err(JournalError::Decode { what: "the session".to_owned(), reason: format!("its replay failed: {error}") })
    })
}

pub(super) fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
