//! The secret behind the pseudonyms: 32 random bytes in a file of their own, readable by the service alone.

use std::{
    fmt, fs, io,
    path::{Path, PathBuf},
};

use hmac::{Hmac, Mac};
use sha2::Sha256;
use thiserror::Error;

/// Bytes of the key: as many as the digest has.
const KEY_BYTES: usize = 32;

/// The secret. It is never shown, not even by `{:?}`.
#[derive(Clone, PartialEq, Eq)]
pub struct PrivacyKey([u8; KEY_BYTES]);

/// Why the key cannot be used.
#[derive(Debug, Error)]
pub enum KeyError {
    /// The file cannot be read or written.
    #[error("the privacy key in {path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: io::Error,
    },
    /// The file holds something else. What it holds is not repeated: it may be half a key.
    #[error("the privacy key in {path} is not {} hexadecimal digits", 2 * KEY_BYTES)]
    NotAKey {
        /// The file.
        path: PathBuf,
    },
    /// There is no file, but there are drives that can only be found again with what was in it.
    #[error("the privacy key in {path} is missing, and the store was written with it: put the file back")]
    Missing {
        /// The file.
        path: PathBuf,
    },
    /// The store's drives were named with another key.
    #[error("the privacy key in {path} is not the one with which the store was written: put that one back")]
    Another {
        /// The file.
        path: PathBuf,
    },
    /// The system gives no random bytes.
    #[error("the privacy key cannot be made: the system gives no random bytes")]
    NoRandomness,
}

impl PrivacyKey {
    /// Reads the key; `None` where there is no file.
    ///
    /// # Errors
    /// A file that cannot be read, or holds no key.
    pub fn read(path: &Path) -> Result<Option<Self>, KeyError> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(KeyError::File { path: path.to_owned(), source }),
        };
        Self::parse(text.trim()).map(Some).ok_or_else(|| KeyError::NotAKey { path: path.to_owned() })
    }

    /// Makes a new key and writes it to `path`, which only this user may read; it is on the disk when this returns.
    ///
    /// # Errors
    /// A folder that cannot be written, or a system without randomness.
    pub fn generate(path: &Path) -> Result<Self, KeyError> {
        let mut bytes = [0; KEY_BYTES];
        let random = rustls::crypto::ring::default_provider().secure_random;
        random.fill(&mut bytes).map_err(|_| KeyError::NoRandomness)?;
        let key = Self(bytes);
        key.write(path).map_err(|source| KeyError::File { path: path.to_owned(), source })?;
        Ok(key)
    }

    fn parse(text: &str) -> Option<Self> {
        let digits = text.as_bytes();
        if digits.len() != 2 * KEY_BYTES || !digits.iter().all(u8::is_ascii_hexdigit) {
            return None;
        }
        let mut bytes = [0; KEY_BYTES];
        for (byte, pair) in bytes.iter_mut().zip(digits.chunks(2)) {
            *byte = u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()?;
        }
        Some(Self(bytes))
    }

    /// Written beside and renamed: a crash leaves a whole key or none.
    fn write(&self, path: &Path) -> io::Result<()> {
        use io::Write;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let beside = path.with_extension("new");
        let mut options = fs::OpenOptions::new();
        options.write(true).create(true).truncate(true);
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        let mut file = options.open(&beside)?;
        for byte in self.0 {
            write!(file, "{byte:02x}")?;
        }
        writeln!(file)?;
        file.sync_all()?;
        fs::rename(&beside, path)?;
        fs::File::open(folder)?.sync_all()
    }

    /// HMAC-SHA256 of `parts` under this key. Each part is led by its length, so that no two lists of parts are alike.
    pub(super) fn digest(&self, parts: &[&[u8]]) -> [u8; 32] {
        #[expect(clippy::expect_used, reason = "an HMAC key may have any length")]
        let mut mac = Hmac::<Sha256>::new_from_slice(&self.0).expect("an HMAC key may have any length");
        for part in parts {
            mac.update(&(part.len() as u64).to_le_bytes());
            mac.update(part);
        }
        mac.finalize().into_bytes().into()
    }
}

impl fmt::Debug for PrivacyKey {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("PrivacyKey(..)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_generated_key_is_read_again_and_is_for_its_owner_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("privacy.key");
        assert_eq!(PrivacyKey::read(&path).unwrap(), None);
        let key = PrivacyKey::generate(&path).unwrap();
        assert_eq!(PrivacyKey::read(&path).unwrap().as_ref(), Some(&key));
        assert_ne!(PrivacyKey::generate(&folder.path().join("another")).unwrap(), key);
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        }
    }

    #[test]
    fn a_key_is_never_shown() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("privacy.key");
        let key = PrivacyKey::generate(&path).unwrap();
        assert_eq!(format!("{key:?}"), "PrivacyKey(..)");
        fs::write(&path, "c0ffee").unwrap();
        assert!(!PrivacyKey::read(&path).unwrap_err().to_string().contains("c0ffee"));
    }

    #[test]
    fn the_digest_is_hmac_sha256_as_rfc_2104_has_it() {
        // Computed with Python: hmac.new(bytes(32), struct.pack("<Q", 1) + b"a", "sha256").hexdigest()
        let digest = PrivacyKey([0; KEY_BYTES]).digest(&[b"a"]);
        assert_eq!(
            format!("{digest:02x?}").replace([',', ' ', '[', ']'], ""),
            "e53cc5d96e1639c02813e32a1a7c3c3963d7600a88112c389aabb0b67405d6c6"
        );
        let key = PrivacyKey([7; KEY_BYTES]);
        assert_ne!(key.digest(&[b"ab", b"c"]), key.digest(&[b"a", b"bc"]));
    }
}
