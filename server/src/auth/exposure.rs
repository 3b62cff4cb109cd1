//! Where the service may listen: beyond the loopback interface only with TLS and with peers that show who they are,
//! unless `insecure_listen_anywhere` says otherwise.

use std::net::IpAddr;

use crate::config::{ConfigError, ServerConfig};

/// Refuses settings that would open the service to a network without TLS, or to anyone.
///
/// # Errors
/// [`ConfigError::Exposed`], which names what is missing.
pub fn check(config: &ServerConfig) -> Result<(), ConfigError> {
    if config.insecure_listen_anywhere || is_loopback(config.listen.ip()) {
        return Ok(());
    }
    let authenticates = config.tls_client_ca_file.is_some() || config.token_keys_file.is_some();
    let missing = match (config.tls_cert_file.is_some(), authenticates) {
        (true, true) => return Ok(()),
        (false, true) => "TLS (tls_cert_file, tls_key_file)",
        (true, false) => "authentication (tls_client_ca_file or token_keys_file)",
        (false, false) => {
            "TLS (tls_cert_file, tls_key_file) and authentication (tls_client_ca_file or token_keys_file)"
        }
    };
    Err(ConfigError::Exposed { setting: "listen", address: config.listen.to_string(), missing })
}

/// Whether only this machine reaches an address.
pub(crate) fn is_loopback(address: IpAddr) -> bool {
    address.to_canonical().is_loopback()
}
