//! Bearer tokens for tests, and the keys that verify them.

use std::time::{SystemTime, UNIX_EPOCH};

use jsonwebtoken::{Algorithm, EncodingKey, Header, encode, jwk::Jwk};
use rcgen::{KeyPair, PKCS_ECDSA_P256_SHA256, PublicKeyData};
use serde_json::{Value, json};

/// The issuer that the tokens name.
pub const ISSUER: &str = "https://issuer.test";
/// The audience that the tokens name.
pub const AUDIENCE: &str = "lanemap";

/// Signs tokens.
#[derive(Debug)]
pub struct TokenIssuer {
    key_id: String,
    key: KeyPair,
}

impl TokenIssuer {
    /// An issuer with a key of its own on P-256.
    #[must_use]
    pub fn new(key_id: &str) -> Self {
        Self { key_id: key_id.to_owned(), key: KeyPair::generate_for(&PKCS_ECDSA_P256_SHA256).unwrap() }
    }

    /// Its public key, PEM.
    #[must_use]
    pub fn public_pem(&self) -> String {
        self.key.public_key_pem()
    }

    /// Its public key, as the curve's point.
    #[must_use]
    pub fn public_point(&self) -> Vec<u8> {
        self.key.der_bytes().to_vec()
    }

    /// A JWKS of the public keys of `issuers`.
    #[must_use]
    pub fn jwks(issuers: &[&Self]) -> String {
        let keys: Vec<_> = issuers.iter().map(|issuer| issuer.jwk()).collect();
        json!({ "keys": keys }).to_string()
    }

    fn jwk(&self) -> Value {
        let mut jwk = Jwk::from_encoding_key(&self.encoding_key(), Algorithm::ES256).unwrap();
        jwk.common.key_id = Some(self.key_id.clone());
        serde_json::to_value(jwk).unwrap()
    }

    fn encoding_key(&self) -> EncodingKey {
        EncodingKey::from_ec_der(self.key.serialized_der())
    }

    /// A token with these claims; `iss`, `aud` and an `exp` in an hour are added where they are missing.
    #[must_use]
    pub fn token(&self, claims: Value) -> String {
        let header = Header { kid: Some(self.key_id.clone()), ..Header::new(Algorithm::ES256) };
        encode(&header, &completed(claims), &self.encoding_key()).unwrap()
    }
}

/// Claims with `iss`, `aud` and an `exp` in an hour where they are missing.
#[must_use]
pub fn completed(mut claims: Value) -> Value {
    let object = claims.as_object_mut().unwrap();
    for (name, value) in [("iss", json!(ISSUER)), ("aud", json!(AUDIENCE)), ("exp", json!(unix_s() + 3600))] {
        object.entry(name).or_insert(value);
    }
    claims
}

/// Seconds since 1970.
#[must_use]
pub fn unix_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs()
}
