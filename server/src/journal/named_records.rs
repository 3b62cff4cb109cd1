//! Stores of earlier builds, whose records hold the names of fleets, vehicles and drives.
//!
//! They stand in a keyspace of their own, `sessions`. It is read once, its records are written anew with pseudonyms, and
//! then it is removed.

use fjall::KeyspaceCreateOptions;
use serde::Deserialize;

use super::{
    JournalError, SessionKey, SessionRecord, SessionSetup, decode_error,
    store::{Store, StoreBatch},
};
use crate::{
    privacy::{Pseudonyms, TripCut},
    session::SessionId,
};

/// The keyspace of such records.
const NAMED: &str = "sessions";

/// A record as earlier builds wrote it.
#[derive(Deserialize)]
struct NamedRecord {
    id: SessionId,
    key: NamedKey,
    setup: SessionSetup,
    ended: bool,
}

#[derive(Deserialize)]
struct NamedKey {
    fleet: String,
    vehicle: String,
    drive: String,
}

/// Commits `batch`, and with it every record that holds names, renamed; then removes the names.
///
/// A crash between leaves the store as it was before, or with both: the batch is what says that it was done.
pub(super) fn rename(store: &Store, mut batch: StoreBatch<'_>, pseudonyms: &Pseudonyms) -> Result<(), JournalError> {
    if !store.database.keyspace_exists(NAMED) {
        return batch.commit();
    }
    let named = store.database.keyspace(NAMED, KeyspaceCreateOptions::default)?;
    let mut renamed = 0;
    for entry in named.iter() {
        let record =
            postcard::from_bytes(&entry.value()?).map_err(|error| decode_error("a session's record", &error))?;
        batch.put_record(&with_pseudonyms(record, pseudonyms))?;
        renamed += 1;
    }
    batch.set_erasure_due();
    batch.commit()?;
    store.database.delete_keyspace(named)?;
    tracing::info!(drives = renamed, "the store's drives have pseudonyms now");
    Ok(())
}

fn with_pseudonyms(record: NamedRecord, pseudonyms: &Pseudonyms) -> SessionRecord {
    let NamedRecord { id, key: NamedKey { fleet, vehicle, drive }, setup, ended } = record;
    let vehicle_pseudonym = pseudonyms.vehicle(&fleet, &vehicle);
    let drive = pseudonyms.drive(&SessionKey { fleet, vehicle, drive });
    SessionRecord { id, drive, vehicle: vehicle_pseudonym, setup, cut: TripCut::default(), ended }
}

#[cfg(test)]
mod tests {
    use fjall::{Database, PersistMode};
    use lanemap_core::{Preset, Sensor};

    use super::*;
    use crate::journal::{Journal, JournalOptions};

    /// A store as earlier builds left it: one record, as they laid it out.
    fn named_store(folder: &std::path::Path, id: SessionId, setup: &SessionSetup) {
        let database = Database::builder(folder).open().unwrap();
        let named = database.keyspace(NAMED, KeyspaceCreateOptions::default).unwrap();
        let record = postcard::to_stdvec(&(id, ("fleet-7", "vehicle-8", "drive-9"), setup, true)).unwrap();
        named.insert(id.to_key(), record).unwrap();
        database.persist(PersistMode::SyncAll).unwrap();
    }

    #[tokio::test]
    async fn the_drives_of_an_earlier_store_are_found_by_their_names_which_are_no_longer_in_it() {
        let folder = tempfile::tempdir().unwrap();
        let id = SessionId::next(None, 0, 1);
        let setup = SessionSetup { preset: Preset::Paper, sensor: Sensor::default() };
        named_store(folder.path(), id, &setup);
        let pseudonyms = Pseudonyms::open(&folder.path().join("privacy.key"), None).unwrap();
        let key = SessionKey { fleet: "fleet-7".into(), vehicle: "vehicle-8".into(), drive: "drive-9".into() };
        let vehicle = pseudonyms.vehicle("fleet-7", "vehicle-8");
        let expected =
            SessionRecord { id, drive: pseudonyms.drive(&key), vehicle, setup, cut: TripCut::default(), ended: true };

        for _ in 0..2 {
            let (journal, thread) = Journal::open(&JournalOptions::new(folder.path())).unwrap();
            if journal.key_fingerprint().unwrap().is_none() {
                journal.adopt_key(&pseudonyms).unwrap();
            }
            assert_eq!(journal.records().unwrap(), std::slice::from_ref(&expected));
            assert!(!journal.store.get().unwrap().database.keyspace_exists(NAMED));
            drop(journal);
            thread.join().await;
        }
    }
}
