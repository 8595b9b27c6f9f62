//! The coordinator over HTTP: JSON for scripts, server-sent events, and gRPC-Web for the page in a browser.
//!
//! There is no second way in. A JSON handler makes a gRPC call inside this process, on the same services
//! behind the same guard, with the token of its request. So tokens, roles, tenants, rates and limits are
//! those of gRPC. What is added here is against other websites, which can make a browser call this address:
//! `fathom_web::check` looks at Host and Origin.

mod answer;
mod api;
mod events;
mod files;
mod read;

use std::io;
use std::sync::Arc;

use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use fathom_proto::admin::v1::admin_service_client::AdminServiceClient;
use fathom_proto::v1::job_service_client::JobServiceClient;
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_web::Refused;
use futures::Stream;
use serde_json::json;
use tokio::io::{AsyncRead, AsyncWrite};
use tonic::service::Routes;
use tonic::transport::Server;
use tonic::transport::server::Connected;
use tonic_web::GrpcWebLayer;
use tower_layer::Layer;

use self::answer::{Answer, Fault};
use crate::access;
use crate::access::guard::{Guard, Guarded};
use crate::connections::Visit;
use crate::metrics::rpc::Rpc;
use crate::server::{KEEPALIVE_EVERY, KEEPALIVE_TIMEOUT, MAX_CALLS_OF_A_CONNECTION};
use crate::service_error::ServiceError;

/// The services of users behind the guard, counted as all calls are.
pub type Door = Rpc<Guarded<Routes>>;

/// Largest answer of a service to a JSON handler: a job of a thousand partitions has some megabytes.
const MAX_ANSWER_BYTES: usize = 64 << 20;
/// Services that a page may call: not those of workers.
const SERVICES: [&str; 3] =
    ["fathom.v1.JobService", "fathom.v1.UploadService", "fathom.admin.v1.AdminService"];

/// What every handler has.
#[derive(Clone)]
struct Web {
    door: Door,
    guard: Arc<Guard>,
}

impl Web {
    fn jobs(&self) -> JobServiceClient<Door> {
        JobServiceClient::new(self.door.clone()).max_decoding_message_size(MAX_ANSWER_BYTES)
    }

    fn uploads(&self) -> UploadServiceClient<Door> {
        UploadServiceClient::new(self.door.clone()).max_decoding_message_size(MAX_ANSWER_BYTES)
    }

    fn admin(&self) -> AdminServiceClient<Door> {
        AdminServiceClient::new(self.door.clone()).max_decoding_message_size(MAX_ANSWER_BYTES)
    }
}

/// Serves until `stopped` ends and open requests are answered.
///
/// # Errors
/// When the server fails.
pub async fn serve<I, C>(
    incoming: I,
    door: Door,
    guard: Arc<Guard>,
    is_own_page: bool,
    stopped: impl Future<Output = ()>,
) -> Result<(), tonic::transport::Error>
where
    I: Stream<Item = io::Result<C>> + Send,
    C: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
{
    Server::builder()
        // Browsers without TLS, and curl, speak HTTP/1.
        .accept_http1(true)
        .http2_keepalive_interval(Some(KEEPALIVE_EVERY))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
        .max_concurrent_streams(MAX_CALLS_OF_A_CONNECTION)
        .tcp_nodelay(true)
        .add_routes(Routes::from(router(Web { door, guard }, is_own_page)))
        .serve_with_incoming_shutdown(incoming, stopped)
        .await
}

fn router(web: Web, is_own_page: bool) -> Router {
    let calls = GrpcWebLayer::new().layer(web.door.clone());
    let mut router = Router::new()
        .nest("/api/v1", api::router().layer(from_fn_with_state(web.clone(), with_token)))
        .route("/api/v1/enter", post(enter))
        .route("/", get(page))
        .route("/assets/{*file}", get(page))
        .route("/licences.txt", get(page))
        .fallback(no_such_page);
    for service in SERVICES {
        router = router.route_service(&format!("/{service}/{{method}}"), calls.clone());
    }
    // The page of a run is always reached by an IP address.
    let asks_for_tokens = web.guard.access.asks_for_tokens() && !is_own_page;
    router
        .layer(from_fn(move |request, next| of_this_site(asks_for_tokens, request, next)))
        // Outermost, so that refusals have them too.
        .layer(from_fn(guard_headers))
        .with_state(web)
}

/// Refuses a request without a valid token before anything of its body is read.
async fn with_token(State(web): State<Web>, mut request: Request, next: Next) -> Result<Response, Fault> {
    let caller = admitted(&web, &request, |shown, now_ms| web.guard.access.principal(shown, now_ms))?;
    request.extensions_mut().insert(caller);
    Ok(next.run(request).await)
}

/// Exchanges the invitation in a link, which is void afterwards, for the token of a page.
async fn enter(State(web): State<Web>, request: Request) -> Answer {
    let token = admitted(&web, &request, |shown, now_ms| web.guard.access.enter(shown, now_ms))?;
    Ok(Json(json!({"token": token.reveal()})))
}

/// What `look` gives for the `authorization` header of a request; otherwise counts and logs the refusal.
fn admitted<T>(
    web: &Web,
    request: &Request,
    look: impl FnOnce(Option<&str>, u64) -> Result<T, access::Refused>,
) -> Result<T, Fault> {
    let visit = Visit::of(request);
    let shown = request.headers().get(header::AUTHORIZATION).map(HeaderValue::to_str).transpose();
    let looked = match shown {
        Ok(shown) => look(shown, web.guard.clock.now_ms()),
        Err(_) => Err(access::Refused::NotValid),
    };
    match looked {
        Ok(found) => {
            if let Some(visit) = visit {
                visit.admit();
            }
            Ok(found)
        }
        Err(refused) => {
            let error = ServiceError::from(refused);
            web.guard.log_refusal(request.uri().path(), visit, &error);
            if let Some(visit) = visit {
                visit.call_without_token();
            }
            Err(Fault::of(error.into()))
        }
    }
}

/// Passes a request on if no other website can have made it.
async fn of_this_site(asks_for_tokens: bool, request: Request, next: Next) -> Result<Response, Fault> {
    let named = request.uri().authority();
    match fathom_web::check(request.headers(), named, asks_for_tokens) {
        Ok(()) => Ok(next.run(request).await),
        Err(Refused::Malformed(message)) => Err(Fault::bad(message)),
        Err(Refused::OtherSite(message)) => Err(Fault::with(StatusCode::FORBIDDEN, "OTHER_SITE", message)),
    }
}

/// A file of the page. It holds nothing of the service, so it needs no token.
async fn page(request: Request) -> Response {
    if let Some(visit) = Visit::of(&request) {
        visit.call_without_token();
    }
    let path = request.uri().path().trim_start_matches('/');
    let path = if path.is_empty() { "index.html" } else { path };
    match fathom_web::page(path, request.headers()) {
        Some(page) => page.map(Body::from),
        None => Fault::not_found("there is no such file of the page; begin at /").into_response(),
    }
}

async fn no_such_page(request: Request) -> Fault {
    if let Some(visit) = Visit::of(&request) {
        visit.call_without_token();
    }
    Fault::not_found(
        "there is nothing at this address; the page is at /, the interface for scripts at /api/v1/jobs",
    )
}

/// Headers for browsers: no answer may run anything, be framed, or be kept. The files of the page have
/// headers of their own.
async fn guard_headers(request: Request, next: Next) -> Response {
    let mut answer = next.run(request).await;
    let headers = answer.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, "default-src 'none'; frame-ancestors 'none'; sandbox"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
    ] {
        headers.entry(name).or_insert(HeaderValue::from_static(value));
    }
    headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
    answer
}
