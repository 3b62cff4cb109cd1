//! The journal: frames are durable before they are acked.
//!
//! One folder (fjall) holds the sessions' records, the frames that no snapshot covers yet, and one snapshot per session.
//! All writes go through one thread that gathers what is waiting, of all sessions, into one atomic batch and one sync to
//! disk: a crash leaves either all of a batch or nothing of it, and only a batch that was synced is acked.
//!
//! A disk that runs full makes the journal refuse ([`JournalHealth`]) while the embedded store still has the room that it
//! needs; what was acked stays, and writes are taken again once there is room.

pub(crate) mod cells;
mod committer;
mod erasure;
mod health;
mod named_records;
mod record;
mod store;

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

use lanemap_core::{Frame, Sequence};
use thiserror::Error;
use tokio::sync::{mpsc, oneshot, watch};

use crate::{
    privacy::{Pseudonyms, pseudonym::KeyFingerprint},
    session::SessionId,
};
pub use committer::CommitterThread;
use committer::{Commit, Committer, Write};
pub use erasure::ForgottenDrive;
use health::DiskReserve;
pub use health::JournalHealth;
pub use record::{SessionKey, SessionRecord, SessionSetup};
use store::Reopenable;

/// Why the journal cannot write or read.
#[derive(Clone, Debug, Error)]
pub enum JournalError {
    /// The embedded store failed; it is opened anew.
    #[error("the store failed: {0}")]
    Store(String),
    /// The disk has less room than is kept free.
    #[error("the disk is full: {free_bytes} bytes are free, {minimum_bytes} are kept free")]
    NoRoom {
        /// Bytes free on the disk.
        free_bytes: u64,
        /// Bytes that are kept free.
        minimum_bytes: u64,
    },
    /// A stored value does not decode.
    #[error("{what} does not decode: {reason}")]
    Decode {
        /// What was read.
        what: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The journal was closed.
    #[error("the journal is closed")]
    Closed,
}

impl From<fjall::Error> for JournalError {
    fn from(error: fjall::Error) -> Self {
        Self::Store(error.to_string())
    }
}

/// How a journal is opened.
#[derive(Clone, Debug)]
pub struct JournalOptions {
    /// Folder of the store.
    pub folder: PathBuf,
    /// Most frames of all sessions made durable together.
    pub max_frames_per_commit: usize,
    /// Writes that may wait for the committing thread; more wait for room among these.
    pub max_waiting_commits: usize,
    /// Room on the disk below which nothing is written, bytes; 0: any.
    pub min_free_disk_bytes: u64,
}

impl JournalOptions {
    /// The defaults, in `folder`.
    #[must_use]
    pub fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
            max_frames_per_commit: 2048,
            max_waiting_commits: 4096,
            min_free_disk_bytes: 0,
        }
    }
}

/// A session's whole state at one frame.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// The frame that the snapshot before this one covers; `None` where it is the first.
    pub covered_before: Option<Sequence>,
    /// The last frame in it.
    pub covered: Sequence,
    /// The state, to go on from.
    pub state: Vec<u8>,
    /// Whether the frames that it makes needless must leave the disk soon, as those of which nobody may know.
    pub erase: bool,
    /// What is told of the session while it sleeps.
    pub summary: Vec<u8>,
}

/// A frame on its way into the journal.
#[derive(Clone, Debug)]
pub struct JournalFrame {
    /// Number in the session.
    pub sequence: Sequence,
    /// The frame's bytes, from [`frame_bytes`].
    pub bytes: Vec<u8>,
}

/// The bytes under which a frame is kept: the validated frame, bit by bit.
///
/// # Errors
/// None in practice: a frame is plain numbers.
pub fn frame_bytes(frame: &Frame) -> Result<Vec<u8>, JournalError> {
    frame.to_bytes().map_err(|error| decode_error("frame", &error))
}

/// A handle to the journal. Clones share it.
#[derive(Clone, Debug)]
pub struct Journal {
    store: Reopenable,
    commits: mpsc::Sender<Commit>,
    health: watch::Receiver<JournalHealth>,
}

impl Journal {
    /// Opens the store, creating it where it is not there, and starts the committing thread.
    ///
    /// # Errors
    /// A store that is locked by another process, damaged, or in a folder that cannot be written.
    pub fn open(options: &JournalOptions) -> Result<(Self, CommitterThread), JournalError> {
        let store = Reopenable::open(&options.folder)?;
        let (commits, waiting) = mpsc::channel(options.max_waiting_commits);
        let (told_health, health) = watch::channel(JournalHealth::Writing);
        let committer = Committer {
            store: store.clone(),
            waiting,
            max_frames: options.max_frames_per_commit,
            reserve: DiskReserve::new(options.folder.clone(), options.min_free_disk_bytes),
            health: told_health,
        };
        Ok((Self { store, commits, health }, committer.start()?))
    }

    /// Which privacy key the store was written with; `None` in a store that is new, or older than pseudonyms.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn key_fingerprint(&self) -> Result<Option<KeyFingerprint>, JournalError> {
        self.store.get()?.key_fingerprint()
    }

    /// Binds the store to the key of `pseudonyms`; a store whose records still hold names gets pseudonyms in their
    /// place. Call it before anything else is written.
    ///
    /// # Errors
    /// The store cannot be read or written, or an old record does not decode.
    pub fn adopt_key(&self, pseudonyms: &Pseudonyms) -> Result<(), JournalError> {
        let store = self.store.get()?;
        let mut batch = store.batch();
        batch.put_key_fingerprint(pseudonyms.fingerprint());
        named_records::rename(&store, batch, pseudonyms)
    }

    /// Makes frames of one session durable; they are on the disk when this returns.
    ///
    /// # Errors
    /// No room on the disk, or the store failed: none of the frames counts as durable.
    pub async fn append(&self, session: SessionId, frames: Vec<JournalFrame>) -> Result<(), JournalError> {
        self.commit(Write::Frames { session, frames }).await
    }

    /// Makes a session's record durable.
    ///
    /// # Errors
    /// No room on the disk, or the store failed.
    pub async fn put_record(&self, record: SessionRecord) -> Result<(), JournalError> {
        self.commit(Write::Record(record)).await
    }

    /// Makes it durable that a session's drive is over, with what is told of it from now on.
    ///
    /// # Errors
    /// No room on the disk, or the store failed: the drive is not over.
    pub async fn put_ended(&self, record: SessionRecord, summary: Vec<u8>) -> Result<(), JournalError> {
        self.commit(Write::Ended { record, summary }).await
    }

    /// Makes a snapshot durable and removes the frames that it makes needless, in one step.
    ///
    /// # Errors
    /// No room on the disk, or the store failed: the old snapshot and the frames stay.
    pub async fn put_snapshot(&self, session: SessionId, snapshot: Snapshot) -> Result<(), JournalError> {
        self.commit(Write::Snapshot { session, snapshot }).await
    }

    /// Asks whether the disk has room, so that [`Journal::health`] knows where nothing is written.
    ///
    /// # Errors
    /// As a write.
    pub async fn probe(&self) -> Result<(), JournalError> {
        self.commit(Write::Probe).await
    }

    /// Whether the journal takes writes.
    #[must_use]
    pub fn health(&self) -> watch::Receiver<JournalHealth> {
        self.health.clone()
    }

    /// Whether as many writes wait as may: the disk does not keep up.
    #[must_use]
    pub fn is_overloaded(&self) -> bool {
        self.commits.capacity() == 0
    }

    async fn commit(&self, write: Write) -> Result<(), JournalError> {
        let (done, outcome) = oneshot::channel();
        self.commits.send(Commit { write, done }).await.map_err(|_| JournalError::Closed)?;
        outcome.await.map_err(|_| JournalError::Closed)?
    }

    /// Makes durable how far a drive has come where its frames are cut, and so not in the journal. The next snapshot
    /// replaces it.
    ///
    /// # Errors
    /// The store failed.
    pub async fn put_cut_mark(&self, session: SessionId, mark: Vec<u8>) -> Result<(), JournalError> {
        self.commit(Write::CutMark { session, mark }).await
    }

    /// What [`Journal::put_cut_mark`] put, where no snapshot came after. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn cut_mark(&self, session: SessionId) -> Result<Option<Vec<u8>>, JournalError> {
        self.store.get()?.cut_mark(session)
    }

    /// Every session's record, in the order of the ids. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read, or a record does not decode.
    pub fn records(&self) -> Result<Vec<SessionRecord>, JournalError> {
        self.store.get()?.records()
    }

    /// One session's record, where it has one. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read, or the record does not decode.
    pub fn record(&self, session: SessionId) -> Result<Option<SessionRecord>, JournalError> {
        self.store.get()?.record(session)
    }

    /// A session's snapshot bytes, where it has one. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn snapshot(&self, session: SessionId) -> Result<Option<Vec<u8>>, JournalError> {
        self.store.get()?.snapshot(session)
    }

    /// The summaries put down with the sessions' snapshots. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn summaries(&self) -> Result<HashMap<SessionId, Vec<u8>>, JournalError> {
        self.store.get()?.summaries()
    }

    /// Those of `sessions` that have frames after the one that their snapshot covers. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn with_frames_after(
        &self,
        sessions: impl IntoIterator<Item = (SessionId, Option<Sequence>)>,
    ) -> Result<Vec<SessionId>, JournalError> {
        let store = self.store.get()?;
        let mut found = Vec::new();
        for (session, covered) in sessions {
            if store.has_frames_after(session, covered)? {
                found.push(session);
            }
        }
        Ok(found)
    }

    /// The frames of a session after `covered`, in the order of their sequence. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read, or a frame does not decode.
    pub fn frames_after(
        &self,
        session: SessionId,
        covered: Option<Sequence>,
    ) -> Result<impl Iterator<Item = Result<Frame, JournalError>> + use<>, JournalError> {
        self.store.frames(session, covered, Sequence(u64::MAX))
    }

    /// The frames of a session after `covered` up to `last`, inclusive, in the order of their sequence. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read, or a frame does not decode.
    pub fn frames_between(
        &self,
        session: SessionId,
        covered: Option<Sequence>,
        last: Sequence,
    ) -> Result<impl Iterator<Item = Result<Frame, JournalError>> + use<>, JournalError> {
        self.store.frames(session, covered, last)
    }

    /// The last frames of a session after `covered`, `most` at most, in the order of their sequence. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn last_frames(
        &self,
        session: SessionId,
        covered: Option<Sequence>,
        most: usize,
    ) -> Result<Vec<JournalFrame>, JournalError> {
        self.store.get()?.last_frames(session, covered, most)
    }

    /// Bytes that the store takes on the disk.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn disk_bytes(&self) -> Result<u64, JournalError> {
        self.store.get()?.disk_bytes()
    }
}

fn decode_error(what: &str, error: &dyn std::error::Error) -> JournalError {
    JournalError::Decode { what: what.to_owned(), reason: error.to_string() }
}

#[cfg(test)]
mod tests {
    use lanemap_core::{FrameLimits, FrameParts, Odometry, Preset, Sensor, TimestampNs, geometry::Pose};

    use super::*;
    use crate::privacy::TripCut;

    fn frame(sequence: u64) -> Frame {
        let odometry = Odometry { odometry_from_vehicle: Pose::identity(), motion_covariance: None };
        let time = TimestampNs(i64::try_from(sequence).unwrap());
        let parts = FrameParts {
            sequence: Sequence(sequence),
            time,
            odometry,
            gnss: None,
            detections: vec![],
            occlusions: vec![],
        };
        Frame::new(parts, &FrameLimits::default()).unwrap()
    }

    fn journaled(sequences: impl IntoIterator<Item = u64>) -> Vec<JournalFrame> {
        let frames = sequences.into_iter().map(frame);
        frames.map(|f| JournalFrame { sequence: f.sequence(), bytes: frame_bytes(&f).unwrap() }).collect()
    }

    /// The same ones at every call.
    fn pseudonyms() -> Pseudonyms {
        static PSEUDONYMS: std::sync::LazyLock<Pseudonyms> = std::sync::LazyLock::new(|| {
            let folder = tempfile::tempdir().unwrap();
            Pseudonyms::open(&folder.path().join("privacy.key"), None).unwrap()
        });
        PSEUDONYMS.clone()
    }

    fn record(id: SessionId) -> SessionRecord {
        let key = SessionKey { fleet: "f".into(), vehicle: "v".into(), drive: id.to_string() };
        SessionRecord {
            id,
            drive: pseudonyms().drive(&key),
            vehicle: pseudonyms().vehicle(&key.fleet, &key.vehicle),
            setup: SessionSetup { preset: Preset::Paper, sensor: Sensor::default() },
            cut: TripCut::default(),
            ended: false,
        }
    }

    fn sequences(journal: &Journal, session: SessionId, covered: Option<Sequence>) -> Vec<u64> {
        let frames = journal.frames_after(session, covered).unwrap();
        frames.map(|frame| frame.unwrap().sequence().0).collect()
    }

    fn snapshot(covered_before: Option<u64>, covered: u64) -> Snapshot {
        let state = format!("state at {covered}").into_bytes();
        let summary = format!("summary at {covered}").into_bytes();
        let (covered_before, covered) = (covered_before.map(Sequence), Sequence(covered));
        Snapshot { covered_before, covered, state, summary, erase: false }
    }

    #[tokio::test]
    async fn what_was_appended_is_there_when_the_folder_is_opened_again() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (SessionId::next(None, 0, 1), SessionId::next(None, 0, 2));
        let (journal, thread) = Journal::open(&JournalOptions::new(folder.path())).unwrap();
        journal.put_record(record(first)).await.unwrap();
        journal.append(first, journaled([1, 2, 256])).await.unwrap();
        journal.append(second, journaled([7])).await.unwrap();
        drop(journal);
        thread.join().await;

        let (journal, _thread) = Journal::open(&JournalOptions::new(folder.path())).unwrap();
        assert_eq!(journal.records().unwrap(), [record(first)]);
        assert_eq!(sequences(&journal, first, None), [1, 2, 256]);
        assert_eq!(sequences(&journal, second, None), [7]);
    }

    #[tokio::test]
    async fn a_snapshot_replaces_the_frames_that_it_covers_and_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (SessionId::next(None, 0, 1), SessionId::next(None, 0, 2));
        let options = JournalOptions { max_frames_per_commit: 2, ..JournalOptions::new(folder.path()) };
        let (journal, _thread) = Journal::open(&options).unwrap();
        journal.append(first, journaled(1..=5)).await.unwrap();
        journal.append(second, journaled(1..=5)).await.unwrap();
        for (before, covered) in [(None, 2), (Some(2), 3)] {
            journal.put_snapshot(first, snapshot(before, covered)).await.unwrap();
        }
        assert_eq!(journal.snapshot(first).unwrap().as_deref(), Some(&b"state at 3"[..]));
        assert_eq!(journal.summaries().unwrap(), HashMap::from([(first, b"summary at 3".to_vec())]));
        let covered = [(first, Some(Sequence(5))), (second, Some(Sequence(4)))];
        assert_eq!(journal.with_frames_after(covered).unwrap(), [second]);
        assert_eq!(sequences(&journal, first, None), [4, 5]);
        assert_eq!(sequences(&journal, second, Some(Sequence(3))), [4, 5]);
        assert_eq!(sequences(&journal, second, None), [1, 2, 3, 4, 5]);
    }

    #[tokio::test]
    async fn a_disk_without_room_refuses_writes_and_loses_none_that_were_done() {
        let folder = tempfile::tempdir().unwrap();
        let session = SessionId::next(None, 0, 1);
        let (journal, thread) = Journal::open(&JournalOptions::new(folder.path())).unwrap();
        journal.append(session, journaled([1])).await.unwrap();
        drop(journal);
        thread.join().await;

        // More than any disk has.
        let options = JournalOptions { min_free_disk_bytes: 1 << 62, ..JournalOptions::new(folder.path()) };
        let (journal, _thread) = Journal::open(&options).unwrap();
        let error = journal.append(session, journaled([2])).await.unwrap_err();
        assert!(matches!(error, JournalError::NoRoom { minimum_bytes, .. } if minimum_bytes == 1 << 62), "{error}");
        assert!(matches!(*journal.health().borrow(), JournalHealth::NoRoom { .. }));
        assert_eq!(sequences(&journal, session, None), [1]);
    }

    #[tokio::test]
    async fn a_store_that_failed_is_opened_anew_and_what_was_durable_is_there() {
        let folder = tempfile::tempdir().unwrap();
        let session = SessionId::next(None, 0, 1);
        let (journal, _thread) = Journal::open(&JournalOptions::new(folder.path())).unwrap();
        journal.append(session, journaled([1])).await.unwrap();
        let mut held = journal.frames_after(session, None).unwrap();
        std::thread::scope(|scope| {
            let reopened = scope.spawn(|| journal.store.reopen());
            // Closing waits for a reader, who reads on.
            assert_eq!(held.next().unwrap().unwrap().sequence(), Sequence(1));
            drop(held);
            reopened.join().unwrap().unwrap();
        });
        journal.append(session, journaled([2])).await.unwrap();
        assert_eq!(sequences(&journal, session, None), [1, 2]);
    }
}
