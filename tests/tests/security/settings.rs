//! What the service refuses to start with.

use std::process::Command;

use lanemap_server::{ConfigOverrides, Server, ServerConfig};
use lanemap_tests::{authorities::TlsFolder, servers, tokens};
use serde_json::json;

#[tokio::test(flavor = "multi_thread")]
async fn the_service_listens_beyond_the_machine_only_with_tls_and_authentication() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let anywhere = "0.0.0.0:0".parse().unwrap();
    let bare = ServerConfig { listen: anywhere, ..servers::config(folder.path()) };
    let refused = |config: &ServerConfig| config.check().unwrap_err().to_string();
    let everything = refused(&bare);
    assert!(everything.contains("TLS") && everything.contains("authentication"), "{everything}");
    assert!(everything.contains("insecure_listen_anywhere"), "{everything}");
    let no_authentication = ServerConfig { listen: anywhere, tls_client_ca_file: None, ..tls.config() };
    assert!(refused(&no_authentication).contains("authentication"));
    let no_tls = ServerConfig {
        token_keys_file: Some("keys.json".into()),
        token_issuer: Some("https://issuer.test".to_owned()),
        ..bare.clone()
    };
    assert!(refused(&no_tls).contains("needs TLS"));
    assert!(Server::start(bare.clone()).await.is_err());

    ServerConfig { listen: "[::1]:0".parse().unwrap(), ..bare.clone() }.check().unwrap();
    Server::start(ServerConfig { listen: anywhere, ..tls.config() }).await.unwrap().shutdown().await;
    let told = ServerConfig { insecure_listen_anywhere: true, ..bare };
    Server::start(told).await.unwrap().shutdown().await;
}

#[test]
fn the_command_says_what_is_missing_where_it_would_be_open_to_a_network() {
    let folder = tempfile::tempdir().unwrap();
    let refused = Command::new(env!("CARGO_BIN_EXE_lanemap-under-test"))
        .args(["serve", "--listen", "0.0.0.0:0", "--data-dir"])
        .arg(folder.path())
        .output()
        .unwrap();
    assert!(!refused.status.success());
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("tls_cert_file") && said.contains("insecure_listen_anywhere"), "{said}");
}

#[test]
fn settings_of_tls_and_tokens_stand_together_or_are_refused_by_name() {
    let path = || Some("file".into());
    let alone = [
        ConfigOverrides { tls_cert_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { tls_key_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { tls_client_ca_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { tls_client_crl_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { tls_require_client_certificate: Some(true), ..ConfigOverrides::default() },
        ConfigOverrides { token_keys_file: path(), ..ConfigOverrides::default() },
        ConfigOverrides { token_issuer: Some("me".to_owned()), ..ConfigOverrides::default() },
    ];
    for overrides in alone {
        let error = ServerConfig::load(None, overrides.clone()).unwrap_err().to_string();
        assert!(error.contains(" needs "), "{overrides:?}: {error}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn files_that_hold_no_certificate_or_weak_keys_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let tls = TlsFolder::new(folder.path());
    let start = async |config: ServerConfig| Server::start(config).await.unwrap_err().to_string();
    let missing = ServerConfig { tls_cert_file: Some(folder.path().join("nothing.crt")), ..tls.config() };
    let error = start(missing).await;
    assert!(error.contains("tls_cert_file") && error.contains("nothing.crt"), "{error}");
    let text = tls.write("text.crt", "a secret that must not be repeated");
    let error = start(ServerConfig { tls_key_file: Some(text), ..tls.config() }).await;
    assert!(error.contains("tls_key_file") && !error.contains("secret"), "{error}");

    let tokens = |name: &str, keys: &str| ServerConfig {
        token_keys_file: Some(tls.write(name, keys)),
        token_issuer: Some(tokens::ISSUER.to_owned()),
        ..servers::config(&folder.path().join("data"))
    };
    let weak = json!({ "keys": [{ "kty": "oct", "kid": "a", "k": "c2hvcnQtc2VjcmV0" }] }).to_string();
    let error = start(tokens("weak.json", &weak)).await;
    assert!(error.contains("key 1") && error.contains("too short") && !error.contains("c2hvcnQ"), "{error}");
    let private = tls.write("private.pem", &tls.servers.server(3).key);
    let private = std::fs::read_to_string(private).unwrap();
    let error = start(tokens("private.pem", &private)).await;
    assert!(error.contains("public keys verify tokens"), "{error}");
    let error = start(tokens("empty.json", "{\"keys\": []}")).await;
    assert!(error.contains("token_keys_file"), "{error}");
}
