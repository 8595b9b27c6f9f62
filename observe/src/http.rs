//! Metrics and health over HTTP, for Prometheus and for what starts and stops services.
//!
//! `/metrics` is OpenMetrics text, `/healthz` says that the process lives, `/readyz` whether it can do its work. Neither encrypted nor
//! authenticated: it tells counts, and no names of jobs or users.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use http_body_util::Full;
use hyper::body::{Bytes, Incoming};
use hyper::header::{CONTENT_TYPE, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

/// Connections that are served at a time; others wait.
const CONNECTIONS: usize = 16;
/// A connection carries one request, and lasts no longer than this.
const CONNECTION_WITHIN: Duration = Duration::from_secs(20);
/// Pause after a failure to take a connection: too many open files do not go away at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
const TEXT: &str = "text/plain; charset=utf-8";
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// A program that is looked at.
pub trait Observed: Send + Sync + 'static {
    /// All metrics as text, or why there are none now.
    fn metrics(&self) -> impl Future<Output = Result<String, String>> + Send;
    /// Why it cannot do its work now; `Ok` when it can.
    fn ready(&self) -> impl Future<Output = Result<(), String>> + Send;
}

/// Serves until it is dropped.
pub async fn serve(listener: TcpListener, observed: Arc<impl Observed>) -> Infallible {
    let seats = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        let Ok(seat) = Arc::clone(&seats).acquire_owned().await else {
            // Nobody closes it.
            std::future::pending::<()>().await;
            continue;
        };
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::debug!(%error, "a connection for metrics was not taken");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let observed = Arc::clone(&observed);
        tokio::spawn(async move {
            // Whoever went away, or is too slow, has no answer.
            let _ = tokio::time::timeout(CONNECTION_WITHIN, answer(stream, observed)).await;
            drop(seat);
        });
    }
}

async fn answer(stream: TcpStream, observed: Arc<impl Observed>) -> hyper::Result<()> {
    let service = service_fn(move |request: Request<Incoming>| {
        let observed = Arc::clone(&observed);
        async move { Ok::<_, Infallible>(page(&request, observed.as_ref()).await) }
    });
    http1::Builder::new().keep_alive(false).serve_connection(TokioIo::new(stream), service).await
}

async fn page(request: &Request<Incoming>, observed: &impl Observed) -> Response<Full<Bytes>> {
    let unavailable = |why: String| (StatusCode::SERVICE_UNAVAILABLE, TEXT, format!("{why}\n"));
    let (status, kind, text) = match (request.method(), request.uri().path()) {
        (&Method::GET | &Method::HEAD, "/metrics") => match observed.metrics().await {
            Ok(text) => (StatusCode::OK, OPEN_METRICS, text),
            Err(why) => unavailable(why),
        },
        (&Method::GET | &Method::HEAD, "/healthz") => (StatusCode::OK, TEXT, "lives\n".into()),
        (&Method::GET | &Method::HEAD, "/readyz") => match observed.ready().await {
            Ok(()) => (StatusCode::OK, TEXT, "ready\n".into()),
            Err(why) => unavailable(why),
        },
        (&Method::GET | &Method::HEAD, _) => {
            (StatusCode::NOT_FOUND, TEXT, "there are /metrics, /healthz and /readyz\n".into())
        }
        _ => (StatusCode::METHOD_NOT_ALLOWED, TEXT, "use GET\n".into()),
    };
    let mut response = Response::new(Full::new(Bytes::from(text)));
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    response
}
