//! Where the service may listen: beyond the loopback interface only with TLS and with peers that show who they are,
//! unless `insecure_listen_anywhere` says otherwise.

use std::net::IpAddr;

use crate::config::{ConfigError, ServerConfig, ZenohMode};

/// Refuses settings that would open the service to a network without TLS, or to anyone.
///
/// # Errors
/// [`ConfigError::Exposed`], which names what is missing.
pub fn check(config: &ServerConfig) -> Result<(), ConfigError> {
    if config.insecure_listen_anywhere {
        return Ok(());
    }
    if !is_loopback(config.listen.ip()) {
        check_port(config)?;
    }
    match config.zenoh_mode {
        ZenohMode::Off => Ok(()),
        ZenohMode::Router => config.zenoh_listen.as_slice().iter().try_for_each(|it| check_listen(config, it)),
        ZenohMode::Client => config.zenoh_connect.as_slice().iter().try_for_each(|it| check_connect(config, it)),
    }
}

/// The port of gRPC and HTTP.
fn check_port(config: &ServerConfig) -> Result<(), ConfigError> {
    let missing = match (config.tls_cert_file.is_some(), config.asks_who_peers_are()) {
        (true, true) => return Ok(()),
        (false, true) => "TLS (tls_cert_file, tls_key_file)",
        (true, false) => "authentication (tls_client_ca_file or token_keys_file)",
        (false, false) => {
            "TLS (tls_cert_file, tls_key_file) and authentication (tls_client_ca_file or token_keys_file)"
        }
    };
    Err(ConfigError::Exposed { setting: "listen", address: config.listen.to_string(), missing })
}

/// Where a zenoh router listens: a token would not do, for it says nothing of who may listen in.
fn check_listen(config: &ServerConfig, endpoint: &str) -> Result<(), ConfigError> {
    let keeps_to_keys = config.zenoh_vehicles_file.is_some() || config.zenoh_passwords_file.is_some();
    let missing = match (is_encrypted(endpoint), keeps_to_keys) {
        _ if is_local(endpoint) => return Ok(()),
        (true, true) => return Ok(()),
        (false, true) => "TLS (tls/ instead of tcp/)",
        (true, false) => "access control (zenoh_vehicles_file or zenoh_passwords_file)",
        (false, false) => "TLS (tls/ instead of tcp/) and access control (zenoh_vehicles_file or zenoh_passwords_file)",
    };
    Err(ConfigError::Exposed { setting: "zenoh_listen", address: endpoint.to_owned(), missing })
}

/// The router of a zenoh client: whoever reaches it reaches the service.
fn check_connect(config: &ServerConfig, endpoint: &str) -> Result<(), ConfigError> {
    let authenticates = config.zenoh_trust_router || config.token_keys_file.is_some();
    let missing = match (is_encrypted(endpoint), authenticates) {
        _ if is_local(endpoint) => return Ok(()),
        (true, true) => return Ok(()),
        (false, true) => "TLS (tls/ instead of tcp/)",
        (true, false) => "authentication (zenoh_trust_router or token_keys_file)",
        (false, false) => "TLS (tls/ instead of tcp/) and authentication (zenoh_trust_router or token_keys_file)",
    };
    Err(ConfigError::Exposed { setting: "zenoh_connect", address: endpoint.to_owned(), missing })
}

fn is_encrypted(endpoint: &str) -> bool {
    endpoint.starts_with("tls/") || endpoint.starts_with("quic/")
}

/// Whether an endpoint of zenoh, `protocol/address`, stays on this machine.
fn is_local(endpoint: &str) -> bool {
    let Some((_, address)) = endpoint.split_once('/') else { return false };
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
    let host = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || host.parse().is_ok_and(is_loopback)
}

/// Whether only this machine reaches an address.
pub(crate) fn is_loopback(address: IpAddr) -> bool {
    address.to_canonical().is_loopback()
}
