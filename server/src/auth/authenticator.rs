//! Tells who a peer is from what it shows: the certificate of its connection, and a bearer token.

use std::{path::PathBuf, sync::Arc};

use arc_swap::ArcSwap;
use axum::http::HeaderValue;
use thiserror::Error;

use super::{
    Peer, VehicleName,
    certificate_name::{CertificateIdentity, CertificateNameError},
    keys::KeySet,
    reload::{CredentialError, read},
    tokens::{TokenError, TokenVerifier},
};
use crate::config::ServerConfig;

/// Why somebody is not who it should be. It repeats nothing of what was shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum AuthenticationError {
    /// Nothing was shown.
    #[error("neither a bearer token nor a client certificate of a vehicle was shown")]
    Missing,
    /// `authorization` is not `Bearer` and a token.
    #[error("the authorization is not of the form Bearer <token>")]
    Scheme,
    /// The token is not taken.
    #[error(transparent)]
    Token(#[from] TokenError),
    /// The certificate is not taken.
    #[error(transparent)]
    Certificate(#[from] CertificateNameError),
    /// What was shown when the stream began has run out since.
    #[error("what authenticated this stream has expired; resume with a new token or certificate")]
    Expired,
}

/// What is known of a connection once its TLS handshake is done.
pub type Identity = Result<CertificateIdentity, CertificateNameError>;

/// Tells who a peer is.
#[derive(Debug)]
pub struct Authenticator {
    tokens: Option<Tokens>,
    is_on: bool,
    anonymous_read: bool,
}

#[derive(Debug)]
struct Tokens {
    keys_file: PathBuf,
    issuer: String,
    audience: String,
    verifier: ArcSwap<TokenVerifier>,
}

impl Authenticator {
    /// Reads the keys that the settings name.
    ///
    /// # Errors
    /// A file of keys that cannot be read.
    pub fn load(config: &ServerConfig) -> Result<Self, CredentialError> {
        let tokens = match (&config.token_keys_file, &config.token_issuer) {
            (Some(file), Some(issuer)) => Some(Tokens::load(file.clone(), issuer, &config.token_audience)?),
            _ => None,
        };
        Ok(Self { tokens, is_on: config.asks_who_peers_are(), anonymous_read: config.anonymous_read })
    }

    /// Whether peers are asked who they are.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.is_on
    }

    /// Who shows this certificate and this `authorization`.
    ///
    /// A token, where one is shown, says what its holder may do; a certificate of a vehicle beside it says as which
    /// vehicle only.
    ///
    /// # Errors
    /// A certificate or a token that is not taken.
    pub fn peer(
        &self,
        certificate: Option<&Identity>,
        authorization: Option<&HeaderValue>,
    ) -> Result<Peer, AuthenticationError> {
        if !self.is_on() {
            return Ok(Peer::unauthenticated());
        }
        let certificate = certificate.cloned().transpose()?;
        let (vehicle, expires_at) = certificate.map_or((None, None), |it| (it.vehicle, Some(it.expires_at)));
        let peer = match (&self.tokens, authorization) {
            (Some(tokens), Some(authorization)) => tokens.peer(bearer(authorization)?)?.bound_to(vehicle),
            _ => vehicle.map_or_else(|| self.anonymous(), |name| Peer::of_vehicle(name.fleet, name.vehicle)),
        };
        Ok(peer.until(expires_at))
    }

    /// Who publishes on the keys of `vehicle` with this token; `None`: without one.
    ///
    /// `key_is_proof` says that the transport lets nobody but that vehicle publish there.
    ///
    /// # Errors
    /// A token that is not taken, or that is missing where it is the only proof.
    pub fn peer_on_key(
        &self,
        vehicle: VehicleName,
        key_is_proof: bool,
        token: Option<&str>,
    ) -> Result<Peer, AuthenticationError> {
        match (&self.tokens, token) {
            (Some(tokens), Some(token)) => Ok(tokens.peer(token)?.bound_to(Some(vehicle))),
            _ if key_is_proof || !self.is_on() => Ok(Peer::of_vehicle(vehicle.fleet, vehicle.vehicle)),
            _ => Err(AuthenticationError::Missing),
        }
    }

    /// Reads the keys again; on error the old ones stay.
    ///
    /// # Errors
    /// A file of keys that cannot be read.
    pub fn reload(&self) -> Result<(), CredentialError> {
        let Some(tokens) = &self.tokens else { return Ok(()) };
        let anew = Tokens::load(tokens.keys_file.clone(), &tokens.issuer, &tokens.audience)?;
        tokens.verifier.store(anew.verifier.into_inner());
        Ok(())
    }

    fn anonymous(&self) -> Peer {
        Peer::anonymous(self.anonymous_read)
    }
}

impl Tokens {
    fn load(keys_file: PathBuf, issuer: &str, audience: &str) -> Result<Self, CredentialError> {
        let bytes = read("token_keys_file", &keys_file)?;
        let keys = KeySet::parse(&bytes).map_err(|error| CredentialError::new("token_keys_file", &keys_file, error))?;
        let verifier = ArcSwap::new(Arc::new(TokenVerifier::new(keys, issuer, audience)));
        Ok(Self { keys_file, issuer: issuer.to_owned(), audience: audience.to_owned(), verifier })
    }

    fn peer(&self, token: &str) -> Result<Peer, AuthenticationError> {
        Ok(self.verifier.load().verify(token)?)
    }
}

/// The token of `Bearer <token>`; the scheme in any case (RFC 9110, 11.1).
fn bearer(authorization: &HeaderValue) -> Result<&str, AuthenticationError> {
    let (scheme, token) =
        authorization.to_str().ok().and_then(|text| text.split_once(' ')).ok_or(AuthenticationError::Scheme)?;
    if scheme.eq_ignore_ascii_case("bearer") { Ok(token.trim()) } else { Err(AuthenticationError::Scheme) }
}
