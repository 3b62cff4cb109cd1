//! Finds or begins the session of a drive, and keeps one actor per session.

use std::{
    collections::{HashMap, HashSet},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::{SystemTime, UNIX_EPOCH},
};

use lanemap_core::{Frame, fleet::localization::LEAST_WAY_M};
use lanemap_proto::v1::RefusalReason;
use tokio::{
    sync::{Mutex as AsyncMutex, OwnedSemaphorePermit, Semaphore, mpsc, oneshot},
    task::JoinHandle,
    time::Instant,
};
use tokio_util::{
    sync::{CancellationToken, DropGuard},
    task::TaskTracker,
};
use tonic::Status;

use super::{
    PublishedMap, SessionId, SessionKey, SessionRecord, SessionSummary,
    actor::{Actor, Arrival, Attach, Attached, Command, StreamNumber, Surroundings},
    drive::Loaded,
    forget::Forgotten,
    in_flight::SessionInFlight,
    mapping_turns::MappingTurns,
    published::state_without_stream,
};
use crate::{
    error::Error,
    ingest::{Outbox, Refusal, decode::Start},
    journal::{Journal, JournalError},
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
    /// Drives that are read from the store at a time.
    loads: Semaphore,
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
    in_flight: SessionInFlight,
    _gone: DropGuard,
}

impl SessionRegistry {
    /// Reads what is told of every session of the store. Maps are read when they are asked for, drives when they are
    /// resumed: a start takes no longer for a store of many drives.
    pub(crate) async fn recover(surroundings: Surroundings) -> Result<Self, JournalError> {
        let journal = surroundings.journal.clone();
        let read = move || Ok((journal.records()?, journal.forgotten()?, journal.summaries()?));
        let (records, forgotten, summaries) = blocking(read).await?;
        let mut slots = HashMap::with_capacity(records.len());
        let last_id = records.last().map(|record| record.id);
        for record in records {
            if let Some(summary) = summary_of(&record, summaries.get(&record.id).map(Vec::as_slice)) {
                surroundings.sessions.add_asleep(&summary);
            }
            let slot = Slot { record: Some(record.clone()), ..Slot::default() };
            slots.insert(record.drive, Place { vehicle: record.vehicle, slot: Arc::new(AsyncMutex::new(slot)) });
        }
        let journal = surroundings.journal.clone();
        surroundings.sessions.read_with(move |session| read_published(&journal, session));
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
            loads: Semaphore::new(cores()),
        };
        Ok(Self { shared: Arc::new(shared) })
    }

    /// Wakes the drives that have frames after their snapshot, or more than they said to the shared map, one after the
    /// other: a crash left them so, or they hold frames of a trip that may be over. They fall asleep again, with a new snapshot, unless their vehicles come back.
    pub(crate) async fn wake_unsaved(&self) -> Result<(), Error> {
        let Surroundings { journal, sessions, fuser, .. } = self.shared.surroundings.clone();
        let listed = sessions.list();
        let told: HashMap<_, _> = listed.iter().map(|told| (told.session, told.last_sequence)).collect();
        let find = move || {
            let records = journal.records()?.into_iter();
            // Nothing is told of one that is hidden.
            journal.with_frames_after(records.map(|record| (record.id, told.get(&record.id).copied().flatten())))
        };
        let mut unsaved: HashSet<_> = blocking(find).await?.into_iter().collect();
        let may_lie_on_the_map = listed.iter().filter(|told| told.georeference.is_some() || is_sought(told));
        let behind = may_lie_on_the_map.filter(|told| fuser.is_behind(told.session, told.version));
        unsaved.extend(behind.map(|told| told.session));
        let slots: Vec<_> = locked(&self.shared.slots).values().map(|place| Arc::clone(&place.slot)).collect();
        for slot in slots {
            let mut slot = slot.lock().await;
            let Some(record) = slot.record.clone().filter(|record| unsaved.contains(&record.id)) else { continue };
            if slot.actor.is_none() {
                let (nobody, _) = Outbox::new();
                self.actor(&mut slot, &record, &nobody).await?;
            }
        }
        Ok(())
    }

    /// Opens a stream of a drive: begins the drive or resumes it, and supersedes a stream that is still open.
    pub(crate) async fn open(&self, start: &Start, outbox: &Outbox) -> Result<Attachment, OpenError> {
        // Where a write failed, what a drive had durable is known only once the journal takes writes again.
        self.shared.surroundings.journal.health().borrow().check().map_err(Error::from)?;
        self.check_load()?;
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
                let in_flight = self.shared.surroundings.in_flight.session();
                return Ok(Attachment { session, at, commands, stream, in_flight, _gone: gone.drop_guard() });
            }
        }
        Err(OpenError::Failed(Error::SessionGone))
    }

    /// Waits until every actor has saved its drive and left.
    pub(crate) async fn stopped(&self) {
        self.shared.actors.close();
        self.shared.actors.wait().await;
    }

    /// Reads no more maps from the store, which is to be closed.
    pub(crate) fn let_go_of_store(&self) {
        self.shared.surroundings.sessions.let_go_of_store();
    }

    /// A place among the streams that may be open at a time.
    pub(crate) fn stream_place(&self) -> Result<StreamPlace, Error> {
        let limit = self.shared.surroundings.config.max_live_sessions;
        let permit = Arc::clone(&self.shared.live).try_acquire_owned();
        permit.map(StreamPlace::new).map_err(|_| Error::TooManyStreams { limit })
    }

    /// Refuses a stream while those that are open are more than the disk or the mappers keep up with.
    fn check_load(&self) -> Result<(), Error> {
        let Surroundings { config, journal, in_flight, .. } = &self.shared.surroundings;
        let overloaded = |what| Err(Error::Overloaded { what });
        if journal.is_overloaded() {
            return overloaded(format!("{} writes wait for the disk", config.max_waiting_commits));
        }
        if in_flight.is_used_up() {
            return overloaded(format!("{} bytes of frames wait to be mapped", config.max_bytes_in_flight));
        }
        Ok(())
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
        let loaded = {
            // It reads and may map frames: more at a time than there are cores would only delay those that stream already.
            let _turn = self.shared.loads.acquire().await;
            blocking(move || Loaded::read(&journal, record)).await.map_err(|error| unreadable(session, error))?
        };
        slot.record = Some(loaded.record.clone());
        let actor = self.shared.begin_actor(loaded, outbox.clone());
        let commands = actor.commands.clone();
        slot.actor = Some(actor);
        Ok(commands)
    }
}

impl Shared {
    fn begin_actor(self: &Arc<Self>, loaded: Loaded, outbox: Outbox) -> ActorHandle {
        let (commands, waiting) = mpsc::channel(self.surroundings.config.max_frames_in_flight);
        let (shared, drive) = (Arc::clone(self), loaded.record.drive);
        let actor =
            Actor::new(self.surroundings.clone(), loaded, waiting, self.actors.clone(), self.mapping_turns.clone());
        let task = self.actors.spawn(async move {
            actor.run().await;
            // A task of its own: who holds the slot waits for this one.
            let actors = shared.actors.clone();
            actors.spawn(async move { shared.let_go_of_actor(drive).await });
        });
        ActorHandle { commands, outbox, task }
    }

    /// Lets go of a drive's actor that has left, of its queue and its task: a store holds many drives and few that are awake.
    async fn let_go_of_actor(&self, drive: DrivePseudonym) {
        let Some(slot) = locked(&self.slots).get(&drive).map(|place| Arc::clone(&place.slot)) else { return };
        slot.lock().await.actor.take_if(|actor| actor.commands.is_closed());
    }
}

impl Attachment {
    /// Hands a frame to the actor; waits where as many are in flight as may be.
    pub(crate) async fn send_frame(&self, frame: Frame, arrived: Instant) -> Result<(), Error> {
        let place = self.in_flight.place(&frame).await.map_err(|_| Error::SessionGone)?;
        self.send(|stream| Command::Frame { stream, arrival: Box::new(Arrival { frame, arrived, place }) }).await
    }

    /// Hands a command to the actor; waits where the session's queue is full.
    pub(crate) async fn send(&self, command: impl FnOnce(StreamNumber) -> Command) -> Result<(), Error> {
        self.commands.send(command(self.stream)).await.map_err(|_| Error::SessionGone)
    }
}

/// A place among the streams that are open.
pub(crate) struct StreamPlace {
    _permit: OwnedSemaphorePermit,
}

impl StreamPlace {
    fn new(permit: OwnedSemaphorePermit) -> Self {
        metrics::gauge!(telemetry::SESSIONS_LIVE).increment(1.0);
        Self { _permit: permit }
    }
}

impl Drop for StreamPlace {
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

/// What is told of a session that sleeps: its summary, or that it has had no snapshot yet; nothing of one that is hidden.
fn summary_of(record: &SessionRecord, bytes: Option<&[u8]>) -> Option<SessionSummary> {
    let empty = SessionSummary::empty(record);
    let Some(bytes) = bytes else { return (!record.cut.is_on()).then_some(empty) };
    match postcard::from_bytes::<Option<SessionSummary>>(bytes) {
        Ok(summary) => summary.map(|summary| SessionSummary { state: empty.state, ..summary }),
        Err(error) => {
            tracing::error!(session = %record.id, %error, "the session's summary does not decode");
            None
        }
    }
}

/// The map of a session that sleeps.
fn read_published(journal: &Journal, session: SessionId) -> Result<Option<PublishedMap>, JournalError> {
    let Some(record) = journal.record(session)? else { return Ok(None) };
    let Loaded { record, mut drive, .. } = Loaded::read(journal, record)?.caught_up(journal)?;
    Ok((!drive.is_hidden()).then(|| drive.published(session, state_without_stream(&record))))
}

pub(super) fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

fn unreadable(session: SessionId, error: JournalError) -> Error {
    match error {
        JournalError::Decode { .. } => Error::Unreadable { session, reason: error.to_string() },
        _ => error.into(),
    }
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

/// Whether a drive without GNSS is so long that it was sought on the shared map, or would be.
fn is_sought(told: &SessionSummary) -> bool {
    told.extent.is_some_and(|[low, high]| (high - low).xy().norm() >= 2.0 * LEAST_WAY_M)
}

#[cfg(test)]
mod tests;
