//! Settings given as flags: each is unset or wins over environment and file.

use std::{net::SocketAddr, path::PathBuf};

use super::{BasePath, Endpoints, ServerConfig, ZenohMode};

/// The settings of [`ServerConfig`], each of which may be unset.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ConfigOverrides {
    /// See [`ServerConfig::listen`].
    pub listen: Option<SocketAddr>,
    /// See [`ServerConfig::insecure_listen_anywhere`].
    pub insecure_listen_anywhere: Option<bool>,
    /// See [`ServerConfig::tls_cert_file`].
    pub tls_cert_file: Option<PathBuf>,
    /// See [`ServerConfig::tls_key_file`].
    pub tls_key_file: Option<PathBuf>,
    /// See [`ServerConfig::tls_client_ca_file`].
    pub tls_client_ca_file: Option<PathBuf>,
    /// See [`ServerConfig::tls_client_crl_file`].
    pub tls_client_crl_file: Option<PathBuf>,
    /// See [`ServerConfig::tls_require_client_certificate`].
    pub tls_require_client_certificate: Option<bool>,
    /// See [`ServerConfig::tls_handshake_timeout_s`].
    pub tls_handshake_timeout_s: Option<u64>,
    /// See [`ServerConfig::max_tls_handshakes`].
    pub max_tls_handshakes: Option<usize>,
    /// See [`ServerConfig::token_keys_file`].
    pub token_keys_file: Option<PathBuf>,
    /// See [`ServerConfig::token_issuer`].
    pub token_issuer: Option<String>,
    /// See [`ServerConfig::token_audience`].
    pub token_audience: Option<String>,
    /// See [`ServerConfig::anonymous_read`].
    pub anonymous_read: Option<bool>,
    /// See [`ServerConfig::base_path`].
    pub base_path: Option<BasePath>,
    /// See [`ServerConfig::trust_forwarded_headers`].
    pub trust_forwarded_headers: Option<bool>,
    /// See [`ServerConfig::request_timeout_s`].
    pub request_timeout_s: Option<u64>,
    /// See [`ServerConfig::header_timeout_s`].
    pub header_timeout_s: Option<u64>,
    /// See [`ServerConfig::max_url_bytes`].
    pub max_url_bytes: Option<usize>,
    /// See [`ServerConfig::max_header_bytes`].
    pub max_header_bytes: Option<usize>,
    /// See [`ServerConfig::data_dir`].
    pub data_dir: Option<PathBuf>,
    /// See [`ServerConfig::zenoh_mode`].
    pub zenoh_mode: Option<ZenohMode>,
    /// See [`ServerConfig::zenoh_listen`].
    pub zenoh_listen: Option<Endpoints>,
    /// See [`ServerConfig::zenoh_connect`].
    pub zenoh_connect: Option<Endpoints>,
    /// See [`ServerConfig::zenoh_vehicles_file`].
    pub zenoh_vehicles_file: Option<PathBuf>,
    /// See [`ServerConfig::zenoh_passwords_file`].
    pub zenoh_passwords_file: Option<PathBuf>,
    /// See [`ServerConfig::zenoh_ca_file`].
    pub zenoh_ca_file: Option<PathBuf>,
    /// See [`ServerConfig::zenoh_user`].
    pub zenoh_user: Option<String>,
    /// See [`ServerConfig::zenoh_password_file`].
    pub zenoh_password_file: Option<PathBuf>,
    /// See [`ServerConfig::zenoh_trust_router`].
    pub zenoh_trust_router: Option<bool>,
    /// See [`ServerConfig::max_message_bytes`].
    pub max_message_bytes: Option<usize>,
    /// See [`ServerConfig::max_detections`].
    pub max_detections: Option<usize>,
    /// See [`ServerConfig::max_points_per_detection`].
    pub max_points_per_detection: Option<usize>,
    /// See [`ServerConfig::max_point_range_m`].
    pub max_point_range_m: Option<f64>,
    /// See [`ServerConfig::max_odometry_range_m`].
    pub max_odometry_range_m: Option<f64>,
    /// See [`ServerConfig::max_sessions`].
    pub max_sessions: Option<usize>,
    /// See [`ServerConfig::max_live_sessions`].
    pub max_live_sessions: Option<usize>,
    /// See [`ServerConfig::max_connections`].
    pub max_connections: Option<usize>,
    /// See [`ServerConfig::max_streams_per_connection`].
    pub max_streams_per_connection: Option<usize>,
    /// See [`ServerConfig::max_frames_in_flight`].
    pub max_frames_in_flight: Option<usize>,
    /// See [`ServerConfig::max_bytes_in_flight`].
    pub max_bytes_in_flight: Option<usize>,
    /// See [`ServerConfig::reorder_window_frames`].
    pub reorder_window_frames: Option<usize>,
    /// See [`ServerConfig::reorder_wait_ms`].
    pub reorder_wait_ms: Option<u64>,
    /// See [`ServerConfig::max_frames_per_commit`].
    pub max_frames_per_commit: Option<usize>,
    /// See [`ServerConfig::max_waiting_commits`].
    pub max_waiting_commits: Option<usize>,
    /// See [`ServerConfig::min_free_disk_bytes`].
    pub min_free_disk_bytes: Option<u64>,
    /// See [`ServerConfig::snapshot_every_frames`].
    pub snapshot_every_frames: Option<u64>,
    /// See [`ServerConfig::publish_interval_ms`].
    pub publish_interval_ms: Option<u64>,
    /// See [`ServerConfig::unload_after_s`].
    pub unload_after_s: Option<u64>,
    /// See [`ServerConfig::max_cached_map_bytes`].
    pub max_cached_map_bytes: Option<usize>,
    /// See [`ServerConfig::fuse_threads`].
    pub fuse_threads: Option<usize>,
    /// See [`ServerConfig::fuse_interval_ms`].
    pub fuse_interval_ms: Option<u64>,
    /// See [`ServerConfig::fuse_cpu_share`].
    pub fuse_cpu_share: Option<f64>,
    /// See [`ServerConfig::max_contributions_per_cell`].
    pub max_contributions_per_cell: Option<usize>,
    /// See [`ServerConfig::cell_versions_kept_s`].
    pub cell_versions_kept_s: Option<u64>,
    /// See [`ServerConfig::max_cached_cell_bytes`].
    pub max_cached_cell_bytes: Option<usize>,
    /// See [`ServerConfig::max_cached_tile_bytes`].
    pub max_cached_tile_bytes: Option<usize>,
    /// See [`ServerConfig::max_cached_feature_bytes`].
    pub max_cached_feature_bytes: Option<usize>,
    /// See [`ServerConfig::keep_alive_s`].
    pub keep_alive_s: Option<u64>,
    /// See [`ServerConfig::start_wait_s`].
    pub start_wait_s: Option<u64>,
    /// See [`ServerConfig::drain_delay_ms`].
    pub drain_delay_ms: Option<u64>,
    /// See [`ServerConfig::shutdown_grace_s`].
    pub shutdown_grace_s: Option<u64>,
    /// See [`ServerConfig::privacy_key_file`].
    pub privacy_key_file: Option<PathBuf>,
    /// See [`ServerConfig::trip_cut_m`].
    pub trip_cut_m: Option<f64>,
    /// See [`ServerConfig::trip_cut_s`].
    pub trip_cut_s: Option<f64>,
    /// See [`ServerConfig::trip_stop_s`].
    pub trip_stop_s: Option<f64>,
    /// See [`ServerConfig::trip_erase_s`].
    pub trip_erase_s: Option<u64>,
}

impl ConfigOverrides {
    pub(super) fn apply_to(self, settings: &mut ServerConfig) {
        set(&mut settings.listen, self.listen);
        set(&mut settings.insecure_listen_anywhere, self.insecure_listen_anywhere);
        set_optional(&mut settings.tls_cert_file, self.tls_cert_file);
        set_optional(&mut settings.tls_key_file, self.tls_key_file);
        set_optional(&mut settings.tls_client_ca_file, self.tls_client_ca_file);
        set_optional(&mut settings.tls_client_crl_file, self.tls_client_crl_file);
        set(&mut settings.tls_require_client_certificate, self.tls_require_client_certificate);
        set(&mut settings.tls_handshake_timeout_s, self.tls_handshake_timeout_s);
        set(&mut settings.max_tls_handshakes, self.max_tls_handshakes);
        set_optional(&mut settings.token_keys_file, self.token_keys_file);
        set_optional(&mut settings.token_issuer, self.token_issuer);
        set(&mut settings.token_audience, self.token_audience);
        set(&mut settings.anonymous_read, self.anonymous_read);
        set(&mut settings.base_path, self.base_path);
        set(&mut settings.trust_forwarded_headers, self.trust_forwarded_headers);
        set(&mut settings.request_timeout_s, self.request_timeout_s);
        set(&mut settings.header_timeout_s, self.header_timeout_s);
        set(&mut settings.max_url_bytes, self.max_url_bytes);
        set(&mut settings.max_header_bytes, self.max_header_bytes);
        set(&mut settings.data_dir, self.data_dir);
        set(&mut settings.zenoh_mode, self.zenoh_mode);
        set(&mut settings.zenoh_listen, self.zenoh_listen);
        set(&mut settings.zenoh_connect, self.zenoh_connect);
        set_optional(&mut settings.zenoh_vehicles_file, self.zenoh_vehicles_file);
        set_optional(&mut settings.zenoh_passwords_file, self.zenoh_passwords_file);
        set_optional(&mut settings.zenoh_ca_file, self.zenoh_ca_file);
        set_optional(&mut settings.zenoh_user, self.zenoh_user);
        set_optional(&mut settings.zenoh_password_file, self.zenoh_password_file);
        set(&mut settings.zenoh_trust_router, self.zenoh_trust_router);
        set(&mut settings.max_message_bytes, self.max_message_bytes);
        set(&mut settings.max_detections, self.max_detections);
        set(&mut settings.max_points_per_detection, self.max_points_per_detection);
        set(&mut settings.max_point_range_m, self.max_point_range_m);
        set(&mut settings.max_odometry_range_m, self.max_odometry_range_m);
        set(&mut settings.max_sessions, self.max_sessions);
        set(&mut settings.max_live_sessions, self.max_live_sessions);
        set(&mut settings.max_connections, self.max_connections);
        set(&mut settings.max_streams_per_connection, self.max_streams_per_connection);
        set(&mut settings.max_frames_in_flight, self.max_frames_in_flight);
        set(&mut settings.max_bytes_in_flight, self.max_bytes_in_flight);
        set(&mut settings.reorder_window_frames, self.reorder_window_frames);
        set(&mut settings.reorder_wait_ms, self.reorder_wait_ms);
        set(&mut settings.max_frames_per_commit, self.max_frames_per_commit);
        set(&mut settings.max_waiting_commits, self.max_waiting_commits);
        set(&mut settings.min_free_disk_bytes, self.min_free_disk_bytes);
        set(&mut settings.snapshot_every_frames, self.snapshot_every_frames);
        set(&mut settings.publish_interval_ms, self.publish_interval_ms);
        set(&mut settings.unload_after_s, self.unload_after_s);
        set(&mut settings.max_cached_map_bytes, self.max_cached_map_bytes);
        set(&mut settings.fuse_threads, self.fuse_threads);
        set(&mut settings.fuse_interval_ms, self.fuse_interval_ms);
        set(&mut settings.fuse_cpu_share, self.fuse_cpu_share);
        set(&mut settings.max_contributions_per_cell, self.max_contributions_per_cell);
        set(&mut settings.cell_versions_kept_s, self.cell_versions_kept_s);
        set(&mut settings.max_cached_cell_bytes, self.max_cached_cell_bytes);
        set(&mut settings.max_cached_tile_bytes, self.max_cached_tile_bytes);
        set(&mut settings.max_cached_feature_bytes, self.max_cached_feature_bytes);
        set(&mut settings.keep_alive_s, self.keep_alive_s);
        set(&mut settings.start_wait_s, self.start_wait_s);
        set(&mut settings.drain_delay_ms, self.drain_delay_ms);
        set(&mut settings.shutdown_grace_s, self.shutdown_grace_s);
        set(&mut settings.privacy_key_file, self.privacy_key_file);
        set(&mut settings.trip_cut_m, self.trip_cut_m);
        set(&mut settings.trip_cut_s, self.trip_cut_s);
        set(&mut settings.trip_stop_s, self.trip_stop_s);
        set(&mut settings.trip_erase_s, self.trip_erase_s);
    }
}

fn set<T>(setting: &mut T, flag: Option<T>) {
    if let Some(value) = flag {
        *setting = value;
    }
}

fn set_optional<T>(setting: &mut Option<T>, flag: Option<T>) {
    if flag.is_some() {
        *setting = flag;
    }
}
