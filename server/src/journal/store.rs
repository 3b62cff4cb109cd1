//! Layout of the embedded store.
//!
//! | keyspace    | key                                          | value                   |
//! |-------------|----------------------------------------------|-------------------------|
//! | `sessions`  | id, 8 bytes big-endian                       | record, postcard        |
//! | `frames`    | id, then sequence, 8 bytes big-endian each   | frame, postcard         |
//! | `snapshots` | id                                           | the session's own bytes |

use std::path::Path;

use fjall::{Database, Keyspace, KeyspaceCreateOptions, OwnedWriteBatch, PersistMode};
use lanemap_core::{Frame, Sequence};

use super::{JournalError, JournalFrame, SessionRecord, decode_error};
use crate::session::SessionId;

/// The keyspaces of one folder.
#[derive(Clone)]
pub(super) struct Store {
    database: Database,
    sessions: Keyspace,
    frames: Keyspace,
    snapshots: Keyspace,
}

/// Writes that become durable together or not at all.
pub(super) struct StoreBatch<'a> {
    store: &'a Store,
    batch: OwnedWriteBatch,
}

impl std::fmt::Debug for Store {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Store").finish_non_exhaustive()
    }
}

impl Store {
    pub(super) fn open(folder: &Path) -> Result<Self, JournalError> {
        let database = Database::builder(folder).open()?;
        let keyspace = |name| database.keyspace(name, KeyspaceCreateOptions::default);
        let (sessions, frames, snapshots) = (keyspace("sessions")?, keyspace("frames")?, keyspace("snapshots")?);
        Ok(Self { database, sessions, frames, snapshots })
    }

    pub(super) fn batch(&self) -> StoreBatch<'_> {
        StoreBatch { store: self, batch: self.database.batch().durability(Some(PersistMode::SyncData)) }
    }

    pub(super) fn records(&self) -> Result<Vec<SessionRecord>, JournalError> {
        self.sessions.iter().map(|entry| record(&entry.value()?)).collect()
    }

    pub(super) fn record(&self, session: SessionId) -> Result<Option<SessionRecord>, JournalError> {
        self.sessions.get(session.to_key())?.map(|value| record(&value)).transpose()
    }

    pub(super) fn snapshot(&self, session: SessionId) -> Result<Option<Vec<u8>>, JournalError> {
        Ok(self.snapshots.get(session.to_key())?.map(|value| value.to_vec()))
    }

    pub(super) fn frames(&self, session: SessionId) -> impl Iterator<Item = Result<Frame, JournalError>> + use<> {
        self.frames.prefix(session.to_key()).map(move |entry| {
            let value = entry.value()?;
            let what = || format!("a frame of session {session}");
            postcard::from_bytes(&value).map_err(|error| decode_error(&what(), &error))
        })
    }
}

impl StoreBatch<'_> {
    pub(super) fn put_frame(&mut self, session: SessionId, frame: JournalFrame) {
        self.batch.insert(&self.store.frames, frame_key(session, frame.sequence), frame.bytes);
    }

    pub(super) fn put_record(&mut self, record: &SessionRecord) -> Result<(), JournalError> {
        let bytes = postcard::to_stdvec(record).map_err(|error| decode_error("a session's record", &error))?;
        self.batch.insert(&self.store.sessions, record.id.to_key(), bytes);
        Ok(())
    }

    /// Puts the snapshot and removes the frames that it covers.
    pub(super) fn put_snapshot(
        &mut self,
        session: SessionId,
        covered: Sequence,
        bytes: Vec<u8>,
    ) -> Result<(), JournalError> {
        let covered = frame_key(session, Sequence(0))..=frame_key(session, covered);
        for entry in self.store.frames.range(covered) {
            self.batch.remove(&self.store.frames, entry.key()?);
        }
        self.batch.insert(&self.store.snapshots, session.to_key(), bytes);
        Ok(())
    }

    /// Makes everything in the batch durable.
    pub(super) fn commit(self) -> Result<(), JournalError> {
        Ok(self.batch.commit()?)
    }
}

fn record(bytes: &[u8]) -> Result<SessionRecord, JournalError> {
    postcard::from_bytes(bytes).map_err(|error| decode_error("a session's record", &error))
}

fn frame_key(session: SessionId, sequence: Sequence) -> [u8; 16] {
    let mut key = [0; 16];
    key[..8].copy_from_slice(&session.to_key());
    key[8..].copy_from_slice(&sequence.0.to_be_bytes());
    key
}
