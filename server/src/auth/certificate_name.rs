//! The name in a client's certificate.
//!
//! A certificate speaks for the vehicle in its first URI among the subject's alternative names that begins with
//! `lanemap://`: `lanemap://{fleet}/{vehicle}`. Where there is none, its first common name `{fleet}/{vehicle}` counts;
//! zenoh knows common names only (at most 64 characters, RFC 5280), so a certificate for zenoh has that too, and where a
//! certificate has both, they must agree. Ids are percent-encoded as in zenoh's keys. DNS names are names of machines:
//! they are not read.
//!
//! A certificate that names no vehicle authenticates nobody: its holder is asked for a token like anyone else.

use std::time::{Duration, SystemTime};

use rustls::pki_types::CertificateDer;
use thiserror::Error;
use x509_parser::prelude::{FromDer, GeneralName, X509Certificate};

use super::VehicleName;

/// What the URI begins with.
const SCHEME: &str = "lanemap://";

/// What a verified certificate says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CertificateIdentity {
    /// The vehicle that it names.
    pub vehicle: Option<VehicleName>,
    /// The end of its validity.
    pub expires_at: SystemTime,
}

/// Why a certificate's name is not taken. It repeats nothing of the certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum CertificateNameError {
    /// The certificate cannot be read, or has no time of expiry that a clock could show.
    #[error("the client's certificate cannot be read")]
    Unreadable,
    /// A URI begins with `lanemap://` but names no vehicle.
    #[error("the client's certificate has a URI lanemap:// that is not lanemap://fleet/vehicle, percent-encoded")]
    Uri,
    /// Two names for one certificate.
    #[error("the client's certificate names one vehicle in its URI and another in its common name")]
    Contradiction,
}

/// Reads what a certificate that was verified says.
///
/// # Errors
/// A certificate whose name is broken or ambiguous.
pub fn identity(certificate: &CertificateDer<'_>) -> Result<CertificateIdentity, CertificateNameError> {
    let (_, certificate) = X509Certificate::from_der(certificate).map_err(|_| CertificateNameError::Unreadable)?;
    let names = certificate.subject_alternative_name().map_err(|_| CertificateNameError::Unreadable)?;
    let uri = names.and_then(|names| {
        names.value.general_names.iter().find_map(|name| match name {
            GeneralName::URI(uri) => uri.strip_prefix(SCHEME),
            _ => None,
        })
    });
    let by_uri = uri.map(str::parse::<VehicleName>).transpose().map_err(|_| CertificateNameError::Uri)?;
    let common_name = certificate.subject().iter_common_name().next().and_then(|name| name.as_str().ok());
    let by_common_name = common_name.and_then(|name| name.parse::<VehicleName>().ok());
    let vehicle = match (by_uri, by_common_name) {
        (Some(by_uri), Some(by_common_name)) if by_uri != by_common_name => {
            return Err(CertificateNameError::Contradiction);
        }
        (by_uri, by_common_name) => by_uri.or(by_common_name),
    };
    let not_after_s = u64::try_from(certificate.validity().not_after.timestamp());
    let expires_at = not_after_s.ok().and_then(|s| SystemTime::UNIX_EPOCH.checked_add(Duration::from_secs(s)));
    Ok(CertificateIdentity { vehicle, expires_at: expires_at.ok_or(CertificateNameError::Unreadable)? })
}
