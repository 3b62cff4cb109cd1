use std::{collections::HashMap, io::Write};

use super::*;

fn environment(pairs: &[(&str, &str)]) -> config::Environment {
    let pairs: HashMap<_, _> = pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
    config::Environment::with_prefix("LANEMAP").try_parsing(true).source(Some(pairs))
}

fn file(text: &str) -> tempfile::NamedTempFile {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(text.as_bytes()).unwrap();
    file
}

#[test]
fn flags_win_over_environment_over_file_over_defaults() {
    let yaml = file("max_detections: 10\nmax_sessions: 11\npublish_interval_ms: 12\n");
    let environment = environment(&[("LANEMAP_MAX_SESSIONS", "21"), ("LANEMAP_PUBLISH_INTERVAL_MS", "22")]);
    let flags = ConfigOverrides { publish_interval_ms: Some(32), ..ConfigOverrides::default() };
    let settings = ServerConfig::from_sources(Some(yaml.path()), environment, flags).unwrap();
    assert_eq!((settings.max_detections, settings.max_sessions, settings.publish_interval_ms), (10, 21, 32));
    assert_eq!(settings.max_live_sessions, ServerConfig::default().max_live_sessions);
}

#[test]
fn a_name_that_is_no_setting_is_refused_by_name() {
    let yaml = file("max_detection: 10\n");
    let error = ServerConfig::from_sources(Some(yaml.path()), environment(&[]), ConfigOverrides::default());
    assert!(error.unwrap_err().to_string().contains("max_detection"));
    let error = ServerConfig::from_sources(None, environment(&[("LANEMAP_LISTN", "x")]), ConfigOverrides::default());
    assert!(error.unwrap_err().to_string().contains("listn"));
}

#[test]
fn a_setting_out_of_range_is_refused_with_its_limit() {
    let flags = ConfigOverrides { max_frames_in_flight: Some(0), ..ConfigOverrides::default() };
    let error = ServerConfig::from_sources(None, environment(&[]), flags).unwrap_err();
    assert_eq!(error.to_string(), "setting max_frames_in_flight = 0 is outside 1 ..= 4096");
    let flags = ConfigOverrides { fuse_draft_km: Some(-1.0), ..ConfigOverrides::default() };
    let error = ServerConfig::from_sources(None, environment(&[]), flags).unwrap_err();
    assert_eq!(error.to_string(), "setting fuse_draft_km = -1 is outside 0 ..= 1e6");
}

#[test]
fn addresses_and_folders_read_from_the_environment() {
    let environment = environment(&[("LANEMAP_LISTEN", "127.0.0.2:9000"), ("LANEMAP_DATA_DIR", "maps")]);
    let settings = ServerConfig::from_sources(None, environment, ConfigOverrides::default()).unwrap();
    assert_eq!(settings.listen, SocketAddr::from(([127, 0, 0, 2], 9000)));
    assert_eq!(settings.data_dir, PathBuf::from("maps"));
}
