//! What a session has taken and the service has not acked: in memory, or in a spool on disk.
//!
//! The session's owner pushes, the session's task sends and forgets; neither waits for the other's network or disk. Disk
//! is touched on blocking threads only.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use lanemap_proto::v1;
use tokio::{
    sync::Notify,
    task::{JoinHandle, spawn_blocking},
    time::sleep,
};

use crate::{
    error::ClientError,
    spool::{Spool, SpoolError, SpoolOptions, SpoolRecovery, SpoolSync, Unsynced, WhenFull},
};

/// How the owner leaves the session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Leaving {
    /// The drive is over.
    End,
    /// It stays open, to be resumed.
    Close,
}

/// What is to be sent next.
#[derive(Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a frame in passing: a box would cost more than it saves")]
pub(crate) enum Next {
    Frame(v1::Frame),
    Leave(Leaving),
}

/// Frames that are not acked, in the order of sending.
#[derive(Debug)]
pub(crate) struct Backlog {
    state: Mutex<State>,
    /// There may be something to send.
    filled: Notify,
    /// There may be room.
    emptied: Notify,
    /// Something is not synced.
    unsynced: Notify,
    disk: Option<Disk>,
}

#[derive(Clone, Copy, Debug)]
struct Disk {
    when_full: WhenFull,
    sync: SpoolSync,
}

#[derive(Debug)]
struct State {
    store: Store,
    /// How many of the oldest the present stream has sent.
    sent: usize,
    leaving: Option<Leaving>,
    /// A disk that failed between two pushes.
    failed: Option<SpoolError>,
}

#[derive(Debug)]
enum Store {
    Memory {
        frames: VecDeque<v1::Frame>,
        max_frames: usize,
    },
    Disk(Box<Spool>),
    /// The session is over.
    Gone,
}

/// What became of a frame that was pushed.
#[expect(clippy::large_enum_variant, reason = "a frame in passing: a box would cost more than it saves")]
enum Pushed {
    Taken,
    /// The frame comes back; a spool says how full it is.
    Full(v1::Frame, Option<SpoolError>),
    Failed(SpoolError),
    /// The session is over, or its owner is leaving.
    Gone,
}

impl Backlog {
    /// A backlog of at most `max_frames` in memory.
    pub(crate) fn in_memory(max_frames: usize) -> Arc<Self> {
        Self::new(Store::Memory { frames: VecDeque::new(), max_frames: max_frames.max(1) }, None, None)
    }

    /// A backlog on disk, with what an earlier process left there. Reads the disk: to be called on a blocking thread.
    pub(crate) fn on_disk(options: &SpoolOptions, start: &v1::SessionStart) -> Result<Arc<Self>, SpoolError> {
        let spool = Spool::open(options, start)?;
        let leaving = spool.ended().then_some(Leaving::End);
        let disk = Disk { when_full: options.when_full, sync: options.sync };
        Ok(Self::new(Store::Disk(Box::new(spool)), Some(disk), leaving))
    }

    fn new(store: Store, disk: Option<Disk>, leaving: Option<Leaving>) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State { store, sent: 0, leaving, failed: None }),
            filled: Notify::new(),
            emptied: Notify::new(),
            unsynced: Notify::new(),
            disk,
        })
    }

    /// Takes a frame; waits for room, or refuses the frame, as the settings say.
    pub(crate) async fn push(self: &Arc<Self>, mut frame: v1::Frame) -> Result<(), ClientError> {
        loop {
            let emptied = self.emptied.notified();
            match self.with(move |state| state.push(frame)).await {
                Pushed::Taken => break,
                Pushed::Full(_, Some(error)) if self.refuses_when_full() => return Err(error.into()),
                Pushed::Full(back, _) => frame = back,
                Pushed::Failed(error) => return Err(error.into()),
                Pushed::Gone => return Err(ClientError::Ended),
            }
            emptied.await;
        }
        self.filled.notify_one();
        match self.disk.map(|disk| disk.sync) {
            None | Some(SpoolSync::System) => Ok(()),
            Some(SpoolSync::Within(_)) => {
                self.unsynced.notify_one();
                Ok(())
            }
            Some(SpoolSync::EveryFrame) => Ok(self.sync().await?),
        }
    }

    fn refuses_when_full(&self) -> bool {
        self.disk.is_some_and(|disk| disk.when_full == WhenFull::Refuse)
    }

    /// The owner leaves: nothing is pushed any more.
    pub(crate) async fn leave(self: &Arc<Self>, leaving: Leaving) -> Result<(), ClientError> {
        let noted = self.with(move |state| state.leave(leaving)).await;
        self.filled.notify_one();
        if noted.is_ok() && self.disk.is_some_and(|disk| disk.sync != SpoolSync::System) {
            self.sync().await?;
        }
        Ok(noted?)
    }

    /// The owner is gone without a word: what was taken is still delivered.
    pub(crate) fn abandon(&self) {
        self.lock().leaving.get_or_insert(Leaving::Close);
        self.filled.notify_one();
    }

    /// Waits until there may be something new to send.
    pub(crate) async fn filled(&self) {
        self.filled.notified().await;
    }

    /// What is to be sent next, where fewer than `window` frames are sent and not acked; it counts as sent then.
    pub(crate) async fn next(self: &Arc<Self>, window: usize) -> Result<Option<Next>, ClientError> {
        Ok(self.with(move |state| state.next(window)).await?)
    }

    /// A new stream sends again what is not acked.
    pub(crate) fn rewind(&self) {
        self.lock().sent = 0;
    }

    /// Forgets what is durable.
    pub(crate) async fn acked(self: &Arc<Self>, sequence: u64) -> Result<(), ClientError> {
        let forgotten = self.with(move |state| state.acked(sequence)).await;
        self.emptied.notify_waiters();
        Ok(forgotten?)
    }

    /// Forgets a frame that was refused: the oldest of its number that was sent.
    pub(crate) async fn refused(self: &Arc<Self>, sequence: u64) -> Result<(), ClientError> {
        let forgotten = self.with(move |state| state.refused(sequence)).await;
        self.emptied.notify_waiters();
        Ok(forgotten?)
    }

    /// How the owner leaves, if it does.
    pub(crate) fn leaving(&self) -> Option<Leaving> {
        self.lock().leaving
    }

    /// Whether everything taken is acked or refused.
    pub(crate) fn is_empty(&self) -> bool {
        self.lock().len() == 0
    }

    /// What was found on disk at the beginning; `None` in memory.
    pub(crate) fn recovery(&self) -> Option<SpoolRecovery> {
        match &self.lock().store {
            Store::Disk(spool) => Some(spool.recovery().clone()),
            _ => None,
        }
    }

    /// Highest sequence ever spooled.
    pub(crate) fn last_sequence(&self) -> Option<u64> {
        match &self.lock().store {
            Store::Disk(spool) => spool.last_sequence(),
            _ => None,
        }
    }

    /// Frames and bytes that wait on disk or in memory.
    pub(crate) fn waiting(&self) -> (usize, u64) {
        let state = self.lock();
        let bytes = match &state.store {
            Store::Disk(spool) => spool.bytes(),
            _ => 0,
        };
        (state.len(), bytes)
    }

    /// The session is over; `delivered`: the drive has ended and the service has all of it.
    pub(crate) async fn close(self: &Arc<Self>, delivered: bool) -> Result<(), ClientError> {
        let closed = self.with(move |state| state.close(delivered)).await;
        self.emptied.notify_waiters();
        Ok(closed?)
    }

    /// A task that forces to disk what has waited for `SpoolSync::Within`; `None` where none is needed.
    pub(crate) fn keep_synced(self: &Arc<Self>) -> Option<JoinHandle<()>> {
        let Some(Disk { sync: SpoolSync::Within(within), .. }) = self.disk else { return None };
        Some(tokio::spawn(Arc::clone(self).sync_within(within)))
    }

    async fn sync_within(self: Arc<Self>, within: Duration) {
        loop {
            self.unsynced.notified().await;
            sleep(within).await;
            if let Err(error) = self.sync().await {
                // The next push says so.
                self.lock().failed = Some(error);
            }
        }
    }

    /// Forces the newest segment to disk; older ones were when they were left.
    async fn sync(self: &Arc<Self>) -> Result<(), SpoolError> {
        match self.with(|state| state.unsynced()).await? {
            Some(unsynced) => on_blocking_thread(move || unsynced.sync()).await,
            None => Ok(()),
        }
    }

    async fn with<T: Send + 'static>(self: &Arc<Self>, act: impl FnOnce(&mut State) -> T + Send + 'static) -> T {
        if self.disk.is_none() {
            return act(&mut self.lock());
        }
        let backlog = Arc::clone(self);
        on_blocking_thread(move || act(&mut backlog.lock())).await
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // What a panic left behind is a frame that was taken, or was not.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Runs on a thread that may block; does not return where the runtime is shutting down.
pub(crate) async fn on_blocking_thread<T: Send + 'static>(act: impl FnOnce() -> T + Send + 'static) -> T {
    match spawn_blocking(act).await {
        Ok(done) => done,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            Err(_shutting_down) => std::future::pending().await,
        },
    }
}

impl State {
    fn len(&self) -> usize {
        match &self.store {
            Store::Memory { frames, .. } => frames.len(),
            Store::Disk(spool) => spool.len(),
            Store::Gone => 0,
        }
    }

    fn push(&mut self, frame: v1::Frame) -> Pushed {
        if let Some(error) = self.failed.take() {
            return Pushed::Failed(error);
        }
        if self.leaving.is_some() {
            return Pushed::Gone;
        }
        match &mut self.store {
            Store::Memory { frames, max_frames } if frames.len() >= *max_frames => Pushed::Full(frame, None),
            Store::Memory { frames, .. } => {
                frames.push_back(frame);
                Pushed::Taken
            }
            Store::Disk(spool) => match spool.append(&frame) {
                Ok(()) => Pushed::Taken,
                Err(error @ SpoolError::Full { .. }) => Pushed::Full(frame, Some(error)),
                Err(error) => Pushed::Failed(error),
            },
            Store::Gone => Pushed::Gone,
        }
    }

    fn leave(&mut self, leaving: Leaving) -> Result<(), SpoolError> {
        if let (Store::Disk(spool), Leaving::End) = (&mut self.store, leaving) {
            spool.append_end()?;
        }
        self.leaving = Some(leaving);
        Ok(())
    }

    fn next(&mut self, window: usize) -> Result<Option<Next>, SpoolError> {
        if self.sent == self.len() {
            return Ok(self.leaving.map(Next::Leave));
        }
        if self.sent >= window {
            return Ok(None);
        }
        let frame = match &mut self.store {
            Store::Memory { frames, .. } => frames.get(self.sent).cloned(),
            Store::Disk(spool) => spool.read(self.sent)?,
            Store::Gone => None,
        };
        self.sent += usize::from(frame.is_some());
        Ok(frame.map(Next::Frame))
    }

    fn acked(&mut self, sequence: u64) -> Result<(), SpoolError> {
        let forgotten = match &mut self.store {
            Store::Memory { frames, .. } => {
                let acked = frames.iter().take_while(|frame| frame.sequence <= sequence).count();
                frames.drain(..acked).count()
            }
            Store::Disk(spool) => spool.forget_up_to(sequence)?,
            Store::Gone => 0,
        };
        self.sent = self.sent.saturating_sub(forgotten);
        Ok(())
    }

    fn refused(&mut self, sequence: u64) -> Result<(), SpoolError> {
        let forgotten = match &mut self.store {
            Store::Memory { frames, .. } => {
                let found = frames.iter().take(self.sent).position(|frame| frame.sequence == sequence);
                found.and_then(|index| frames.remove(index)).is_some()
            }
            Store::Disk(spool) => spool.forget(sequence, self.sent)?,
            Store::Gone => false,
        };
        self.sent -= usize::from(forgotten);
        Ok(())
    }

    fn close(&mut self, delivered: bool) -> Result<(), SpoolError> {
        match std::mem::replace(&mut self.store, Store::Gone) {
            Store::Disk(spool) if delivered => spool.remove(),
            _ => Ok(()),
        }
    }

    fn unsynced(&self) -> Result<Option<Unsynced>, SpoolError> {
        match &self.store {
            Store::Disk(spool) => spool.unsynced().map(Some),
            _ => Ok(None),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(sequence: u64) -> v1::Frame {
        v1::Frame { sequence, ..v1::Frame::default() }
    }

    async fn of(backlog: &Arc<Backlog>, sequences: &[u64]) {
        for &sequence in sequences {
            backlog.push(frame(sequence)).await.unwrap();
        }
    }

    async fn sent(backlog: &Arc<Backlog>, window: usize) -> Vec<u64> {
        let mut sent = Vec::new();
        while let Some(Next::Frame(frame)) = backlog.next(window).await.unwrap() {
            sent.push(frame.sequence);
        }
        sent
    }

    fn on_disk(folder: &tempfile::TempDir, when_full: WhenFull) -> Arc<Backlog> {
        let options =
            SpoolOptions { when_full, max_bytes: SpoolOptions::MIN_BYTES, ..SpoolOptions::new(folder.path()) };
        Backlog::on_disk(&options, &v1::SessionStart::default()).unwrap()
    }

    #[tokio::test]
    async fn what_is_acked_is_forgotten_and_the_rest_stays_in_order() {
        let folder = tempfile::tempdir().unwrap();
        for backlog in [Backlog::in_memory(10), on_disk(&folder, WhenFull::Block)] {
            of(&backlog, &[1, 2, 3, 4]).await;
            assert_eq!(sent(&backlog, 3).await, [1, 2, 3]);
            backlog.acked(2).await.unwrap();
            assert_eq!(sent(&backlog, 3).await, [4]);
            backlog.rewind();
            assert_eq!(sent(&backlog, 3).await, [3, 4]);
        }
    }

    #[tokio::test]
    async fn a_refused_frame_is_not_sent_again() {
        let folder = tempfile::tempdir().unwrap();
        for backlog in [Backlog::in_memory(10), on_disk(&folder, WhenFull::Block)] {
            of(&backlog, &[1, 2, 3]).await;
            assert_eq!(sent(&backlog, 2).await, [1, 2]);
            backlog.refused(2).await.unwrap();
            backlog.rewind();
            assert_eq!(sent(&backlog, 9).await, [1, 3]);
        }
    }

    #[tokio::test]
    async fn the_end_is_sent_after_the_last_frame_whatever_the_window() {
        let backlog = Backlog::in_memory(10);
        of(&backlog, &[1]).await;
        backlog.leave(Leaving::End).await.unwrap();
        assert_eq!(backlog.next(1).await.unwrap(), Some(Next::Frame(frame(1))));
        assert_eq!(backlog.next(1).await.unwrap(), Some(Next::Leave(Leaving::End)));
        assert!(matches!(backlog.push(frame(2)).await, Err(ClientError::Ended)));
    }

    #[tokio::test]
    async fn a_push_into_a_full_backlog_waits_until_acks_make_room() {
        let backlog = Backlog::in_memory(2);
        of(&backlog, &[1, 2]).await;
        let pushing = tokio::spawn({
            let backlog = Arc::clone(&backlog);
            async move { backlog.push(frame(3)).await }
        });
        tokio::task::yield_now().await;
        assert!(!pushing.is_finished());
        assert_eq!(sent(&backlog, 9).await, [1, 2]);
        backlog.acked(1).await.unwrap();
        pushing.await.unwrap().unwrap();
        assert_eq!(sent(&backlog, 9).await, [3]);
    }

    #[tokio::test]
    async fn a_full_spool_that_is_told_to_refuse_refuses_the_newest_and_keeps_the_rest() {
        let folder = tempfile::tempdir().unwrap();
        let backlog = on_disk(&folder, WhenFull::Refuse);
        let mut taken = 0;
        let error = loop {
            let long =
                v1::Frame { detections: vec![v1::Detection { category: 0, xyz: vec![1.0; 300] }], ..frame(taken) };
            match backlog.push(long).await {
                Ok(()) => taken += 1,
                Err(error) => break error,
            }
        };
        assert!(matches!(error, ClientError::Spool(SpoolError::Full { .. })), "{error}");
        assert_eq!(sent(&backlog, usize::MAX).await, (0..taken).collect::<Vec<_>>());
    }

    #[tokio::test]
    async fn a_session_that_is_over_wakes_who_waits_for_room() {
        let backlog = Backlog::in_memory(1);
        of(&backlog, &[1]).await;
        let pushing = tokio::spawn({
            let backlog = Arc::clone(&backlog);
            async move { backlog.push(frame(2)).await }
        });
        tokio::task::yield_now().await;
        backlog.close(false).await.unwrap();
        assert!(matches!(pushing.await.unwrap(), Err(ClientError::Ended)));
    }
}
