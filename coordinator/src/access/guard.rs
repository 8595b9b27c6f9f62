//! The door: every call passes here before any service sees it.
//!
//! What a role may call is one table, by the names of services and methods; what stands in no row nobody may call. Whose jobs a
//! caller sees is decided where jobs are looked up.

use std::future::{Ready, ready};
use std::sync::Arc;
use std::task::{Context, Poll};

use futures::future::Either;
use tonic::body::Body;
use tonic::codegen::http;
use tonic::transport::server::{TcpConnectInfo, TlsConnectInfo};
use tonic::{Request, Status};
use tower_layer::Layer;
use tower_service::Service;

use super::{Access, Principal, RateLimit, Refused, Role};
use crate::clock::Clock;
use crate::services::convert::ServiceError;

const JOBS: &str = "fathom.v1.JobService";
const UPLOADS: &str = "fathom.v1.UploadService";
const WORKERS: &str = "fathom.worker.v1.WorkerService";
const ADMIN: &str = "fathom.admin.v1.AdminService";
const HEALTH: &str = "grpc.health.v1.Health";
const REFLECTION: &str = "grpc.reflection.v1.ServerReflection";

/// Methods of JobService that change nothing.
const LOOKS: [&str; 5] = ["GetJob", "ListJobs", "WatchJob", "StreamLogs", "ListArtifacts"];

/// Methods of UploadService that change nothing and that people call.
const LOOKS_AT_UPLOADS: [&str; 3] = ["ReadBlob", "GetDataset", "ListDatasets"];
/// Methods of UploadService about blobs, which workers have and need too.
const OF_BLOBS: [&str; 4] = ["FindMissingBlobs", "WriteBlob", "QueryBlob", "ReadBlob"];

/// Whether a role may call a method; of operators, whether those of a tenant may.
fn may(caller: &Principal, service: &str, method: &str) -> bool {
    use Role::{Operator, Submitter, Viewer, Worker};
    match (service, caller.role) {
        (JOBS, Viewer) => LOOKS.contains(&method),
        (JOBS, Submitter | Operator) => true,
        (UPLOADS, Viewer) => LOOKS_AT_UPLOADS.contains(&method),
        (UPLOADS, Submitter | Operator) => true,
        (UPLOADS, Worker) => OF_BLOBS.contains(&method),
        (WORKERS, Worker) => true,
        (ADMIN, Operator) => caller.tenant.is_none(),
        (REFLECTION, _) => true,
        _ => false,
    }
}

/// What the door goes by.
pub struct Guard {
    /// Tokens.
    pub access: Arc<Access>,
    /// How often tenants may call.
    pub rate: RateLimit,
    /// Whether workers must show a certificate that the configured authority signed.
    pub workers_show_certificates: bool,
    /// For the ends of tokens.
    pub clock: Clock,
}

impl Guard {
    /// Who calls, unless they are sent away.
    fn admit<B>(&self, request: &http::Request<B>) -> Result<Option<Principal>, ServiceError> {
        let (service, method) =
            request.uri().path().trim_start_matches('/').split_once('/').unwrap_or_default();
        if service == HEALTH {
            return Ok(None);
        }
        if service == WORKERS && self.workers_show_certificates && !has_certificate(request) {
            return Err(ServiceError::NoCertificate);
        }
        let shown = request.headers().get(http::header::AUTHORIZATION);
        let shown = shown.map(|value| value.to_str().map_err(|_| Refused::NotValid)).transpose()?;
        let now_ms = self.clock.now_ms();
        let caller = self.access.principal(shown, now_ms)?;
        if !self.access.asks_for_tokens() {
            return Ok(Some(caller));
        }
        if !may(&caller, service, method) {
            let (role, method) = (caller.role, method.to_owned());
            return Err(ServiceError::RoleRefused { role, method, of_tenant: caller.tenant.is_some() });
        }
        // Workers call as often as they must, and there may be a thousand of one token.
        if caller.role != Role::Worker {
            self.rate.take(&caller.home(), now_ms).map_err(ServiceError::TooManyCalls)?;
        }
        Ok(Some(caller))
    }
}

fn has_certificate<B>(request: &http::Request<B>) -> bool {
    let connection = request.extensions().get::<TlsConnectInfo<TcpConnectInfo>>();
    connection.and_then(TlsConnectInfo::peer_certs).is_some_and(|chain| !chain.is_empty())
}

/// Who sent a request that has passed the door.
///
/// # Errors
/// When it has not, which no configuration allows.
pub fn caller<T>(request: &Request<T>) -> Result<Principal, Status> {
    let caller = request.extensions().get::<Principal>().cloned();
    caller.ok_or_else(|| Status::internal("the call did not pass the guard"))
}

/// Puts a [`Guard`] before all services.
#[derive(Clone)]
pub struct GuardLayer(pub Arc<Guard>);

impl<S> Layer<S> for GuardLayer {
    type Service = Guarded<S>;

    fn layer(&self, inner: S) -> Guarded<S> {
        Guarded { guard: Arc::clone(&self.0), inner }
    }
}

/// Services behind a [`Guard`].
#[derive(Clone)]
pub struct Guarded<S> {
    guard: Arc<Guard>,
    inner: S,
}

type Answer = http::Response<Body>;

impl<S, B> Service<http::Request<B>> for Guarded<S>
where
    S: Service<http::Request<B>, Response = Answer>,
{
    type Response = Answer;
    type Error = S::Error;
    type Future = Either<Ready<Result<Answer, S::Error>>, S::Future>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<B>) -> Self::Future {
        match self.guard.admit(&request) {
            Ok(caller) => {
                if let Some(caller) = caller {
                    request.extensions_mut().insert(caller);
                }
                Either::Right(self.inner.call(request))
            }
            Err(error) => {
                // Counted by method and code; a line each would let strangers fill the log. The path is the caller's own text.
                let path: String = request.uri().path().chars().take(100).collect();
                tracing::debug!(%path, %error, "a call was sent away");
                Either::Left(ready(Ok(Status::from(error).into_http())))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use prost::Message as _;
    use prost_types::FileDescriptorSet;

    use super::*;

    fn caller(role: Role, tenant: Option<&str>) -> Principal {
        let tenant = tenant.map(|tenant| tenant.parse().unwrap());
        Principal { name: String::new(), role, tenant, token_id: Some(String::new()) }
    }

    /// All methods of all services that the coordinator has, as `service/method`.
    fn methods() -> Vec<String> {
        let all = FileDescriptorSet::decode(fathom_proto::FILE_DESCRIPTOR_SET).unwrap();
        let mut found = Vec::new();
        for file in &all.file {
            for service in &file.service {
                for method in &service.method {
                    found.push(format!("{}.{}/{}", file.package(), service.name(), method.name()));
                }
            }
        }
        found
    }

    fn allowed(caller: &Principal) -> Vec<String> {
        let may =
            |path: &&String| may(caller, path.split_once('/').unwrap().0, path.split_once('/').unwrap().1);
        methods().iter().filter(may).cloned().collect()
    }

    #[test]
    fn each_role_may_call_what_it_is_for_and_nothing_else() {
        let viewer = allowed(&caller(Role::Viewer, Some("reef")));
        let looks = ["GetJob", "ListJobs", "WatchJob", "StreamLogs", "ListArtifacts"];
        let mut wanted: Vec<String> = looks.iter().map(|method| format!("{JOBS}/{method}")).collect();
        let of_uploads = ["ReadBlob", "GetDataset", "ListDatasets"];
        wanted.extend(of_uploads.map(|method| format!("{UPLOADS}/{method}")));
        let (mut found, mut expected) = (viewer.clone(), wanted);
        found.sort();
        expected.sort();
        assert_eq!(found, expected);

        let submitter = allowed(&caller(Role::Submitter, Some("reef")));
        assert!(submitter.iter().all(|path| path.starts_with("fathom.v1.")), "{submitter:?}");
        assert_eq!(submitter, allowed(&caller(Role::Operator, Some("reef"))));
        let worker = allowed(&caller(Role::Worker, None));
        assert!(
            worker.iter().all(|path| path.starts_with(WORKERS) || path.starts_with(UPLOADS)),
            "{worker:?}"
        );
        let of_uploads: Vec<_> = worker.iter().filter_map(|path| path.strip_prefix(UPLOADS)).collect();
        assert_eq!(of_uploads, ["/FindMissingBlobs", "/WriteBlob", "/QueryBlob", "/ReadBlob"]);
        let operator = allowed(&caller(Role::Operator, None));
        assert!(methods().iter().all(|path| operator.contains(path) || path.starts_with(WORKERS)));
        for role in Role::ALL {
            assert!(!may(&caller(role, None), "fathom.v2.JobService", "GetJob"), "{role}");
        }
    }
}
