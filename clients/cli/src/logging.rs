//! Logs on stderr, and traces where they are asked for.

use std::io::IsTerminal;

use clap::{Args, ValueEnum};
use tracing::{Level, Metadata};
use tracing_subscriber::{
    EnvFilter, Layer,
    filter::{FilterExt, filter_fn},
    layer::SubscriberExt,
    util::SubscriberInitExt,
};

/// What is logged unless `RUST_LOG` says otherwise: the store's own notes are not a user's business.
const DEFAULT_LOG: &str = "info,fjall=warn,lsm_tree=warn,value_log=warn";

/// Where the service tells what it does.
#[derive(Args, Clone, Debug, Default)]
pub struct LogArgs {
    /// Logs as text for people, or as one JSON object a line; `RUST_LOG` says which
    #[arg(long, value_enum, default_value_t = LogFormat::Text)]
    log_format: LogFormat,
    /// Send traces to an OpenTelemetry collector's gRPC address, e.g. <http://localhost:4317>; needs a build with
    /// `--features otlp`
    #[arg(long, value_name = "URL", env = "OTEL_EXPORTER_OTLP_ENDPOINT")]
    otlp_endpoint: Option<String>,
}

/// How logs are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum LogFormat {
    /// For people
    #[default]
    Text,
    /// For machines
    Json,
}

/// Sends what is left of the traces when it is dropped.
#[must_use]
pub struct Telemetry {
    #[cfg(feature = "otlp")]
    _traces: Option<lanemap_server::telemetry::traces::TraceExport>,
}

/// Logs to stderr, in colour where that is a terminal.
pub fn to_stderr() {
    tracing_subscriber::registry().with(lines(LogFormat::Text)).init();
}

/// Logs, and traces where they are asked for, until what is returned is dropped.
#[cfg(feature = "otlp")]
pub fn start(args: &LogArgs) -> anyhow::Result<Telemetry> {
    let subscriber = tracing_subscriber::registry().with(lines(args.log_format));
    let Some(endpoint) = &args.otlp_endpoint else {
        subscriber.init();
        return Ok(Telemetry { _traces: None });
    };
    let (traces, layer) = lanemap_server::telemetry::traces::export(endpoint)?;
    subscriber.with(layer.with_filter(filter())).init();
    Ok(Telemetry { _traces: Some(traces) })
}

/// Logs, until what is returned is dropped.
#[cfg(not(feature = "otlp"))]
pub fn start(args: &LogArgs) -> anyhow::Result<Telemetry> {
    anyhow::ensure!(
        args.otlp_endpoint.is_none(),
        "this lanemap was built without traces: leave --otlp-endpoint (OTEL_EXPORTER_OTLP_ENDPOINT) out, or build with \
         --features otlp"
    );
    tracing_subscriber::registry().with(lines(args.log_format)).init();
    Ok(Telemetry {})
}

fn lines<S>(format: LogFormat) -> Box<dyn Layer<S> + Send + Sync>
where
    S: tracing::Subscriber + for<'span> tracing_subscriber::registry::LookupSpan<'span>,
{
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
    match format {
        LogFormat::Text => lines.with_ansi(std::io::stderr().is_terminal()).with_filter(filter()).boxed(),
        LogFormat::Json => lines.json().flatten_event(true).with_filter(filter()).boxed(),
    }
}

fn filter<S>() -> impl tracing_subscriber::layer::Filter<S> {
    let wanted = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(DEFAULT_LOG));
    wanted.and(filter_fn(names_no_vehicle))
}

/// Whatever is asked for: zenoh logs keys, and vehicles' keys bear their names.
fn names_no_vehicle(metadata: &Metadata<'_>) -> bool {
    !metadata.target().starts_with("zenoh") || *metadata.level() == Level::ERROR
}
