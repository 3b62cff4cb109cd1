//! `lanemap serve`: the service, until a signal ends it.

use std::{net::SocketAddr, path::PathBuf, process::ExitCode};

use anyhow::Context;
use clap::Args;
use lanemap_server::{
    ConfigOverrides, Server, ServerConfig,
    config::{BasePath, Endpoints, ZenohMode},
};

use crate::{logging, signal};

/// Settings of the service: a flag wins over its LANEMAP_ variable, that over the file of --config, that over the
/// default.
#[derive(Args, Debug)]
#[expect(clippy::doc_markdown, reason = "the comments are the text of --help")]
pub struct ServeArgs {
    /// YAML file of settings, named as the flags are, with _ for -; a name that is no setting is refused
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    logs: logging::LogArgs,
    /// Address and port for gRPC and HTTP; port 0 takes any free one [env: LANEMAP_LISTEN] [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<SocketAddr>,
    /// Listen beyond the loopback interface although there is no TLS, or peers do not show who they are: in a private
    /// network, or behind a proxy that does both [env: LANEMAP_INSECURE_LISTEN_ANYWHERE] [default: false]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, default_missing_value = "true")]
    insecure_listen_anywhere: Option<bool>,
    /// Certificates that the service shows, PEM, its own first; with --tls-key-file: TLS on the port, and no plain text
    /// [env: LANEMAP_TLS_CERT_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    tls_cert_file: Option<PathBuf>,
    /// Private key of the first of these certificates, PEM [env: LANEMAP_TLS_KEY_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    tls_key_file: Option<PathBuf>,
    /// Authorities whose client certificates are taken, PEM; a certificate names its vehicle by the URI
    /// lanemap://fleet/vehicle or the common name fleet/vehicle [env: LANEMAP_TLS_CLIENT_CA_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    tls_client_ca_file: Option<PathBuf>,
    /// Lists of revoked client certificates, PEM [env: LANEMAP_TLS_CLIENT_CRL_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    tls_client_crl_file: Option<PathBuf>,
    /// Refuse connections without a client certificate; without this, a bearer token will do
    /// [env: LANEMAP_TLS_REQUIRE_CLIENT_CERTIFICATE] [default: false]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, default_missing_value = "true")]
    tls_require_client_certificate: Option<bool>,
    /// Time for a TLS handshake, seconds [env: LANEMAP_TLS_HANDSHAKE_TIMEOUT_S] [default: 10]
    #[arg(long, value_name = "S")]
    tls_handshake_timeout_s: Option<u64>,
    /// Most TLS handshakes at a time; more wait [env: LANEMAP_MAX_TLS_HANDSHAKES] [default: 512]
    #[arg(long, value_name = "N")]
    max_tls_handshakes: Option<usize>,
    /// Keys that verify bearer tokens (JWT): a JWKS, or public keys in PEM [env: LANEMAP_TOKEN_KEYS_FILE]
    /// [default: none]
    #[arg(long, value_name = "FILE")]
    token_keys_file: Option<PathBuf>,
    /// Issuer of bearer tokens, their claim iss [env: LANEMAP_TOKEN_ISSUER] [default: none]
    #[arg(long, value_name = "ISSUER")]
    token_issuer: Option<String>,
    /// Audience of bearer tokens, one of their claim aud [env: LANEMAP_TOKEN_AUDIENCE] [default: lanemap]
    #[arg(long, value_name = "AUDIENCE")]
    token_audience: Option<String>,
    /// Let anybody read maps and metrics, where others show who they are [env: LANEMAP_ANONYMOUS_READ]
    /// [default: false]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, default_missing_value = "true")]
    anonymous_read: Option<bool>,
    /// Path under which a proxy serves the service, e.g. /maps: links begin with it; requests may come with it or without
    /// [env: LANEMAP_BASE_PATH] [default: ]
    #[arg(long, value_name = "PATH")]
    base_path: Option<BasePath>,
    /// Make links of what the headers Forwarded and X-Forwarded-{Proto,Host,Prefix} say: only behind a proxy that sets
    /// them [env: LANEMAP_TRUST_FORWARDED_HEADERS] [default: false]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, default_missing_value = "true")]
    trust_forwarded_headers: Option<bool>,
    /// Longest that the answer to a request over HTTP may take to begin, seconds; then it is a 503
    /// [env: LANEMAP_REQUEST_TIMEOUT_S] [default: 30]
    #[arg(long, value_name = "S")]
    request_timeout_s: Option<u64>,
    /// Longest that the headers of a request may take to come, seconds; then the connection is closed
    /// [env: LANEMAP_HEADER_TIMEOUT_S] [default: 30]
    #[arg(long, value_name = "S")]
    header_timeout_s: Option<u64>,
    /// Longest path and query of a request, bytes, 256 to 65,000; a longer one is refused
    /// [env: LANEMAP_MAX_URL_BYTES] [default: 8192]
    #[arg(long, value_name = "BYTES")]
    max_url_bytes: Option<usize>,
    /// Largest headers of a request, together, bytes; larger ones are refused
    /// [env: LANEMAP_MAX_HEADER_BYTES] [default: 32768]
    #[arg(long, value_name = "BYTES")]
    max_header_bytes: Option<usize>,
    /// Folder of the embedded store; made where it does not exist [env: LANEMAP_DATA_DIR] [default: lanemap-data]
    #[arg(long, value_name = "DIR")]
    data_dir: Option<PathBuf>,
    /// What the server is in zenoh: off, a router to which vehicles connect, or a client of one
    /// [env: LANEMAP_ZENOH_MODE] [default: off]
    #[arg(long, value_name = "MODE")]
    zenoh_mode: Option<ZenohMode>,
    /// Where a zenoh router listens; several are separated by commas
    /// [env: LANEMAP_ZENOH_LISTEN] [default: tcp/127.0.0.1:7447]
    #[arg(long, value_name = "ENDPOINTS")]
    zenoh_listen: Option<Endpoints>,
    /// Zenoh routers to connect to; several are separated by commas; a client needs one
    /// [env: LANEMAP_ZENOH_CONNECT] [default: ]
    #[arg(long, value_name = "ENDPOINTS")]
    zenoh_connect: Option<Endpoints>,
    /// Vehicles that may connect to the router with a certificate of --tls-client-ca-file: a common name fleet/vehicle
    /// on each line; each may use its own keys only [env: LANEMAP_ZENOH_VEHICLES_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    zenoh_vehicles_file: Option<PathBuf>,
    /// Vehicles that may connect to the router with a password: fleet/vehicle:password on each line; each may use its
    /// own keys only. With --zenoh-vehicles-file, both are asked for [env: LANEMAP_ZENOH_PASSWORDS_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    zenoh_passwords_file: Option<PathBuf>,
    /// Who may read the shared map from the router, and nothing else: the common name of a certificate, or a user name of
    /// --zenoh-passwords-file, on each line [env: LANEMAP_ZENOH_READERS_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    zenoh_readers_file: Option<PathBuf>,
    /// Publish the shared map over zenoh. Where peers are asked who they are, it is published only where access rules are
    /// in force (or --anonymous-read) [env: LANEMAP_ZENOH_PUBLISH_MAP] [default: true]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, default_missing_value = "true")]
    zenoh_publish_map: Option<bool>,
    /// Authorities of the certificates of routers to connect to, PEM; without it, those that the system trusts
    /// [env: LANEMAP_ZENOH_CA_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    zenoh_ca_file: Option<PathBuf>,
    /// Name with which a zenoh client connects to its router [env: LANEMAP_ZENOH_USER] [default: none]
    #[arg(long, value_name = "NAME")]
    zenoh_user: Option<String>,
    /// File of the password of --zenoh-user [env: LANEMAP_ZENOH_PASSWORD_FILE] [default: none]
    #[arg(long, value_name = "FILE")]
    zenoh_password_file: Option<PathBuf>,
    /// Take it that the router of a zenoh client lets each vehicle use its own keys only, as lanemap zenoh-access has it
    /// [env: LANEMAP_ZENOH_TRUST_ROUTER] [default: false]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, default_missing_value = "true")]
    zenoh_trust_router: Option<bool>,
    /// Largest message of a vehicle, bytes; one that comes packed may unpack to half of it. A larger one ends its stream
    /// [env: LANEMAP_MAX_MESSAGE_BYTES] [default: 33554432]
    #[arg(long, value_name = "BYTES")]
    max_message_bytes: Option<usize>,
    /// Most detections in a frame [env: LANEMAP_MAX_DETECTIONS] [default: 64]
    #[arg(long, value_name = "N")]
    max_detections: Option<usize>,
    /// Most points in one detection [env: LANEMAP_MAX_POINTS_PER_DETECTION] [default: 4096]
    #[arg(long, value_name = "N")]
    max_points_per_detection: Option<usize>,
    /// Farthest point from the vehicle, metres, on each axis [env: LANEMAP_MAX_POINT_RANGE_M] [default: 500.0]
    #[arg(long, value_name = "M")]
    max_point_range_m: Option<f64>,
    /// Farthest odometry position from the origin of its frame, metres, on each axis
    /// [env: LANEMAP_MAX_ODOMETRY_RANGE_M] [default: 10000000.0]
    #[arg(long, value_name = "M")]
    max_odometry_range_m: Option<f64>,
    /// Most drives that the store holds [env: LANEMAP_MAX_SESSIONS] [default: 100000]
    #[arg(long, value_name = "N")]
    max_sessions: Option<usize>,
    /// Most streams of vehicles at a time [env: LANEMAP_MAX_LIVE_SESSIONS] [default: 4096]
    #[arg(long, value_name = "N")]
    max_live_sessions: Option<usize>,
    /// Most connections at a time; more wait to be accepted [env: LANEMAP_MAX_CONNECTIONS] [default: 8192]
    #[arg(long, value_name = "N")]
    max_connections: Option<usize>,
    /// Most streams and requests at a time on one connection; a client waits with more
    /// [env: LANEMAP_MAX_STREAMS_PER_CONNECTION] [default: 1024]
    #[arg(long, value_name = "N")]
    max_streams_per_connection: Option<usize>,
    /// Frames of one session between the network and the journal; a faster vehicle waits
    /// [env: LANEMAP_MAX_FRAMES_IN_FLIGHT] [default: 64]
    #[arg(long, value_name = "N")]
    max_frames_in_flight: Option<usize>,
    /// Frames of one session that are acked and wait to be mapped, in the journal; a vehicle that is farther ahead of its
    /// map waits
    /// [env: LANEMAP_MAX_UNMAPPED_FRAMES] [default: 600]
    #[arg(long, value_name = "N")]
    max_unmapped_frames: Option<usize>,
    /// Bytes of frames of all sessions between the network and the journal, 1 MiB to 1 TiB; vehicles wait where there are more
    /// [env: LANEMAP_MAX_BYTES_IN_FLIGHT] [default: 268435456]
    #[arg(long, value_name = "BYTES")]
    max_bytes_in_flight: Option<usize>,
    /// Frames of a session that wait for one before them, 0 to 4096; more give it up as missing
    /// [env: LANEMAP_REORDER_WINDOW_FRAMES] [default: 32]
    #[arg(long, value_name = "N")]
    reorder_window_frames: Option<usize>,
    /// Longest that a frame waits for one before it, milliseconds
    /// [env: LANEMAP_REORDER_WAIT_MS] [default: 200]
    #[arg(long, value_name = "MS")]
    reorder_wait_ms: Option<u64>,
    /// Most frames of all sessions made durable together [env: LANEMAP_MAX_FRAMES_PER_COMMIT] [default: 2048]
    #[arg(long, value_name = "N")]
    max_frames_per_commit: Option<usize>,
    /// Writes that may wait for the disk, at least 1; while as many wait, no stream is opened
    /// [env: LANEMAP_MAX_WAITING_COMMITS] [default: 4096]
    #[arg(long, value_name = "N")]
    max_waiting_commits: Option<usize>,
    /// Room on the disk below which frames are refused, bytes; 0 leaves nothing in reserve. The store needs some to go on
    /// [env: LANEMAP_MIN_FREE_DISK_BYTES] [default: 536870912]
    #[arg(long, value_name = "BYTES")]
    min_free_disk_bytes: Option<u64>,
    /// Frames of a session after which its mapper's state is saved and its journal trimmed
    /// [env: LANEMAP_SNAPSHOT_EVERY_FRAMES] [default: 1000]
    #[arg(long, value_name = "N")]
    snapshot_every_frames: Option<u64>,
    /// Least time between two publications of one session's map, milliseconds
    /// [env: LANEMAP_PUBLISH_INTERVAL_MS] [default: 150]
    #[arg(long, value_name = "MS")]
    publish_interval_ms: Option<u64>,
    /// Time after which a session without a stream leaves memory (its map stays readable), seconds; one that is over leaves
    /// at once
    /// [env: LANEMAP_UNLOAD_AFTER_S] [default: 60]
    #[arg(long, value_name = "S")]
    unload_after_s: Option<u64>,
    /// Memory for maps of drives that are not streaming, bytes; those not in it are read from the store when asked for
    /// [env: LANEMAP_MAX_CACHED_MAP_BYTES] [default: 134217728]
    #[arg(long, value_name = "BYTES")]
    max_cached_map_bytes: Option<usize>,
    /// Threads that fuse the shared map, 1 to 64 [env: LANEMAP_FUSE_THREADS] [default: 1]
    #[arg(long, value_name = "N")]
    fuse_threads: Option<usize>,
    /// Least time from the start of one fusion of a cell to that of the next, milliseconds; a cell that was quiet is fused at once
    /// [env: LANEMAP_FUSE_INTERVAL_MS] [default: 500]
    #[arg(long, value_name = "MS")]
    fuse_interval_ms: Option<u64>,
    /// Share of a core that each of these threads takes at most, 0.01 to 1: it rests after its work
    /// [env: LANEMAP_FUSE_CPU_SHARE] [default: 0.5]
    #[arg(long, value_name = "SHARE")]
    fuse_cpu_share: Option<f64>,
    /// Kilometres of line from which on a cell is drafted while up to 8 drives are live in it, 0 to 1e6: they are laid on the map of
    /// the others, and all are fused once the cell is quiet, or after two minutes
    /// [env: LANEMAP_FUSE_DRAFT_KM] [default: 8.0]
    #[arg(long, value_name = "KM")]
    fuse_draft_km: Option<f64>,
    /// Drives from which a cell is fused, at least 1. Of more, what is missed least is dropped: the oldest whose ways a crowd
    /// of younger ones went as well
    /// [env: LANEMAP_MAX_CONTRIBUTIONS_PER_CELL] [default: 256]
    #[arg(long, value_name = "N")]
    max_contributions_per_cell: Option<usize>,
    /// Kilometres of line up to which drives without GNSS are sought on the shared map, 0 to 1e6; 0: they stay in their own
    /// frames. A search takes some 0.2 s of a fusing thread for 40 km of line
    /// [env: LANEMAP_MAX_LOCALIZATION_KM] [default: 1000.0]
    #[arg(long, value_name = "KM")]
    max_localization_km: Option<f64>,
    /// Time for which a version of a cell is kept once it was replaced, seconds, so that changes since it can be told;
    /// of one cell at most 128
    /// [env: LANEMAP_CELL_VERSIONS_KEPT_S] [default: 3600]
    #[arg(long, value_name = "S")]
    cell_versions_kept_s: Option<u64>,
    /// Events that are kept of a cell, 1 to 10,000 of each sort: of what happened to its road, and of what became of its
    /// lines' names
    /// [env: LANEMAP_MAX_EVENTS_PER_CELL] [default: 256]
    #[arg(long, value_name = "N")]
    max_events_per_cell: Option<usize>,
    /// Time for which an event of a cell is kept, seconds, 0 to 1e10; those of a cell leave when it is fused again
    /// [env: LANEMAP_CELL_EVENTS_KEPT_S] [default: 31622400]
    #[arg(long, value_name = "S")]
    cell_events_kept_s: Option<u64>,
    /// Readers that may follow the map at a time, over HTTP and gRPC together; more are told to come again
    /// [env: LANEMAP_MAX_CHANGE_READERS] [default: 1000]
    #[arg(long, value_name = "N")]
    max_change_readers: Option<usize>,
    /// Time between two signs of life to a reader that follows the map while nothing changes, seconds, at least 1; one
    /// that takes nothing for four times as long is let go of
    /// [env: LANEMAP_CHANGE_HEARTBEAT_S] [default: 15]
    #[arg(long, value_name = "S")]
    change_heartbeat_s: Option<u64>,
    /// Most bytes of one change that is sent with its lines; one that is larger is sent without them
    /// [env: LANEMAP_MAX_CHANGE_EVENT_BYTES] [default: 262144]
    #[arg(long, value_name = "BYTES")]
    max_change_event_bytes: Option<usize>,
    /// Memory for cells of the shared map, bytes; those not in it are read from the store when asked for
    /// [env: LANEMAP_MAX_CACHED_CELL_BYTES] [default: 134217728]
    #[arg(long, value_name = "BYTES")]
    max_cached_cell_bytes: Option<usize>,
    /// Memory for tiles as they are served, and for the lines that they are drawn from, bytes; others are drawn when asked
    /// for [env: LANEMAP_MAX_CACHED_TILE_BYTES] [default: 268435456]
    #[arg(long, value_name = "BYTES")]
    max_cached_tile_bytes: Option<usize>,
    /// Memory for cells as they are written for readers (GeoJSON), bytes; those not in it are written anew when asked for
    /// [env: LANEMAP_MAX_CACHED_FEATURE_BYTES] [default: 134217728]
    #[arg(long, value_name = "BYTES")]
    max_cached_feature_bytes: Option<usize>,
    /// Time between pings that find dead connections, seconds [env: LANEMAP_KEEP_ALIVE_S] [default: 20]
    #[arg(long, value_name = "S")]
    keep_alive_s: Option<u64>,
    /// Longest that a stream may be open before it names its drive, seconds
    /// [env: LANEMAP_START_WAIT_S] [default: 10]
    #[arg(long, value_name = "S")]
    start_wait_s: Option<u64>,
    /// Time between the fall of /readyz and the end of streams when the service is told to stop, milliseconds
    /// [env: LANEMAP_DRAIN_DELAY_MS] [default: 0]
    #[arg(long, value_name = "MS")]
    drain_delay_ms: Option<u64>,
    /// Time that a shutdown gives open streams and connections to end, seconds
    /// [env: LANEMAP_SHUTDOWN_GRACE_S] [default: 6]
    #[arg(long, value_name = "S")]
    shutdown_grace_s: Option<u64>,
    /// File of the key behind the pseudonyms of vehicles and drives, within the store's folder unless it is absolute;
    /// made at the first start [env: LANEMAP_PRIVACY_KEY_FILE] [default: privacy.key]
    #[arg(long, value_name = "FILE")]
    privacy_key_file: Option<PathBuf>,
    /// Distance from either end of a trip within which nothing is mapped, metres as the crow flies; 0: none
    /// [env: LANEMAP_TRIP_CUT_M] [default: 0.0]
    #[arg(long, value_name = "M")]
    trip_cut_m: Option<f64>,
    /// Time from either end of a trip within which nothing is mapped, seconds; 0: none
    /// [env: LANEMAP_TRIP_CUT_S] [default: 0.0]
    #[arg(long, value_name = "S")]
    trip_cut_s: Option<f64>,
    /// Time without a frame, or without leaving the distance of the cut, that ends a trip, seconds
    /// [env: LANEMAP_TRIP_STOP_S] [default: 1800.0]
    #[arg(long, value_name = "S")]
    trip_stop_s: Option<f64>,
    /// Time after which what was cut has left the store's files, seconds [env: LANEMAP_TRIP_ERASE_S] [default: 3600]
    #[arg(long, value_name = "S")]
    trip_erase_s: Option<u64>,
}

impl ServeArgs {
    fn overrides(&self) -> ConfigOverrides {
        ConfigOverrides {
            listen: self.listen,
            insecure_listen_anywhere: self.insecure_listen_anywhere,
            tls_cert_file: self.tls_cert_file.clone(),
            tls_key_file: self.tls_key_file.clone(),
            tls_client_ca_file: self.tls_client_ca_file.clone(),
            tls_client_crl_file: self.tls_client_crl_file.clone(),
            tls_require_client_certificate: self.tls_require_client_certificate,
            tls_handshake_timeout_s: self.tls_handshake_timeout_s,
            max_tls_handshakes: self.max_tls_handshakes,
            token_keys_file: self.token_keys_file.clone(),
            token_issuer: self.token_issuer.clone(),
            token_audience: self.token_audience.clone(),
            anonymous_read: self.anonymous_read,
            base_path: self.base_path.clone(),
            trust_forwarded_headers: self.trust_forwarded_headers,
            request_timeout_s: self.request_timeout_s,
            header_timeout_s: self.header_timeout_s,
            max_url_bytes: self.max_url_bytes,
            max_header_bytes: self.max_header_bytes,
            data_dir: self.data_dir.clone(),
            zenoh_mode: self.zenoh_mode,
            zenoh_listen: self.zenoh_listen.clone(),
            zenoh_connect: self.zenoh_connect.clone(),
            zenoh_vehicles_file: self.zenoh_vehicles_file.clone(),
            zenoh_passwords_file: self.zenoh_passwords_file.clone(),
            zenoh_readers_file: self.zenoh_readers_file.clone(),
            zenoh_publish_map: self.zenoh_publish_map,
            zenoh_ca_file: self.zenoh_ca_file.clone(),
            zenoh_user: self.zenoh_user.clone(),
            zenoh_password_file: self.zenoh_password_file.clone(),
            zenoh_trust_router: self.zenoh_trust_router,
            max_message_bytes: self.max_message_bytes,
            max_detections: self.max_detections,
            max_points_per_detection: self.max_points_per_detection,
            max_point_range_m: self.max_point_range_m,
            max_odometry_range_m: self.max_odometry_range_m,
            max_sessions: self.max_sessions,
            max_live_sessions: self.max_live_sessions,
            max_connections: self.max_connections,
            max_streams_per_connection: self.max_streams_per_connection,
            max_frames_in_flight: self.max_frames_in_flight,
            max_unmapped_frames: self.max_unmapped_frames,
            max_bytes_in_flight: self.max_bytes_in_flight,
            reorder_window_frames: self.reorder_window_frames,
            reorder_wait_ms: self.reorder_wait_ms,
            max_frames_per_commit: self.max_frames_per_commit,
            max_waiting_commits: self.max_waiting_commits,
            min_free_disk_bytes: self.min_free_disk_bytes,
            snapshot_every_frames: self.snapshot_every_frames,
            publish_interval_ms: self.publish_interval_ms,
            unload_after_s: self.unload_after_s,
            max_cached_map_bytes: self.max_cached_map_bytes,
            fuse_threads: self.fuse_threads,
            fuse_interval_ms: self.fuse_interval_ms,
            fuse_cpu_share: self.fuse_cpu_share,
            fuse_draft_km: self.fuse_draft_km,
            max_contributions_per_cell: self.max_contributions_per_cell,
            max_localization_km: self.max_localization_km,
            cell_versions_kept_s: self.cell_versions_kept_s,
            max_events_per_cell: self.max_events_per_cell,
            cell_events_kept_s: self.cell_events_kept_s,
            max_change_readers: self.max_change_readers,
            change_heartbeat_s: self.change_heartbeat_s,
            max_change_event_bytes: self.max_change_event_bytes,
            max_cached_cell_bytes: self.max_cached_cell_bytes,
            max_cached_tile_bytes: self.max_cached_tile_bytes,
            max_cached_feature_bytes: self.max_cached_feature_bytes,
            keep_alive_s: self.keep_alive_s,
            start_wait_s: self.start_wait_s,
            drain_delay_ms: self.drain_delay_ms,
            shutdown_grace_s: self.shutdown_grace_s,
            privacy_key_file: self.privacy_key_file.clone(),
            trip_cut_m: self.trip_cut_m,
            trip_cut_s: self.trip_cut_s,
            trip_stop_s: self.trip_stop_s,
            trip_erase_s: self.trip_erase_s,
        }
    }
}

/// Serves until SIGINT or SIGTERM; SIGHUP reads certificates and keys anew.
#[tokio::main]
pub async fn run(args: &ServeArgs) -> anyhow::Result<ExitCode> {
    let _telemetry = logging::start(&args.logs)?;
    let settings = ServerConfig::load(args.config.as_deref(), args.overrides())
        .context("the settings cannot be used; lanemap serve --help lists them all")?;
    let stop = signal::stop_signals()?;
    let server = Server::start(settings).await.context("the service does not start")?;
    println!("serving gRPC and HTTP on {url}, viewer at {url}/viewer", url = server.url());
    let credentials = server.credentials();
    let reloading = tokio::spawn(signal::at_each_hangup(move || credentials.reload())?);
    stop.await;
    reloading.abort();
    server.shutdown().await;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Only {
        #[command(flatten)]
        args: ServeArgs,
    }

    #[test]
    fn every_setting_is_a_flag_whose_help_states_its_variable_and_true_default() {
        let command = <Only as clap::CommandFactory>::command();
        let defaults = serde_json::to_value(ServerConfig::default()).unwrap();
        for (name, default) in defaults.as_object().unwrap() {
            let flag = name.replace('_', "-");
            let argument = command.get_arguments().find(|argument| argument.get_long() == Some(flag.as_str()));
            let help = argument.unwrap_or_else(|| panic!("no flag for {name}")).get_help().unwrap().to_string();
            let default = match default {
                serde_json::Value::Null => "none".to_owned(),
                serde_json::Value::String(text) => text.clone(),
                other => other.to_string(),
            };
            assert!(help.contains(&format!("[default: {default}]")), "{name}: {help} lacks {default}");
            assert!(help.contains(&format!("[env: LANEMAP_{}]", name.to_uppercase())), "{name}: {help}");
        }
    }

    #[test]
    fn a_flag_reaches_the_settings() {
        let only = Only::parse_from(["serve", "--keep-alive-s", "7", "--listen", "127.0.0.1:0"]);
        let settings = ServerConfig::load(None, only.args.overrides()).unwrap();
        assert_eq!(settings.keep_alive_s, 7);
        assert_eq!(settings.listen.port(), 0);
    }
}
