//! Access control over real connections: tokens, roles, tenants, quotas, rates, TLS.
#![expect(clippy::unwrap_used, reason = "the helpers of a test fail by panicking")]

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use fathom_coordinator::{CoordinatorConfig, serve};
use fathom_proto::admin::v1::{
    IssueTokenRequest, ListWorkersRequest, Quota, RevokeTokenRequest, Role, SetQuotaRequest,
};
use fathom_proto::dial::{Dial, Secret, reason};
use fathom_proto::v1::{
    BeginUploadRequest, BlobRef, CancelJobRequest, CommitDatasetRequest, CreateJobRequest, DatasetFile,
    DeleteDatasetRequest, FindMissingBlobsRequest, GetDatasetRequest, GetJobRequest, ListDatasetsRequest,
    ListJobsRequest, PauseJobRequest, ReadBlobRequest, ResumeJobRequest, Stage, WatchJobRequest,
};
use fathom_proto::worker::v1 as worker_v1;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tonic::Code;
use tonic_types::StatusExt;

use crate::callers::{Caller, GuardedCluster, INCARNATION, POINTS, blob, is, said};

/// A failed task is not retried during a test.
fn long_pauses(config: &mut CoordinatorConfig, _: &Path) {
    config.backoff_ms = 60_000;
}

#[tokio::test]
async fn only_health_is_served_without_a_token() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let stranger = cluster.with(None);
    let missing = is(Code::Unauthenticated, "TOKEN_MISSING");
    assert_eq!(said(stranger.list().await), missing);
    assert_eq!(said(stranger.upload(b"a photograph").await), missing);
    assert_eq!(said(stranger.admin().list_workers(ListWorkersRequest {}).await), missing);
    let register = worker_v1::RegisterRequest::default();
    assert_eq!(said(stranger.workers().register(register).await), missing);
    let forged = format!("fathom_{}_{}", "a".repeat(12), "b".repeat(64));
    let refused = is(Code::Unauthenticated, "TOKEN_REFUSED");
    assert_eq!(said(cluster.with(Some(&forged)).list().await), refused);
    assert_eq!(said(cluster.with(Some("nonsense")).list().await), refused);
    let mut health = tonic_health::pb::health_client::HealthClient::new(stranger.connection.clone());
    let request = tonic_health::pb::HealthCheckRequest { service: "fathom.v1.JobService".into() };
    assert_eq!(health.check(request).await.unwrap().into_inner().status, 1);
    assert!(cluster.operator().list().await.unwrap().is_empty());
}

#[tokio::test]
async fn a_tenant_sees_nothing_of_another_whatever_it_asks() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let reef = cluster.caller(Role::Submitter, "reef").await;
    let wreck = cluster.caller(Role::Submitter, "wreck").await;
    let job = reef.job("a request").await.unwrap();
    assert_eq!(job.tenant, "reef");

    let absent = is(Code::NotFound, "JOB_NOT_FOUND");
    let get = || GetJobRequest { job_id: job.job_id.clone() };
    assert_eq!(said(wreck.jobs().get_job(get()).await), absent);
    let cancel = CancelJobRequest { job_id: job.job_id.clone(), reason: String::new() };
    assert_eq!(said(wreck.jobs().cancel_job(cancel).await), absent);
    let watch = WatchJobRequest { job_id: job.job_id.clone(), after_seq: 0 };
    assert_eq!(said(wreck.jobs().watch_job(watch).await), absent);
    assert!(wreck.list().await.unwrap().is_empty());
    let of_reef = ListJobsRequest { tenant: "reef".into(), ..Default::default() };
    assert!(wreck.jobs().list_jobs(of_reef).await.unwrap().into_inner().jobs.is_empty());

    // Neither the existence nor the content of a file is visible, by its digest or by its job.
    let read = |job_id: &str| ReadBlobRequest {
        digest: blob(POINTS).digest,
        offset_bytes: 0,
        job_id: job_id.to_owned(),
        ..Default::default()
    };
    assert_eq!(said(wreck.uploads().read_blob(read("")).await), is(Code::NotFound, "BLOB_NOT_FOUND"));
    assert_eq!(said(wreck.uploads().read_blob(read(&job.job_id)).await), absent);
    let question = FindMissingBlobsRequest { blobs: vec![blob(POINTS)], ..Default::default() };
    let missing = wreck.uploads().find_missing_blobs(question).await.unwrap().into_inner().missing;
    assert_eq!(missing.len(), 1, "another tenant's file is visible");

    // The same request id of two tenants makes two jobs, and the operator of all tenants sees both.
    let other = wreck.job("a request").await.unwrap();
    assert_ne!(other.job_id, job.job_id);
    assert_eq!(reef.list().await.unwrap(), std::slice::from_ref(&job.job_id));
    assert_eq!(cluster.operator().list().await.unwrap().len(), 2);
    assert!(cluster.operator().uploads().read_blob(read(&job.job_id)).await.is_ok());
}

#[tokio::test]
async fn only_its_tenant_uses_a_dataset_and_viewers_read_it() {
    let cluster = GuardedCluster::start(|config, _| config.tenant_bytes = 200).await;
    let reef = cluster.caller(Role::Submitter, "reef").await;
    let wreck = cluster.caller(Role::Submitter, "wreck").await;
    let viewer = cluster.caller(Role::Viewer, "reef").await;
    let worker = cluster.caller(Role::Worker, "reef").await;
    let photograph = reef.upload(b"a photograph").await.unwrap();
    let begin = |blob: &BlobRef| BeginUploadRequest {
        dataset_id: "scene".into(),
        request_id: "one".into(),
        files: vec![DatasetFile { path: "a.jpg".into(), blob: Some(blob.clone()) }],
        list: None,
    };
    let get = || GetDatasetRequest { dataset_id: "scene".into() };
    let commit = || CommitDatasetRequest { dataset_id: "scene".into() };
    let begun = reef.uploads().begin_upload(begin(&photograph)).await.unwrap().into_inner();
    assert!(begun.missing.is_empty() && begun.dataset.unwrap().tenant == "reef");
    reef.uploads().commit_dataset(commit()).await.unwrap();
    assert_eq!(viewer.uploads().get_dataset(get()).await.unwrap().into_inner().files, 1);

    let absent = is(Code::NotFound, "DATASET_NOT_FOUND");
    assert_eq!(said(wreck.uploads().get_dataset(get()).await), absent);
    assert_eq!(said(wreck.uploads().commit_dataset(commit()).await), absent);
    let delete = || DeleteDatasetRequest { dataset_id: "scene".into() };
    assert_eq!(said(wreck.uploads().delete_dataset(delete()).await), absent);
    let request = CreateJobRequest {
        request_id: "one".into(),
        config_json: "{}".into(),
        dataset_id: "scene".into(),
        ..Default::default()
    };
    assert_eq!(said(wreck.jobs().create_job(request).await), absent);
    let list = ListDatasetsRequest::default;
    assert!(wreck.uploads().list_datasets(list()).await.unwrap().into_inner().datasets.is_empty());
    // Another tenant uses the same name and files: its blob is missing, and nothing reveals that it exists
    // elsewhere.
    let begun = wreck.uploads().begin_upload(begin(&photograph)).await.unwrap().into_inner();
    assert_eq!(begun.missing, std::slice::from_ref(&photograph));
    let large = BlobRef { size_bytes: 300, ..blob(b"another") };
    let request =
        BeginUploadRequest { dataset_id: "large".into(), request_id: "two".into(), ..begin(&large) };
    assert_eq!(said(wreck.uploads().begin_upload(request).await), is(Code::ResourceExhausted, "QUOTA_SPENT"));

    let refused = is(Code::PermissionDenied, "ROLE_REFUSED");
    assert_eq!(said(viewer.uploads().begin_upload(begin(&photograph)).await), refused);
    assert_eq!(said(viewer.uploads().commit_dataset(commit()).await), refused);
    assert_eq!(said(viewer.uploads().delete_dataset(delete()).await), refused);
    assert_eq!(said(worker.uploads().list_datasets(list()).await), refused);
    assert_eq!(said(worker.uploads().delete_dataset(delete()).await), refused);
    reef.uploads().delete_dataset(delete()).await.unwrap();
}

#[tokio::test]
async fn a_role_permits_its_own_calls_and_no_others() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let submitter = cluster.caller(Role::Submitter, "reef").await;
    let viewer = cluster.caller(Role::Viewer, "reef").await;
    let worker = cluster.caller(Role::Worker, "").await;
    let local = cluster.caller(Role::Operator, "reef").await;
    let job = submitter.job("a request").await.unwrap();
    assert_eq!(viewer.list().await.unwrap(), std::slice::from_ref(&job.job_id));
    let refused = is(Code::PermissionDenied, "ROLE_REFUSED");
    assert_eq!(said(viewer.upload(b"a photograph").await), refused);
    let cancel = || CancelJobRequest { job_id: job.job_id.clone(), reason: String::new() };
    assert_eq!(said(viewer.jobs().cancel_job(cancel()).await), refused);
    assert_eq!(said(worker.list().await), refused);
    for caller in [&submitter, &viewer, &worker, &local] {
        assert_eq!(said(caller.admin().list_workers(ListWorkersRequest {}).await), refused);
    }
    assert_eq!(said(submitter.workers().register(worker_v1::RegisterRequest::default()).await), refused);
    assert!(local.jobs().cancel_job(cancel()).await.is_ok());
}

#[tokio::test]
async fn terminal_control_text_is_refused_on_arrival() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let submitter = cluster.caller(Role::Submitter, "reef").await;
    let manifest = submitter.upload_scene().await.unwrap();
    let named = |name: &str| CreateJobRequest {
        request_id: "a request".into(),
        name: name.to_owned(),
        config_json: "{}".into(),
        manifest: Some(manifest.clone()),
        ..Default::default()
    };
    for (name, found) in [
        ("a\nINFO forged", "U+000A"),
        ("\u{1b}[2J", "U+001B"),
        ("a\0", "U+0000"),
        ("\u{9b}2J", "U+009B"),
        ("\u{7f}", "U+007F"),
    ] {
        let status = submitter.jobs().create_job(named(name)).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument, "{name:?}");
        assert!(status.message().contains("name") && status.message().contains(found), "{status}");
    }
    let job = submitter.jobs().create_job(named("W\u{fc}rfel \u{1f41f}")).await.unwrap().into_inner();
    let pause = PauseJobRequest { job_id: job.job_id, reason: "\u{1b}]0;gone\u{7}".into() };
    let status = submitter.jobs().pause_job(pause).await.unwrap_err();
    assert!(status.code() == Code::InvalidArgument && status.message().contains("reason"), "{status}");
}

#[tokio::test]
async fn a_token_ends_when_it_is_revoked_and_its_streams_with_it() {
    let cluster = GuardedCluster::start(long_pauses).await;
    let (secret, id) = cluster.issue(Role::Submitter, "reef").await;
    let caller = cluster.with(Some(&secret));
    // The stream lasts as long as the job.
    let job = cluster.lasting_job(&caller, "reef", "a request").await;
    let watch = WatchJobRequest { job_id: job.job_id, after_seq: 0 };
    let mut stream = caller.jobs().watch_job(watch).await.unwrap().into_inner();
    let revoke = RevokeTokenRequest { token_id: id, even_last: false };
    let revoked = cluster.operator().admin().revoke_token(revoke.clone()).await.unwrap().into_inner();
    let again = cluster.operator().admin().revoke_token(revoke).await.unwrap().into_inner();
    assert!(revoked.revoke_time.is_some());
    assert_eq!(revoked, again);
    assert_eq!(said(caller.list().await), is(Code::Unauthenticated, "TOKEN_REFUSED"));
    let end = tokio::time::timeout(Duration::from_secs(20), async {
        loop {
            match stream.message().await {
                Ok(Some(_)) => {}
                Ok(None) => return None,
                Err(status) => return Some(status.code()),
            }
        }
    });
    let end = end.await.expect("the stream outlives its token");
    assert_eq!(end, Some(Code::Unauthenticated));

    let unknown = RevokeTokenRequest { token_id: "0".repeat(12), even_last: false };
    assert_eq!(
        said(cluster.operator().admin().revoke_token(unknown).await),
        is(Code::NotFound, "TOKEN_NOT_FOUND")
    );
}

#[tokio::test]
async fn a_tenants_worker_gets_and_ends_no_lease_of_another_tenant() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let own = cluster.caller(Role::Worker, "wreck").await;
    let job = cluster.caller(Role::Submitter, "reef").await.job("a request").await.unwrap();
    let register = worker_v1::RegisterRequest {
        worker_name: "own".into(),
        incarnation: INCARNATION.into(),
        protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
        capabilities: Some(worker_v1::Capabilities {
            stages: vec![Stage::Partition.into(), Stage::Plan.into()],
            ..Default::default()
        }),
        ..Default::default()
    };
    own.workers().register(register).await.unwrap();
    let lease = worker_v1::Lease { job_id: job.job_id, task_id: "plan".into(), attempt: 1, fence: 1 };
    let release = worker_v1::ReleaseRequest { lease: Some(lease.clone()), reason: String::new() };
    let absent = is(Code::NotFound, "JOB_NOT_FOUND");
    assert_eq!(said(own.workers().release(release).await), absent);
    let renewal = worker_v1::Renewal { lease: Some(lease), ..Default::default() };
    let renew = worker_v1::RenewRequest { incarnation: INCARNATION.into(), renewals: vec![renewal] };
    assert_eq!(said(own.workers().renew(renew).await), absent);
    let claim =
        worker_v1::ClaimRequest { incarnation: INCARNATION.into(), request_id: "a".into(), wait_ms: 0 };
    assert!(own.workers().claim(claim).await.unwrap().into_inner().assignment.is_none());
}

#[tokio::test]
async fn a_tenant_at_its_quota_is_refused() {
    let cluster = GuardedCluster::start(|config, dir| {
        config.tenant_bytes = 4000;
        long_pauses(config, dir);
    })
    .await;
    let reef = cluster.caller(Role::Submitter, "reef").await;
    let limit = |quota| SetQuotaRequest { tenant: "reef".into(), quota };
    let quota = Quota { max_open_jobs: 1, max_parallel: 0, max_bytes: 5000 };
    let spent = is(Code::ResourceExhausted, "QUOTA_SPENT");

    let nearly_all = [b' '; 3980];
    reef.upload(&nearly_all).await.unwrap();
    assert_eq!(said(reef.upload(b"and twenty-one of it.").await), spent);
    reef.upload(&nearly_all).await.expect("an existing blob takes no room");
    let tenant = cluster.operator().admin().set_quota(limit(Some(quota))).await.unwrap().into_inner();
    assert_eq!((tenant.bytes, tenant.quota, tenant.quota_is_own), (3980, Some(quota), true));
    reef.upload(b"and twenty-one of it.").await.unwrap();

    let job = cluster.lasting_job(&reef, "reef", "one").await;
    assert_eq!(said(reef.job("two").await), spent);
    assert_eq!(reef.job("one").await.unwrap().job_id, job.job_id, "a repeated call is answered");
    cluster.caller(Role::Submitter, "wreck").await.job("two").await.expect("another tenant's limit");
    let tenant = cluster.operator().admin().set_quota(limit(None)).await.unwrap().into_inner();
    assert_eq!((tenant.quota.unwrap().max_bytes, tenant.quota_is_own), (4000, false));
}

#[tokio::test]
async fn rate_limited_callers_get_a_retry_delay() {
    let cluster = GuardedCluster::start(|config, _| config.calls_per_second = 5).await;
    let reef = cluster.caller(Role::Submitter, "reef").await;
    let mut refused = None;
    for _ in 0..40 {
        if let Err(status) = reef.list().await {
            refused = Some(status);
            break;
        }
    }
    let refused = refused.expect("forty calls at once");
    assert_eq!(reason(&refused).as_deref(), Some("RATE_LIMITED"));
    let pause = refused.get_details_retry_info().unwrap().retry_delay.unwrap();
    assert!(pause >= Duration::from_millis(10) && pause <= Duration::from_millis(200), "{pause:?}");
    cluster.caller(Role::Viewer, "wreck").await.list().await.expect("another tenant's rate");
    tokio::time::sleep(pause + Duration::from_millis(50)).await;
    reef.list().await.expect("it waited for the given delay");
}

#[tokio::test]
async fn tokens_are_stored_only_in_the_first_operators_file() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let (secret, _) = cluster.issue(Role::Submitter, "reef").await;
    let tail = |token: &str| token[token.len() - 64..].to_owned();
    let secrets = [tail(&secret), tail(&cluster.first_token())];
    let data = cluster.dir.path().join("data");
    cluster.with(Some(&secret)).job("a request").await.unwrap();
    cluster.coordinator.stop().await.unwrap();
    let mut folders = vec![data.clone()];
    let mut files = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            files += 1;
            let bytes = std::fs::read(&path).unwrap();
            let holds = |secret: &&String| bytes.windows(64).any(|window| window == secret.as_bytes());
            let found = secrets.iter().filter(holds).count();
            let allowed = usize::from(path == data.join("operator.token"));
            assert_eq!(found, allowed, "{}", path.display());
        }
    }
    assert!(files >= 4, "{files} files were looked at");
}

/// A CA and its certificates, as files.
pub struct Authority {
    dir: PathBuf,
    issuer: CertifiedIssuer<'static, KeyPair>,
}

impl Authority {
    pub fn new(dir: &Path, name: &str) -> Self {
        let dir = dir.join(name);
        std::fs::create_dir_all(&dir).unwrap();
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name.push(rcgen::DnType::CommonName, name);
        let issuer = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        std::fs::write(dir.join("ca.pem"), issuer.pem()).unwrap();
        Self { dir, issuer }
    }

    pub fn ca(&self) -> PathBuf {
        self.dir.join("ca.pem")
    }

    pub fn certify(&self, name: &str) -> (PathBuf, PathBuf) {
        let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(names).unwrap();
        let cert = params.signed_by(&key, &self.issuer).unwrap();
        let paths = (self.dir.join(format!("{name}.pem")), self.dir.join(format!("{name}.key")));
        std::fs::write(&paths.0, cert.pem()).unwrap();
        std::fs::write(&paths.1, key.serialize_pem()).unwrap();
        paths
    }
}

#[tokio::test]
async fn workers_show_a_certificate_and_people_a_token_over_tls() {
    let dir = tempfile::tempdir().unwrap();
    let (ours, theirs) = (Authority::new(dir.path(), "ours"), Authority::new(dir.path(), "theirs"));
    let (server, worker, stranger) =
        (ours.certify("server"), ours.certify("worker"), theirs.certify("worker"));
    let cluster = GuardedCluster::start(|config, _| {
        (config.tls_cert, config.tls_key) = (Some(server.0.clone()), Some(server.1.clone()));
        config.client_ca = Some(ours.ca());
    })
    .await;
    assert!(cluster.coordinator.url().starts_with("https://"));
    let operator = Dial {
        tls_ca: Some(ours.ca()),
        token: Some(Secret::new(&cluster.first_token())),
        ..Dial::to(&cluster.coordinator.url())
    };
    let call = |dial: Dial| async move { Caller { connection: dial.lazily().unwrap() }.list().await };
    assert!(call(operator.clone()).await.unwrap().is_empty());
    let plain = Dial { url: operator.url.replace("https", "http"), ..operator.clone() };
    assert!(call(plain).await.is_err(), "plain text was answered");
    let believes_another = Dial { tls_ca: Some(theirs.ca()), ..operator.clone() };
    assert!(call(believes_another).await.is_err(), "a server certificate of an unknown CA was accepted");

    let caller = Caller { connection: operator.lazily().unwrap() };
    let request = IssueTokenRequest { name: "gpu".into(), role: Role::Worker.into(), ..Default::default() };
    let token = caller.admin().issue_token(request).await.unwrap().into_inner().secret;
    let dial = |tls_identity| Dial { token: Some(Secret::new(&token)), tls_identity, ..operator.clone() };
    let register = |dial: Dial| async move {
        let request = worker_v1::RegisterRequest {
            incarnation: INCARNATION.into(),
            protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
            ..Default::default()
        };
        Caller { connection: dial.lazily().unwrap() }.workers().register(request).await
    };
    assert!(register(dial(Some(worker))).await.is_ok());
    assert_eq!(said(register(dial(None)).await), is(Code::Unauthenticated, "CERTIFICATE_MISSING"));
    assert!(
        register(dial(Some(stranger))).await.is_err(),
        "a client certificate of an unknown CA was \
        accepted"
    );
}

/// Time until changed files are in use: more than two checks of the files.
const RELOADED_WITHIN: Duration = Duration::from_secs(30);

#[tokio::test]
async fn changed_certificates_are_reloaded_and_open_calls_continue() {
    let dir = tempfile::tempdir().unwrap();
    let (old, new) = (Authority::new(dir.path(), "old"), Authority::new(dir.path(), "new"));
    let served = ["cert", "key", "authority"].map(|name| dir.path().join(name));
    let serve_by = |authority: &Authority| {
        let (cert, key) = authority.certify("server");
        for (from, to) in [cert, key, authority.ca()].iter().zip(&served) {
            std::fs::copy(from, to).unwrap();
        }
    };
    serve_by(&old);
    let cluster = GuardedCluster::start(|config, dir| {
        (config.tls_cert, config.tls_key) = (Some(served[0].clone()), Some(served[1].clone()));
        config.client_ca = Some(served[2].clone());
        long_pauses(config, dir);
    })
    .await;
    let dial = |authority: &Authority, token: &str| Dial {
        tls_ca: Some(authority.ca()),
        token: Some(Secret::new(token)),
        ..Dial::to(&cluster.coordinator.url())
    };
    let call = |dial: Dial| async move { Caller { connection: dial.lazily().unwrap() }.list().await };
    let register = |dial: Dial| async move {
        let request = worker_v1::RegisterRequest {
            incarnation: INCARNATION.into(),
            protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
            ..Default::default()
        };
        Caller { connection: dial.lazily().unwrap() }.workers().register(request).await
    };
    let operator = cluster.first_token();
    let before = Caller { connection: dial(&old, &operator).lazily().unwrap() };
    let issue = |role: Role, tenant: &str| IssueTokenRequest {
        name: "ana".into(),
        role: role.into(),
        tenant: tenant.into(),
        ..Default::default()
    };
    let token_of = |role, tenant| {
        let (mut admin, request) = (before.admin(), issue(role, tenant));
        async move { admin.issue_token(request).await.unwrap().into_inner().secret }
    };
    let (submitter, worker) = (token_of(Role::Submitter, "reef").await, token_of(Role::Worker, "").await);
    let watcher = Caller { connection: dial(&old, &submitter).lazily().unwrap() };
    let job_id = cluster.lasting_job(&watcher, "reef", "a request").await.job_id;
    let watch = WatchJobRequest { job_id: job_id.clone(), after_seq: 0 };
    let mut stream = watcher.jobs().watch_job(watch).await.unwrap().into_inner();
    while let Ok(event) = tokio::time::timeout(Duration::from_secs(1), stream.message()).await {
        assert!(event.unwrap().is_some(), "the stream ended before anything changed");
    }
    let by_old = Dial { tls_identity: Some(old.certify("worker")), ..dial(&old, &worker) };
    register(by_old).await.unwrap();

    serve_by(&new);
    let begun = Instant::now();
    while let Err(status) = call(dial(&new, &operator)).await {
        assert!(begun.elapsed() < RELOADED_WITHIN, "{status}");
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    assert!(call(dial(&old, &operator)).await.is_err(), "the old certificate is still presented");
    let by_new = Dial { tls_identity: Some(new.certify("worker")), ..dial(&new, &worker) };
    register(by_new).await.unwrap();
    let by_old = Dial { tls_identity: Some(old.certify("worker")), ..dial(&new, &worker) };
    assert!(register(by_old).await.is_err(), "the old CA is still trusted");

    let resume = ResumeJobRequest { job_id };
    before.jobs().resume_job(resume).await.expect("a connection from before");
    let event = tokio::time::timeout(Duration::from_secs(10), stream.message()).await;
    assert!(event.expect("an old call receives the event").unwrap().is_some(), "it was ended");

    std::fs::write(&served[0], "half a certificate").unwrap();
    // Longer than two checks of the files.
    tokio::time::sleep(Duration::from_secs(7)).await;
    call(dial(&new, &operator)).await.expect("the certificate in use before the broken file");
}

#[tokio::test]
async fn silent_handshakes_block_nothing_and_end_after_ten_seconds() {
    let dir = tempfile::tempdir().unwrap();
    let ours = Authority::new(dir.path(), "ours");
    let (cert, key) = ours.certify("server");
    let cluster = GuardedCluster::start(|config, _| {
        (config.tls_cert, config.tls_key) = (Some(cert.clone()), Some(key.clone()))
    })
    .await;
    let begun = Instant::now();
    let mut silent = Vec::new();
    for _ in 0..50 {
        silent.push(TcpStream::connect(cluster.coordinator.address()).await.unwrap());
    }
    let operator = Dial {
        tls_ca: Some(ours.ca()),
        token: Some(Secret::new(&cluster.first_token())),
        ..Dial::to(&cluster.coordinator.url())
    };
    Caller { connection: operator.lazily().unwrap() }.list().await.unwrap();
    assert!(
        begun.elapsed() < Duration::from_secs(5),
        "it waited for the silent connections: {:?}",
        begun.elapsed()
    );
    for stream in &mut silent {
        let end = tokio::time::timeout(Duration::from_secs(30), stream.read_u8()).await;
        assert!(end.expect("the connection is still open").is_err());
    }
    assert!(begun.elapsed() >= Duration::from_secs(9), "it was closed too early: {:?}", begun.elapsed());
}

#[tokio::test]
async fn unusable_tls_files_are_named_before_anything_is_created() {
    let dir = tempfile::tempdir().unwrap();
    let (cert, key) = Authority::new(dir.path(), "ours").certify("server");
    let config = |cert: &Path, key: &Path| CoordinatorConfig {
        data_dir: dir.path().join("data"),
        listen: ([127, 0, 0, 1], 0).into(),
        tls_cert: Some(cert.to_owned()),
        tls_key: Some(key.to_owned()),
        ..CoordinatorConfig::default()
    };
    let missing = dir.path().join("missing.pem");
    for (config, named) in [(config(&missing, &key), "missing.pem"), (config(&cert, &cert), "PRIVATE KEY")] {
        let Err(error) = serve(config).await else { panic!("it serves") };
        assert!(error.to_string().contains(named), "{error}");
    }
    assert!(!dir.path().join("data").exists(), "a data directory was created");
}

#[tokio::test]
async fn a_message_too_large_is_refused_and_the_next_is_answered() {
    let cluster = GuardedCluster::start(|_, _| {}).await;
    let reef = cluster.caller(Role::Submitter, "reef").await;
    let request =
        CreateJobRequest { request_id: "a".into(), config_json: " ".repeat(5 << 20), ..Default::default() };
    let (code, _) = said(reef.jobs().create_job(request).await);
    assert_eq!(code, Code::OutOfRange);
    assert!(reef.list().await.unwrap().is_empty());
}
