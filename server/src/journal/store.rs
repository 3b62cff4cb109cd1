//! Layout of the embedded store.
//!
//! | keyspace    | key                                          | value                       |
//! |-------------|----------------------------------------------|-----------------------------|
//! | `records`   | id, 8 bytes big-endian                       | record, postcard            |
//! | `frames`    | id, then sequence, 8 bytes big-endian each   | `Frame::to_bytes`           |
//! | `snapshots` | id                                           | the session's own bytes     |
//! | `cuts`      | id                                           | how far the drive has come where its frames are cut |
//! | `summaries` | id                                           | the session's own bytes     |
//! | `facts`     | `privacy key`                                | the key's fingerprint       |
//! |             | `erasure due`                                | none: what was removed is still on the disk |
//! | `forgotten` | pseudonym of a drive that was deleted        | day of it                   |
//! | `filler`    |                                              | see [`super::erasure`]      |
//!
//! Beside them stand those of the shared map: see [`super::cells`].
//!
//! No name of a fleet, a vehicle or a drive stands in any of them.

use std::{
    collections::HashMap,
    ops::RangeInclusive,
    path::{Path, PathBuf},
    sync::{Arc, PoisonError, RwLock},
    thread,
    time::Duration,
};

use fjall::{Database, Keyspace, KeyspaceCreateOptions, OwnedWriteBatch, PersistMode};
use lanemap_core::{Frame, Sequence};

use super::{JournalError, JournalFrame, SessionRecord, Snapshot, decode_error};
use crate::{privacy::pseudonym::KeyFingerprint, session::SessionId};

/// Key of the privacy key's fingerprint in the keyspace `facts`.
const KEY_FINGERPRINT: &str = "privacy key";

/// Most bytes of write-ahead log, which a start reads again: it bounds the time of a recovery.
const MAX_LOG_BYTES: u64 = 128 * 1024 * 1024;
/// Bytes of frames and of snapshots that wait in memory to be written as tables.
const MAX_MEMTABLE_BYTES: u64 = 32 * 1024 * 1024;
/// Bytes of records, of summaries and the like that wait in memory, of which there are few.
const MAX_SMALL_MEMTABLE_BYTES: u64 = 4 * 1024 * 1024;
/// Bytes of tables kept in memory for reading.
const CACHE_BYTES: u64 = 16 * 1024 * 1024;
/// Pause while somebody still reads what is to be closed.
const CLOSING_PAUSE: Duration = Duration::from_millis(5);

/// The keyspaces of one folder.
pub(super) struct Store {
    pub(super) database: Database,
    pub(super) folder: PathBuf,
    pub(super) records: Keyspace,
    pub(super) frames: Keyspace,
    pub(super) snapshots: Keyspace,
    pub(super) cuts: Keyspace,
    pub(super) summaries: Keyspace,
    pub(super) facts: Keyspace,
    pub(super) forgotten: Keyspace,
    pub(super) filler: Keyspace,
    pub(super) contributions: Keyspace,
    pub(super) contribution_facts: Keyspace,
    pub(super) contributed: Keyspace,
    pub(super) cells: Keyspace,
    pub(super) cell_lines: Keyspace,
    pub(super) cell_versions: Keyspace,
    pub(super) cell_purges: Keyspace,
    pub(super) publications: Keyspace,
    pub(super) cell_events: Keyspace,
    pub(super) own_frames: Keyspace,
    pub(super) sought: Keyspace,
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
        let database = Database::builder(folder).max_journaling_size(MAX_LOG_BYTES).cache_size(CACHE_BYTES).open()?;
        let keyspace = |name, max_memtable_bytes| {
            database.keyspace(name, || KeyspaceCreateOptions::default().max_memtable_size(max_memtable_bytes))
        };
        Ok(Self {
            records: keyspace("records", MAX_SMALL_MEMTABLE_BYTES)?,
            frames: keyspace("frames", MAX_MEMTABLE_BYTES)?,
            snapshots: keyspace("snapshots", MAX_MEMTABLE_BYTES)?,
            summaries: keyspace("summaries", MAX_SMALL_MEMTABLE_BYTES)?,
            cuts: keyspace("cuts", MAX_SMALL_MEMTABLE_BYTES)?,
            facts: keyspace("facts", MAX_SMALL_MEMTABLE_BYTES)?,
            forgotten: keyspace("forgotten", MAX_SMALL_MEMTABLE_BYTES)?,
            filler: keyspace("filler", MAX_MEMTABLE_BYTES)?,
            contributions: keyspace("contributions", MAX_MEMTABLE_BYTES)?,
            contribution_facts: keyspace("contribution_facts", MAX_SMALL_MEMTABLE_BYTES)?,
            contributed: keyspace("contributed", MAX_SMALL_MEMTABLE_BYTES)?,
            cells: keyspace("cells", MAX_SMALL_MEMTABLE_BYTES)?,
            cell_lines: keyspace("cell_lines", MAX_MEMTABLE_BYTES)?,
            cell_versions: keyspace("cell_versions", MAX_MEMTABLE_BYTES)?,
            cell_purges: keyspace("cell_purges", MAX_SMALL_MEMTABLE_BYTES)?,
            publications: keyspace("publications", MAX_SMALL_MEMTABLE_BYTES)?,
            cell_events: keyspace("cell_events", MAX_SMALL_MEMTABLE_BYTES)?,
            own_frames: keyspace("own_frames", MAX_MEMTABLE_BYTES)?,
            sought: keyspace("sought", MAX_SMALL_MEMTABLE_BYTES)?,
            folder: folder.to_owned(),
            database,
        })
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

    pub(super) fn summaries(&self) -> Result<HashMap<SessionId, Vec<u8>>, JournalError> {
        let entry = |entry: fjall::Guard| {
            let (key, value) = entry.into_inner()?;
            let key = (*key).try_into().map_err(|_| JournalError::Decode {
                what: "a summary's key".to_owned(),
                reason: format!("it has {} bytes", key.len()),
            })?;
            Ok((SessionId::from_key(key), value.to_vec()))
        };
        self.summaries.iter().map(entry).collect()
    }

    pub(super) fn has_frames_after(&self, session: SessionId, covered: Option<Sequence>) -> Result<bool, JournalError> {
        let first = self.frames_between(session, covered, Sequence(u64::MAX)).next();
        Ok(first.map(fjall::Guard::key).transpose()?.is_some())
    }

    fn frames_between(
        &self,
        session: SessionId,
        after: Option<Sequence>,
        last: Sequence,
    ) -> impl DoubleEndedIterator<Item = fjall::Guard> + use<> {
        frame_keys(session, after, last).map(|keys| self.frames.range(keys)).into_iter().flatten()
    }

    pub(super) fn last_frames(
        &self,
        session: SessionId,
        after: Option<Sequence>,
        most: usize,
    ) -> Result<Vec<JournalFrame>, JournalError> {
        let entries = self.frames_between(session, after, Sequence(u64::MAX)).rev().take(most);
        let mut frames = entries.map(journal_frame).collect::<Result<Vec<_>, _>>()?;
        frames.reverse();
        Ok(frames)
    }

    /// Bytes on the disk, the preallocated part of the log included.
    pub(super) fn disk_bytes(&self) -> Result<u64, JournalError> {
        Ok(self.database.disk_space()?)
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

    /// Puts the record of a drive that is over, and what is told of it.
    pub(super) fn put_ended(&mut self, record: &SessionRecord, summary: Vec<u8>) -> Result<(), JournalError> {
        self.batch.insert(&self.store.summaries, record.id.to_key(), summary);
        self.put_record(record)
    }

    /// Puts the snapshot and removes the frames that it covers.
    pub(super) fn put_snapshot(&mut self, session: SessionId, snapshot: Snapshot) -> Result<(), JournalError> {
        let Snapshot { covered_before, covered, state, summary, erase } = snapshot;
        for entry in self.store.frames_between(session, covered_before, covered) {
            self.batch.remove(&self.store.frames, entry.key()?);
        }
        if erase {
            self.set_erasure_due();
        }
        self.batch.insert(&self.store.snapshots, session.to_key(), state);
        self.batch.insert(&self.store.summaries, session.to_key(), summary);
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
        self.batch.remove(&self.store.summaries, session.to_key());
        self.batch.remove(&self.store.records, session.to_key());
        self.remove_contributions(session)
    }

    /// Makes everything in the batch durable.
    pub(super) fn commit(self) -> Result<(), JournalError> {
        Ok(self.batch.commit()?)
    }
}

/// The store of a folder, which may be closed and opened again while others hold this. Clones share it.
#[derive(Clone, Debug)]
pub(super) struct Reopenable {
    folder: PathBuf,
    current: Arc<RwLock<Option<Arc<Store>>>>,
}

impl Reopenable {
    pub(super) fn open(folder: &Path) -> Result<Self, JournalError> {
        let store = Store::open(folder)?;
        Ok(Self { folder: folder.to_owned(), current: Arc::new(RwLock::new(Some(Arc::new(store)))) })
    }

    /// The store, for the length of one read or write; waits while it is opened anew.
    pub(super) fn get(&self) -> Result<Arc<Store>, JournalError> {
        let current = self.current.read().unwrap_or_else(PoisonError::into_inner);
        current.clone().ok_or_else(|| JournalError::Store("it could not be opened anew yet".to_owned()))
    }

    /// Closes the store once nobody reads it, and opens it again from what is on the disk.
    pub(super) fn reopen(&self) -> Result<(), JournalError> {
        let mut current = self.current.write().unwrap_or_else(PoisonError::into_inner);
        if let Some(store) = current.take() {
            close(store);
        }
        *current = Some(Arc::new(Store::open(&self.folder)?));
        Ok(())
    }

    /// The frames of a session after `after` up to `last`, inclusive, in the order of their sequence.
    pub(super) fn frames(
        &self,
        session: SessionId,
        after: Option<Sequence>,
        last: Sequence,
    ) -> Result<impl Iterator<Item = Result<Frame, JournalError>> + use<>, JournalError> {
        let store = self.get()?;
        let entries = store.frames_between(session, after, last);
        Ok(entries.map(move |entry| {
            // The store stays open as long as its frames are read.
            let _held = &store;
            let value = entry.value()?;
            let what = || format!("a frame of session {session}");
            Frame::from_bytes(&value).map_err(|error| decode_error(&what(), &error))
        }))
    }
}

fn close(mut store: Arc<Store>) {
    loop {
        match Arc::try_unwrap(store) {
            Ok(last) => return drop(last),
            Err(shared) => store = shared,
        }
        thread::sleep(CLOSING_PAUSE);
    }
}

fn record(bytes: &[u8]) -> Result<SessionRecord, JournalError> {
    postcard::from_bytes(bytes).map_err(|error| decode_error("a session's record", &error))
}

fn journal_frame(entry: fjall::Guard) -> Result<JournalFrame, JournalError> {
    let (key, value) = entry.into_inner()?;
    let sequence = key.last_chunk().map(|sequence| Sequence(u64::from_be_bytes(*sequence)));
    let sequence = sequence.ok_or_else(|| JournalError::Decode {
        what: "a frame's key".to_owned(),
        reason: format!("it has {} bytes", key.len()),
    })?;
    Ok(JournalFrame { sequence, bytes: value.to_vec() })
}

fn frame_key(session: SessionId, sequence: Sequence) -> [u8; 16] {
    let mut key = [0; 16];
    key[..8].copy_from_slice(&session.to_key());
    key[8..].copy_from_slice(&sequence.0.to_be_bytes());
    key
}

/// Keys of the frames after `after`, up to `last` inclusive; `None` where there are none between.
fn frame_keys(session: SessionId, after: Option<Sequence>, last: Sequence) -> Option<RangeInclusive<[u8; 16]>> {
    let first = after.map_or(0, |after| after.0.saturating_add(1));
    (first <= last.0).then(|| frame_key(session, Sequence(first))..=frame_key(session, last))
}
