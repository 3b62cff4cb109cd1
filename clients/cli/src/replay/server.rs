//! The server that a replay streams to, and how it is reached.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use lanemap_client::{ConnectOptions, Credentials, IdentityFiles, Token};

/// Where to stream to, and how.
#[derive(Args, Debug)]
pub struct ServerArgs {
    /// The server to stream to, and to read the maps from
    #[arg(id = "server", long = "server", value_name = "URL", default_value = "http://127.0.0.1:8080")]
    pub url: String,
    /// How frames go to the server
    #[arg(long, value_enum, default_value_t = Transport::Grpc)]
    pub transport: Transport,
    /// Where zenoh is, with --transport zenoh: the server itself, or a router between
    #[arg(long, value_name = "ENDPOINT", default_value = "tcp/127.0.0.1:7447")]
    pub zenoh: String,
    /// Certificates that sign the server's, PEM; for https:// and tls/
    #[arg(long, value_name = "FILE")]
    pub ca: Option<PathBuf>,
    /// Certificate to show to the server, PEM
    #[arg(long, value_name = "FILE", requires = "key")]
    pub cert: Option<PathBuf>,
    /// Private key of --cert, PEM
    #[arg(long, value_name = "FILE", requires = "cert")]
    pub key: Option<PathBuf>,
    /// File that holds the bearer token to show to the server
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Fleet to stream as
    #[arg(long, value_name = "NAME", default_value = "replay")]
    pub fleet: String,
    /// Vehicle to stream as; without it each drive is a vehicle of its own
    #[arg(long, value_name = "NAME")]
    pub vehicle: Option<String>,
}

/// How frames go to the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Transport {
    /// gRPC, at --server
    Grpc,
    /// Zenoh, at --zenoh
    Zenoh,
}

impl ServerArgs {
    /// Where frames go.
    pub fn ingest_url(&self) -> &str {
        match self.transport {
            Transport::Grpc => &self.url,
            Transport::Zenoh => &self.zenoh,
        }
    }

    /// Who streams, and whom it trusts.
    pub fn connect_options(&self) -> ConnectOptions {
        let identity = self.cert.clone().zip(self.key.clone()).map(|(cert, key)| IdentityFiles { cert, key });
        let token = self.token_file.clone().map(Token::File);
        let credentials = Credentials { ca: self.ca.clone(), identity, token, ..Credentials::default() };
        ConnectOptions { credentials, ..ConnectOptions::default() }
    }
}
