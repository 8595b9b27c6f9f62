//! Counts calls in the server layer, by method and code.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use bytes::Bytes;
use http::{HeaderMap, Request, Response};
use http_body::{Frame, SizeHint};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Registry, Unit};
use prost::Message as _;
use prost_types::FileDescriptorSet;
use tonic::body::Body;
use tonic::{Code, Status};
use tower_layer::Layer;
use tower_service::Service;

use super::Metrics;

/// The label of unknown methods, because clients can invent names.
const OTHER: &str = "other";
/// Waiting calls (Claim) and streams may be long; all others take milliseconds.
const BUCKETS: [f64; 9] = [0.001, 0.005, 0.025, 0.1, 0.5, 2.5, 10.0, 30.0, 300.0];

/// Calls that ended.
pub struct RpcMetrics {
    /// "fathom.v1.JobService/CreateJob" by the path of the request.
    methods: HashMap<String, Arc<str>>,
    other: Arc<str>,
    ended: Family<Labels, Counter>,
    seconds: Family<Labels, Histogram, fn() -> Histogram>,
}

/// A method, or a code.
type Label = Box<str>;
type Labels = Vec<(&'static str, Label)>;

impl RpcMetrics {
    /// For all methods of our services.
    pub fn register(registry: &mut Registry) -> Self {
        // The built descriptor can always be decoded; otherwise all methods would count as unknown.
        let files = FileDescriptorSet::decode(fathom_proto::FILE_DESCRIPTOR_SET).unwrap_or_default().file;
        let mut methods = HashMap::new();
        for file in &files {
            for service in &file.service {
                for method in &service.method {
                    let name = format!("{}.{}/{}", file.package(), service.name(), method.name());
                    methods.insert(format!("/{name}"), name.into());
                }
            }
        }
        let ended = Family::default();
        registry.register("grpc_calls", "Calls that ended, by method and code", ended.clone());
        let seconds: Family<Labels, _, fn() -> Histogram> =
            Family::new_with_constructor(|| Histogram::new(BUCKETS));
        let help = "Time of calls to the end of their answer, by method; Claim waits, and streams last";
        registry.register_with_unit("grpc_call", help, Unit::Seconds, seconds.clone());
        Self { methods, other: OTHER.into(), ended, seconds }
    }
}

/// Adds [`Rpc`] to a server.
#[derive(Clone)]
pub struct RpcLayer(pub Arc<Metrics>);

impl<S> Layer<S> for RpcLayer {
    type Service = Rpc<S>;

    fn layer(&self, inner: S) -> Rpc<S> {
        Rpc { inner, metrics: Arc::clone(&self.0) }
    }
}

/// A server whose calls are counted.
#[derive(Clone)]
pub struct Rpc<S> {
    inner: S,
    metrics: Arc<Metrics>,
}

impl<S, B> Service<Request<B>> for Rpc<S>
where
    S: Service<Request<B>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Response<Body>, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<B>) -> Self::Future {
        let rpc = &self.metrics.rpc;
        let method = Arc::clone(rpc.methods.get(request.uri().path()).unwrap_or(&rpc.other));
        let call = Call { metrics: Arc::clone(&self.metrics), method, since: Instant::now(), code: None };
        let answer = self.inner.call(request);
        Box::pin(async move {
            let mut call = call;
            let response = answer.await?;
            call.note(response.headers());
            Ok(response.map(|inner| Body::new(CountedBody { inner, call })))
        })
    }
}

/// A call; counted when it is dropped, however it ends.
struct Call {
    metrics: Arc<Metrics>,
    method: Arc<str>,
    since: Instant,
    /// Known once the server has answered.
    code: Option<Code>,
}

impl Call {
    fn note(&mut self, headers: &HeaderMap) {
        self.code = self.code.or_else(|| Some(Status::from_header_map(headers)?.code()));
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        // No status means that the client disconnected.
        let code = code_word(self.code.unwrap_or(Code::Cancelled));
        let rpc = &self.metrics.rpc;
        let method = || ("method", Label::from(self.method.as_ref()));
        rpc.ended.get_or_create(&vec![method(), ("code", code.into())]).inc();
        rpc.seconds.get_or_create(&vec![method()]).observe(self.since.elapsed().as_secs_f64());
    }
}

/// The body of an answer, whose end has the status.
struct CountedBody {
    inner: Body,
    call: Call,
}

impl http_body::Body for CountedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let polled = Pin::new(&mut self.inner).poll_frame(context);
        if let Poll::Ready(Some(Ok(frame))) = &polled
            && let Some(trailers) = frame.trailers_ref()
        {
            self.call.note(trailers);
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.size_hint()
    }
}

fn code_word(code: Code) -> &'static str {
    match code {
        Code::Ok => "ok",
        Code::Cancelled => "cancelled",
        Code::Unknown => "unknown",
        Code::InvalidArgument => "invalid_argument",
        Code::DeadlineExceeded => "deadline_exceeded",
        Code::NotFound => "not_found",
        Code::AlreadyExists => "already_exists",
        Code::PermissionDenied => "permission_denied",
        Code::ResourceExhausted => "resource_exhausted",
        Code::FailedPrecondition => "failed_precondition",
        Code::Aborted => "aborted",
        Code::OutOfRange => "out_of_range",
        Code::Unimplemented => "unimplemented",
        Code::Internal => "internal",
        Code::Unavailable => "unavailable",
        Code::DataLoss => "data_loss",
        Code::Unauthenticated => "unauthenticated",
    }
}
