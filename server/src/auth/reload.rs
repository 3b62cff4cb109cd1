//! Credentials from files, read anew while the service runs: at SIGHUP, and when a file changes.

use std::{
    error::Error as StdError,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, SystemTime},
};

use thiserror::Error;
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use super::{Authenticator, tls::Tls};
use crate::config::ServerConfig;

/// How often files are looked at.
const WATCH_INTERVAL: Duration = Duration::from_secs(2);
/// Largest file of credentials, bytes.
const LARGEST_FILE_BYTES: u64 = 64 * 1024 * 1024;

/// A file of credentials that cannot be used. It names the file and the fault, never what stands in it.
#[derive(Debug, Error)]
#[error("{setting} ({path}): {source}")]
pub struct CredentialError {
    setting: &'static str,
    path: String,
    source: Box<dyn StdError + Send + Sync>,
}

impl CredentialError {
    pub(crate) fn new(setting: &'static str, path: &Path, source: impl Into<Box<dyn StdError + Send + Sync>>) -> Self {
        Self { setting, path: path.display().to_string(), source: source.into() }
    }
}

/// The bytes of a file that a setting names.
pub(crate) fn read(setting: &'static str, path: &Path) -> Result<Vec<u8>, CredentialError> {
    let bytes = fs::metadata(path).and_then(|metadata| {
        if metadata.len() > LARGEST_FILE_BYTES {
            return Err(std::io::Error::other(format!("larger than {LARGEST_FILE_BYTES} bytes")));
        }
        fs::read(path)
    });
    bytes.map_err(|error| CredentialError::new(setting, path, error))
}

/// Everything by which the service shows who it is and learns who others are. Clones share it.
#[derive(Clone, Debug)]
pub struct Credentials {
    /// TLS of the port of gRPC and HTTP; `None`: plain text.
    pub tls: Option<Arc<Tls>>,
    /// Tells who peers are.
    pub authenticator: Arc<Authenticator>,
    files: Arc<Vec<PathBuf>>,
}

impl Credentials {
    /// Reads every file that the settings name.
    ///
    /// # Errors
    /// The first file that cannot be used.
    pub fn load(config: &ServerConfig) -> Result<Self, CredentialError> {
        let files = [
            &config.tls_cert_file,
            &config.tls_key_file,
            &config.tls_client_ca_file,
            &config.tls_client_crl_file,
            &config.token_keys_file,
        ];
        Ok(Self {
            tls: Tls::load(config)?.map(Arc::new),
            authenticator: Arc::new(Authenticator::load(config)?),
            files: Arc::new(files.into_iter().flatten().cloned().collect()),
        })
    }

    /// Reads every file again; what cannot be used is reported and stays as it was.
    pub fn reload(&self) {
        let tls = self.tls.as_ref().map_or(Ok(()), |tls| tls.reload());
        for outcome in [tls, self.authenticator.reload()] {
            if let Err(error) = outcome {
                tracing::error!(%error, "credentials were not read anew; those of before stay in force");
            }
        }
        tracing::info!("credentials were read");
    }

    /// Reads the files again whenever one of them changes, until `stop`.
    pub async fn watch(self, stop: CancellationToken) {
        if self.files.is_empty() {
            return;
        }
        let mut seen = self.fingerprint();
        let mut ticks = interval(WATCH_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                () = stop.cancelled() => return,
                _ = ticks.tick() => {}
            }
            let found = self.fingerprint();
            if found != seen {
                seen = found;
                self.reload();
            }
        }
    }

    /// Changes when a file does: time and length, through links (a secret of Kubernetes is one).
    fn fingerprint(&self) -> Vec<Option<(SystemTime, u64)>> {
        let of = |path: &PathBuf| fs::metadata(path).and_then(|file| Ok((file.modified()?, file.len()))).ok();
        self.files.iter().map(of).collect()
    }
}
