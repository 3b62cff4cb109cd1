//! What the store keeps of the shared map: contributions of drives to cells, and the cells' versions.
//!
//! | keyspace            | key                                    | value                                      |
//! |---------------------|----------------------------------------|--------------------------------------------|
//! | `contributions`     | cell, then session, 8 bytes each       | what a drive says of a cell, postcard      |
//! | `contribution_facts`| the same                               | [`ContributionFact`], postcard             |
//! | `contributed`       | session                                | [`Contributed`], postcard                  |
//! | `cells`             | cell                                   | its version, 8 bytes, and what is told of it |
//! | `cell_lines`        | cell                                   | its lines as fused, the fuser's own        |
//! | `cell_versions`     | cell, then version, 8 bytes big-endian | when it was published, then its bytes      |
//! | `cell_purges`       | cell                                   | none: a drive in it was deleted            |
//! | `publications`      | revision, 8 bytes big-endian           | which version of which cell, postcard      |
//! | `cell_events`       | cell, then number, 8 bytes big-endian  | what happened in it, postcard              |
//! | `own_frames`        | session without GNSS                   | all that it says, in its own frame, postcard |
//! | `sought`            | session without GNSS                   | what came of the search for it, postcard   |
//!
//! Contributions are written without waiting for the disk: whatever a crash takes of them, the drives' snapshots and
//! frames give again. Versions are on the disk before anybody reads them, so that none is ever given twice.

use std::collections::BTreeMap;

use fjall::PersistMode;
use lanemap_core::{
    TimestampNs,
    fleet::{CellId, Contribution, DriveId},
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use tokio::sync::watch;

use super::{
    Journal, JournalError, JournalHealth, decode_error,
    store::{Reopenable, Store, StoreBatch},
};
use crate::session::{MapVersion, SessionId};

/// Key in the keyspace `facts`: the form in which contributions are kept.
const MAP_FORMAT: &str = "map format";

/// A contribution on its way into the store.
#[derive(Clone, Debug)]
pub(crate) struct StoredContribution {
    pub(crate) cell: CellId,
    pub(crate) fact: ContributionFact,
    /// The contribution, postcard.
    pub(crate) bytes: Vec<u8>,
}

/// What is known of a contribution without reading it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct ContributionFact {
    /// Start of the drive.
    pub(crate) started: TimestampNs,
    /// The drive.
    pub(crate) drive: DriveId,
    /// Hash of the contribution's bytes.
    pub(crate) digest: u64,
}

/// How much of a session has been contributed.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Contributed {
    /// The version of its map.
    pub(crate) version: MapVersion,
    /// The cells that it touches, in their order.
    pub(crate) cells: Vec<CellId>,
}

/// A version of a cell on its way into the store.
#[derive(Clone, Debug)]
pub(crate) struct NewVersion {
    pub(crate) version: u64,
    /// Milliseconds since the Unix epoch.
    pub(crate) published_ms: u64,
    pub(crate) bytes: Vec<u8>,
    /// The revision that it gives the map.
    pub(crate) revision: u64,
    /// What is told of its publication.
    pub(crate) publication: Vec<u8>,
}

/// How a fused cell is written.
#[derive(Clone, Debug)]
pub(crate) struct CellWrite {
    pub(crate) cell: CellId,
    /// Its newest version.
    pub(crate) newest: u64,
    /// What is told of it.
    pub(crate) told: Vec<u8>,
    /// Its lines as fused; `None` where they stay.
    pub(crate) lines: Option<Vec<u8>>,
    /// `None` where its map stays.
    pub(crate) version: Option<NewVersion>,
    /// Versions that are no longer kept.
    pub(crate) outdated: Vec<u64>,
    /// Revisions whose publications are no longer kept.
    pub(crate) outdated_revisions: Vec<u64>,
    /// Events that are no longer kept, by their numbers.
    pub(crate) outdated_events: Vec<u64>,
    /// Events that are new or differ, by their numbers.
    pub(crate) events: Vec<(u64, Vec<u8>)>,
    /// Contributions that are no longer kept.
    pub(crate) dropped: Vec<SessionId>,
    /// What of a deleted drive was in the versions before goes with them.
    pub(crate) purged: bool,
}

/// What becomes of what is kept of a drive without GNSS.
#[derive(Clone, Debug)]
pub(crate) enum OwnFrame {
    /// There is none, or it stays.
    Stays,
    /// The drive has a place on the earth now.
    Goes,
    /// It is new, in part.
    Put {
        /// All that the drive says, postcard; `None` where that stays.
        contribution: Option<Vec<u8>>,
        /// What came of the search for it, postcard; `None` where that stays.
        sought: Option<Vec<u8>>,
    },
}

/// The contributions to one cell, by session.
pub(crate) type Facts = BTreeMap<SessionId, ContributionFact>;

/// The part of the store that holds the shared map. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct CellStore {
    store: Reopenable,
    health: watch::Receiver<JournalHealth>,
}

impl Journal {
    /// The part of the store that holds the shared map.
    pub(crate) fn cells(&self) -> CellStore {
        CellStore { store: self.store.clone(), health: self.health.clone() }
    }
}

impl CellStore {
    /// Makes sure that contributions have the form of this build: those of another are removed, to be given again.
    pub(crate) fn adopt_format(&self, format: u16) -> Result<(), JournalError> {
        let store = self.store.get()?;
        if store.facts.get(MAP_FORMAT)?.as_deref() == Some(&format.to_be_bytes()) {
            return Ok(());
        }
        let keyspaces = [&store.contributions, &store.contribution_facts, &store.contributed];
        for keyspace in keyspaces.into_iter().chain([&store.own_frames, &store.sought]) {
            keyspace.clear()?;
        }
        Ok(store.facts.insert(MAP_FORMAT, format.to_be_bytes())?)
    }

    /// Version of every cell, and what is told of it, where it has the form of this build.
    pub(crate) fn told<T: DeserializeOwned>(&self) -> Result<BTreeMap<CellId, (u64, Option<T>)>, JournalError> {
        self.store
            .get()?
            .cells
            .iter()
            .map(|entry| {
                let (key, value) = entry.into_inner()?;
                let (version, told) = value.split_at_checked(8).unwrap_or_default();
                Ok((cell_of(&key)?, (number(Some(version))?, postcard::from_bytes(told).ok())))
            })
            .collect()
    }

    /// What was contributed, by cell.
    pub(crate) fn facts(&self) -> Result<BTreeMap<CellId, Facts>, JournalError> {
        let mut cells: BTreeMap<CellId, Facts> = BTreeMap::new();
        for entry in self.store.get()?.contribution_facts.iter() {
            let (key, value) = entry.into_inner()?;
            let (cell, session) = (cell_of(&key)?, session_of(key.get(8..).unwrap_or_default())?);
            cells.entry(cell).or_default().insert(session, decoded("a contribution's fact", &value)?);
        }
        Ok(cells)
    }

    /// What was contributed to one cell.
    pub(crate) fn facts_of(&self, cell: CellId) -> Result<Facts, JournalError> {
        self.store
            .get()?
            .contribution_facts
            .prefix(cell.to_key())
            .map(|entry| {
                let (key, value) = entry.into_inner()?;
                Ok((session_of(key.get(8..).unwrap_or_default())?, decoded("a contribution's fact", &value)?))
            })
            .collect()
    }

    /// One contribution.
    pub(crate) fn contribution(&self, cell: CellId, session: SessionId) -> Result<Option<Contribution>, JournalError> {
        let bytes = self.store.get()?.contributions.get(pair(cell, session))?;
        bytes.map(|bytes| decoded("a contribution", &bytes)).transpose()
    }

    /// How much of every session has been contributed.
    pub(crate) fn contributed(&self) -> Result<BTreeMap<SessionId, Contributed>, JournalError> {
        self.store
            .get()?
            .contributed
            .iter()
            .map(|entry| {
                let (key, value) = entry.into_inner()?;
                Ok((session_of(&key)?, decoded("how much was contributed", &value)?))
            })
            .collect()
    }

    /// How much of one session has been contributed.
    pub(crate) fn contributed_of(&self, session: SessionId) -> Result<Contributed, JournalError> {
        let bytes = self.store.get()?.contributed.get(session.to_key())?;
        bytes.map_or_else(|| Ok(Contributed::default()), |bytes| decoded("how much was contributed", &bytes))
    }

    /// What came of the search for every drive without GNSS; `None` of one that is to be sought.
    pub(crate) fn sought<T: DeserializeOwned>(&self) -> Result<Vec<(SessionId, Option<T>)>, JournalError> {
        let store = self.store.get()?;
        let sessions = store.own_frames.iter().map(|entry| session_of(&entry.key()?));
        sessions
            .map(|session| {
                let session = session?;
                let bytes = store.sought.get(session.to_key())?;
                Ok((session, bytes.and_then(|bytes| postcard::from_bytes(&bytes).ok())))
            })
            .collect()
    }

    /// All that a drive without GNSS says, in its own frame.
    pub(crate) fn own_frame(&self, session: SessionId) -> Result<Option<Contribution>, JournalError> {
        let bytes = self.store.get()?.own_frames.get(session.to_key())?;
        bytes.map(|bytes| decoded("a drive in its own frame", &bytes)).transpose()
    }

    /// The cells of which a drive was deleted since they were fused.
    pub(crate) fn purges(&self) -> Result<Vec<CellId>, JournalError> {
        self.store.get()?.cell_purges.iter().map(|entry| cell_of(&entry.key()?)).collect()
    }

    /// A cell's lines as they were fused.
    pub(crate) fn lines<T: DeserializeOwned + Default>(&self, cell: CellId) -> Result<T, JournalError> {
        let bytes = self.store.get()?.cell_lines.get(cell.to_key())?;
        bytes.map_or_else(|| Ok(T::default()), |bytes| decoded("a cell's lines", &bytes))
    }

    /// The bytes of one version of a cell, where they are kept.
    pub(crate) fn version(&self, cell: CellId, version: u64) -> Result<Option<Vec<u8>>, JournalError> {
        let value = self.store.get()?.cell_versions.get(versioned(cell, version))?;
        Ok(value.and_then(|value| Some(value.get(8..)?.to_vec())))
    }

    /// Whether a version of a cell is kept.
    pub(crate) fn has_version(&self, cell: CellId, version: u64) -> Result<bool, JournalError> {
        Ok(self.store.get()?.cell_versions.contains_key(versioned(cell, version))?)
    }

    /// The versions of a cell that are kept, the oldest first, and when each was published, milliseconds since the epoch.
    pub(crate) fn versions(&self, cell: CellId) -> Result<Vec<(u64, u64)>, JournalError> {
        self.store
            .get()?
            .cell_versions
            .prefix(cell.to_key())
            .map(|entry| {
                let (key, value) = entry.into_inner()?;
                Ok((number(key.get(8..))?, number(value.get(..8))?))
            })
            .collect()
    }

    /// The events of a cell, in the order of their numbers.
    pub(crate) fn events<T: DeserializeOwned>(&self, cell: CellId) -> Result<Vec<T>, JournalError> {
        let entries = self.store.get()?.cell_events.prefix(cell.to_key());
        entries.map(|entry| decoded("an event", &entry.value()?)).collect()
    }

    /// What is told of the publications that are kept, in the order of their revisions.
    pub(crate) fn publications<T: DeserializeOwned>(&self) -> Result<Vec<T>, JournalError> {
        let entries = self.store.get()?.publications.iter();
        entries.map(|entry| decoded("a publication", &entry.value()?)).collect()
    }

    /// Writes publications by their revisions; they are on the disk when this returns.
    pub(crate) fn put_publications(&self, told: Vec<(u64, Vec<u8>)>) -> Result<(), JournalError> {
        let store = self.store.get()?;
        let mut batch = store.batch();
        for (revision, told) in told {
            batch.batch.insert(&store.publications, revision.to_be_bytes(), told);
        }
        batch.commit()
    }

    /// Writes what a session says of cells, in the place of what it said before, and removes what it says of others.
    pub(crate) fn contribute(
        &self,
        session: SessionId,
        contributed: &Contributed,
        changed: Vec<StoredContribution>,
        left: &[CellId],
        own_frame: OwnFrame,
    ) -> Result<(), JournalError> {
        self.health.borrow().check()?;
        let store = self.store.get()?;
        let mut batch = store.database.batch().durability(Some(PersistMode::Buffer));
        for StoredContribution { cell, fact, bytes } in changed {
            batch.insert(&store.contributions, pair(cell, session), bytes);
            batch.insert(&store.contribution_facts, pair(cell, session), encoded("a contribution's fact", &fact)?);
        }
        for cell in left {
            batch.remove(&store.contributions, pair(*cell, session));
            batch.remove(&store.contribution_facts, pair(*cell, session));
        }
        batch.insert(&store.contributed, session.to_key(), encoded("how much was contributed", contributed)?);
        match own_frame {
            OwnFrame::Put { contribution, sought } => {
                for (keyspace, bytes) in [(&store.own_frames, contribution), (&store.sought, sought)] {
                    if let Some(bytes) = bytes {
                        batch.insert(keyspace, session.to_key(), bytes);
                    }
                }
            }
            OwnFrame::Stays => {}
            OwnFrame::Goes => {
                batch.remove(&store.own_frames, session.to_key());
                batch.remove(&store.sought, session.to_key());
            }
        }
        Ok(batch.commit()?)
    }

    /// Writes a fused cell; it is on the disk when this returns.
    pub(crate) fn put_cell(&self, write: CellWrite) -> Result<(), JournalError> {
        self.health.borrow().check()?;
        let store = self.store.get()?;
        let mut batch = store.batch();
        batch.put_cell(write);
        batch.commit()
    }
}

impl StoreBatch<'_> {
    fn put_cell(&mut self, write: CellWrite) {
        let cell = write.cell;
        let told = [write.newest.to_be_bytes().as_slice(), &write.told].concat();
        self.batch.insert(&self.store.cells, cell.to_key(), told);
        if let Some(lines) = write.lines {
            self.batch.insert(&self.store.cell_lines, cell.to_key(), lines);
        }
        if let Some(NewVersion { version, published_ms, bytes, revision, publication }) = write.version {
            let value = [published_ms.to_be_bytes().as_slice(), &bytes].concat();
            self.batch.insert(&self.store.cell_versions, versioned(cell, version), value);
            self.batch.insert(&self.store.publications, revision.to_be_bytes(), publication);
        }
        for revision in write.outdated_revisions {
            self.batch.remove(&self.store.publications, revision.to_be_bytes());
        }
        for version in write.outdated {
            self.batch.remove(&self.store.cell_versions, versioned(cell, version));
        }
        for number in write.outdated_events {
            self.batch.remove(&self.store.cell_events, versioned(cell, number));
        }
        for (number, event) in write.events {
            self.batch.insert(&self.store.cell_events, versioned(cell, number), event);
        }
        for session in write.dropped {
            self.batch.remove(&self.store.contributions, pair(cell, session));
            self.batch.remove(&self.store.contribution_facts, pair(cell, session));
        }
        if write.purged {
            self.batch.remove(&self.store.cell_purges, cell.to_key());
            self.set_erasure_due();
        }
    }

    /// Removes what a session contributed; the cells that it touched are to be fused again, without their past.
    pub(super) fn remove_contributions(&mut self, session: SessionId) -> Result<(), JournalError> {
        let Some(bytes) = self.store.contributed.get(session.to_key())? else { return Ok(()) };
        let contributed: Contributed = decoded("how much was contributed", &bytes)?;
        for cell in &contributed.cells {
            self.batch.remove(&self.store.contributions, pair(*cell, session));
            self.batch.remove(&self.store.contribution_facts, pair(*cell, session));
            self.batch.insert(&self.store.cell_purges, cell.to_key(), []);
        }
        self.batch.remove(&self.store.contributed, session.to_key());
        self.batch.remove(&self.store.own_frames, session.to_key());
        self.batch.remove(&self.store.sought, session.to_key());
        self.withdraw_those_found_on(&contributed.cells)
    }

    /// Takes the drives that were found on cells, of which another is deleted, off the map: they are where they are because
    /// of it, maybe.
    fn withdraw_those_found_on(&mut self, cells: &[CellId]) -> Result<(), JournalError> {
        for entry in self.store.sought.iter() {
            let session = session_of(&entry.key()?)?;
            let Some(bytes) = self.store.contributed.get(session.to_key())? else { continue };
            let contributed: Contributed = decoded("how much was contributed", &bytes)?;
            if !contributed.cells.iter().any(|cell| cells.contains(cell)) {
                continue;
            }
            for cell in contributed.cells {
                self.batch.remove(&self.store.contributions, pair(cell, session));
                self.batch.remove(&self.store.contribution_facts, pair(cell, session));
            }
            self.batch.remove(&self.store.contributed, session.to_key());
            self.batch.remove(&self.store.sought, session.to_key());
        }
        Ok(())
    }
}

impl Store {
    pub(super) fn map_keyspaces(&self) -> [&fjall::Keyspace; 11] {
        [
            &self.contributions,
            &self.contribution_facts,
            &self.contributed,
            &self.cells,
            &self.cell_lines,
            &self.cell_versions,
            &self.cell_purges,
            &self.publications,
            &self.cell_events,
            &self.own_frames,
            &self.sought,
        ]
    }
}

/// The bytes under which a value is kept.
pub(crate) fn encoded<T: Serialize>(what: &str, value: &T) -> Result<Vec<u8>, JournalError> {
    postcard::to_stdvec(value).map_err(|error| decode_error(what, &error))
}

fn decoded<T: DeserializeOwned>(what: &str, bytes: &[u8]) -> Result<T, JournalError> {
    postcard::from_bytes(bytes).map_err(|error| decode_error(what, &error))
}

fn pair(cell: CellId, session: SessionId) -> [u8; 16] {
    joined(cell.to_key(), session.to_key())
}

fn versioned(cell: CellId, version: u64) -> [u8; 16] {
    joined(cell.to_key(), version.to_be_bytes())
}

fn joined(first: [u8; 8], second: [u8; 8]) -> [u8; 16] {
    let mut key = [0; 16];
    key[..8].copy_from_slice(&first);
    key[8..].copy_from_slice(&second);
    key
}

fn eight(what: &str, bytes: Option<&[u8]>) -> Result<[u8; 8], JournalError> {
    bytes
        .and_then(|bytes| bytes.try_into().ok())
        .ok_or_else(|| JournalError::Decode { what: what.to_owned(), reason: "it has another length".to_owned() })
}

fn number(bytes: Option<&[u8]>) -> Result<u64, JournalError> {
    Ok(u64::from_be_bytes(eight("a version", bytes)?))
}

fn cell_of(key: &[u8]) -> Result<CellId, JournalError> {
    CellId::from_key(eight("a cell's key", key.get(..8))?).ok_or_else(|| JournalError::Decode {
        what: "a cell's key".to_owned(),
        reason: "there is no such tile".to_owned(),
    })
}

fn session_of(key: &[u8]) -> Result<SessionId, JournalError> {
    Ok(SessionId::from_key(eight("a session's key", Some(key))?))
}
