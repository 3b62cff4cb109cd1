//! Forgets drives, and makes what was deleted leave the disk.
//!
//! The embedded store is log-structured: a deleted value stays in its write-ahead logs and tables until they are written
//! anew. That happens here, by force: the logs that were there are outgrown and go, and every table is compacted.

use std::{
    collections::BTreeSet,
    fs, io,
    path::{Path, PathBuf},
    thread,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use fjall::{Keyspace, PersistMode};
use xxhash_rust::xxh3::xxh3_64;

use super::{
    Journal, JournalError,
    committer::Write,
    decode_error,
    store::{Store, StoreBatch},
};
use crate::{privacy::DrivePseudonym, session::SessionId};

/// Key in the keyspace `facts` that is there from a deletion until it has left the disk.
const ERASURE_DUE: &str = "erasure due";

/// Length of one filler; the store begins a new log where one has outgrown 64 MB.
const FILLER_BYTES: usize = 8 << 20;
/// Fillers that outgrow a log.
const FILLERS_PER_LOG: u64 = 9;
/// Pause between two looks at what the store writes in the background.
const FLUSH_PAUSE: Duration = Duration::from_millis(2);
/// Fillers after which a log must have been outgrown, many times over.
const MOST_FILLERS: u64 = 64;

/// A drive that was forgotten.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ForgottenDrive {
    /// The drive.
    pub drive: DrivePseudonym,
    /// The day, counted from 1970.
    pub day: u32,
}

/// What is to be removed, in one step.
#[derive(Debug)]
pub(super) struct Forget {
    sessions: Vec<SessionId>,
    drives: Vec<ForgottenDrive>,
    /// Forgotten drives that need not be remembered any more.
    outdated: Vec<DrivePseudonym>,
}

impl Journal {
    /// Removes all that there is of `sessions` and remembers that `drives` were forgotten, in one step; `outdated` need
    /// not be remembered any more. [`Journal::erase`] makes it leave the disk.
    ///
    /// # Errors
    /// The store failed: nothing was removed.
    pub async fn forget(
        &self,
        sessions: Vec<SessionId>,
        drives: Vec<ForgottenDrive>,
        outdated: Vec<DrivePseudonym>,
    ) -> Result<(), JournalError> {
        let forget = Forget { sessions, drives, outdated };
        self.commit(Write::Forget(forget)).await
    }

    /// Makes what was removed leave the disk, where anything was; whether it was. What was removed before a crash counts.
    ///
    /// # Errors
    /// The store failed, or has no room to be written anew: it is still to be done.
    pub async fn erase(&self) -> Result<bool, JournalError> {
        let store = self.store.get()?;
        let Some(since) = store.erasure_due()? else { return Ok(false) };
        let erasing = tokio::task::spawn_blocking(move || store.erase_deleted());
        erasing.await.map_err(|error| JournalError::Store(format!("erasing: {error}")))??;
        self.commit(Write::Erased { since }).await?;
        Ok(true)
    }

    /// The drives that were forgotten.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn forgotten(&self) -> Result<Vec<ForgottenDrive>, JournalError> {
        let decode = |entry: fjall::Guard| {
            let (key, value) = entry.into_inner()?;
            let decoded = postcard::from_bytes(&key).and_then(|drive| Ok((drive, postcard::from_bytes(&value)?)));
            let (drive, day) = decoded.map_err(|error| decode_error("a forgotten drive", &error))?;
            Ok(ForgottenDrive { drive, day })
        };
        self.store.get()?.forgotten.iter().map(decode).collect()
    }
}

impl StoreBatch<'_> {
    pub(super) fn forget(&mut self, forget: &Forget) -> Result<(), JournalError> {
        for session in &forget.sessions {
            self.remove_session(*session)?;
        }
        let encode_error = |error| decode_error("a forgotten drive", &error);
        for ForgottenDrive { drive, day } in &forget.drives {
            let (key, value) = (postcard::to_stdvec(drive), postcard::to_stdvec(day));
            self.batch.insert(&self.store.forgotten, key.map_err(encode_error)?, value.map_err(encode_error)?);
        }
        for drive in &forget.outdated {
            self.batch.remove(&self.store.forgotten, postcard::to_stdvec(drive).map_err(encode_error)?);
        }
        self.set_erasure_due();
        Ok(())
    }

    /// What this batch removes must leave the disk, even after a crash.
    pub(super) fn set_erasure_due(&mut self) {
        // Any value that it did not have before.
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.batch.insert(&self.store.facts, ERASURE_DUE, since_epoch.as_nanos().to_le_bytes());
    }

    /// What was removed up to `since` has left the disk.
    pub(super) fn erased(&mut self, since: &[u8]) -> Result<(), JournalError> {
        if self.store.erasure_due()?.as_deref() == Some(since) {
            self.batch.remove(&self.store.facts, ERASURE_DUE);
        }
        Ok(())
    }
}

impl Store {
    /// Since when something that was removed is to leave the disk.
    fn erasure_due(&self) -> Result<Option<Vec<u8>>, JournalError> {
        Ok(self.facts.get(ERASURE_DUE)?.map(|since| since.to_vec()))
    }

    /// Writes all logs and tables anew without what was deleted. Other writes may go on meanwhile. Takes a second, and
    /// as long as it takes to write every table.
    pub(super) fn erase_deleted(&self) -> Result<(), JournalError> {
        self.outgrow_logs()?;
        for keyspace in self.keyspaces() {
            keyspace.major_compact()?;
        }
        // Tables that were compacted away are kept for readers of the past, until something new is written.
        self.settle()
    }

    /// Fills the log until every log that is there now has been replaced and removed.
    fn outgrow_logs(&self) -> Result<(), JournalError> {
        let before = logs(&self.folder)?;
        // What is in memory holds the log in which it was written.
        self.settle()?;
        for number in 0..MOST_FILLERS {
            self.filler.insert("filler", filler(number))?;
            self.flush(&self.filler)?;
            if number % FILLERS_PER_LOG == FILLERS_PER_LOG - 1 {
                self.settle()?;
            }
            if logs(&self.folder)?.is_disjoint(&before) {
                self.filler.clear()?;
                return Ok(());
            }
        }
        Err(JournalError::Store("its logs do not give way to new ones".to_owned()))
    }

    /// Writes what is in memory to tables, and something new in every keyspace.
    fn settle(&self) -> Result<(), JournalError> {
        for keyspace in self.keyspaces().chain([&self.filler]) {
            // A log goes when each keyspace has a table that is younger. One whose entries were all deleted may have been
            // compacted to no table at all, and would hold its logs for ever. What is removed here never was.
            keyspace.remove("settled")?;
            self.flush(keyspace)?;
        }
        Ok(())
    }

    /// Writes what a keyspace has in memory to tables, and waits for it.
    fn flush(&self, keyspace: &Keyspace) -> Result<(), JournalError> {
        keyspace.rotate_memtable()?;
        while keyspace.sealed_memtable_count() > 0 {
            // Fails where the store's own threads have: on a full disk they would be waited for for ever.
            self.database.persist(PersistMode::Buffer)?;
            thread::sleep(FLUSH_PAUSE);
        }
        Ok(())
    }

    fn keyspaces(&self) -> impl Iterator<Item = &Keyspace> {
        [&self.records, &self.frames, &self.snapshots, &self.summaries, &self.cuts, &self.facts, &self.forgotten]
            .into_iter()
            .chain(self.map_keyspaces())
    }
}

fn logs(folder: &Path) -> Result<BTreeSet<PathBuf>, JournalError> {
    let read = || -> io::Result<BTreeSet<PathBuf>> {
        let files = fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
        Ok(files.into_iter().filter(|path| path.extension().is_some_and(|extension| extension == "jnl")).collect())
    };
    read().map_err(|error| JournalError::Store(format!("its folder: {error}")))
}

/// Bytes that no compression makes shorter.
fn filler(number: u64) -> Vec<u8> {
    let words = (0..FILLER_BYTES as u64 / 8).map(|word| xxh3_64(&(number << 32 | word).to_le_bytes()));
    words.flat_map(u64::to_le_bytes).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        journal::{JournalFrame, Snapshot},
        session::SessionId,
    };
    use lanemap_core::Sequence;

    /// Whether a file below `folder` holds `pattern`.
    fn holds(folder: &Path, pattern: &[u8]) -> bool {
        fs::read_dir(folder).unwrap().any(|entry| {
            let path = entry.unwrap().path();
            if path.is_dir() {
                return holds(&path, pattern);
            }
            fs::read(path).unwrap().windows(pattern.len()).any(|window| window == pattern)
        })
    }

    #[test]
    fn what_was_deleted_is_on_no_disk_afterwards_and_what_was_not_is() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let (gone, kept) = (SessionId::next(None, 0, 1), SessionId::next(None, 0, 2));
        let (gone_bytes, kept_bytes) = (b"to be forgotten".to_vec(), b"to be kept, too".to_vec());
        let mut batch = store.batch();
        for (session, bytes) in [(gone, &gone_bytes), (kept, &kept_bytes)] {
            batch.put_frame(session, JournalFrame { sequence: Sequence(1), bytes: bytes.clone() });
            let (state, summary) = (bytes.clone(), bytes.clone());
            let snapshot = Snapshot { covered_before: None, covered: Sequence(0), state, summary, erase: false };
            batch.put_snapshot(session, snapshot).unwrap();
        }
        batch.commit().unwrap();
        store.settle().unwrap();
        assert!(holds(folder.path(), &gone_bytes) && holds(folder.path(), &kept_bytes));

        let mut batch = store.batch();
        batch.remove_session(gone).unwrap();
        batch.commit().unwrap();
        store.erase_deleted().unwrap();
        assert!(!holds(folder.path(), &gone_bytes));
        assert!(holds(folder.path(), &kept_bytes));
        assert_eq!(store.snapshot(kept).unwrap(), Some(kept_bytes));
    }
}
