//! Metrics: names in base units, counters end in `_total`, and no label names a vehicle or a session.

pub mod requests;
#[cfg(feature = "otlp")]
pub mod traces;

use std::sync::OnceLock;

use lanemap_proto::v1::RefusalReason;
use metrics::{Unit, describe_counter, describe_gauge, describe_histogram};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};

/// Frames that were made durable.
pub const FRAMES_ACKED: &str = "lanemap_frames_acked_total";
/// Frames that came again and were acked again.
pub const FRAMES_REPEATED: &str = "lanemap_frames_repeated_total";
/// Runs of frames that did not come before those after them were taken.
pub const GAPS: &str = "lanemap_frame_gaps_total";
/// Messages refused, by `reason`.
pub const REFUSALS: &str = "lanemap_refusals_total";
/// Seconds of one step of a mapper.
pub const STEP_SECONDS: &str = "lanemap_mapper_step_seconds";
/// Frames that are acked and not mapped yet.
pub const FRAMES_UNMAPPED: &str = "lanemap_frames_unmapped";
/// Seconds from a frame's decoding to its ack.
pub const ACK_SECONDS: &str = "lanemap_frame_ack_seconds";
/// Seconds of one durable commit of the journal.
pub const COMMIT_SECONDS: &str = "lanemap_journal_commit_seconds";
/// Frames in one durable commit.
pub const COMMIT_FRAMES: &str = "lanemap_journal_commit_frames";
/// Streams of vehicles that are open.
pub const SESSIONS_LIVE: &str = "lanemap_sessions_live";
/// Drives that the store holds.
pub const SESSIONS: &str = "lanemap_sessions";
/// Connections that are open.
pub const CONNECTIONS: &str = "lanemap_connections";
/// TLS handshakes that failed or took too long.
pub const HANDSHAKES_FAILED: &str = "lanemap_tls_handshakes_failed_total";
/// Requests whose token or certificate was not taken.
pub const CREDENTIALS_REFUSED: &str = "lanemap_credentials_refused_total";
/// Poses and local maps dropped because their client did not read them.
pub const UPDATES_DROPPED: &str = "lanemap_updates_dropped_total";

/// Cells of the shared map.
pub const CELLS: &str = "lanemap_cells";
/// Cells of which drives have said something that is not in the map yet.
pub const CELLS_DIRTY: &str = "lanemap_cells_dirty";
/// Readers that follow the map.
pub const CHANGE_READERS: &str = "lanemap_change_readers";
/// Cells that were fused.
pub const CELLS_FUSED: &str = "lanemap_cells_fused_total";
/// Cells that were drafted.
pub const CELLS_DRAFTED: &str = "lanemap_cells_drafted_total";
/// Seconds of fusing one cell.
pub const FUSE_SECONDS: &str = "lanemap_fuse_seconds";
/// Contributions of drives to cells that came or changed.
pub const CONTRIBUTIONS: &str = "lanemap_contributions_total";
/// Seconds of cutting one drive into contributions and storing those that changed.
pub const CONTRIBUTE_SECONDS: &str = "lanemap_contribute_seconds";

/// Streams over zenoh that ended because a message was missing, too large or too many, by gRPC `code`.
pub const ZENOH_BROKEN: &str = "lanemap_zenoh_streams_broken_total";
/// Messages over zenoh that came again and were passed over.
pub const ZENOH_REPEATED: &str = "lanemap_zenoh_messages_repeated_total";
/// Messages over zenoh that belong to no stream.
pub const ZENOH_TURNED_AWAY: &str = "lanemap_zenoh_messages_turned_away_total";
/// Queries of the map over zenoh for which there was no room.
pub const ZENOH_QUERIES_TURNED_AWAY: &str = "lanemap_zenoh_queries_turned_away_total";
/// HTTP requests and gRPC calls, by `method`, `route` and `status`.
pub const REQUESTS: &str = "lanemap_http_requests_total";
/// Seconds from a request to the head of its answer, by `method` and `route`.
pub const REQUEST_SECONDS: &str = "lanemap_http_request_seconds";
/// 1 while the service takes traffic, 0 from the moment it begins to stop.
pub const READY: &str = "lanemap_ready";
/// Always 1, with the `version`.
pub const BUILD_INFO: &str = "lanemap_build_info";

/// Buckets of durations, seconds: 10 us to 10 s.
const SECONDS: [f64; 13] = [1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.25, 1.0, 3.0, 10.0];

/// Buckets of counts of frames.
const FRAMES: [f64; 10] = [1.0, 3.0, 10.0, 30.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0];

/// Renders the metrics of this process; installs the recorder at the first call.
///
/// Where another recorder was installed before, the handle renders nothing.
#[must_use]
pub fn metrics_handle() -> PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    HANDLE.get_or_init(install).clone()
}

fn install() -> PrometheusHandle {
    // Buckets are refused only where there are none.
    let builder = PrometheusBuilder::new().set_buckets(&SECONDS);
    let builder = builder.and_then(|b| b.set_buckets_for_metric(Matcher::Full(COMMIT_FRAMES.to_owned()), &FRAMES));
    let recorder = builder.unwrap_or_default().build_recorder();
    let handle = recorder.handle();
    if metrics::set_global_recorder(recorder).is_err() {
        tracing::warn!("another metrics recorder is installed: /metrics stays empty");
    }
    describe();
    metrics_process::Collector::default().describe();
    begin_at_zero();
    metrics::gauge!(BUILD_INFO, "version" => env!("CARGO_PKG_VERSION")).set(1.0);
    handle
}

/// The Prometheus text format: the service's metrics, and the process's as they are now.
#[must_use]
pub fn render(handle: &PrometheusHandle) -> String {
    metrics_process::Collector::default().collect();
    handle.render()
}

/// Counters that nothing has counted yet are shown as 0, so that their first increase is seen as one.
fn begin_at_zero() {
    for name in [FRAMES_ACKED, FRAMES_REPEATED, UPDATES_DROPPED, HANDSHAKES_FAILED, CREDENTIALS_REFUSED] {
        metrics::counter!(name).increment(0);
    }
    for name in
        [ZENOH_REPEATED, ZENOH_TURNED_AWAY, ZENOH_QUERIES_TURNED_AWAY, CELLS_FUSED, CELLS_DRAFTED, CONTRIBUTIONS]
    {
        metrics::counter!(name).increment(0);
    }
    for reason in (1..).map_while(|number| RefusalReason::try_from(number).ok()) {
        metrics::counter!(REFUSALS, "reason" => reason.as_str_name()).increment(0);
    }
    for name in [SESSIONS_LIVE, CONNECTIONS, CELLS, CELLS_DIRTY, CHANGE_READERS] {
        metrics::gauge!(name).increment(0.0);
    }
}

fn describe() {
    describe_counter!(FRAMES_ACKED, Unit::Count, "Frames that were made durable");
    describe_counter!(FRAMES_REPEATED, Unit::Count, "Frames that came again and were acked again");
    describe_counter!(GAPS, Unit::Count, "Runs of frames that did not come before those after them were taken");
    describe_counter!(REFUSALS, Unit::Count, "Messages refused, by reason");
    describe_gauge!(FRAMES_UNMAPPED, Unit::Count, "Frames that are acked and not mapped yet");
    describe_histogram!(STEP_SECONDS, Unit::Seconds, "One step of a mapper");
    describe_histogram!(ACK_SECONDS, Unit::Seconds, "From a frame's decoding to its ack");
    describe_histogram!(COMMIT_SECONDS, Unit::Seconds, "One durable commit of the journal");
    describe_histogram!(COMMIT_FRAMES, Unit::Count, "Frames in one durable commit");
    describe_gauge!(SESSIONS_LIVE, Unit::Count, "Streams of vehicles that are open");
    describe_gauge!(SESSIONS, Unit::Count, "Drives that the store holds");
    describe_gauge!(CONNECTIONS, Unit::Count, "Connections that are open");
    describe_counter!(HANDSHAKES_FAILED, Unit::Count, "TLS handshakes that failed or took too long");
    describe_counter!(CREDENTIALS_REFUSED, Unit::Count, "Requests whose token or certificate was not taken");
    describe_counter!(ZENOH_BROKEN, Unit::Count, "Streams over zenoh that a missing or refused message ended, by code");
    describe_counter!(ZENOH_REPEATED, Unit::Count, "Messages over zenoh that came again");
    describe_counter!(ZENOH_TURNED_AWAY, Unit::Count, "Messages over zenoh that belong to no stream");
    describe_counter!(ZENOH_QUERIES_TURNED_AWAY, Unit::Count, "Queries of the map for which there was no room");
    describe_counter!(REQUESTS, Unit::Count, "HTTP requests and gRPC calls, by method, route and status");
    describe_histogram!(REQUEST_SECONDS, Unit::Seconds, "From a request to the head of its answer");
    describe_gauge!(READY, Unit::Count, "1 while the service takes traffic, 0 from the moment it begins to stop");
    describe_gauge!(BUILD_INFO, Unit::Count, "Always 1, with the version of the service");
    describe_gauge!(CELLS, Unit::Count, "Cells of the shared map");
    describe_gauge!(CELLS_DIRTY, Unit::Count, "Cells that are not fused from what drives say now");
    describe_gauge!(CHANGE_READERS, Unit::Count, "Readers that follow the map");
    describe_counter!(CELLS_FUSED, Unit::Count, "Cells that were fused");
    describe_counter!(CELLS_DRAFTED, Unit::Count, "Drafts of cells: live drives laid on what is settled");
    describe_histogram!(FUSE_SECONDS, Unit::Seconds, "Fusing one cell");
    describe_counter!(CONTRIBUTIONS, Unit::Count, "Contributions of drives to cells that came or changed");
    describe_histogram!(CONTRIBUTE_SECONDS, Unit::Seconds, "Cutting one drive into contributions and storing them");
    describe_counter!(UPDATES_DROPPED, Unit::Count, "Poses and local maps that their client did not read in time");
}
