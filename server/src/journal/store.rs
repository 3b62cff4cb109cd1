//! Layout of the embedded store.
//!
//! | keyspace    | key                                          | value                       |
//! |-------------|----------------------------------------------|-----------------------------|
//! | `records`   | id, 8 bytes big-endian                       | record, postcard            |
//! | `frames`    | id, then sequence, 8 bytes big-endian each   | frame, postcard             |
//! | `snapshots` | id                                           | the session's own bytes     |
//! | `cuts`      | id                                           | how far the drive has come where its frames are cut |
//! | `facts`     | `privacy key`                                | the key's fingerprint       |
//! |             | `erasure due`                                | none: what was removed is still on the disk |
//! | `forgotten` | pseudonym of a drive that was deleted        | day of it                   |
//! | `filler`    |                                              | see [`super::erasure`]      |
//!
//! No name of a fleet, a vehicle or a drive stands in any of them.

use std::path::{Path, PathBuf};

use fjall::{Database, Keyspace, KeyspaceCreateOptions, OwnedWriteBatch, PersistMode};
use lanemap_core::{Frame, Sequence};

use super::{JournalError, JournalFrame, SessionRecord, Snapshot, decode_error};
use crate::{privacy::pseudonym::KeyFingerprint, session::SessionId};

/// Key of the privacy key's fingerprint in the keyspace `facts`.
const KEY_FINGERPRINT: &str = "privacy key";

/// The keyspaces of one folder.
#[derive(Clone)]
pub(super) struct Store {
    pub(super) database: Database,
    pub(super) folder: PathBuf,
    pub(super) records: Keyspace,
    pub(super) frames: Keyspace,
    pub(super) snapshots: Keyspace,
    pub(super) cuts: Keyspace,
    pub(super) facts: Keyspace,
    pub(super) forgotten: Keyspace,
    pub(super) filler: Keyspace,
}

/// Writes that become durable together or not at all.
pub(super) struct StoreBatch<'a> {
    pub(super) store: &'a Store,
    pub(super) batch: OwnedWriteBatch,
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
        let (records, frames, snapshots) = (keyspace("records")?, keyspace("frames")?, keyspace("snapshots")?);
        let (cuts, facts) = (keyspace("cuts")?, keyspace("facts")?);
        let (forgotten, filler) = (keyspace("forgotten")?, keyspace("filler")?);
        Ok(Self { folder: folder.to_owned(), database, records, frames, snapshots, cuts, facts, forgotten, filler })
    }

    pub(super) fn batch(&self) -> StoreBatch<'_> {
        StoreBatch { store: self, batch: self.database.batch().durability(Some(PersistMode::SyncData)) }
    }

    pub(super) fn records(&self) -> Result<Vec<SessionRecord>, JournalError> {
        self.records.iter().map(|entry| record(&entry.value()?)).collect()
    }

    pub(super) fn record(&self, session: SessionId) -> Result<Option<SessionRecord>, JournalError> {
        self.records.get(session.to_key())?.map(|value| record(&value)).transpose()
    }

    pub(super) fn key_fingerprint(&self) -> Result<Option<KeyFingerprint>, JournalError> {
        let Some(bytes) = self.facts.get(KEY_FINGERPRINT)? else { return Ok(None) };
        let bytes = (*bytes).try_into().map_err(|_| JournalError::Decode {
            what: "the fingerprint of the privacy key".to_owned(),
            reason: format!("it has {} bytes", bytes.len()),
        })?;
        Ok(Some(KeyFingerprint(bytes)))
    }

    pub(super) fn cut_mark(&self, session: SessionId) -> Result<Option<Vec<u8>>, JournalError> {
        Ok(self.cuts.get(session.to_key())?.map(|value| value.to_vec()))
    }

    pub(super) fn snapshot(&self, session: SessionId) -> Result<Option<Vec<u8>>, JournalError> {
        Ok(self.snapshots.get(session.to_key())?.map(|value| value.to_vec()))
    }

    pub(super) fn frames(
        &self,
        session: SessionId,
        after: Option<Sequence>,
        last: Sequence,
    ) -> impl Iterator<Item = Result<Frame, JournalError>> + use<> {
        let first = after.map_or(0, |after| after.0.saturating_add(1));
        // A range that ends before it begins is none.
        let keys = frame_key(session, Sequence(first.min(last.0)))..=frame_key(session, last);
        let entries = self.frames.range(keys).filter(move |_| first <= last.0);
        entries.map(move |entry| {
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

    pub(super) fn put_key_fingerprint(&mut self, fingerprint: KeyFingerprint) {
        self.batch.insert(&self.store.facts, KEY_FINGERPRINT, fingerprint.0);
    }

    pub(super) fn put_record(&mut self, record: &SessionRecord) -> Result<(), JournalError> {
        let bytes = postcard::to_stdvec(record).map_err(|error| decode_error("a session's record", &error))?;
        self.batch.insert(&self.store.records, record.id.to_key(), bytes);
        Ok(())
    }

    /// Puts the snapshot and removes the frames that it covers.
    pub(super) fn put_snapshot(&mut self, session: SessionId, snapshot: Snapshot) -> Result<(), JournalError> {
        let Snapshot { covered, state, erase } = snapshot;
        let covered = frame_key(session, Sequence(0))..=frame_key(session, covered);
        for entry in self.store.frames.range(covered) {
            self.batch.remove(&self.store.frames, entry.key()?);
        }
        if erase {
            self.set_erasure_due();
        }
        self.batch.insert(&self.store.snapshots, session.to_key(), state);
        self.batch.remove(&self.store.cuts, session.to_key());
        Ok(())
    }

    pub(super) fn put_cut_mark(&mut self, session: SessionId, mark: Vec<u8>) {
        self.batch.insert(&self.store.cuts, session.to_key(), mark);
    }

    /// Removes all that the store has of a session.
    pub(super) fn remove_session(&mut self, session: SessionId) -> Result<(), JournalError> {
        for entry in self.store.frames.prefix(session.to_key()) {
            self.batch.remove(&self.store.frames, entry.key()?);
        }
        self.batch.remove(&self.store.snapshots, session.to_key());
        self.batch.remove(&self.store.cuts, session.to_key());
        self.batch.remove(&self.store.records, session.to_key());
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
