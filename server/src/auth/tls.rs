//! TLS on the port of gRPC and HTTP: the server's certificate, and which certificates of clients it takes.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use arc_swap::ArcSwap;
use rustls::{
    RootCertStore, ServerConfig as TlsConfig,
    pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer, pem::PemObject},
    server::{NoServerSessionStorage, WebPkiClientVerifier, danger::ClientCertVerifier},
};
use thiserror::Error;
use tokio::{net::TcpStream, sync::Semaphore, time::timeout};
use tokio_rustls::{TlsAcceptor, server::TlsStream};

use super::{
    authenticator::Identity,
    certificate_name,
    reload::{CredentialError, read},
};
use crate::config::ServerConfig;

/// What is spoken inside: gRPC needs the first.
const PROTOCOLS: [&[u8]; 2] = [b"h2", b"http/1.1"];

/// Why a connection did not come about.
#[derive(Debug, Error)]
pub(crate) enum HandshakeError {
    #[error("the handshake took too long")]
    TooSlow,
    #[error("the handshake failed: {0}")]
    Failed(#[from] std::io::Error),
}

/// TLS of one port. What it shows and takes can be read anew; connections that are open stay as they are.
#[derive(Debug)]
pub struct Tls {
    files: TlsFiles,
    config: ArcSwap<TlsConfig>,
    handshakes: Semaphore,
    handshake_timeout: Duration,
}

#[derive(Debug)]
struct TlsFiles {
    certificate: PathBuf,
    key: PathBuf,
    clients: Option<ClientFiles>,
}

#[derive(Debug)]
struct ClientFiles {
    authorities: PathBuf,
    revoked: Option<PathBuf>,
    required: bool,
}

impl Tls {
    /// Reads the files that the settings name; `None` where they name no certificate.
    ///
    /// # Errors
    /// A file that cannot be used.
    pub fn load(config: &ServerConfig) -> Result<Option<Self>, CredentialError> {
        let (Some(certificate), Some(key)) = (&config.tls_cert_file, &config.tls_key_file) else { return Ok(None) };
        let clients = config.tls_client_ca_file.as_ref().map(|authorities| ClientFiles {
            authorities: authorities.clone(),
            revoked: config.tls_client_crl_file.clone(),
            required: config.tls_require_client_certificate,
        });
        let files = TlsFiles { certificate: certificate.clone(), key: key.clone(), clients };
        Ok(Some(Self {
            config: ArcSwap::new(Arc::new(files.read()?)),
            files,
            handshakes: Semaphore::new(config.max_tls_handshakes),
            handshake_timeout: Duration::from_secs(config.tls_handshake_timeout_s),
        }))
    }

    /// Reads the files again; on error everything stays as it was.
    pub(super) fn reload(&self) -> Result<(), CredentialError> {
        self.config.store(Arc::new(self.files.read()?));
        Ok(())
    }

    /// Shakes hands with a client: bounded in time, waiting for a place included.
    pub(crate) async fn accept(&self, connection: TcpStream) -> Result<TlsStream<TcpStream>, HandshakeError> {
        let handshake = async {
            // The semaphore is never closed.
            let _place = self.handshakes.acquire().await;
            TlsAcceptor::from(self.config.load_full()).accept(connection).await
        };
        match timeout(self.handshake_timeout, handshake).await {
            Ok(stream) => Ok(stream?),
            Err(_) => Err(HandshakeError::TooSlow),
        }
    }
}

/// Who is at the other end of a connection; `None`: it showed no certificate.
pub(crate) fn identity(connection: &TlsStream<TcpStream>) -> Option<Identity> {
    let (_, session) = connection.get_ref();
    let certificate = session.peer_certificates()?.first()?;
    Some(certificate_name::identity(certificate))
}

impl TlsFiles {
    fn read(&self) -> Result<TlsConfig, CredentialError> {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let chain = certificates("tls_cert_file", &self.certificate)?;
        let key = PrivateKeyDer::from_pem_slice(&read("tls_key_file", &self.key)?)
            .map_err(|error| CredentialError::new("tls_key_file", &self.key, no_pem("private key", &error)))?;
        let builder = TlsConfig::builder_with_provider(Arc::clone(&provider))
            .with_safe_default_protocol_versions()
            .map_err(|error| CredentialError::new("tls_cert_file", &self.certificate, error))?;
        let builder = match &self.clients {
            Some(clients) => builder.with_client_cert_verifier(clients.verifier(provider)?),
            None => builder.with_no_client_auth(),
        };
        let mut config = builder
            .with_single_cert(chain, key)
            .map_err(|error| CredentialError::new("tls_cert_file", &self.certificate, error))?;
        config.alpn_protocols = PROTOCOLS.map(<[u8]>::to_vec).to_vec();
        if self.clients.is_some() {
            // A session that is resumed shows no certificate again: one that was revoked or ran out would still do.
            config.session_storage = Arc::new(NoServerSessionStorage {});
            config.send_tls13_tickets = 0;
        }
        Ok(config)
    }
}

impl ClientFiles {
    fn verifier(
        &self,
        provider: Arc<rustls::crypto::CryptoProvider>,
    ) -> Result<Arc<dyn ClientCertVerifier>, CredentialError> {
        let bad = |error: Box<dyn std::error::Error + Send + Sync>| {
            CredentialError::new("tls_client_ca_file", &self.authorities, error)
        };
        let mut roots = RootCertStore::empty();
        for certificate in certificates("tls_client_ca_file", &self.authorities)? {
            roots.add(certificate).map_err(|error| bad(error.into()))?;
        }
        let mut builder = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
        if let Some(revoked) = &self.revoked {
            let bytes = read("tls_client_crl_file", revoked)?;
            let lists: Result<Vec<_>, _> = CertificateRevocationListDer::pem_slice_iter(&bytes).collect();
            let lists =
                lists.map_err(|error| CredentialError::new("tls_client_crl_file", revoked, no_pem("CRL", &error)))?;
            // A list of one authority says nothing of another's certificates.
            builder = builder.with_crls(lists).allow_unknown_revocation_status();
        }
        if !self.required {
            builder = builder.allow_unauthenticated();
        }
        builder.build().map_err(|error| bad(error.into()))
    }
}

fn certificates(setting: &'static str, path: &Path) -> Result<Vec<CertificateDer<'static>>, CredentialError> {
    let bytes = read(setting, path)?;
    let all: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes).collect();
    let all = all.map_err(|error| CredentialError::new(setting, path, no_pem("certificate", &error)))?;
    if all.is_empty() {
        return Err(CredentialError::new(setting, path, "no certificate in PEM (-----BEGIN CERTIFICATE-----)"));
    }
    Ok(all)
}

/// What is wrong with a file in PEM; the reader's own words could repeat what stands in it.
fn no_pem(what: &str, error: &rustls::pki_types::pem::Error) -> String {
    use rustls::pki_types::pem::Error;
    match error {
        Error::NoItemsFound => format!("no {what} in PEM"),
        Error::Base64Decode(_) => format!("a {what} whose base64 is broken"),
        _ => format!("no {what} in well-formed PEM"),
    }
}
