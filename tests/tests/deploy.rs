//! What `deploy/` hands to an operator is true: the example's settings exist, and its comments tell the defaults.

#![allow(clippy::unwrap_used)] // a test fails where it fails

use std::{io::Write, path::Path};

use lanemap_server::{ConfigOverrides, ServerConfig};
use tempfile::NamedTempFile;

const EXAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/lanemap.example.yaml");

fn load(file: &Path) -> ServerConfig {
    ServerConfig::load(Some(file), ConfigOverrides::default()).unwrap()
}

/// The example with every commented setting put in force.
fn example_uncommented() -> NamedTempFile {
    let example = std::fs::read_to_string(EXAMPLE).unwrap();
    let mut file = NamedTempFile::new().unwrap();
    for line in example.lines() {
        let setting = line.strip_prefix("# ").filter(|rest| is_setting(rest));
        writeln!(file, "{}", setting.unwrap_or(line)).unwrap();
    }
    file
}

fn is_setting(line: &str) -> bool {
    line.split_once(": ")
        .is_some_and(|(name, _)| name.chars().all(|letter| letter.is_ascii_lowercase() || letter == '_'))
}

fn shipped_settings() -> ServerConfig {
    ServerConfig {
        listen: "0.0.0.0:8080".parse().unwrap(),
        data_dir: "/var/lib/lanemap".into(),
        tls_cert_file: Some("/etc/lanemap/tls/server.crt".into()),
        tls_key_file: Some("/etc/lanemap/tls/server.key".into()),
        tls_client_ca_file: Some("/etc/lanemap/tls/vehicles-ca.crt".into()),
        ..ServerConfig::default()
    }
}

#[test]
fn the_example_configuration_is_accepted_as_it_stands() {
    assert_eq!(load(Path::new(EXAMPLE)), shipped_settings());
}

#[test]
fn commented_settings_of_the_example_are_the_defaults() {
    assert_eq!(load(example_uncommented().path()), shipped_settings());
}

#[test]
fn the_example_names_every_setting() {
    let example = std::fs::read_to_string(EXAMPLE).unwrap();
    let settings = serde_json::to_value(ServerConfig::default()).unwrap();
    for name in settings.as_object().unwrap().keys() {
        let named = example.lines().any(|line| line.trim_start_matches("# ").starts_with(&format!("{name}: ")));
        assert!(named, "{name} is missing from deploy/lanemap.example.yaml");
    }
}
