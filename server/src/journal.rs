//! The journal: frames are durable before they are acked.
//!
//! One folder (fjall) holds the sessions' records, the frames that no snapshot covers yet, and one snapshot per session.
//! All writes go through one thread that gathers what is waiting, of all sessions, into one atomic batch and one sync to
//! disk: a crash leaves either all of a batch or nothing of it, and only a batch that was synced is acked.

mod committer;
mod erasure;
mod named_records;
mod record;
mod store;

use std::path::Path;

use lanemap_core::{Frame, Sequence};
use thiserror::Error;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use crate::{
    privacy::{Pseudonyms, pseudonym::KeyFingerprint},
    session::SessionId,
};
pub use committer::CommitterThread;
use committer::{Commit, Committer};
pub use erasure::ForgottenDrive;
pub use record::{SessionKey, SessionRecord, SessionSetup};
use store::Store;

/// Commits that may wait for the thread; each holds at most one session's frames in flight.
const WAITING_COMMITS: usize = 4096;

/// Why the journal cannot write or read.
#[derive(Clone, Debug, Error)]
pub enum JournalError {
    /// The embedded store failed; it takes no more writes until it is opened anew.
    #[error("the store failed: {0}")]
    Store(String),
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

/// A session's whole state at one frame.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// The last frame in it.
    pub covered: Sequence,
    /// The state, to go on from.
    pub state: Vec<u8>,
    /// Whether the frames that it makes needless must leave the disk soon, as those of which nobody may know.
    pub erase: bool,
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
    postcard::to_stdvec(frame).map_err(|error| decode_error("frame", &error))
}

/// A handle to the journal. Clones share it.
#[derive(Clone, Debug)]
pub struct Journal {
    store: Store,
    commits: mpsc::Sender<Commit>,
    failed: CancellationToken,
}

impl Journal {
    /// Opens the store in `folder`, creating it where it is not there, and starts the committing thread.
    ///
    /// # Errors
    /// A store that is locked by another process, damaged, or in a folder that cannot be written.
    pub fn open(folder: &Path, max_frames_per_commit: usize) -> Result<(Self, CommitterThread), JournalError> {
        let store = Store::open(folder)?;
        let (commits, waiting) = mpsc::channel(WAITING_COMMITS);
        let failed = CancellationToken::new();
        let thread = Committer::new(store.clone(), waiting, max_frames_per_commit, failed.clone()).start()?;
        Ok((Self { store, commits, failed }, thread))
    }

    /// Which privacy key the store was written with; `None` in a store that is new, or older than pseudonyms.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn key_fingerprint(&self) -> Result<Option<KeyFingerprint>, JournalError> {
        self.store.key_fingerprint()
    }

    /// Binds the store to the key of `pseudonyms`; a store whose records still hold names gets pseudonyms in their
    /// place. Call it before anything else is written.
    ///
    /// # Errors
    /// The store cannot be read or written, or an old record does not decode.
    pub fn adopt_key(&self, pseudonyms: &Pseudonyms) -> Result<(), JournalError> {
        let mut batch = self.store.batch();
        batch.put_key_fingerprint(pseudonyms.fingerprint());
        named_records::rename(&self.store, batch, pseudonyms)
    }

    /// Makes frames of one session durable; they are on the disk when this returns.
    ///
    /// # Errors
    /// The store failed: none of the frames counts as durable.
    pub async fn append(&self, session: SessionId, frames: Vec<JournalFrame>) -> Result<(), JournalError> {
        self.commit(|done| Commit::Frames { session, frames, done }).await
    }

    /// Makes a session's record durable.
    ///
    /// # Errors
    /// The store failed.
    pub async fn put_record(&self, record: SessionRecord) -> Result<(), JournalError> {
        self.commit(|done| Commit::Record { record, done }).await
    }

    /// Makes a snapshot durable and removes the frames up to `covered`, which it makes needless, in one step.
    ///
    /// # Errors
    /// The store failed: the old snapshot and the frames stay.
    pub async fn put_snapshot(&self, session: SessionId, snapshot: Snapshot) -> Result<(), JournalError> {
        self.commit(|done| Commit::Snapshot { session, snapshot, done }).await
    }

    /// Cancelled once a commit has failed: the store takes no more writes until it is opened anew.
    #[must_use]
    pub fn failed(&self) -> CancellationToken {
        self.failed.clone()
    }

    async fn commit(
        &self,
        commit: impl FnOnce(oneshot::Sender<Result<(), JournalError>>) -> Commit,
    ) -> Result<(), JournalError> {
        let (done, outcome) = oneshot::channel();
        self.commits.send(commit(done)).await.map_err(|_| JournalError::Closed)?;
        outcome.await.map_err(|_| JournalError::Closed)?
    }

    /// Makes durable how far a drive has come where its frames are cut, and so not in the journal. The next snapshot
    /// replaces it.
    ///
    /// # Errors
    /// The store failed.
    pub async fn put_cut_mark(&self, session: SessionId, mark: Vec<u8>) -> Result<(), JournalError> {
        self.commit(|done| Commit::CutMark { session, mark, done }).await
    }

    /// What [`Journal::put_cut_mark`] put, where no snapshot came after. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn cut_mark(&self, session: SessionId) -> Result<Option<Vec<u8>>, JournalError> {
        self.store.cut_mark(session)
    }

    /// Every session's record, in the order of the ids. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read, or a record does not decode.
    pub fn records(&self) -> Result<Vec<SessionRecord>, JournalError> {
        self.store.records()
    }

    /// One session's record, where it has one. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read, or the record does not decode.
    pub fn record(&self, session: SessionId) -> Result<Option<SessionRecord>, JournalError> {
        self.store.record(session)
    }

    /// A session's snapshot bytes, where it has one. Reads the disk.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn snapshot(&self, session: SessionId) -> Result<Option<Vec<u8>>, JournalError> {
        self.store.snapshot(session)
    }

    /// The frames of a session after `covered`, in the order of their sequence. Reads the disk.
    pub fn frames_after(
        &self,
        session: SessionId,
        covered: Option<Sequence>,
    ) -> impl Iterator<Item = Result<Frame, JournalError>> {
        self.store.frames(session, covered, Sequence(u64::MAX))
    }

    /// The frames of a session after `covered` up to `last`, inclusive, in the order of their sequence. Reads the disk.
    pub fn frames_between(
        &self,
        session: SessionId,
        covered: Option<Sequence>,
        last: Sequence,
    ) -> impl Iterator<Item = Result<Frame, JournalError>> {
        self.store.frames(session, covered, last)
    }
}

fn decode_error(what: &str, error: &postcard::Error) -> JournalError {
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
        let parts = FrameParts { sequence: Sequence(sequence), time, odometry, gnss: None, detections: vec![] };
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

    fn sequences(journal: &Journal, session: SessionId) -> Vec<u64> {
        journal.frames_after(session, None).map(|frame| frame.unwrap().sequence().0).collect()
    }

    #[tokio::test]
    async fn what_was_appended_is_there_when_the_folder_is_opened_again() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (SessionId::next(None, 0, 1), SessionId::next(None, 0, 2));
        let (journal, thread) = Journal::open(folder.path(), 100).unwrap();
        journal.put_record(record(first)).await.unwrap();
        journal.append(first, journaled([1, 2, 256])).await.unwrap();
        journal.append(second, journaled([7])).await.unwrap();
        drop(journal);
        thread.join().await;

        let (journal, _thread) = Journal::open(folder.path(), 100).unwrap();
        assert_eq!(journal.records().unwrap(), [record(first)]);
        assert_eq!(sequences(&journal, first), [1, 2, 256]);
        assert_eq!(sequences(&journal, second), [7]);
    }

    #[tokio::test]
    async fn a_snapshot_replaces_the_frames_that_it_covers_and_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (SessionId::next(None, 0, 1), SessionId::next(None, 0, 2));
        let (journal, _thread) = Journal::open(folder.path(), 2).unwrap();
        journal.append(first, journaled(1..=5)).await.unwrap();
        journal.append(second, journaled(1..=5)).await.unwrap();
        let snapshot = Snapshot { covered: Sequence(3), state: b"state".to_vec(), erase: false };
        journal.put_snapshot(first, snapshot).await.unwrap();
        assert_eq!(journal.snapshot(first).unwrap().as_deref(), Some(&b"state"[..]));
        assert_eq!(sequences(&journal, first), [4, 5]);
        assert_eq!(sequences(&journal, second), [1, 2, 3, 4, 5]);
    }
}
