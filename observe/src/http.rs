//! Metrics and health over HTTP, for Prometheus and for service managers.
//!
//! `/metrics` is OpenMetrics text, `/healthz` reports that the process is alive, `/readyz` whether it can do
//! its work. The endpoint is neither encrypted nor authenticated: it exposes counts, and no names of jobs or
//! users.

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
/// Pause after a failure to accept a connection: a shortage of file descriptors does not end at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
const TEXT: &str = "text/plain; charset=utf-8";
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// A program that is observed.
pub trait Observed: Send + Sync + 'static {
    /// All metrics as text, or the reason why there are none now.
    fn metrics(&self) -> impl Future<Output = Result<String, String>> + Send;
    /// `Ok` when it can do its work, otherwise the reason.
    fn ready(&self) -> impl Future<Output = Result<(), String>> + Send;
}

/// Serves until it is dropped.
pub async fn serve(listener: TcpListener, observed: Arc<impl Observed>) -> Infallible {
    serve_within(CONNECTION_WITHIN, listener, observed).await
}

/// The same where a connection lasts no longer than `within`.
async fn serve_within(within: Duration, listener: TcpListener, observed: Arc<impl Observed>) -> Infallible {
    let seats = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        let Ok(seat) = Arc::clone(&seats).acquire_owned().await else {
            // The semaphore is never closed.
            std::future::pending::<()>().await;
            continue;
        };
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::debug!(%error, "could not accept a connection for metrics");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let observed = Arc::clone(&observed);
        tokio::spawn(async move {
            // Clients that left or are too slow get no answer.
            let _ = tokio::time::timeout(within, answer(stream, observed)).await;
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

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    /// Takes a moment to answer, and counts simultaneous requests.
    #[derive(Default)]
    struct Busy {
        now: AtomicUsize,
        most: AtomicUsize,
    }

    impl Observed for Busy {
        async fn metrics(&self) -> Result<String, String> {
            self.most.fetch_max(self.now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            tokio::time::sleep(Duration::from_millis(5)).await;
            self.now.fetch_sub(1, Ordering::SeqCst);
            Ok("counts\n".to_owned())
        }

        async fn ready(&self) -> Result<(), String> {
            Ok(())
        }
    }

    /// The whole answer to `request`, up to the end of the connection.
    async fn asked(address: std::net::SocketAddr, request: &str) -> String {
        let mut stream = TcpStream::connect(address).await.unwrap();
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        // A connection closed with unread data may report an error.
        let _ = stream.read_to_end(&mut answer).await;
        String::from_utf8(answer).unwrap()
    }

    #[tokio::test]
    async fn slow_requests_are_closed_and_many_are_served_a_few_at_a_time() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let observed = Arc::new(Busy::default());
        let served = tokio::spawn(serve_within(Duration::from_secs(2), listener, Arc::clone(&observed)));

        // As many connections as are served at a time, none with a complete request.
        let mut slow: Vec<TcpStream> = Vec::new();
        for _ in 0..CONNECTIONS {
            let mut stream = TcpStream::connect(address).await.unwrap();
            stream.write_all(b"GET /metrics HTTP/1.1\r\nHost:").await.unwrap();
            slow.push(stream);
        }
        let whole = "GET /metrics HTTP/1.1\r\nHost: here\r\n\r\n";
        let answers: Vec<_> = (0..300).map(|_| tokio::spawn(asked(address, whole))).collect();
        for answer in answers {
            let answer = tokio::time::timeout(Duration::from_secs(60), answer).await.unwrap().unwrap();
            assert!(answer.starts_with("HTTP/1.1 200") && answer.ends_with("counts\n"), "{answer:?}");
        }
        for mut stream in slow {
            let mut answer = Vec::new();
            let closed = tokio::time::timeout(Duration::from_secs(60), stream.read_to_end(&mut answer)).await;
            assert!(closed.is_ok(), "a slow request is still served");
            assert!(!answer.starts_with(b"HTTP/1.1 200"));
        }
        let most = observed.most.load(Ordering::SeqCst);
        assert!((2..=CONNECTIONS).contains(&most), "{most} at a time");
        served.abort();
    }
}
