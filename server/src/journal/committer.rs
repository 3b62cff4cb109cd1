//! Group commit: one thread, one batch, one sync to disk for all that is waiting.
//!
//! Where a batch cannot be written, nothing of it counts as durable and its senders are told. From then on every write is
//! refused at once, until the disk has room again or the store could be opened anew.

use std::{
    thread,
    time::{Duration, Instant},
};

use tokio::sync::{
    mpsc::{self, error::TryRecvError},
    oneshot, watch,
};

use super::{
    JournalError, JournalFrame, JournalHealth, SessionRecord, Snapshot,
    erasure::Forget,
    health::DiskReserve,
    store::{Reopenable, StoreBatch},
};
use crate::{session::SessionId, telemetry};

/// Time between two attempts to take writes again.
const MENDING_PAUSE: Duration = Duration::from_millis(200);

/// Where a commit's outcome goes.
type Done = oneshot::Sender<Result<(), JournalError>>;

/// A write that waits to become durable.
#[derive(Debug)]
pub(super) enum Write {
    /// Frames of one session.
    Frames { session: SessionId, frames: Vec<JournalFrame> },
    /// A session's record.
    Record(SessionRecord),
    /// The record of a drive that is over, and what is told of it.
    Ended { record: SessionRecord, summary: Vec<u8> },
    /// A snapshot, and the frames that it covers are removed.
    Snapshot { session: SessionId, snapshot: Snapshot },
    /// What was removed up to `since` has left the disk.
    Erased { since: Vec<u8> },
    /// How far a drive has come whose frames are cut.
    CutMark { session: SessionId, mark: Vec<u8> },
    /// All that there is of some drives is removed.
    Forget(Forget),
    /// Nothing: asks whether the disk has room.
    Probe,
}

impl Write {
    /// Whether it may be done on a disk that is full.
    fn frees_room(&self) -> bool {
        matches!(self, Self::Forget(_) | Self::Erased { .. })
    }
}

/// A write, and who waits for it.
#[derive(Debug)]
pub(super) struct Commit {
    pub(super) write: Write,
    pub(super) done: Done,
}

/// The committing thread's state.
pub(super) struct Committer {
    pub(super) store: Reopenable,
    pub(super) waiting: mpsc::Receiver<Commit>,
    pub(super) max_frames: usize,
    pub(super) reserve: DiskReserve,
    pub(super) health: watch::Sender<JournalHealth>,
}

/// The committing thread; it ends once every handle to the journal is dropped and all that was waiting is durable.
#[derive(Debug)]
pub struct CommitterThread {
    ended: oneshot::Receiver<()>,
}

impl CommitterThread {
    /// Waits for the thread's end, which frees the store's folder.
    pub async fn join(self) {
        // An error says that the thread is gone, which is what we wait for.
        let _ = self.ended.await;
    }
}

impl Committer {
    pub(super) fn start(self) -> Result<CommitterThread, JournalError> {
        let (end, ended) = oneshot::channel();
        let run = move || {
            self.run();
            // The receiver may be dropped: nobody waits then.
            let _ = end.send(());
        };
        let spawned = thread::Builder::new().name("lanemap-journal".to_owned()).spawn(run);
        spawned.map_err(|error| JournalError::Store(format!("its thread does not start: {error}")))?;
        Ok(CommitterThread { ended })
    }

    fn run(mut self) {
        loop {
            let healthy = self.health.borrow().is_writing();
            let open = if healthy { self.write_next() } else { self.mend() };
            if !open {
                return;
            }
        }
    }

    /// Waits for a write and makes it durable with all that wait behind it; `false` where none will come.
    fn write_next(&mut self) -> bool {
        let Some(first) = self.waiting.blocking_recv() else { return false };
        self.write(first);
        true
    }

    fn write(&mut self, first: Commit) {
        let started = Instant::now();
        let mut done = Vec::new();
        let span = tracing::info_span!("commit", frames = tracing::field::Empty).entered();
        let (frames, outcome) = match self.commit_waiting(first, &mut done) {
            Ok(frames) => (frames, Ok(())),
            Err(error) => (0, Err(error)),
        };
        span.record("frames", frames);
        if frames > 0 {
            metrics::histogram!(telemetry::COMMIT_SECONDS).record(started.elapsed().as_secs_f64());
            metrics::histogram!(telemetry::COMMIT_FRAMES).record(frames as f64);
        }
        if let Some(health) = outcome.as_ref().err().and_then(JournalHealth::after) {
            tracing::error!(%health, "nothing is acked until the journal takes writes again");
            // Known before anyone hears of the failure, so that nobody begins anew on what was not written.
            self.health.send_replace(health);
        }
        for done in done {
            tell(done, outcome.clone());
        }
    }

    fn commit_waiting(&mut self, first: Commit, done: &mut Vec<Done>) -> Result<usize, JournalError> {
        let (writes, frames) = self.gather(first, done);
        if !writes.iter().all(Write::frees_room) {
            self.reserve.check()?;
        }
        let store = self.store.get()?;
        let mut batch = store.batch();
        for write in writes {
            add(&mut batch, write)?;
        }
        batch.commit()?;
        Ok(frames)
    }

    /// The writes that wait, `first` before them, and the number of frames in them.
    fn gather(&mut self, first: Commit, done: &mut Vec<Done>) -> (Vec<Write>, usize) {
        let mut writes = Vec::new();
        let mut frames = 0;
        let mut next = Some(first);
        while let Some(commit) = next {
            if let Write::Frames { frames: some, .. } = &commit.write {
                frames += some.len();
            }
            writes.push(commit.write);
            done.push(commit.done);
            next = if frames < self.max_frames { self.waiting.try_recv().ok() } else { None };
        }
        (writes, frames)
    }

    /// Refuses what waits, and tries to take writes again; `false` where none will come.
    fn mend(&mut self) -> bool {
        let health = self.health.borrow().clone();
        loop {
            match self.waiting.try_recv() {
                Ok(commit) if commit.write.frees_room() && matches!(health, JournalHealth::NoRoom { .. }) => {
                    self.write(commit);
                }
                Ok(commit) => tell(commit.done, health.check()),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => return false,
            }
        }
        match self.try_to_mend(&health) {
            Ok(()) => {
                tracing::info!("the journal takes writes again");
                self.health.send_replace(JournalHealth::Writing);
            }
            Err(error) => {
                tracing::debug!(%error, "the journal takes no writes yet");
                thread::sleep(MENDING_PAUSE);
            }
        }
        true
    }

    fn try_to_mend(&self, health: &JournalHealth) -> Result<(), JournalError> {
        self.reserve.check_refilled()?;
        match health {
            // A write that failed may be on the disk or not: the store is read anew, so that it knows.
            JournalHealth::Failed { .. } => self.store.reopen(),
            JournalHealth::NoRoom { .. } | JournalHealth::Writing => Ok(()),
        }
    }
}

fn add(batch: &mut StoreBatch<'_>, write: Write) -> Result<(), JournalError> {
    match write {
        Write::Frames { session, frames } => {
            for frame in frames {
                batch.put_frame(session, frame);
            }
            Ok(())
        }
        Write::Record(record) => batch.put_record(&record),
        Write::Ended { record, summary } => batch.put_ended(&record, summary),
        Write::Snapshot { session, snapshot } => batch.put_snapshot(session, snapshot),
        Write::Erased { since } => batch.erased(&since),
        Write::CutMark { session, mark } => {
            batch.put_cut_mark(session, mark);
            Ok(())
        }
        Write::Forget(forget) => batch.forget(&forget),
        Write::Probe => Ok(()),
    }
}

fn tell(done: Done, outcome: Result<(), JournalError>) {
    // A session that ended meanwhile does not ask for the outcome.
    let _ = done.send(outcome);
}
