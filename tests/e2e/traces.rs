//! Spans arrive at the collector set by the standard environment variables.

#[path = "../support/processes.rs"]
mod processes;

use std::collections::HashMap;
use std::process::Stdio;
use std::time::{Duration, Instant};

use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{
    TraceService, TraceServiceServer,
};
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::KeyValue;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use processes::{Service, free_port, json, succeed, tiny_scene, under};
use tokio::sync::mpsc;
use tonic::{Request, Response, Status};

/// Much longer than a plan and a batch of spans take.
const PATIENCE: Duration = Duration::from_secs(60);

/// A collector that forwards requests to the test.
struct Collector(mpsc::UnboundedSender<ExportTraceServiceRequest>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        self.0.send(request.into_inner()).map_err(|_| Status::unavailable("the test is over"))?;
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

fn attributes(list: &[KeyValue]) -> HashMap<&str, String> {
    let text = |value: &Value| match value {
        Value::StringValue(text) => text.clone(),
        Value::IntValue(number) => number.to_string(),
        other => format!("{other:?}"),
    };
    let value = |entry: &KeyValue| entry.value.as_ref()?.value.as_ref().map(text);
    list.iter().filter_map(|entry| Some((entry.key.as_str(), value(entry)?))).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn spans_of_each_job_form_one_trace_at_the_collector() {
    let (sender, mut arrived) = mpsc::unbounded_channel();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let collector = format!("http://{}", listener.local_addr().expect("its address"));
    let incoming = tokio_stream::wrappers::TcpListenerStream::new(listener);
    let service = TraceServiceServer::new(Collector(sender));
    tokio::spawn(tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming));

    let folder = tempfile::tempdir().expect("a folder");
    let scene = tiny_scene(folder.path());
    let port = free_port();
    let (listen, url) = (format!("127.0.0.1:{port}"), format!("http://127.0.0.1:{port}"));
    let data = under(folder.path(), "data");
    let arguments = ["coordinator", "--data-dir", &data, "--listen", &listen];
    let settings = [("OTEL_EXPORTER_OTLP_ENDPOINT", collector.as_str()), ("OTEL_BSP_SCHEDULE_DELAY", "200")];
    let mut coordinator = Service::with_environment(&arguments, Stdio::piped(), Stdio::null(), &settings);
    coordinator.wait_until_it_listens();
    let submit = |name: &str| {
        let line = ["submit", &scene, "--coordinator", &url, "--name", name, "--iterations=50"];
        succeed(&line).trim().to_owned()
    };
    let jobs = ["wreck", "reef"].map(submit);

    let (begin, mut traces) = (Instant::now(), HashMap::new());
    while traces.len() < jobs.len() {
        assert!(begin.elapsed() < PATIENCE, "spans of {traces:?} only");
        let Ok(Some(request)) = tokio::time::timeout(PATIENCE, arrived.recv()).await else {
            panic!("no spans")
        };
        for of_process in &request.resource_spans {
            let resource = of_process.resource.clone().unwrap_or_default();
            assert_eq!(attributes(&resource.attributes)["service.name"], "fathom-coordinator");
            for span in of_process.scope_spans.iter().flat_map(|scope| &scope.spans) {
                let said = attributes(&span.attributes);
                if span.name == "task" && said["task"] == "plan" {
                    assert_eq!((said["attempt"].as_str(), said["worker"].as_str()), ("1", "coordinator"));
                    traces.insert(said["job"].clone(), span.trace_id.clone());
                }
            }
        }
    }
    assert!(jobs.iter().all(|job| traces.contains_key(job)), "{traces:?}");
    assert_ne!(traces[&jobs[0]], traces[&jobs[1]], "two jobs share a trace");
    // It still answers while it exports.
    assert_eq!(json(&["ls", "--coordinator", &url, "--json"]).as_array().map(Vec::len), Some(2));
}
