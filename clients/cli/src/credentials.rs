//! Who the caller of a service is, on the command line.

use std::path::PathBuf;

use clap::Args;
use lanemap_client::{Credentials, IdentityFiles, Token};

/// Files that show who asks, and whom to trust.
#[derive(Args, Clone, Debug)]
pub struct CredentialArgs {
    /// File of a bearer token
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Certificates that sign the service's, PEM, for an address that begins with https
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// The caller's own certificate, PEM, for a service that asks for one
    #[arg(long, value_name = "FILE", requires = "key")]
    cert: Option<PathBuf>,
    /// Its private key, PEM
    #[arg(long, value_name = "FILE", requires = "cert")]
    key: Option<PathBuf>,
}

impl CredentialArgs {
    /// As the clients take them.
    pub fn read(&self) -> Credentials {
        let identity = self.cert.clone().zip(self.key.clone());
        Credentials {
            ca: self.ca.clone(),
            identity: identity.map(|(cert, key)| IdentityFiles { cert, key }),
            token: self.token_file.clone().map(Token::File),
            ..Credentials::default()
        }
    }
}
