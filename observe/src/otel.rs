//! Traces over OTLP: spans of our own crates are sent in batches to the collector in the standard environment
//! variables.
//!
//! `OTEL_EXPORTER_OTLP_ENDPOINT` (or `OTEL_EXPORTER_OTLP_TRACES_ENDPOINT`) switches it on; OTEL_SERVICE_NAME,
//! OTEL_RESOURCE_ATTRIBUTES, OTEL_TRACES_SAMPLER and OTEL_BSP_* work as in the SDK. An unreachable collector
//! loses spans and nothing else.

use std::time::Duration;

use opentelemetry::trace::{
    SpanContext, SpanId, TraceContextExt as _, TraceFlags, TraceId, TraceState, TracerProvider as _,
};
use opentelemetry::{Context, KeyValue};
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tokio::runtime::Runtime;
use tracing::{Span, Subscriber};
use tracing_opentelemetry::OpenTelemetrySpanExt as _;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::Layer;
use tracing_subscriber::registry::LookupSpan;

/// Time to send the last spans when the process ends.
const FLUSH_WITHIN: Duration = Duration::from_secs(2);
/// The exported targets: only our own crates, because the exporter itself creates spans too.
const OURS: [&str; 5] = ["fathom", "fathom_core", "fathom_coordinator", "fathom_observe", "fathom_worker"];

/// Sends the last spans when it is dropped.
pub struct Exporter {
    provider: SdkTracerProvider,
    /// Drives the connection to the collector; separate from the program's runtime, which may not exist yet.
    _runtime: Runtime,
}

impl Drop for Exporter {
    fn drop(&mut self) {
        // The process ends; there is nothing to report to.
        let _ = self.provider.shutdown_with_timeout(FLUSH_WITHIN);
    }
}

/// The exporting layer, if the environment names a collector.
pub fn start<S>(service: &'static str) -> Option<(impl Layer<S>, Exporter)>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    let is_set = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    if !(is_set("OTEL_EXPORTER_OTLP_ENDPOINT") || is_set("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")) {
        return None;
    }
    // The log is not set up yet, so errors go to stderr.
    let exporter =
        connect(service).inspect_err(|error| eprintln!("fathom: no traces are exported: {error}")).ok()?;
    let tracer = exporter.provider.tracer("fathom");
    let ours = Targets::new().with_targets(OURS.map(|target| (target, LevelFilter::INFO)));
    Some((tracing_opentelemetry::layer().with_tracer(tracer).with_filter(ours), exporter))
}

fn connect(service: &'static str) -> Result<Exporter, String> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .thread_name("traces")
        .enable_all()
        .build()
        .map_err(|error| error.to_string())?;
    let entered = runtime.enter();
    let exporter = SpanExporter::builder().with_tonic().build().map_err(|error| error.to_string())?;
    drop(entered);
    let mut resource =
        Resource::builder().with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")));
    if std::env::var_os("OTEL_SERVICE_NAME").is_none() {
        resource = resource.with_service_name(service);
    }
    let provider =
        SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource.build()).build();
    Ok(Exporter { provider, _runtime: runtime })
}

/// Puts a span into the trace of a job.
pub fn join_trace_of(job: &str, span: &Span) {
    let digest = blake3::hash(job.as_bytes());
    let (mut trace, mut root) = ([0; 16], [0; 8]);
    trace.copy_from_slice(&digest.as_bytes()[..16]);
    root.copy_from_slice(&digest.as_bytes()[16..24]);
    let root = SpanContext::new(
        TraceId::from_bytes(trace),
        SpanId::from_bytes(root),
        TraceFlags::SAMPLED,
        true,
        TraceState::NONE,
    );
    // Fails where nothing is exported.
    let _ = span.set_parent(Context::new().with_remote_span_context(root));
}
