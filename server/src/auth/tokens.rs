//! Bearer tokens: JSON Web Tokens (RFC 7519, RFC 8725) that somebody else issues and this service verifies.
//!
//! | claim | is |
//! |---|---|
//! | `iss`, `aud`, `exp` | required; `iss` and `aud` as the settings `token_issuer` and `token_audience` say |
//! | `nbf` | obeyed where present |
//! | `scope` | scopes separated by blanks; `ingest`, `read` and `admin` are known here. `roles`, a list, counts as well |
//! | `fleet` | the fleet for which the scopes hold; `*`: every fleet. Without it: every fleet for `read` and `admin`, none for `ingest` |
//! | `vehicle` | the vehicle as which the holder streams; `*`: any of the fleet. Without it: none |

use std::time::{Duration, SystemTime};

use jsonwebtoken::{Validation, decode, decode_header, errors::ErrorKind};
use serde::Deserialize;
use thiserror::Error;

use super::{
    keys::{KeySet, VerificationKey},
    peer::{Extent, Grants, Peer, Role},
};

/// Longest token, bytes: larger ones are no tokens of any issuer, and cost memory.
const LONGEST_TOKEN_BYTES: usize = 8 * 1024;
/// Difference of clocks that is forgiven, seconds.
pub const CLOCK_LEEWAY_S: u64 = 30;
/// The claim's value that stands for every fleet or vehicle.
const ANY: &str = "*";

/// Why a token is not taken. It repeats nothing of the token.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum TokenError {
    /// Not three parts of base64url, or not JSON inside, or too long.
    #[error("the token is malformed")]
    Malformed,
    /// No key has the token's `kid` and verifies by its `alg`.
    #[error("no key of this server verifies tokens of this kid and alg")]
    NoKey,
    /// Signed by somebody else, or altered.
    #[error("the token's signature is wrong")]
    Signature,
    /// Its time is over.
    #[error("the token has expired")]
    Expired,
    /// Its time has not come.
    #[error("the token is not valid yet")]
    NotYetValid,
    /// Issued by somebody else.
    #[error("the token is of another issuer")]
    Issuer,
    /// Issued for another service.
    #[error("the token is for another audience")]
    Audience,
    /// `iss`, `aud` or `exp` is missing or malformed.
    #[error("the token lacks one of the claims iss, aud and exp, or one is malformed")]
    Claims,
}

/// Verifies tokens.
#[derive(Clone, Debug)]
pub struct TokenVerifier {
    keys: KeySet,
    issuer: String,
    audience: String,
}

#[derive(Deserialize)]
struct Claims {
    exp: u64,
    #[serde(default)]
    scope: String,
    #[serde(default)]
    roles: Vec<String>,
    fleet: Option<String>,
    vehicle: Option<String>,
}

impl TokenVerifier {
    /// A verifier of tokens that `issuer` issues for `audience`.
    #[must_use]
    pub fn new(keys: KeySet, issuer: impl Into<String>, audience: impl Into<String>) -> Self {
        Self { keys, issuer: issuer.into(), audience: audience.into() }
    }

    /// Who holds this token.
    ///
    /// # Errors
    /// A token that is malformed, not signed by a known key, of the wrong time, issuer or audience.
    pub fn verify(&self, token: &str) -> Result<Peer, TokenError> {
        if token.len() > LONGEST_TOKEN_BYTES {
            return Err(TokenError::Malformed);
        }
        let header = decode_header(token).map_err(|_| TokenError::Malformed)?;
        // Extensions that must be understood, and none is (RFC 7515, 4.1.11).
        if header.crit.is_some() {
            return Err(TokenError::Malformed);
        }
        let mut error = TokenError::NoKey;
        for key in self.keys.candidates(header.kid.as_deref(), header.alg) {
            match self.verify_with(token, key) {
                Ok(claims) => return Ok(claims.peer()),
                Err(TokenError::Signature) => error = TokenError::Signature,
                Err(other) => return Err(other),
            }
        }
        Err(error)
    }

    fn verify_with(&self, token: &str, key: &VerificationKey) -> Result<Claims, TokenError> {
        let mut validation = Validation::new(key.algorithm);
        validation.leeway = CLOCK_LEEWAY_S;
        validation.validate_nbf = true;
        validation.set_required_spec_claims(&["exp", "iss", "aud"]);
        validation.set_issuer(&[&self.issuer]);
        validation.set_audience(&[&self.audience]);
        match decode::<Claims>(token, &key.key, &validation) {
            Ok(token) => Ok(token.claims),
            Err(error) => Err(match error.kind() {
                ErrorKind::InvalidSignature | ErrorKind::InvalidAlgorithm => TokenError::Signature,
                ErrorKind::ExpiredSignature => TokenError::Expired,
                ErrorKind::ImmatureSignature => TokenError::NotYetValid,
                ErrorKind::InvalidIssuer => TokenError::Issuer,
                ErrorKind::InvalidAudience => TokenError::Audience,
                ErrorKind::MissingRequiredClaim(_) | ErrorKind::InvalidClaimFormat(_) | ErrorKind::Json(_) => {
                    TokenError::Claims
                }
                _ => TokenError::Malformed,
            }),
        }
    }
}

impl Claims {
    fn peer(self) -> Peer {
        let named: Vec<_> = self.scope.split_ascii_whitespace().chain(self.roles.iter().map(String::as_str)).collect();
        let known = [("ingest", Role::Ingest), ("read", Role::Read), ("admin", Role::Admin)];
        let roles: Vec<_> = known.into_iter().filter(|(name, _)| named.contains(name)).map(|(_, role)| role).collect();
        // A token that may stream is one fleet's unless it says otherwise: forgetting a claim opens nothing.
        let fleet = match self.fleet {
            Some(fleet) => extent(fleet),
            None if roles.contains(&Role::Ingest) => Extent::None,
            None => Extent::Any,
        };
        let vehicle = self.vehicle.map_or(Extent::None, extent);
        let expires_at =
            SystemTime::UNIX_EPOCH.checked_add(Duration::from_secs(self.exp.saturating_add(CLOCK_LEEWAY_S)));
        Peer::with_grants(Grants { roles, fleet, vehicle }).until(expires_at)
    }
}

fn extent(claim: String) -> Extent {
    if claim == ANY { Extent::Any } else { Extent::Only(claim) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verifier(keys: &[u8]) -> TokenVerifier {
        TokenVerifier::new(KeySet::parse(keys).unwrap(), "i", "lanemap")
    }

    #[test]
    fn keys_in_pem_verify_what_openssl_signed() {
        let pairs: [(&[u8], &str); 3] = [
            (include_bytes!("../../testdata/tokens/rsa.pem"), include_str!("../../testdata/tokens/rsa.jwt")),
            (include_bytes!("../../testdata/tokens/ed25519.pem"), include_str!("../../testdata/tokens/ed25519.jwt")),
            (include_bytes!("../../testdata/tokens/p384.pem"), include_str!("../../testdata/tokens/p384.jwt")),
        ];
        for (index, (keys, token)) in pairs.iter().enumerate() {
            let peer = verifier(keys).verify(token).unwrap();
            assert!(peer.may_read(None).is_ok() && peer.may_stream("north", "car-1").is_err());
            let another = pairs[(index + 1) % pairs.len()].1;
            assert_eq!(verifier(keys).verify(another).unwrap_err(), TokenError::NoKey);
        }
        let all: Vec<u8> = pairs.iter().flat_map(|(keys, _)| keys.iter().copied()).collect();
        assert!(pairs.iter().all(|(_, token)| verifier(&all).verify(token).is_ok()));
    }

    #[test]
    fn a_scope_is_a_whole_word() {
        let claims = |scope: &str| Claims {
            exp: 4_102_444_800,
            scope: scope.to_owned(),
            roles: Vec::new(),
            fleet: None,
            vehicle: None,
        };
        assert!(claims("openid read profile").peer().may_read(None).is_ok());
        assert!(claims("readers READ read:maps").peer().may_read(None).is_err());
        assert!(
            claims("read ingest").peer().may_read(None).is_err(),
            "one that streams is one fleet's unless it says so"
        );
    }
}
