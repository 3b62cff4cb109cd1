//! Certificates for tests: authorities, servers, vehicles.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::Arc,
};

use lanemap_server::ServerConfig;
use rcgen::{
    BasicConstraints, Certificate, CertificateParams, CertificateRevocationListParams, DnType, IsCa, Issuer,
    KeyIdMethod, KeyPair, KeyUsagePurpose, RevokedCertParams, SanType, SerialNumber, date_time_ymd,
};
use rustls::{
    ClientConfig, RootCertStore,
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
};
use tonic::transport::{Channel, ClientTlsConfig, Identity};

/// A certificate with its key, both PEM.
#[derive(Clone, Debug)]
pub struct Certified {
    /// The certificate.
    pub certificate: String,
    /// The private key.
    pub key: String,
    /// The serial number.
    pub serial: u64,
}

/// An authority that signs certificates.
#[derive(Debug)]
pub struct Authority {
    certificate: Certificate,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    /// An authority with a key of its own.
    #[must_use]
    pub fn new(name: &str) -> Self {
        let mut params = CertificateParams::new(Vec::<String>::new()).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let key = KeyPair::generate().unwrap();
        Self { certificate: params.self_signed(&key).unwrap(), issuer: Issuer::new(params, key) }
    }

    /// Its certificate, PEM.
    #[must_use]
    pub fn pem(&self) -> String {
        self.certificate.pem()
    }

    /// A server on this machine.
    #[must_use]
    pub fn server(&self, serial: u64) -> Certified {
        let mut params = CertificateParams::new(vec!["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
        params.distinguished_name.push(DnType::CommonName, "localhost");
        self.sign(params, serial)
    }

    /// A vehicle, named by a URI.
    #[must_use]
    pub fn vehicle(&self, fleet: &str, vehicle: &str, serial: u64) -> Certified {
        self.sign(named_by_uri(&format!("lanemap://{fleet}/{vehicle}")), serial)
    }

    /// A vehicle, named by its common name, as zenoh wants it.
    #[must_use]
    pub fn vehicle_by_common_name(&self, fleet: &str, vehicle: &str, serial: u64) -> Certified {
        let mut params = CertificateParams::new(Vec::<String>::new()).unwrap();
        params.distinguished_name.push(DnType::CommonName, format!("{fleet}/{vehicle}"));
        self.sign(params, serial)
    }

    /// A vehicle whose certificate ran out long ago.
    #[must_use]
    pub fn expired_vehicle(&self, fleet: &str, vehicle: &str, serial: u64) -> Certified {
        let mut params = named_by_uri(&format!("lanemap://{fleet}/{vehicle}"));
        (params.not_before, params.not_after) = (date_time_ymd(2020, 1, 1), date_time_ymd(2021, 1, 1));
        self.sign(params, serial)
    }

    /// Signs what `params` say, with a new key.
    #[must_use]
    pub fn sign(&self, mut params: CertificateParams, serial: u64) -> Certified {
        params.serial_number = Some(SerialNumber::from(serial));
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap().pem();
        Certified { certificate, key: key.serialize_pem(), serial }
    }

    /// A list that revokes the certificates of these serial numbers, PEM.
    #[must_use]
    pub fn revocation_list(&self, serials: &[u64]) -> String {
        let revoked = |&serial: &u64| RevokedCertParams {
            serial_number: SerialNumber::from(serial),
            revocation_time: date_time_ymd(2024, 1, 1),
            reason_code: None,
            invalidity_date: None,
        };
        let list = CertificateRevocationListParams {
            this_update: date_time_ymd(2024, 1, 1),
            next_update: date_time_ymd(2090, 1, 1),
            crl_number: SerialNumber::from(1),
            issuing_distribution_point: None,
            revoked_certs: serials.iter().map(revoked).collect(),
            key_identifier_method: KeyIdMethod::Sha256,
        };
        list.signed_by(&self.issuer).unwrap().pem().unwrap()
    }
}

/// What is to be signed for a holder named by a URI.
#[must_use]
pub fn named_by_uri(uri: &str) -> CertificateParams {
    let mut params = CertificateParams::new(Vec::<String>::new()).unwrap();
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.subject_alt_names.push(SanType::URI(uri.try_into().unwrap()));
    params
}

/// A folder of the files that a server with mTLS reads.
#[derive(Debug)]
pub struct TlsFolder {
    /// Signs the server's certificate.
    pub servers: Authority,
    /// Signs certificates of vehicles.
    pub vehicles: Authority,
    folder: PathBuf,
}

impl TlsFolder {
    /// Writes certificates of new authorities to `folder`.
    #[must_use]
    pub fn new(folder: &Path) -> Self {
        let folder = Self {
            servers: Authority::new("servers"),
            vehicles: Authority::new("vehicles"),
            folder: folder.to_owned(),
        };
        folder.write_server(&folder.servers.server(1));
        folder.write("vehicles-ca.crt", &folder.vehicles.pem());
        folder
    }

    /// Puts a server's certificate into force once the server reads it.
    pub fn write_server(&self, server: &Certified) {
        self.write("server.key", &server.key);
        self.write("server.crt", &server.certificate);
    }

    /// Writes a file.
    #[expect(clippy::must_use_candidate, reason = "written for its own sake too")]
    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.folder.join(name);
        fs::write(&path, text).unwrap();
        path
    }

    /// Settings of a server that shows its certificate and takes those of vehicles, its store in the same folder.
    #[must_use]
    pub fn config(&self) -> ServerConfig {
        ServerConfig {
            tls_cert_file: Some(self.folder.join("server.crt")),
            tls_key_file: Some(self.folder.join("server.key")),
            tls_client_ca_file: Some(self.folder.join("vehicles-ca.crt")),
            ..crate::servers::config(&self.folder.join("data"))
        }
    }

    /// A connection for gRPC.
    ///
    /// # Errors
    /// The handshake failed.
    pub async fn channel(&self, url: &str, client: Option<&Certified>) -> Result<Channel, tonic::transport::Error> {
        let authority = tonic::transport::Certificate::from_pem(self.servers.pem());
        let tls = ClientTlsConfig::new().ca_certificate(authority).domain_name("localhost");
        let tls = client.iter().fold(tls, |tls, it| tls.identity(Identity::from_pem(&it.certificate, &it.key)));
        Channel::from_shared(url.to_owned()).unwrap().tls_config(tls).unwrap().connect().await
    }

    /// TLS of a client that trusts the servers' authority.
    #[must_use]
    pub fn client_tls(&self, client: Option<&Certified>) -> ClientConfig {
        let mut roots = RootCertStore::empty();
        roots.add(CertificateDer::from_pem_slice(self.servers.pem().as_bytes()).unwrap()).unwrap();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions().unwrap();
        let builder = builder.with_root_certificates(roots);
        match client {
            None => builder.with_no_client_auth(),
            Some(client) => {
                let certificate = CertificateDer::from_pem_slice(client.certificate.as_bytes()).unwrap();
                let key = PrivateKeyDer::from_pem_slice(client.key.as_bytes()).unwrap();
                builder.with_client_auth_cert(vec![certificate], key).unwrap()
            }
        }
    }
}
