//! An S3 server that somebody else wrote (`s3s-fs`), in this process, and faults between it and its clients.
#![allow(dead_code, reason = "each test file uses a part of this one")]
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::convert::Infallible;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures::StreamExt;
use http::{Request, Response, StatusCode};
use http_body_util::{BodyExt, StreamBody};
use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::server::conn::auto::Builder;
use s3s::auth::SimpleAuth;
use s3s::service::{S3Service, S3ServiceBuilder};
use tempfile::TempDir;
use tokio::net::TcpListener;

/// Its only bucket.
pub const BUCKET: &str = "reef";
const KEY: &str = "of-the-test";
const SECRET: &str = "no-secret";

/// What happens to a request.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Fault {
    /// The server answers with this status instead.
    Status(u16),
    /// The answer comes this much later.
    Slow(Duration),
    /// The connection breaks in the middle of the answer's body.
    Truncated,
}

/// A running server; ends when dropped.
pub struct S3Server {
    folder: TempDir,
    address: SocketAddr,
    plan: Arc<Plan>,
    runtime: Option<tokio::runtime::Runtime>,
}

#[derive(Default)]
struct Plan {
    /// Every n-th request has the fault.
    fault: Mutex<Option<(Fault, u64)>>,
    requests: AtomicU64,
    faults: AtomicU64,
}

impl S3Server {
    /// Starts one with an empty bucket.
    pub fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join(BUCKET)).unwrap();
        let mut service = S3ServiceBuilder::new(s3s_fs::FileSystem::new(folder.path()).unwrap());
        service.set_auth(SimpleAuth::from_single(KEY, SECRET));
        let service = service.build();
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        let address = listener.local_addr().unwrap();
        let plan = Arc::new(Plan::default());
        runtime.spawn(serve(listener, service, Arc::clone(&plan)));
        Self { folder, address, plan, runtime: Some(runtime) }
    }

    /// The URL of a prefix in its bucket.
    pub fn url(&self, prefix: &str) -> String {
        format!("s3://{BUCKET}/{prefix}")
    }

    /// Its address.
    pub fn endpoint(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Variables with which a process finds it.
    pub fn environment(&self) -> [(&'static str, String); 5] {
        [
            ("AWS_ACCESS_KEY_ID", KEY.into()),
            ("AWS_SECRET_ACCESS_KEY", SECRET.into()),
            ("AWS_ENDPOINT", self.endpoint()),
            ("AWS_ALLOW_HTTP", "true".into()),
            ("AWS_REGION", "us-east-1".into()),
        ]
    }

    /// The folder in which it keeps a prefix of its bucket.
    pub fn folder(&self, prefix: &str) -> PathBuf {
        self.folder.path().join(BUCKET).join(prefix)
    }

    /// From now on every `n`-th request has a fault; `None`: none.
    pub fn break_every(&self, n: u64, fault: Option<Fault>) {
        *self.plan.fault.lock().unwrap_or_else(PoisonError::into_inner) = fault.map(|fault| (fault, n));
    }

    /// Requests so far, and those that had a fault.
    pub fn requests(&self) -> (u64, u64) {
        (self.plan.requests.load(Ordering::Relaxed), self.plan.faults.load(Ordering::Relaxed))
    }
}

impl Drop for S3Server {
    fn drop(&mut self) {
        // Also in an asynchronous test, which must not wait for threads.
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

/// Makes a file older.
pub fn age(path: &Path, by: Duration) {
    let file = std::fs::File::options().append(true).open(path).unwrap();
    file.set_modified(SystemTime::now() - by).unwrap();
}

async fn serve(listener: std::net::TcpListener, service: S3Service, plan: Arc<Plan>) {
    let listener = TcpListener::from_std(listener).unwrap();
    loop {
        let Ok((socket, _)) = listener.accept().await else { continue };
        let (service, plan) = (service.clone(), Arc::clone(&plan));
        let answer = move |request: Request<hyper::body::Incoming>| {
            let (service, plan) = (service.clone(), Arc::clone(&plan));
            async move { Ok::<_, Infallible>(answered(&service, &plan, request).await) }
        };
        tokio::spawn(async move {
            let builder = Builder::new(TokioExecutor::new());
            let _ = builder.serve_connection(TokioIo::new(socket), hyper::service::service_fn(answer)).await;
        });
    }
}

type Body = http_body_util::combinators::UnsyncBoxBody<Bytes, std::io::Error>;

async fn answered(
    service: &S3Service,
    plan: &Plan,
    request: Request<hyper::body::Incoming>,
) -> Response<Body> {
    let number = plan.requests.fetch_add(1, Ordering::Relaxed);
    let fault = *plan.fault.lock().unwrap_or_else(PoisonError::into_inner);
    let fault = fault.filter(|(_, every)| number.is_multiple_of(*every)).map(|(fault, _)| fault);
    if fault.is_some() {
        plan.faults.fetch_add(1, Ordering::Relaxed);
    }
    match fault {
        Some(Fault::Status(status)) => {
            // The body must be read: a client that still sends would see a broken connection instead.
            let _ = request.into_body().collect().await;
            let body = http_body_util::Full::new(Bytes::from_static(b"<Error/>"));
            let mut response = Response::new(body.map_err(|never| match never {}).boxed_unsync());
            *response.status_mut() = StatusCode::from_u16(status).unwrap();
            return response;
        }
        Some(Fault::Slow(by)) => tokio::time::sleep(by).await,
        Some(Fault::Truncated) | None => {}
    }
    let response = service.call(request.map(s3s::Body::from)).await;
    let response = match response {
        Ok(response) => response.map(|body| body.map_err(std::io::Error::other).boxed_unsync()),
        Err(error) => panic!("the S3 server failed: {error:?}"),
    };
    if fault != Some(Fault::Truncated) {
        return response;
    }
    let (parts, body) = response.into_parts();
    let bytes = body.collect().await.unwrap().to_bytes();
    let half = bytes.slice(..bytes.len() / 2);
    let cut = std::io::Error::other("the connection breaks");
    let frames = futures::stream::iter([Ok(http_body::Frame::data(half)), Err(cut)]);
    Response::from_parts(parts, StreamBody::new(frames.boxed()).boxed_unsync())
}
