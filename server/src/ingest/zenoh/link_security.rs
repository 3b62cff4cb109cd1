//! TLS and passwords of zenoh's links, from the files that secure gRPC and HTTP too.
//!
//! As it is published, zenoh 1.10 reads and writes the same TLS connection from two threads without a lock
//! (<https://github.com/eclipse-zenoh/zenoh/issues/2557>): a write that meets a read ends the link, once in some thousands of
//! messages, and may end the process. This server and the Rust client build the link with a lock (`server/vendor`); a
//! vehicle that brings its own zenoh may still lose its link by itself. It connects again, and sends what was not acked;
//! whoever wants TLS without such breaks takes gRPC.

use std::path::Path;

use serde_json::{Value, json};

use super::access::AccessRules;
use crate::{
    auth::reload::{CredentialError, read},
    config::{ServerConfig, ZenohMode},
};

/// Settings of zenoh's transport, by name.
pub(super) fn link_security(
    settings: &ServerConfig,
    rules: Option<&AccessRules>,
) -> Result<Vec<(&'static str, Value)>, CredentialError> {
    let mut transport = vec![("transport/link/tls", tls(settings, rules))];
    let mut login = serde_json::Map::new();
    if let Some(passwords) = &settings.zenoh_passwords_file {
        login.insert("dictionary_file".to_owned(), path(passwords));
    }
    if let (Some(user), Some(file)) = (&settings.zenoh_user, &settings.zenoh_password_file) {
        login.insert("user".to_owned(), json!(user));
        login.insert("password".to_owned(), json!(password(file)?));
    }
    if !login.is_empty() {
        transport.push(("transport/auth/usrpwd", Value::Object(login)));
    }
    Ok(transport)
}

fn tls(settings: &ServerConfig, rules: Option<&AccessRules>) -> Value {
    let client = settings.zenoh_mode == ZenohMode::Client;
    let mut tls = json!({ "verify_name_on_connect": true, "close_link_on_expiration": true });
    let mut set = |name: &str, value: Option<Value>| {
        if let Some(value) = value {
            tls[name] = value;
        }
    };
    let (certificate, key) = (settings.tls_cert_file.as_deref(), settings.tls_key_file.as_deref());
    let side = if client { "connect" } else { "listen" };
    set(&format!("{side}_certificate"), certificate.map(path));
    set(&format!("{side}_private_key"), key.map(path));
    let authorities = if client { &settings.zenoh_ca_file } else { &settings.tls_client_ca_file };
    set("root_ca_certificate", authorities.as_deref().map(path));
    // A router that asks for certificates asks everyone; a client shows the one that it has.
    let by_certificate = if client { certificate.is_some() } else { rules.is_some_and(|it| it.proofs().certificate) };
    set("enable_mtls", Some(json!(by_certificate)));
    tls
}

fn path(path: &Path) -> Value {
    json!(path.display().to_string())
}

fn password(file: &Path) -> Result<String, CredentialError> {
    let text = String::from_utf8(read("zenoh_password_file", file)?)
        .map_err(|_| CredentialError::new("zenoh_password_file", file, "it is not UTF-8"))?;
    Ok(text.trim_end_matches(['\r', '\n']).to_owned())
}
