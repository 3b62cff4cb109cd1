//! Settings of the service: flags over environment over file over defaults.
//!
//! A YAML file holds settings by the names of [`ServerConfig`]'s fields; the environment holds them as `LANEMAP_` and the
//! name in capitals, e.g. `LANEMAP_DATA_DIR`. A name that is not a setting is refused in either.

use std::{net::SocketAddr, path::Path, path::PathBuf, time::Duration};

use lanemap_core::FrameLimits;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{auth::exposure, privacy::TripCut};

mod base_path;
mod credentials;
mod overrides;
#[cfg(test)]
mod tests;
mod zenoh;

pub use base_path::{BasePath, BasePathError};
pub use overrides::ConfigOverrides;
pub use zenoh::{EndpointError, Endpoints, ModeError, ZenohMode};

/// Every setting of the service.
#[expect(clippy::struct_excessive_bools, reason = "each is a switch of its own, named as users set it")]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServerConfig {
    /// Address and port for gRPC and HTTP, e.g. `0.0.0.0:8080`; port 0 takes any free one.
    pub listen: SocketAddr,
    /// Listen beyond the loopback interface although there is no TLS, or peers do not show who they are: in a private
    /// network, or behind a proxy that does both.
    pub insecure_listen_anywhere: bool,
    /// Certificates that the service shows, PEM, its own first; with `tls_key_file`: TLS on the port, and no plain text.
    pub tls_cert_file: Option<PathBuf>,
    /// Private key of the first certificate of `tls_cert_file`, PEM.
    pub tls_key_file: Option<PathBuf>,
    /// Authorities whose client certificates are taken, PEM: a certificate names its vehicle.
    pub tls_client_ca_file: Option<PathBuf>,
    /// Lists of revoked client certificates, PEM.
    pub tls_client_crl_file: Option<PathBuf>,
    /// Refuse connections without a client certificate; without this, a bearer token will do.
    pub tls_require_client_certificate: bool,
    /// Time for a TLS handshake, seconds, at least 1.
    pub tls_handshake_timeout_s: u64,
    /// Most TLS handshakes at a time, at least 1; more wait.
    pub max_tls_handshakes: usize,
    /// Keys that verify bearer tokens: a JWKS, or public keys in PEM.
    pub token_keys_file: Option<PathBuf>,
    /// Issuer of bearer tokens, their claim `iss`.
    pub token_issuer: Option<String>,
    /// Audience of bearer tokens, one of their claim `aud`.
    pub token_audience: String,
    /// Let anybody read maps and metrics, where others show who they are.
    pub anonymous_read: bool,
    /// Path under which a proxy serves the service, e.g. `/maps`: links begin with it. Requests may come with it or
    /// without.
    pub base_path: BasePath,
    /// Make links of what the headers `Forwarded`, `X-Forwarded-Proto`, `X-Forwarded-Host` and `X-Forwarded-Prefix` say:
    /// only behind a proxy that sets them, for else any client could.
    pub trust_forwarded_headers: bool,
    /// Longest that the answer to a request over HTTP may take to begin, seconds, at least 1; then it is a 503.
    pub request_timeout_s: u64,
    /// Longest that the headers of a request may take to come, seconds, at least 1; then the connection is closed.
    pub header_timeout_s: u64,
    /// Longest path and query of a request, bytes, 256 to 65,000; a longer one is refused with 414.
    pub max_url_bytes: usize,
    /// Largest headers of a request, together, bytes, 1 KiB to 1 MiB; larger ones are refused with 431.
    pub max_header_bytes: usize,
    /// Folder of the embedded store; created where it does not exist.
    pub data_dir: PathBuf,
    /// What the server is in zenoh: `off`, a `router` to which vehicles connect, or a `client` of one.
    pub zenoh_mode: ZenohMode,
    /// Where a zenoh router listens, e.g. `tcp/0.0.0.0:7447`; several are separated by commas.
    pub zenoh_listen: Endpoints,
    /// Zenoh routers to connect to, e.g. `tcp/router:7447`; several are separated by commas. A client needs one.
    pub zenoh_connect: Endpoints,
    /// Vehicles that may connect to the router with a certificate of `tls_client_ca_file`: a common name `fleet/vehicle`
    /// on each line. Each may use its own keys only.
    pub zenoh_vehicles_file: Option<PathBuf>,
    /// Vehicles that may connect to the router with a password: `fleet/vehicle:password` on each line. Each may use its
    /// own keys only. With `zenoh_vehicles_file`, both are asked for.
    pub zenoh_passwords_file: Option<PathBuf>,
    /// Who may read the shared map from the router, and nothing else: the common name of a certificate, or a user name of
    /// `zenoh_passwords_file`, on each line.
    pub zenoh_readers_file: Option<PathBuf>,
    /// Publish the shared map over zenoh. Where peers are asked who they are, it is published only where access rules are in
    /// force (or `anonymous_read`).
    pub zenoh_publish_map: bool,
    /// Authorities of the certificates of routers to connect to, PEM; without it, those that the system trusts.
    pub zenoh_ca_file: Option<PathBuf>,
    /// Name with which a zenoh client connects to its router.
    pub zenoh_user: Option<String>,
    /// File of the password of `zenoh_user`.
    pub zenoh_password_file: Option<PathBuf>,
    /// Take it that the router of a zenoh client lets each vehicle use its own keys only, as `lanemap zenoh-access` has
    /// it.
    pub zenoh_trust_router: bool,
    /// Largest message of a vehicle, bytes, 1 KiB to 1 GiB; a larger one ends its stream. One that comes packed may unpack
    /// to half of it.
    pub max_message_bytes: usize,
    /// Most detections in a frame, at least 1.
    pub max_detections: usize,
    /// Most points in one detection, at least 2.
    pub max_points_per_detection: usize,
    /// Farthest point from the vehicle, metres, on each axis.
    pub max_point_range_m: f64,
    /// Farthest odometry position from the origin of its frame, metres, on each axis.
    pub max_odometry_range_m: f64,
    /// Most drives that the store holds.
    pub max_sessions: usize,
    /// Most streams of vehicles at a time.
    pub max_live_sessions: usize,
    /// Most connections at a time; more wait to be accepted.
    pub max_connections: usize,
    /// Most streams and requests at a time on one connection; a client waits with more.
    pub max_streams_per_connection: usize,
    /// Frames of one session between the network and the journal, 1 to 4096; a faster vehicle waits.
    pub max_frames_in_flight: usize,
    /// Frames of one session that are acked and wait to be mapped, in the journal, 1 to 1e6; a vehicle that is farther ahead
    /// of its map waits.
    pub max_unmapped_frames: usize,
    /// Bytes of frames of all sessions between the network and the journal, 1 MiB to 1 TiB; vehicles wait where there are more.
    pub max_bytes_in_flight: usize,
    /// Frames of a session that wait for one before them, 0 to 4096; more give it up as missing.
    pub reorder_window_frames: usize,
    /// Longest that a frame waits for one before it, milliseconds.
    pub reorder_wait_ms: u64,
    /// Most frames of all sessions made durable together, at least 1.
    pub max_frames_per_commit: usize,
    /// Writes that may wait for the disk, at least 1; while as many wait, no stream is opened.
    pub max_waiting_commits: usize,
    /// Room on the disk below which frames are refused, bytes; 0 leaves nothing in reserve. The store needs some to go on.
    pub min_free_disk_bytes: u64,
    /// Frames of a session after which its mapper's state is saved and its journal trimmed, at least 1.
    pub snapshot_every_frames: u64,
    /// Least time between two publications of one session's map, milliseconds.
    pub publish_interval_ms: u64,
    /// Time after which a session without a stream leaves memory (its map stays readable), seconds; one that is over leaves
    /// at once.
    pub unload_after_s: u64,
    /// Memory for maps of drives that are not streaming, bytes; those not in it are read from the store when asked for. As much
    /// again is for maps of drives that went on while a reader pages through them.
    pub max_cached_map_bytes: usize,
    /// Threads that fuse the shared map, 1 to 64.
    pub fuse_threads: usize,
    /// Least time from the start of one fusion of a cell to that of the next, milliseconds; a cell that was quiet is fused at once.
    pub fuse_interval_ms: u64,
    /// Share of a core that each of these threads takes at most, 0.01 to 1: it rests after its work.
    pub fuse_cpu_share: f64,
    /// Kilometres of line from which on a cell is drafted while up to 8 drives are live in it, 0 to 1e6: they are laid on the map of
    /// the others, and all are fused once the cell is quiet, or after two minutes.
    pub fuse_draft_km: f64,
    /// Drives from which a cell is fused, at least 1. Of more, what is missed least is dropped: the oldest whose ways a crowd
    /// of younger ones went as well.
    pub max_contributions_per_cell: usize,
    /// Kilometres of line up to which drives without GNSS are sought on the shared map, 0 to 1e6; 0: they stay in their own
    /// frames. A search takes some 0.2 s of a fusing thread for 40 km of line.
    pub max_localization_km: f64,
    /// Time for which a version of a cell is kept once it was replaced, seconds, so that changes since it can be told;
    /// of one cell at most 128.
    pub cell_versions_kept_s: u64,
    /// Events that are kept of a cell, 1 to 10,000 of each sort: of what happened to its road, and of what became of its
    /// lines' names.
    pub max_events_per_cell: usize,
    /// Time for which an event of a cell is kept, seconds, 0 to 1e10; those of a cell leave when it is fused again.
    pub cell_events_kept_s: u64,
    /// Readers that may follow the map at a time, over HTTP and gRPC together; more are told to come again.
    pub max_change_readers: usize,
    /// Time between two signs of life to a reader that follows the map while nothing changes, seconds, at least 1. One that
    /// takes nothing for four times as long is let go of.
    pub change_heartbeat_s: u64,
    /// Most bytes of one change that is sent with its lines; one that is larger is sent without them.
    pub max_change_event_bytes: usize,
    /// Memory for cells of the shared map, bytes; those not in it are read from the store when asked for.
    pub max_cached_cell_bytes: usize,
    /// Memory for tiles as they are served, and for the lines that they are drawn from, bytes; others are drawn when asked
    /// for.
    pub max_cached_tile_bytes: usize,
    /// Memory for cells as they are written for readers (GeoJSON), bytes; those not in it are written anew when asked for.
    pub max_cached_feature_bytes: usize,
    /// Time between pings that find dead connections, seconds, at least 1.
    pub keep_alive_s: u64,
    /// Longest that a stream may be open before it names its drive, seconds.
    pub start_wait_s: u64,
    /// Time between the fall of `/readyz` and the end of streams when the service is told to stop, milliseconds: balancers
    /// see the one before the other.
    pub drain_delay_ms: u64,
    /// Time that a shutdown gives open streams and connections to end, seconds.
    pub shutdown_grace_s: u64,
    /// File of the key behind the pseudonyms of vehicles and drives, within the store's folder unless it is absolute.
    /// Made at the first start where it is not there; without it no drive of the store can be resumed or deleted.
    pub privacy_key_file: PathBuf,
    /// Distance from either end of a trip within which nothing is mapped, metres as the crow flies; 0: none. What is
    /// cut is acked. A drive keeps the cut with which it began.
    pub trip_cut_m: f64,
    /// Time from either end of a trip within which nothing is mapped, seconds; 0: none. A frame is mapped where it lies
    /// beyond both the distance and the time.
    pub trip_cut_s: f64,
    /// Time without a frame, or without leaving the distance of the cut, that ends a trip, seconds: what comes then sets
    /// out anew.
    pub trip_stop_s: f64,
    /// Time after which what was cut has left the store's files, seconds, at least 1: they are written anew for it.
    pub trip_erase_s: u64,
}

impl Default for ServerConfig {
    fn default() -> Self {
        let limits = FrameLimits::default();
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            insecure_listen_anywhere: false,
            tls_cert_file: None,
            tls_key_file: None,
            tls_client_ca_file: None,
            tls_client_crl_file: None,
            tls_require_client_certificate: false,
            tls_handshake_timeout_s: 10,
            max_tls_handshakes: 512,
            token_keys_file: None,
            token_issuer: None,
            token_audience: "lanemap".to_owned(),
            anonymous_read: false,
            base_path: BasePath::default(),
            trust_forwarded_headers: false,
            request_timeout_s: 30,
            header_timeout_s: 30,
            max_url_bytes: 8192,
            max_header_bytes: 32 * 1024,
            data_dir: PathBuf::from("lanemap-data"),
            zenoh_mode: ZenohMode::Off,
            zenoh_listen: Endpoints::loopback(),
            zenoh_connect: Endpoints::default(),
            zenoh_vehicles_file: None,
            zenoh_passwords_file: None,
            zenoh_readers_file: None,
            zenoh_publish_map: true,
            zenoh_ca_file: None,
            zenoh_user: None,
            zenoh_password_file: None,
            zenoh_trust_router: false,
            max_message_bytes: 32 * 1024 * 1024,
            max_detections: limits.max_detections,
            max_points_per_detection: limits.max_points_per_detection,
            max_point_range_m: limits.max_point_range_m,
            max_odometry_range_m: limits.max_odometry_range_m,
            max_sessions: 100_000,
            max_live_sessions: 4096,
            max_connections: 8192,
            max_streams_per_connection: 1024,
            max_frames_in_flight: 64,
            max_unmapped_frames: 600,
            max_bytes_in_flight: 256 * 1024 * 1024,
            reorder_window_frames: 32,
            reorder_wait_ms: 200,
            max_frames_per_commit: 2048,
            max_waiting_commits: 4096,
            min_free_disk_bytes: 512 * 1024 * 1024,
            snapshot_every_frames: 1000,
            publish_interval_ms: 150,
            unload_after_s: 60,
            max_cached_map_bytes: 128 * 1024 * 1024,
            fuse_threads: 1,
            fuse_interval_ms: 500,
            fuse_cpu_share: 0.5,
            fuse_draft_km: 8.0,
            max_contributions_per_cell: 256,
            max_localization_km: 1000.0,
            cell_versions_kept_s: 3600,
            max_events_per_cell: 256,
            cell_events_kept_s: 366 * 24 * 3600,
            max_change_readers: 1000,
            change_heartbeat_s: 15,
            max_change_event_bytes: 256 * 1024,
            max_cached_cell_bytes: 128 * 1024 * 1024,
            max_cached_tile_bytes: 256 * 1024 * 1024,
            max_cached_feature_bytes: 128 * 1024 * 1024,
            keep_alive_s: 20,
            start_wait_s: 10,
            drain_delay_ms: 0,
            shutdown_grace_s: 6,
            privacy_key_file: PathBuf::from("privacy.key"),
            trip_cut_m: 0.0,
            trip_cut_s: 0.0,
            trip_stop_s: 1800.0,
            trip_erase_s: 3600,
        }
    }
}

/// Why settings cannot be used.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file or the environment does not read as settings.
    #[error("settings: {0}")]
    Read(#[from] config::ConfigError),
    /// A setting lies outside its range.
    #[error("setting {name} = {value} is outside {limit}")]
    OutOfRange {
        /// Name of the setting.
        name: &'static str,
        /// Its value.
        value: String,
        /// Its range.
        limit: &'static str,
    },
    /// A setting means nothing without another.
    #[error("setting {name} needs {needs}")]
    Incomplete {
        /// Name of the setting.
        name: &'static str,
        /// What it needs.
        needs: &'static str,
    },
    /// The service would be open to a network.
    #[error(
        "{setting} = {address} is reached from other machines, and that needs {missing}; \
         insecure_listen_anywhere: true does without, in a private network or behind a proxy that has both"
    )]
    Exposed {
        /// Name of the setting.
        setting: &'static str,
        /// Where it would listen.
        address: String,
        /// What is missing.
        missing: &'static str,
    },
}

impl ServerConfig {
    /// Reads the settings: `overrides` (flags) over the environment (`LANEMAP_*`) over `file` (YAML) over defaults.
    ///
    /// # Errors
    /// A file that cannot be read, a name that is no setting, a value of the wrong type or out of range.
    pub fn load(file: Option<&Path>, overrides: ConfigOverrides) -> Result<Self, ConfigError> {
        let environment = config::Environment::with_prefix("LANEMAP").try_parsing(true);
        Self::from_sources(file, environment, overrides)
    }

    fn from_sources(
        file: Option<&Path>,
        environment: config::Environment,
        overrides: ConfigOverrides,
    ) -> Result<Self, ConfigError> {
        let mut builder = config::Config::builder();
        if let Some(path) = file {
            builder = builder.add_source(config::File::from(path).format(config::FileFormat::Yaml));
        }
        let mut settings: Self = builder.add_source(environment).build()?.try_deserialize()?;
        overrides.apply_to(&mut settings);
        settings.check()?;
        Ok(settings)
    }

    /// Checks every range.
    ///
    /// # Errors
    /// The first setting that lies outside its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        let within = |name, value: f64, minimum: f64, maximum: f64, limit| {
            let inside = value >= minimum && value <= maximum;
            if inside { Ok(()) } else { Err(ConfigError::OutOfRange { name, value: value.to_string(), limit }) }
        };
        self.check_zenoh()?;
        within("max_message_bytes", self.max_message_bytes as f64, 1024.0, 1024.0 * 1024.0 * 1024.0, "1024 ..= 2^30")?;
        within("max_detections", self.max_detections as f64, 1.0, 1e6, "1 ..= 1e6")?;
        within("max_points_per_detection", self.max_points_per_detection as f64, 2.0, 1e7, "2 ..= 1e7")?;
        within("max_point_range_m", self.max_point_range_m, 1.0, 1e6, "1 ..= 1e6")?;
        within("max_odometry_range_m", self.max_odometry_range_m, 1.0, 1e8, "1 ..= 1e8")?;
        within("max_sessions", self.max_sessions as f64, 1.0, 1e8, "1 ..= 1e8")?;
        within("max_live_sessions", self.max_live_sessions as f64, 1.0, 1e6, "1 ..= 1e6")?;
        within("max_connections", self.max_connections as f64, 1.0, 1e6, "1 ..= 1e6")?;
        within("max_streams_per_connection", self.max_streams_per_connection as f64, 1.0, 1e6, "1 ..= 1e6")?;
        within("max_frames_in_flight", self.max_frames_in_flight as f64, 1.0, 4096.0, "1 ..= 4096")?;
        within("max_unmapped_frames", self.max_unmapped_frames as f64, 1.0, 1e6, "1 ..= 1e6")?;
        within("max_bytes_in_flight", self.max_bytes_in_flight as f64, 1_048_576.0, 1e12, "1048576 ..= 1e12")?;
        within("reorder_window_frames", self.reorder_window_frames as f64, 0.0, 4096.0, "0 ..= 4096")?;
        within("reorder_wait_ms", self.reorder_wait_ms as f64, 0.0, 60_000.0, "0 ..= 60000")?;
        within("max_frames_per_commit", self.max_frames_per_commit as f64, 1.0, 1e6, "1 ..= 1e6")?;
        within("max_waiting_commits", self.max_waiting_commits as f64, 1.0, 1e6, "1 ..= 1e6")?;
        within("min_free_disk_bytes", self.min_free_disk_bytes as f64, 0.0, 1e18, "0 ..= 1e18")?;
        within("snapshot_every_frames", self.snapshot_every_frames as f64, 1.0, 1e9, "1 ..= 1e9")?;
        within("publish_interval_ms", self.publish_interval_ms as f64, 0.0, 60_000.0, "0 ..= 60000")?;
        within("unload_after_s", self.unload_after_s as f64, 0.0, 1e6, "0 ..= 1e6")?;
        within("max_cached_map_bytes", self.max_cached_map_bytes as f64, 0.0, 1e12, "0 ..= 1e12")?;
        within("fuse_threads", self.fuse_threads as f64, 1.0, 64.0, "1 ..= 64")?;
        within("fuse_interval_ms", self.fuse_interval_ms as f64, 0.0, 3_600_000.0, "0 ..= 3600000")?;
        within("fuse_cpu_share", self.fuse_cpu_share, 0.01, 1.0, "0.01 ..= 1")?;
        within("fuse_draft_km", self.fuse_draft_km, 0.0, 1e6, "0 ..= 1e6")?;
        within("max_contributions_per_cell", self.max_contributions_per_cell as f64, 1.0, 1e4, "1 ..= 1e4")?;
        within("max_localization_km", self.max_localization_km, 0.0, 1e6, "0 ..= 1e6")?;
        within("cell_versions_kept_s", self.cell_versions_kept_s as f64, 0.0, 1e8, "0 ..= 1e8")?;
        within("max_events_per_cell", self.max_events_per_cell as f64, 1.0, 1e4, "1 ..= 1e4")?;
        within("cell_events_kept_s", self.cell_events_kept_s as f64, 0.0, 1e10, "0 ..= 1e10")?;
        within("max_change_readers", self.max_change_readers as f64, 0.0, 1e6, "0 ..= 1e6")?;
        within("change_heartbeat_s", self.change_heartbeat_s as f64, 1.0, 3600.0, "1 ..= 3600")?;
        within("max_change_event_bytes", self.max_change_event_bytes as f64, 0.0, 2_097_152.0, "0 ..= 2097152")?;
        within("max_cached_cell_bytes", self.max_cached_cell_bytes as f64, 0.0, 1e12, "0 ..= 1e12")?;
        within("max_cached_tile_bytes", self.max_cached_tile_bytes as f64, 0.0, 1e12, "0 ..= 1e12")?;
        within("max_cached_feature_bytes", self.max_cached_feature_bytes as f64, 0.0, 1e12, "0 ..= 1e12")?;
        within("request_timeout_s", self.request_timeout_s as f64, 1.0, 3600.0, "1 ..= 3600")?;
        within("header_timeout_s", self.header_timeout_s as f64, 1.0, 3600.0, "1 ..= 3600")?;
        within("max_url_bytes", self.max_url_bytes as f64, 256.0, 65_000.0, "256 ..= 65000")?;
        within("max_header_bytes", self.max_header_bytes as f64, 1024.0, 1_048_576.0, "1024 ..= 1048576")?;
        within("keep_alive_s", self.keep_alive_s as f64, 1.0, 3600.0, "1 ..= 3600")?;
        within("start_wait_s", self.start_wait_s as f64, 1.0, 3600.0, "1 ..= 3600")?;
        within("drain_delay_ms", self.drain_delay_ms as f64, 0.0, 600_000.0, "0 ..= 600000")?;
        within("trip_cut_m", self.trip_cut_m, 0.0, 1e5, "0 ..= 1e5")?;
        within("trip_cut_s", self.trip_cut_s, 0.0, 86_400.0, "0 ..= 86400")?;
        within("trip_erase_s", self.trip_erase_s as f64, 1.0, 1e6, "1 ..= 1e6")?;
        within("trip_stop_s", self.trip_stop_s, 1.0, 1e6, "1 ..= 1e6")?;
        within("shutdown_grace_s", self.shutdown_grace_s as f64, 0.0, 3600.0, "0 ..= 3600")?;
        within("tls_handshake_timeout_s", self.tls_handshake_timeout_s as f64, 1.0, 3600.0, "1 ..= 3600")?;
        within("max_tls_handshakes", self.max_tls_handshakes as f64, 1.0, 1e6, "1 ..= 1e6")?;
        self.check_credentials()?;
        exposure::check(self)
    }

    fn check_zenoh(&self) -> Result<(), ConfigError> {
        let needed = |name, limit| Err(ConfigError::OutOfRange { name, value: "nothing".to_owned(), limit });
        match self.zenoh_mode {
            ZenohMode::Client if self.zenoh_connect.is_empty() => {
                needed("zenoh_connect", "at least one router, since zenoh_mode is client")
            }
            ZenohMode::Router if self.zenoh_listen.is_empty() && self.zenoh_connect.is_empty() => {
                needed("zenoh_listen", "at least one endpoint, since zenoh_mode is router")
            }
            _ => Ok(()),
        }
    }

    /// The bounds on a frame.
    #[must_use]
    pub fn frame_limits(&self) -> FrameLimits {
        FrameLimits {
            max_detections: self.max_detections,
            max_points_per_detection: self.max_points_per_detection,
            max_point_range_m: self.max_point_range_m,
            max_odometry_range_m: self.max_odometry_range_m,
        }
    }

    pub(crate) fn trip_erase(&self) -> Duration {
        Duration::from_secs(self.trip_erase_s)
    }

    /// The cut of drives that begin now.
    pub(crate) fn trip_cut(&self) -> TripCut {
        TripCut { distance_m: self.trip_cut_m, time_s: self.trip_cut_s, stop_s: self.trip_stop_s }
    }

    pub(crate) fn privacy_key_path(&self) -> PathBuf {
        self.data_dir.join(&self.privacy_key_file)
    }

    pub(crate) fn change_heartbeat(&self) -> Duration {
        Duration::from_secs(self.change_heartbeat_s)
    }

    pub(crate) fn publish_interval(&self) -> Duration {
        Duration::from_millis(self.publish_interval_ms)
    }

    pub(crate) fn unload_after(&self) -> Duration {
        Duration::from_secs(self.unload_after_s)
    }

    pub(crate) fn reorder_wait(&self) -> Duration {
        Duration::from_millis(self.reorder_wait_ms)
    }

    pub(crate) fn start_wait(&self) -> Duration {
        Duration::from_secs(self.start_wait_s)
    }

    pub(crate) fn request_timeout(&self) -> Duration {
        Duration::from_secs(self.request_timeout_s)
    }

    pub(crate) fn header_timeout(&self) -> Duration {
        Duration::from_secs(self.header_timeout_s)
    }

    pub(crate) fn keep_alive(&self) -> Duration {
        Duration::from_secs(self.keep_alive_s)
    }

    pub(crate) fn drain_delay(&self) -> Duration {
        Duration::from_millis(self.drain_delay_ms)
    }

    pub(crate) fn shutdown_grace(&self) -> Duration {
        Duration::from_secs(self.shutdown_grace_s)
    }
}
