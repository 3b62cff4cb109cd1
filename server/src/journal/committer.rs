//! Group commit: one thread, one batch, one sync to disk for all that is waiting.

use std::{thread, time::Instant};

use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use super::{JournalError, JournalFrame, SessionRecord, Snapshot, erasure::Forget, store::Store, store::StoreBatch};
use crate::{session::SessionId, telemetry};

/// Where a commit's outcome goes.
type Done = oneshot::Sender<Result<(), JournalError>>;

/// A write that waits to become durable.
#[derive(Debug)]
pub(super) enum Commit {
    /// Frames of one session.
    Frames { session: SessionId, frames: Vec<JournalFrame>, done: Done },
    /// A session's record.
    Record { record: SessionRecord, done: Done },
    /// A snapshot, and the frames that it covers are removed.
    Snapshot { session: SessionId, snapshot: Snapshot, done: Done },
    /// What was removed up to `since` has left the disk.
    Erased { since: Vec<u8>, done: Done },
    /// How far a drive has come whose frames are cut.
    CutMark { session: SessionId, mark: Vec<u8>, done: Done },
    /// All that there is of some drives is removed.
    Forget { forget: Forget, done: Done },
}

/// The committing thread's state.
pub(super) struct Committer {
    store: Store,
    waiting: mpsc::Receiver<Commit>,
    max_frames: usize,
    failed: CancellationToken,
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
    pub(super) fn new(
        store: Store,
        waiting: mpsc::Receiver<Commit>,
        max_frames: usize,
        failed: CancellationToken,
    ) -> Self {
        Self { store, waiting, max_frames, failed }
    }

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
        while let Some(first) = self.waiting.blocking_recv() {
            let started = Instant::now();
            let span = tracing::info_span!("commit", frames = tracing::field::Empty).entered();
            let (frames, done, outcome) = self.commit_waiting(first);
            span.record("frames", frames);
            metrics::histogram!(telemetry::COMMIT_SECONDS).record(started.elapsed().as_secs_f64());
            metrics::histogram!(telemetry::COMMIT_FRAMES).record(frames as f64);
            if let Err(error) = &outcome {
                tracing::error!(%error, "the journal cannot commit: nothing is acked any more");
                self.failed.cancel();
            }
            for done in done {
                // A session that ended meanwhile does not ask for the outcome.
                let _ = done.send(outcome.clone());
            }
        }
    }

    fn commit_waiting(&mut self, first: Commit) -> (usize, Vec<Done>, Result<(), JournalError>) {
        let mut batch = self.store.batch();
        let mut frames = 0;
        let mut done = Vec::new();
        let mut next = Some(first);
        while let Some(commit) = next {
            match add(&mut batch, commit) {
                Ok((count, one_done)) => {
                    frames += count;
                    done.push(one_done);
                }
                Err((error, one_done)) => {
                    done.push(one_done);
                    return (frames, done, Err(error));
                }
            }
            next = if frames < self.max_frames { self.waiting.try_recv().ok() } else { None };
        }
        (frames, done, batch.commit())
    }
}

/// Adds a write to the batch; gives the number of its frames.
fn add(batch: &mut StoreBatch<'_>, commit: Commit) -> Result<(usize, Done), (JournalError, Done)> {
    match commit {
        Commit::Frames { session, frames, done } => {
            let count = frames.len();
            for frame in frames {
                batch.put_frame(session, frame);
            }
            Ok((count, done))
        }
        Commit::Record { record, done } => match batch.put_record(&record) {
            Ok(()) => Ok((0, done)),
            Err(error) => Err((error, done)),
        },
        Commit::Erased { since, done } => match batch.erased(&since) {
            Ok(()) => Ok((0, done)),
            Err(error) => Err((error, done)),
        },
        Commit::CutMark { session, mark, done } => {
            batch.put_cut_mark(session, mark);
            Ok((0, done))
        }
        Commit::Forget { forget, done } => match batch.forget(&forget) {
            Ok(()) => Ok((0, done)),
            Err(error) => Err((error, done)),
        },
        Commit::Snapshot { session, snapshot, done } => match batch.put_snapshot(session, snapshot) {
            Ok(()) => Ok((0, done)),
            Err(error) => Err((error, done)),
        },
    }
}
