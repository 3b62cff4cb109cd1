//! Keyed digests in the place of names.

use std::{fmt, path::Path, sync::Arc};

use lanemap_core::fleet::DriveId;
use serde::{Deserialize, Serialize};

use super::key::{KeyError, PrivacyKey};
use crate::session::SessionKey;

/// A vehicle of a fleet, as the store knows it. Two drives of one vehicle have the same one, so it is never published.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct VehiclePseudonym([u8; 32]);

/// A drive of a vehicle, as the store knows it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct DrivePseudonym([u8; 32]);

/// Which key a store was written with, without the key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KeyFingerprint(pub [u8; 32]);

/// Gives the names' digests. Clones share the key.
#[derive(Clone, Debug)]
pub struct Pseudonyms {
    key: Arc<PrivacyKey>,
}

impl Pseudonyms {
    /// Pseudonyms under `key`.
    #[must_use]
    pub fn new(key: PrivacyKey) -> Self {
        Self { key: Arc::new(key) }
    }

    /// Pseudonyms under the key in the file at `path`, for a store that was written under the key of `written_with`.
    /// A store that is new gets a new key where there is no file.
    ///
    /// # Errors
    /// A file that cannot be read or written, or holds another key than the store was written with.
    pub fn open(path: &Path, written_with: Option<KeyFingerprint>) -> Result<Self, KeyError> {
        let key = match (PrivacyKey::read(path)?, written_with) {
            (Some(key), _) => key,
            (None, Some(_)) => return Err(KeyError::Missing { path: path.to_owned() }),
            (None, None) => PrivacyKey::generate(path)?,
        };
        let pseudonyms = Self::new(key);
        if written_with.is_some_and(|fingerprint| fingerprint != pseudonyms.fingerprint()) {
            return Err(KeyError::Another { path: path.to_owned() });
        }
        Ok(pseudonyms)
    }

    /// What a store keeps to know its key again.
    #[must_use]
    pub fn fingerprint(&self) -> KeyFingerprint {
        KeyFingerprint(self.key.digest(&[b"fingerprint"]))
    }

    /// The digest of a vehicle's name.
    #[must_use]
    pub fn vehicle(&self, fleet: &str, vehicle: &str) -> VehiclePseudonym {
        VehiclePseudonym(self.key.digest(&[b"vehicle", fleet.as_bytes(), vehicle.as_bytes()]))
    }

    /// The digest of a drive's name.
    #[must_use]
    pub fn drive(&self, key: &SessionKey) -> DrivePseudonym {
        let (fleet, vehicle, drive) = (key.fleet.as_bytes(), key.vehicle.as_bytes(), key.drive.as_bytes());
        DrivePseudonym(self.key.digest(&[b"drive", fleet, vehicle, drive]))
    }

    /// The name of a drive in the shared map, which is published: it tells neither the drive's pseudonym nor its session.
    #[must_use]
    pub fn in_shared_map(&self, drive: DrivePseudonym) -> DriveId {
        DriveId(first_of(self.key.digest(&[b"shared map", &drive.0])))
    }

    /// A number that nobody can foretell without the key: `moment_ns` makes it another one every time.
    #[must_use]
    pub fn noise(&self, drive: DrivePseudonym, moment_ns: u128) -> u64 {
        first_of(self.key.digest(&[b"noise", &drive.0, &moment_ns.to_le_bytes()]))
    }
}

fn first_of(digest: [u8; 32]) -> u64 {
    let mut first = [0; 8];
    first.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(first)
}

impl fmt::Debug for VehiclePseudonym {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Digests of one vehicle would link its drives in a log.
        formatter.write_str("VehiclePseudonym(..)")
    }
}

impl fmt::Debug for DrivePseudonym {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("DrivePseudonym(..)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(fleet: &str, vehicle: &str, drive: &str) -> SessionKey {
        SessionKey { fleet: fleet.into(), vehicle: vehicle.into(), drive: drive.into() }
    }

    #[test]
    fn a_name_has_one_digest_under_one_key_and_another_under_another() {
        let folder = tempfile::tempdir().unwrap();
        let open = |name: &str| Pseudonyms::open(&folder.path().join(name), None).unwrap();
        let (first, second) = (open("a"), open("b"));
        assert_eq!(open("a").drive(&key("f", "v", "d")), first.drive(&key("f", "v", "d")));
        assert_ne!(second.drive(&key("f", "v", "d")), first.drive(&key("f", "v", "d")));
        assert_ne!(first.drive(&key("f", "v", "e")), first.drive(&key("f", "v", "d")));
        assert_ne!(first.vehicle("f", "v"), first.vehicle("fv", ""));
    }

    #[test]
    fn a_store_is_not_opened_without_its_key_nor_with_another() {
        let folder = tempfile::tempdir().unwrap();
        let (path, other) = (folder.path().join("key"), folder.path().join("other"));
        let written_with = Some(Pseudonyms::open(&path, None).unwrap().fingerprint());
        assert!(Pseudonyms::open(&path, written_with).is_ok());
        let missing = Pseudonyms::open(&other, written_with).unwrap_err();
        assert!(matches!(missing, KeyError::Missing { .. }), "{missing}");
        PrivacyKey::generate(&other).unwrap();
        let another = Pseudonyms::open(&other, written_with).unwrap_err();
        assert!(matches!(another, KeyError::Another { .. }), "{another}");
    }
}
