//! Traces over OTLP: spans of requests, streams and commits, exported in batches by a thread of its own.

use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{ExporterBuildError, SpanExporter, WithExportConfig};
use opentelemetry_sdk::{Resource, trace::SdkTracerProvider};
use tracing::Subscriber;
use tracing_opentelemetry::OpenTelemetryLayer;
use tracing_subscriber::registry::LookupSpan;

/// The service's name in traces.
const SERVICE: &str = "lanemap";

/// Sends what it has when it is dropped.
#[derive(Debug)]
pub struct TraceExport {
    provider: SdkTracerProvider,
}

/// The export to a collector's gRPC address, e.g. `http://localhost:4317`, and the layer that feeds it. Call it within a
/// tokio runtime.
///
/// # Errors
/// An address that is not one.
pub fn export<S>(
    endpoint: &str,
) -> Result<(TraceExport, OpenTelemetryLayer<S, opentelemetry_sdk::trace::SdkTracer>), ExporterBuildError>
where
    S: Subscriber + for<'span> LookupSpan<'span>,
{
    let exporter = SpanExporter::builder().with_tonic().with_endpoint(endpoint).build()?;
    let resource = Resource::builder().with_service_name(SERVICE).build();
    let provider = SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build();
    let layer = OpenTelemetryLayer::new(provider.tracer(SERVICE));
    Ok((TraceExport { provider }, layer))
}

impl Drop for TraceExport {
    fn drop(&mut self) {
        if let Err(error) = self.provider.shutdown() {
            eprintln!("the last traces were not exported: {error}");
        }
    }
}
