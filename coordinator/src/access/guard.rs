//! The guard: every call passes here before any service sees it.
//!
//! One table lists the methods that each role may call, by service and method; a method in no row is refused.
//! The lookup of jobs decides which jobs a caller sees.

use std::collections::HashSet;
use std::pin::Pin;
use std::sync::{Arc, LazyLock};
use std::task::{Context, Poll};

use bytes::Bytes;
use prost::Message as _;
use prost_types::FileDescriptorSet;
use tonic::body::Body;
use tonic::codegen::http;
use tonic::transport::server::TlsConnectInfo;
use tonic::{Request, Status};
use tower_layer::Layer;
use tower_service::Service;

use super::calls::{Arriving, OpenCalls, Standing, Void, refused};
use super::places::{Kind, Places};
use super::{Access, Principal, RateLimit, Refused, Role};
use crate::clock::Clock;
use crate::connections::Visit;
use crate::rate_limited_log::RateLimitedLog;
use crate::schedule::Tenant;
use crate::service_error::ServiceError;

const JOBS: &str = "fathom.v1.JobService";
const UPLOADS: &str = "fathom.v1.UploadService";
const WORKERS: &str = "fathom.worker.v1.WorkerService";
const ADMIN: &str = "fathom.admin.v1.AdminService";
const HEALTH: &str = "grpc.health.v1.Health";
/// Both versions of reflection: many programs still use the older one.
const REFLECTION: [&str; 2] =
    ["grpc.reflection.v1.ServerReflection", "grpc.reflection.v1alpha.ServerReflection"];

/// All methods of our own services, as `service/method`.
static METHODS: LazyLock<HashSet<String>> = LazyLock::new(|| {
    // The built descriptor can always be decoded; otherwise no call would work, and tests would fail.
    let files = FileDescriptorSet::decode(fathom_proto::FILE_DESCRIPTOR_SET).unwrap_or_default().file;
    let mut methods = HashSet::new();
    for file in &files {
        for service in &file.service {
            for method in &service.method {
                methods.insert(format!("{}.{}/{}", file.package(), service.name(), method.name()));
            }
        }
    }
    methods
});

/// Methods of JobService that change nothing.
const LOOKS: [&str; 6] = ["GetJob", "ListJobs", "WatchJob", "StreamLogs", "GetHistory", "ListArtifacts"];

/// Methods of UploadService that change nothing and that users call.
const LOOKS_AT_UPLOADS: [&str; 3] = ["ReadBlob", "GetDataset", "ListDatasets"];
/// Methods of UploadService about blobs, which workers also use.
const OF_BLOBS: [&str; 7] =
    ["FindMissingBlobs", "WriteBlob", "WriteChunk", "QueryBlob", "ReadBlob", "SignWrite", "FinishWrite"];

/// Whether a caller's role may call a method; operators of one tenant may call fewer.
fn may(caller: &Principal, service: &str, method: &str) -> bool {
    use Role::{Operator, Submitter, Viewer, Worker};
    match (service, caller.role) {
        (ADMIN, _) if method == "GetCaller" => true,
        // Datasets are not those of the job alone.
        (UPLOADS, Viewer) if caller.job.is_some() => method == "ReadBlob",
        (JOBS, Viewer) => LOOKS.contains(&method),
        (JOBS, Submitter | Operator) => true,
        (UPLOADS, Viewer) => LOOKS_AT_UPLOADS.contains(&method),
        (UPLOADS, Submitter | Operator) => true,
        (UPLOADS, Worker) => OF_BLOBS.contains(&method),
        (WORKERS, Worker) => true,
        (ADMIN, Operator) => caller.tenant.is_none(),
        (service, _) if REFLECTION.contains(&service) => true,
        _ => false,
    }
}

/// The roles that may call a method, as a sentence.
fn need_of(service: &str, method: &str) -> String {
    let of = |role| Principal { role, tenant: Some(Tenant::default()), ..Principal::anonymous() };
    let roles: Vec<String> = Role::ALL
        .into_iter()
        .filter(|&role| may(&of(role), service, method))
        .map(|role| role.to_string())
        .collect();
    match roles.as_slice() {
        [] => format!("{method} needs the role operator, of all tenants"),
        [role] if service == WORKERS => format!("running a worker needs the role {role}"),
        [role] => format!("{method} needs the role {role}"),
        [first @ .., last] => format!("{method} needs the role {} or {last}", first.join(", ")),
    }
}

/// The settings of the guard.
pub struct Guard {
    /// Tokens.
    pub access: Arc<Access>,
    /// Rate limits of tenants.
    pub rate: RateLimit,
    /// Whether workers must present a certificate signed by the configured authority.
    pub workers_show_certificates: bool,
    /// For the expiry of tokens.
    pub clock: Clock,
    /// Limits on the memory of waiting data.
    pub places: Places,
    /// The open calls.
    pub calls: Arc<OpenCalls>,
    /// Refused calls.
    pub refused: RateLimitedLog,
}

impl Guard {
    /// Identifies the caller or refuses the call; anonymous where the call needs no identity.
    fn admit<B>(&self, request: &http::Request<B>) -> Result<Option<Principal>, ServiceError> {
        let path = request.uri().path().trim_start_matches('/');
        let (service, method) = path.split_once('/').unwrap_or_default();
        let is_ours = METHODS.contains(path);
        if service == HEALTH || !(is_ours || REFLECTION.contains(&service)) {
            // Unknown methods are UNIMPLEMENTED for every caller.
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
            if caller.job.is_some() {
                return Err(ServiceError::OfLink);
            }
            let (role, of_tenant) = (caller.role, caller.tenant.is_some());
            return Err(ServiceError::RoleRefused { role, need: need_of(service, method), of_tenant });
        }
        // Workers have no rate limit: a thousand may share one token.
        if caller.role != Role::Worker {
            self.rate.take(&caller.home(), now_ms).map_err(ServiceError::TooManyCalls)?;
        }
        Ok(Some(caller))
    }

    /// Logs refused calls without a valid token: a count, because a line for each would let unauthenticated
    /// clients fill the log.
    pub fn log_refusal(&self, path: &str, visit: Option<&Visit>, error: &ServiceError) {
        // The path is the caller's own text.
        let path: String = path.chars().take(100).collect();
        tracing::debug!(?path, %error, "refused a call");
        if !matches!(error, ServiceError::Token(_) | ServiceError::NoCertificate) {
            return;
        }
        if let Some(calls) = self.refused.count() {
            let from = visit.and_then(Visit::from).map(|from| from.to_string()).unwrap_or_default();
            tracing::warn!(calls, last_from = %from, last = %error, "refused calls without a valid token");
        }
    }
}

fn has_certificate<B>(request: &http::Request<B>) -> bool {
    let connection = request.extensions().get::<TlsConnectInfo<Visit>>();
    connection.and_then(TlsConnectInfo::peer_certs).is_some_and(|chain| !chain.is_empty())
}

/// The caller of a request that has passed the guard.
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
    S: Service<http::Request<Body>, Response = Answer> + Clone + Send + 'static,
    S::Future: Send,
    B: http_body::Body<Data = Bytes> + Send + 'static,
    B::Error: Into<Box<dyn std::error::Error + Send + Sync>>,
{
    type Response = Answer;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Answer, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<B>) -> Self::Future {
        // The polled service is ready; its clone may not be.
        let copy = self.inner.clone();
        let mut inner = std::mem::replace(&mut self.inner, copy);
        let guard = Arc::clone(&self.guard);
        let visit = Visit::of(&request).cloned();
        let admitted = guard.admit(&request);
        match (&admitted, &visit) {
            (Ok(Some(_)), Some(visit)) => visit.admit(),
            (_, Some(visit)) => visit.call_without_token(),
            (_, None) => {}
        }
        let caller = match admitted {
            Ok(Some(caller)) => caller,
            Ok(None) => return Box::pin(inner.call(request.map(Body::new))),
            Err(error) => {
                guard.log_refusal(request.uri().path(), visit.as_ref(), &error);
                return Box::pin(async { Ok(Status::from(error).into_http()) });
            }
        };
        let method = request.uri().path().rsplit('/').next().unwrap_or_default();
        let (kind, revokes) = (Kind::of(method), method == "RevokeToken");
        request.extensions_mut().insert(caller.clone());
        let entry = guard.calls.begin(caller.clone(), visit, kind);
        let mut void: Void = {
            let (access, clock, caller) = (Arc::clone(&guard.access), guard.clock, caller.clone());
            if revokes {
                // A caller that revokes its own token must get the answer.
                Box::pin(std::future::pending())
            } else {
                Box::pin(async move { access.until_void(&caller, clock).await })
            }
        };
        Box::pin(async move {
            let answered = async {
                // First, so that a call that waits for a download place holds no place that short calls need.
                let to_leave = guard.places.to_leave(kind, &caller).await;
                let place = guard.places.to_arrive(kind, &caller).await;
                let request = request.map(|body| Body::new(Arriving::new(body, place, kind)));
                (inner.call(request).await, to_leave)
            };
            let (answer, place) = tokio::select! {
                biased;
                () = &mut void => return Ok(refused().into_http()),
                answered = answered => answered,
            };
            Ok(answer?.map(|body| Body::new(Standing::new(body, void, entry, place))))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn caller(role: Role, tenant: Option<&str>) -> Principal {
        let tenant = tenant.map(|tenant| tenant.parse().unwrap());
        Principal { role, tenant, token_id: Some(String::new()), ..Principal::anonymous() }
    }

    fn allowed(caller: &Principal) -> Vec<String> {
        let may =
            |path: &String| may(caller, path.split_once('/').unwrap().0, path.split_once('/').unwrap().1);
        let mut allowed: Vec<String> = METHODS.iter().filter(|path| may(path)).cloned().collect();
        allowed.sort();
        allowed
    }

    #[test]
    fn a_refusal_names_the_roles_that_the_call_needs() {
        for (path, need) in [
            ("fathom.worker.v1.WorkerService/Claim", "running a worker needs the role worker"),
            ("fathom.v1.JobService/CreateJob", "CreateJob needs the role submitter or operator"),
            ("fathom.v1.JobService/GetJob", "GetJob needs the role viewer, submitter or operator"),
            (
                "fathom.admin.v1.AdminService/BackUpStore",
                "BackUpStore needs the role operator, of all tenants",
            ),
        ] {
            let (service, method) = path.split_once('/').unwrap();
            assert!(METHODS.contains(path), "{path}");
            assert_eq!(need_of(service, method), need);
        }
    }

    #[test]
    fn each_role_permits_exactly_its_own_methods() {
        let viewer = allowed(&caller(Role::Viewer, Some("reef")));
        let looks = ["GetJob", "ListJobs", "WatchJob", "StreamLogs", "GetHistory", "ListArtifacts"];
        let mut wanted: Vec<String> = looks.iter().map(|method| format!("{JOBS}/{method}")).collect();
        let of_uploads = ["ReadBlob", "GetDataset", "ListDatasets"];
        wanted.extend(of_uploads.map(|method| format!("{UPLOADS}/{method}")));
        wanted.push(format!("{ADMIN}/GetCaller"));
        let (mut found, mut expected) = (viewer.clone(), wanted);
        found.sort();
        expected.sort();
        assert_eq!(found, expected);

        let job = "01a21ea5539c6b5f23ab".parse().ok();
        let link = allowed(&Principal { job, ..caller(Role::Viewer, Some("reef")) });
        let of_link = viewer.iter().filter(|path| !path.ends_with("Dataset") && !path.ends_with("Datasets"));
        assert!(link.iter().eq(of_link), "{link:?}");

        let submitter = allowed(&caller(Role::Submitter, Some("reef")));
        let who = format!("{ADMIN}/GetCaller");
        assert!(submitter.iter().all(|path| path.starts_with("fathom.v1.") || *path == who), "{submitter:?}");
        assert_eq!(submitter, allowed(&caller(Role::Operator, Some("reef"))));
        let worker = allowed(&caller(Role::Worker, None));
        assert!(
            worker.iter().all(|path| path.starts_with(WORKERS) || path.starts_with(UPLOADS) || *path == who),
            "{worker:?}"
        );
        let of_uploads: Vec<_> = worker.iter().filter_map(|path| path.strip_prefix(UPLOADS)).collect();
        let mut of_blobs = OF_BLOBS;
        of_blobs.sort_unstable();
        assert_eq!(of_uploads, of_blobs.map(|method| format!("/{method}")));
        let operator = allowed(&caller(Role::Operator, None));
        assert!(METHODS.iter().all(|path| operator.contains(path) || path.starts_with(WORKERS)));
        for role in Role::ALL {
            assert!(!may(&caller(role, None), "fathom.v2.JobService", "GetJob"), "{role}");
        }
    }
}
