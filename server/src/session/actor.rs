//! The actor of one session: the only owner of the drive's mapper.
//!
//! It gathers the frames that are waiting, puts them in order (`intake`), makes them durable in one commit and acks them.
//! Acked frames wait (`backlog`) until it is the session's turn at mapping, while others are taken and acked: an ack waits
//! for the disk and for nothing else, until `max_unmapped_frames` wait. Poses go back as frames are mapped. The actor publishes the map at most every `publish_interval_ms` while frames flow, and always when they stop. It saves a
//! snapshot every so many frames, when the drive ends, and before it leaves memory.

mod backlog;
mod command;
mod intake;
mod mapping;
mod updates;

use std::{sync::Arc, time::Duration};

use lanemap_core::Sequence;
use lanemap_proto::v1;
use tokio::{
    sync::mpsc,
    time::{Instant, sleep_until},
};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tonic::Status;

use super::{
    SessionRecord, SessionState, Sessions,
    drive::{Drive, DriveError, Loaded},
    in_flight::InFlightBudget,
    mapping_turns::MappingTurns,
    published::state_without_stream,
    registry,
    reorder::Reorder,
};
use crate::{
    config::ServerConfig,
    error::Error,
    fuse::Fuser,
    ingest::Outbox,
    journal::{Journal, JournalError, JournalFrame, Snapshot},
    privacy::Pseudonyms,
    telemetry,
};
use backlog::Backlog;
pub(crate) use command::{Arrival, Attach, Attached, Command, StreamNumber};
use intake::Early;

/// Frames that are taken together, and acked ones that wait in memory to be mapped, are one in so many of those that a
/// session may have in flight.
const TOGETHER_SHARE: usize = 4;
/// Publications may take this share of the machine's time at most, those of all sessions together: one part in so many.
const PUBLISH_SHARE: u32 = 20;

/// What an actor shares with the rest of the service.
#[derive(Clone, Debug)]
pub(crate) struct Surroundings {
    pub(crate) config: Arc<ServerConfig>,
    pub(crate) journal: Journal,
    pub(crate) pseudonyms: Pseudonyms,
    pub(crate) sessions: Sessions,
    pub(crate) fuser: Fuser,
    pub(crate) in_flight: InFlightBudget,
    pub(crate) shutdown: CancellationToken,
}

pub(crate) struct Actor {
    surroundings: Surroundings,
    record: SessionRecord,
    drive: Drive,
    reorder: Reorder<Early>,
    commands: mpsc::Receiver<Command>,
    /// The actors that are running, this one among them.
    actors: TaskTracker,
    mapping_turns: MappingTurns,
    backlog: Backlog,
    stream: Option<Stream>,
    unpublished: bool,
    next_publication: Instant,
    unload_at: Instant,
    /// The last frame in the snapshot that the store has.
    covered: Option<Sequence>,
    frames_since_snapshot: u64,
    /// It takes no new stream: it saves the drive and ends.
    leaving: bool,
}

struct Stream {
    number: StreamNumber,
    outbox: Outbox,
    wants_local_map: bool,
    gone: CancellationToken,
}

/// Frames admitted, not yet durable.
#[derive(Default)]
struct Batch {
    frames: Vec<Arrival>,
    journal: Vec<JournalFrame>,
    repeated: bool,
    /// Frames that were cut: they are acked once it is durable how far the drive has come. Never beside other frames.
    cut: u64,
}

/// Whether the actor goes on.
type Outcome = Result<(), ActorError>;

#[derive(Debug, thiserror::Error)]
enum ActorError {
    #[error(transparent)]
    Journal(#[from] JournalError),
    #[error("the drive's state cannot be saved: {0}")]
    Drive(#[from] DriveError),
    #[error("the drive is to be deleted")]
    Forgotten,
}

impl Batch {
    /// Whether the batch must be committed before a frame that is cut, or not, comes into it.
    fn must_precede(&self, cut: bool) -> bool {
        if cut { !self.frames.is_empty() } else { self.cut > 0 }
    }
}

impl From<ActorError> for Status {
    fn from(error: ActorError) -> Self {
        match error {
            ActorError::Journal(error) => Error::from(error).into(),
            ActorError::Drive(_) => Self::internal(error.to_string()),
            ActorError::Forgotten => Error::Forgotten.into(),
        }
    }
}

impl Actor {
    pub(crate) fn new(
        surroundings: Surroundings,
        Loaded { record, drive, covered, replayed, unmapped }: Loaded,
        commands: mpsc::Receiver<Command>,
        actors: TaskTracker,
        mapping_turns: MappingTurns,
    ) -> Self {
        let now = Instant::now();
        let config = &surroundings.config;
        // Frames that wait are in flight: with a window of one more, those that they wait for still come through.
        let window = config.reorder_window_frames.min(config.max_frames_in_flight - 1);
        let reorder = Reorder::new(window, config.reorder_wait(), drive.last_sequence());
        let together = config.max_frames_in_flight.div_ceil(TOGETHER_SHARE);
        let backlog = Backlog::new(mapping_turns.clone(), &surroundings.journal, record.id, unmapped, together);
        let mut actor = Self {
            surroundings,
            record,
            drive,
            reorder,
            commands,
            actors,
            backlog,
            mapping_turns,
            stream: None,
            unpublished: false,
            next_publication: now,
            unload_at: now,
            covered,
            frames_since_snapshot: replayed,
            leaving: false,
        };
        actor.unload_at = actor.unload_time();
        actor
    }

    /// Runs until the session leaves memory, the service shuts down, or the journal fails.
    pub(crate) async fn run(mut self) {
        if let Err(error) = self.serve().await {
            if !matches!(error, ActorError::Forgotten) {
                tracing::error!(session = %self.record.id, %error, "the session ends");
            }
            // Not published: of what was admitted, some is not durable.
            self.surroundings.sessions.fall_asleep(self.record.id, state_without_stream(&self.record));
            if let Some(stream) = self.stream.take() {
                stream.outbox.finish(Err(error.into()));
            }
        }
    }

    async fn serve(&mut self) -> Outcome {
        self.publish();
        while self.serve_next().await? {}
        self.leaving = true;
        self.commands.close();
        while let Some(command) = self.commands.recv().await {
            self.take(command).await?;
        }
        if !self.stops_before_it_caught_up() {
            self.save().await?;
        }
        self.publish();
        self.surroundings.sessions.fall_asleep(self.record.id, state_without_stream(&self.record));
        Ok(())
    }

    /// Waits for what comes next; `false` where the actor is no longer needed.
    async fn serve_next(&mut self) -> Result<bool, ActorError> {
        let gone = self.stream.as_ref().map(|stream| stream.gone.clone());
        let detached = gone.is_none();
        let overdue = self.reorder.deadline();
        // Acks run ahead of the map, but not far.
        let takes_more = self.backlog.acked() < self.surroundings.config.max_unmapped_frames;
        tokio::select! {
            biased;
            command = self.commands.recv(), if takes_more => match command {
                Some(command) => self.take(command).await?,
                None => return Ok(false),
            },
            turn = self.backlog.turn() => {
                self.map_for(turn?).await;
                if self.backlog.is_empty() && self.snapshot_is_due() {
                    self.save().await?;
                }
            }
            () = sleep_until(self.next_publication), if self.unpublished && !self.backlog.is_catching_up() => self.publish(),
            () = sleep_until_some(overdue) => self.give_up_overdue().await?,
            () = cancelled(gone) => self.detach(Ok(())).await?,
            () = sleep_until(self.unload_at), if detached => {
                // Frames are held no longer than a trip pauses.
                self.end_trip();
                return Ok(false);
            }
            () = self.surroundings.shutdown.cancelled(), if detached => return Ok(false),
        }
        Ok(true)
    }

    /// Takes a command, and the frames that wait behind it, as one batch.
    async fn take(&mut self, first: Command) -> Outcome {
        let mut batch = Batch::default();
        let mut next = Some(first);
        let mut taken = 0;
        while let Some(command) = next {
            taken += 1;
            match command {
                Command::Frame { stream, arrival } => self.take_frame(stream, arrival, &mut batch).await?,
                Command::Refused { stream, sequence } => {
                    if self.is_current(stream) {
                        self.reorder.refused(sequence);
                        self.pass_due(&mut batch).await?;
                    }
                }
                Command::Attach(attach) => {
                    self.commit(&mut batch).await?;
                    self.attach(attach).await?;
                }
                Command::End { stream } => {
                    if self.is_current(stream) {
                        self.pass_all(&mut batch).await?;
                    }
                    self.commit(&mut batch).await?;
                    self.end(stream).await?;
                }
                Command::Forget => return Err(ActorError::Forgotten),
                Command::Detach { stream, with } => {
                    // A stream that was closed in order brings nothing more; one that broke is resumed, and what is
                    // missing may come yet.
                    if with.is_ok() && self.is_current(stream) && self.somebody_reads() {
                        self.pass_all(&mut batch).await?;
                    }
                    self.commit(&mut batch).await?;
                    if self.is_current(stream) {
                        self.detach(with).await?;
                    }
                }
            }
            let full = taken >= self.most_together();
            next = if full { None } else { self.commands.try_recv().ok() };
        }
        self.commit(&mut batch).await?;
        self.publish_if_due();
        Ok(())
    }

    /// Commands that are taken together.
    fn most_together(&self) -> usize {
        self.surroundings.config.max_frames_in_flight.div_ceil(TOGETHER_SHARE)
    }

    fn is_current(&self, stream: StreamNumber) -> bool {
        self.stream.as_ref().is_some_and(|current| current.number == stream)
    }

    async fn attach(&mut self, attach: Attach) -> Outcome {
        if self.leaving {
            // Its sender sees that it was dropped, and starts the next actor.
            return Ok(());
        }
        // The poses of what was acked are the stream's before.
        self.backlog.begin_stream();
        if let Some(before) = self.stream.take() {
            before.outbox.finish(Err(Error::Superseded.into()));
        }
        // What the stream before left unfinished was not acked: it comes again.
        self.reorder.restart(self.drive.last_sequence());
        let attached = Attached { last: self.drive.last_sequence(), ended: self.record.ended };
        if attach.attached.send(attached).is_err() {
            return self.detach(Ok(())).await;
        }
        self.stream = Some(Stream {
            number: attach.stream,
            outbox: attach.outbox,
            wants_local_map: attach.wants_local_map,
            gone: attach.gone,
        });
        self.publish();
        Ok(())
    }

    async fn detach(&mut self, with: Result<(), Status>) -> Outcome {
        // Who broke off comes back, and does not wait for the map.
        if with.is_ok() && self.somebody_reads() && !self.stops_before_it_caught_up() {
            self.map_all_acked().await?;
        }
        let stream = self.stream.take();
        self.reorder.restart(self.drive.last_sequence());
        self.unload_at = self.unload_time();
        // Published before the vehicle hears of it: who waits for the end of a stream that it closed reads all of its frames.
        self.publish();
        if let Some(stream) = stream {
            stream.outbox.finish(with);
        }
        Ok(())
    }

    /// When a drive without a stream leaves memory: at once where it is over. One that holds frames stays until its trip
    /// counts as over.
    fn unload_time(&self) -> Instant {
        if self.record.ended {
            return Instant::now();
        }
        let after = self.surroundings.config.unload_after();
        let stop = Duration::from_secs_f64(self.record.cut.stop_s);
        Instant::now() + if self.drive.holds_frames() { after.max(stop) } else { after }
    }

    fn end_trip(&mut self) {
        if self.drive.end_trip() {
            // What was held is erased by the next snapshot.
            self.frames_since_snapshot = self.frames_since_snapshot.max(1);
        }
    }

    fn somebody_reads(&self) -> bool {
        self.stream.as_ref().is_some_and(|stream| !stream.outbox.is_closed())
    }

    /// Makes the batch durable, acks it, and has it wait to be mapped.
    async fn commit(&mut self, batch: &mut Batch) -> Outcome {
        let Batch { frames, journal, repeated, cut } = std::mem::take(batch);
        if cut > 0 {
            return self.commit_cut(cut).await;
        }
        if frames.is_empty() {
            if repeated {
                self.ack();
            }
            return Ok(());
        }
        let (store, session) = (self.surroundings.journal.clone(), self.record.id);
        self.mapping_meanwhile(store.append(session, journal)).await?;
        self.ack();
        for arrival in &frames {
            metrics::histogram!(telemetry::ACK_SECONDS).record(arrival.arrived.elapsed().as_secs_f64());
        }
        metrics::counter!(telemetry::FRAMES_ACKED).increment(frames.len() as u64);
        self.frames_since_snapshot += frames.len() as u64;
        if self.drive.holds_back() {
            let ready = self.ready_frames().await?;
            self.map_held_back(&ready).await;
        } else {
            self.backlog.extend(frames);
        }
        // Where mapping never catches up, a snapshot that is long due waits for it here.
        if self.drive.holds_back() && self.snapshot_is_due() || self.snapshot_is_overdue() {
            self.save().await?;
        }
        Ok(())
    }

    /// Makes durable how far the drive has come with frames that were cut, and acks them.
    async fn commit_cut(&mut self, frames: u64) -> Outcome {
        if self.frames_since_snapshot > 0 {
            // The trip stopped. What was held before is erased with this.
            self.save().await?;
        } else {
            self.surroundings.journal.put_cut_mark(self.record.id, self.drive.cut_mark()?).await?;
        }
        self.ack();
        metrics::counter!(telemetry::FRAMES_ACKED).increment(frames);
        Ok(())
    }

    fn snapshot_is_due(&self) -> bool {
        self.frames_since_snapshot >= self.surroundings.config.snapshot_every_frames
    }

    fn snapshot_is_overdue(&self) -> bool {
        self.frames_since_snapshot / 2 >= self.surroundings.config.snapshot_every_frames
    }

    fn ack(&self) {
        if let (Some(stream), Some(sequence)) = (&self.stream, self.drive.last_sequence()) {
            stream.outbox.ack(sequence);
        }
    }

    /// Ends the drive: its state is saved, and no frame is taken any more.
    async fn end(&mut self, stream: StreamNumber) -> Outcome {
        if !self.is_current(stream) {
            return Ok(());
        }
        self.map_all_acked().await?;
        if !self.record.ended {
            // A crash between leaves a drive that the client ends again.
            self.end_trip();
            self.save().await?;
            self.record.ended = true;
            // Its map may be another one now that it is over.
            let summary = self.drive.summary_bytes(self.record.id, SessionState::Closed)?;
            self.surroundings.journal.put_ended(self.record.clone(), summary).await?;
        }
        let acked_sequence_inclusive = self.drive.last_sequence().map(|sequence| sequence.0);
        self.publish();
        if let Some(stream) = &self.stream {
            stream.outbox.end(v1::SessionEnded { acked_sequence_inclusive });
        }
        self.detach(Ok(())).await
    }

    /// Saves the drive's state where it changed, and trims the journal.
    async fn save(&mut self) -> Outcome {
        self.map_all_acked().await?;
        let Some(covered) = self.drive.covered().filter(|_| self.frames_since_snapshot > 0) else {
            return Ok(());
        };
        // Frames of a trip's ends, and where it set out.
        let erase = self.drive.holds_back();
        let state = self.drive.snapshot()?;
        let summary = self.drive.summary_bytes(self.record.id, state_without_stream(&self.record))?;
        let snapshot = Snapshot { covered_before: self.covered, covered, state, summary, erase };
        self.surroundings.journal.put_snapshot(self.record.id, snapshot).await?;
        self.covered = Some(covered);
        self.frames_since_snapshot = 0;
        Ok(())
    }

    fn publish_if_due(&mut self) {
        if self.unpublished && Instant::now() >= self.next_publication {
            self.publish();
        }
    }

    fn publish(&mut self) {
        let state = match (&self.stream, self.record.ended) {
            (_, true) => SessionState::Closed,
            (Some(_), false) => SessionState::Live,
            (None, false) => SessionState::Idle,
        };
        let started = Instant::now();
        if self.backlog.is_catching_up() {
            // What is shown of the session is what its last snapshot says, until the map has come farther.
            return;
        }
        if self.drive.is_hidden() {
            self.unpublished = false;
            return;
        }
        let published = self.drive.published(self.record.id, state);
        let in_shared_map = self.surroundings.pseudonyms.in_shared_map(self.record.drive);
        self.surroundings.fuser.offer(self.drive.offer(in_shared_map, &self.record, &published));
        self.surroundings.sessions.publish(published);
        let now = Instant::now();
        self.next_publication = now + self.publication_pause(now - started);
        self.unpublished = false;
    }

    fn publication_pause(&self, took: Duration) -> Duration {
        let sessions_per_core = self.actors.len().div_ceil(registry::cores());
        let sessions_per_core = u32::try_from(sessions_per_core).unwrap_or(u32::MAX).max(1);
        self.surroundings.config.publish_interval().max(took.saturating_mul(PUBLISH_SHARE * sessions_per_core))
    }
}

async fn sleep_until_some(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => sleep_until(deadline).await,
        None => std::future::pending().await,
    }
}

async fn cancelled(token: Option<CancellationToken>) {
    match token {
        Some(token) => token.cancelled().await,
        None => std::future::pending().await,
    }
}
