//! Keys that verify bearer tokens, from a file: a JWKS (RFC 7517), or public keys in PEM.
//!
//! The algorithm of a signature is a property of the key, never a choice of the token: a key verifies by one algorithm
//! only, so a public key is never taken for a secret, and `none` is no key's algorithm.

use std::collections::HashSet;

use jsonwebtoken::{
    Algorithm, AlgorithmFamily, DecodingKey,
    jwk::{AlgorithmParameters, EllipticCurve, Jwk, KeyOperations, PublicKeyUse},
};
use rustls::pki_types::pem::{PemObject, SectionKind};
use serde::Deserialize;
use thiserror::Error;
use x509_parser::prelude::{FromDer, SubjectPublicKeyInfo};

/// Most keys in a file: a token that names none is tried with each.
const MOST_KEYS: usize = 100;
/// Shortest shared secret, bytes: as long as the hash of HS256 (RFC 7518, 3.2).
const SHORTEST_SECRET_BYTES: usize = 32;
/// Shortest modulus of an RSA key, bytes: 2048 bits (RFC 7518, 3.3).
const SHORTEST_MODULUS_BYTES: usize = 256;

/// One key. Its `Debug` does not show it.
#[derive(Clone)]
pub struct VerificationKey {
    /// Its name, which a token may give as `kid`.
    pub id: Option<String>,
    /// By which it verifies.
    pub algorithm: Algorithm,
    /// The key.
    pub key: DecodingKey,
}

/// The keys of a file.
#[derive(Clone, Debug)]
pub struct KeySet {
    keys: Vec<VerificationKey>,
}

/// Why a file holds no keys. It repeats nothing of the file.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum KeyError {
    /// Neither JSON with `keys` nor PEM.
    #[error("it is neither a JWKS ({{\"keys\": [...]}}) nor public keys in PEM (-----BEGIN PUBLIC KEY-----)")]
    Format,
    /// A PEM section that is no public key.
    #[error("it holds a {0} in PEM; public keys verify tokens, and no other key belongs here")]
    NotPublic(String),
    /// A key that cannot be used.
    #[error("key {number}: {reason}")]
    Key {
        /// Number of the key in the file, from 1.
        number: usize,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// No key by which signatures could be verified.
    #[error("it holds no key for signatures of RS, PS, ES, EdDSA or HS")]
    None,
    /// More keys than are tried for one token.
    #[error("it holds more than {MOST_KEYS} keys")]
    TooMany,
}

#[derive(Deserialize)]
struct JwkSet {
    keys: Vec<serde_json::Value>,
}

impl KeySet {
    /// Reads a file: JSON where it begins with `{`, else PEM.
    ///
    /// Keys of a JWKS that are for encryption, or of a type that is not known here, are passed over (RFC 7517, 5).
    ///
    /// # Errors
    /// A file without a usable key, or with a weak one.
    pub fn parse(bytes: &[u8]) -> Result<Self, KeyError> {
        let is_json = bytes.iter().find(|byte| !byte.is_ascii_whitespace()) == Some(&b'{');
        let keys = if is_json { from_jwks(bytes)? } else { from_pem(bytes)? };
        if keys.is_empty() {
            return Err(KeyError::None);
        }
        if keys.len() > MOST_KEYS {
            return Err(KeyError::TooMany);
        }
        let mut ids = HashSet::new();
        for (index, key) in keys.iter().enumerate() {
            if key.id.as_ref().is_some_and(|id| !ids.insert((id, key.algorithm))) {
                return Err(KeyError::Key { number: index + 1, reason: "its kid is that of another key" });
            }
        }
        Ok(Self { keys })
    }

    /// The keys with which a token of this header is to be tried: those of its `kid`, or, where it has none or no key
    /// has one, those of its algorithm.
    pub fn candidates<'a>(
        &'a self,
        id: Option<&'a str>,
        algorithm: Algorithm,
    ) -> impl Iterator<Item = &'a VerificationKey> {
        let of_id = move |key: &&VerificationKey| match (&key.id, id) {
            (Some(mine), Some(id)) => mine == id,
            _ => true,
        };
        self.keys.iter().filter(of_id).filter(move |key| key.algorithm == algorithm)
    }

    /// Number of keys.
    #[must_use]
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }
}

fn from_jwks(bytes: &[u8]) -> Result<Vec<VerificationKey>, KeyError> {
    let set: JwkSet = serde_json::from_slice(bytes).map_err(|_| KeyError::Format)?;
    let mut keys = Vec::new();
    for (index, value) in set.keys.into_iter().enumerate() {
        let Ok(jwk) = serde_json::from_value::<Jwk>(value) else { continue };
        if let Some(key) = from_jwk(&jwk).map_err(|reason| KeyError::Key { number: index + 1, reason })? {
            keys.push(key);
        }
    }
    Ok(keys)
}

/// `None` for a key that is not for signatures, or whose type is not known.
fn from_jwk(jwk: &Jwk) -> Result<Option<VerificationKey>, &'static str> {
    let common = &jwk.common;
    let for_signatures = common.public_key_use.as_ref().is_none_or(|usage| *usage == PublicKeyUse::Signature);
    let verifies = common.key_operations.as_ref().is_none_or(|all| all.contains(&KeyOperations::Verify));
    if !for_signatures || !verifies {
        return Ok(None);
    }
    let own = match &jwk.algorithm {
        AlgorithmParameters::RSA(_) => Algorithm::RS256,
        AlgorithmParameters::EllipticCurve(ec) if ec.curve == EllipticCurve::P256 => Algorithm::ES256,
        AlgorithmParameters::EllipticCurve(ec) if ec.curve == EllipticCurve::P384 => Algorithm::ES384,
        AlgorithmParameters::OctetKeyPair(pair) if pair.curve == EllipticCurve::Ed25519 => Algorithm::EdDSA,
        AlgorithmParameters::OctetKey(_) => Algorithm::HS256,
        _ => return Ok(None),
    };
    let algorithm = match common.key_algorithm {
        None => own,
        Some(named) => match Algorithm::try_from(named) {
            Ok(named) if fits(named, own) => named,
            Ok(_) => return Err("its alg is not one of its kty and crv"),
            Err(_) => return Ok(None),
        },
    };
    let key = DecodingKey::from_jwk(jwk).map_err(|_| "it cannot be read")?;
    if is_weak(&key) {
        return Err("it is too short: RSA needs 2048 bits, a secret 32 bytes");
    }
    Ok(Some(VerificationKey { id: common.key_id.clone(), algorithm, key }))
}

/// Whether a key whose own algorithm is `own` may verify by `named`.
fn fits(named: Algorithm, own: Algorithm) -> bool {
    match own {
        Algorithm::ES256 | Algorithm::ES384 => named == own,
        _ => named.family() == own.family(),
    }
}

fn is_weak(key: &DecodingKey) -> bool {
    use jsonwebtoken::DecodingKeyKind::{RsaModulusExponent, SecretOrDer};
    match (key.family(), key.kind()) {
        (AlgorithmFamily::Hmac, SecretOrDer(secret)) => secret.len() < SHORTEST_SECRET_BYTES,
        (_, RsaModulusExponent { n, .. }) => n.iter().skip_while(|byte| **byte == 0).count() < SHORTEST_MODULUS_BYTES,
        _ => false,
    }
}

fn from_pem(bytes: &[u8]) -> Result<Vec<VerificationKey>, KeyError> {
    let mut keys = Vec::new();
    for section in <(SectionKind, Vec<u8>)>::pem_slice_iter(bytes) {
        let (kind, der) = section.map_err(|_| KeyError::Format)?;
        if kind != SectionKind::PublicKey {
            return Err(KeyError::NotPublic(format!("{kind:?}")));
        }
        let key = from_public_key(&der).map_err(|reason| KeyError::Key { number: keys.len() + 1, reason })?;
        keys.push(key);
    }
    if keys.is_empty() { Err(KeyError::Format) } else { Ok(keys) }
}

fn from_public_key(der: &[u8]) -> Result<VerificationKey, &'static str> {
    use x509_parser::public_key::PublicKey;
    let unreadable = "it is not a public key that can be read";
    let (_, info) = SubjectPublicKeyInfo::from_der(der).map_err(|_| unreadable)?;
    let raw = info.subject_public_key.data.as_ref();
    let (algorithm, key) = match info.parsed() {
        Ok(PublicKey::RSA(rsa)) => {
            (Algorithm::RS256, DecodingKey::from_rsa_raw_components(unsigned(rsa.modulus), unsigned(rsa.exponent)))
        }
        // An uncompressed point: 1 + 2 x 32 bytes on P-256, 1 + 2 x 48 on P-384.
        Ok(PublicKey::EC(_)) if raw.len() == 65 => (Algorithm::ES256, DecodingKey::from_ec_der(raw)),
        Ok(PublicKey::EC(_)) if raw.len() == 97 => (Algorithm::ES384, DecodingKey::from_ec_der(raw)),
        Ok(_) if info.algorithm.algorithm == x509_parser::oid_registry::OID_SIG_ED25519 && raw.len() == 32 => {
            (Algorithm::EdDSA, DecodingKey::from_ed_der(raw))
        }
        _ => return Err("it is not a key of RSA, P-256, P-384 or Ed25519"),
    };
    if is_weak(&key) {
        Err("it is too short: RSA needs 2048 bits")
    } else {
        Ok(VerificationKey { id: None, algorithm, key })
    }
}

/// A DER integer without the zero that marks it as positive.
fn unsigned(integer: &[u8]) -> &[u8] {
    integer.strip_prefix(&[0]).unwrap_or(integer)
}

impl std::fmt::Debug for VerificationKey {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("VerificationKey").field("algorithm", &self.algorithm).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn jwks(keys: &serde_json::Value) -> Result<KeySet, KeyError> {
        KeySet::parse(json!({ "keys": keys }).to_string().as_bytes())
    }

    fn secret(extra: &serde_json::Value) -> serde_json::Value {
        let mut key = json!({ "kty": "oct", "k": "MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE" });
        key.as_object_mut().unwrap().extend(extra.as_object().unwrap().clone());
        key
    }

    #[test]
    fn keys_that_are_not_for_signatures_are_passed_over() {
        let others = json!([
            secret(&json!({ "use": "enc" })),
            secret(&json!({ "key_ops": ["encrypt"] })),
            secret(&json!({ "alg": "A128KW" })),
            json!({ "kty": "new", "x": "y" }),
            secret(&json!({ "kid": "a", "use": "sig", "alg": "HS512" })),
        ]);
        let keys = jwks(&others).unwrap();
        assert_eq!(keys.len(), 1);
        assert_eq!(keys.candidates(Some("a"), Algorithm::HS512).count(), 1);
        assert_eq!(keys.candidates(Some("a"), Algorithm::HS256).count(), 0);
        assert_eq!(keys.candidates(Some("b"), Algorithm::HS512).count(), 0);
        assert_eq!(jwks(&json!([secret(&json!({ "use": "enc" }))])).unwrap_err(), KeyError::None);
    }

    #[test]
    fn a_key_whose_algorithm_is_not_its_own_is_refused() {
        let refused = jwks(&json!([secret(&json!({ "alg": "RS256" }))])).unwrap_err();
        assert_eq!(refused, KeyError::Key { number: 1, reason: "its alg is not one of its kty and crv" });
        let twice = jwks(&json!([secret(&json!({ "kid": "a" })), secret(&json!({ "kid": "a" }))])).unwrap_err();
        assert_eq!(twice, KeyError::Key { number: 2, reason: "its kid is that of another key" });
    }

    #[test]
    fn a_short_rsa_key_is_refused() {
        let short = KeySet::parse(include_bytes!("../../testdata/tokens/rsa-1024.pem")).unwrap_err();
        assert_eq!(short, KeyError::Key { number: 1, reason: "it is too short: RSA needs 2048 bits" });
    }

    #[test]
    fn a_key_does_not_show_itself_in_a_log() {
        let keys = jwks(&json!([secret(&json!({ "kid": "name-of-key" }))])).unwrap();
        let shown = format!("{keys:?}");
        assert!(shown.contains("HS256") && !shown.contains("0123") && !shown.contains("MDEy"), "{shown}");
    }
}
