//! Settings of TLS, tokens and zenoh's access that mean nothing, or something dangerous, without others.

use super::{ConfigError, ServerConfig, ZenohMode};

impl ServerConfig {
    /// Checks that no setting by which somebody shows who it is stands without those that it needs.
    pub(super) fn check_credentials(&self) -> Result<(), ConfigError> {
        let (certificate, key) = (self.tls_cert_file.is_some(), self.tls_key_file.is_some());
        let clients = self.tls_client_ca_file.is_some();
        needs("tls_cert_file", certificate, key, "tls_key_file")?;
        needs("tls_key_file", key, certificate, "tls_cert_file")?;
        needs("tls_client_ca_file", clients, certificate, "tls_cert_file and tls_key_file")?;
        needs("tls_client_crl_file", self.tls_client_crl_file.is_some(), clients, "tls_client_ca_file")?;
        needs("tls_require_client_certificate", self.tls_require_client_certificate, clients, "tls_client_ca_file")?;
        let (keys, issuer) = (self.token_keys_file.is_some(), self.token_issuer.is_some());
        needs("token_keys_file", keys, issuer, "token_issuer")?;
        needs("token_issuer", issuer, keys, "token_keys_file")?;
        self.check_zenoh_access()
    }

    fn check_zenoh_access(&self) -> Result<(), ConfigError> {
        let (router, client) = (self.zenoh_mode == ZenohMode::Router, self.zenoh_mode == ZenohMode::Client);
        let listed = self.zenoh_vehicles_file.is_some();
        needs("zenoh_vehicles_file", listed, router, "zenoh_mode: router")?;
        needs("zenoh_vehicles_file", listed, self.tls_client_ca_file.is_some(), "tls_client_ca_file")?;
        needs("zenoh_passwords_file", self.zenoh_passwords_file.is_some(), router, "zenoh_mode: router")?;
        let proofs = listed || self.zenoh_passwords_file.is_some();
        let readers = self.zenoh_readers_file.is_some();
        needs("zenoh_readers_file", readers, proofs, "zenoh_vehicles_file or zenoh_passwords_file")?;
        needs("zenoh_ca_file", self.zenoh_ca_file.is_some(), client, "zenoh_mode: client")?;
        needs("zenoh_user", self.zenoh_user.is_some(), client, "zenoh_mode: client")?;
        needs("zenoh_user", self.zenoh_user.is_some(), self.zenoh_password_file.is_some(), "zenoh_password_file")?;
        needs("zenoh_password_file", self.zenoh_password_file.is_some(), self.zenoh_user.is_some(), "zenoh_user")?;
        needs("zenoh_trust_router", self.zenoh_trust_router, client, "zenoh_mode: client")?;
        let zenoh = router || client;
        needs(
            "zenoh_mode",
            zenoh && self.asks_who_peers_are(),
            self.zenoh_key_is_proof() || self.token_keys_file.is_some(),
            "zenoh_vehicles_file or zenoh_passwords_file (router), or zenoh_trust_router (client), or token_keys_file, \
             since peers of gRPC are asked who they are",
        )
    }

    /// Whether peers of gRPC and HTTP are asked who they are.
    pub(crate) fn asks_who_peers_are(&self) -> bool {
        self.tls_client_ca_file.is_some() || self.token_keys_file.is_some()
    }

    /// Whether the shared map is published over zenoh: where whoever reads it there may.
    pub(crate) fn publishes_map_over_zenoh(&self) -> bool {
        let is_open = !self.asks_who_peers_are() || self.anonymous_read;
        self.zenoh_publish_map && (self.zenoh_key_is_proof() || is_open)
    }

    /// Whether nobody but a vehicle can publish on its keys in zenoh.
    pub(crate) fn zenoh_key_is_proof(&self) -> bool {
        self.zenoh_vehicles_file.is_some() || self.zenoh_passwords_file.is_some() || self.zenoh_trust_router
    }
}

fn needs(name: &'static str, is_set: bool, met: bool, needs: &'static str) -> Result<(), ConfigError> {
    if is_set && !met { Err(ConfigError::Incomplete { name, needs }) } else { Ok(()) }
}
