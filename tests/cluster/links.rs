//! Links to one job, for colleagues.

use fathom_proto::admin::v1::{
    GetCallerRequest, ListTokensRequest, ListWorkersRequest, RevokeTokenRequest, Role,
};
use fathom_proto::v1;
use tonic::Code;

use crate::callers::{Caller, GuardedCluster, POINTS, blob, is, said};

async fn share(caller: &Caller, job: &str, seconds: u64) -> Result<v1::ShareJobResponse, tonic::Status> {
    let request = v1::ShareJobRequest { job_id: job.to_owned(), expires_in_seconds: seconds };
    caller.jobs().share_job(request).await.map(tonic::Response::into_inner)
}

fn read(digest: String, job: &str) -> v1::ReadBlobRequest {
    v1::ReadBlobRequest { digest, job_id: job.to_owned(), ..Default::default() }
}

#[tokio::test]
async fn a_link_reads_its_job_and_nothing_else() {
    let cluster = GuardedCluster::start(|config, _| {
        (config.backoff_ms, config.web) = (60_000, Some(([127, 0, 0, 1], 0).into()));
    })
    .await;
    // Of a process, once; a second call changes nothing.
    let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
    let reef = cluster.caller(Role::Submitter, "reef").await;
    let job = reef.job("shared").await.unwrap();
    let other = reef.job("another").await.unwrap();
    let secret = reef.upload(b"a photograph of another job").await.unwrap();

    let link = share(&reef, &job.job_id, 3600).await.unwrap();
    let guest = cluster.with(Some(&link.secret));
    assert_eq!(guest.list().await.unwrap(), std::slice::from_ref(&job.job_id));
    let get = |of: &v1::Job| v1::GetJobRequest { job_id: of.job_id.clone() };
    assert_eq!(guest.jobs().get_job(get(&job)).await.unwrap().into_inner().name, job.name);
    let history = v1::GetHistoryRequest { job_id: job.job_id.clone(), ..Default::default() };
    assert!(guest.jobs().get_history(history).await.is_ok());
    // A file of the job, by its digest.
    assert!(guest.uploads().read_blob(read(blob(POINTS).digest, &job.job_id)).await.is_ok());
    let manifest = job.manifest.clone().unwrap().digest;
    assert!(guest.uploads().read_blob(read(manifest.clone(), &job.job_id)).await.is_ok());
    let who = guest.admin().get_caller(GetCallerRequest {}).await.unwrap().into_inner();
    assert_eq!((who.role(), who.job_id.as_str(), who.tenant.as_str()), (Role::Viewer, &*job.job_id, "reef"));
    assert_eq!(who.expire_time, link.expire_time);

    let absent = is(Code::NotFound, "JOB_NOT_FOUND");
    assert_eq!(said(guest.jobs().get_job(get(&other)).await), absent);
    let watch = v1::WatchJobRequest { job_id: other.job_id.clone(), after_seq: 0 };
    assert_eq!(said(guest.jobs().watch_job(watch).await), absent);
    // Not even with the digest in hand, under any job.
    let gone = is(Code::NotFound, "BLOB_NOT_FOUND");
    assert_eq!(said(guest.uploads().read_blob(read(secret.digest.clone(), &job.job_id)).await), gone);
    assert_eq!(said(guest.uploads().read_blob(read(secret.digest.clone(), "")).await), gone);
    assert_eq!(said(guest.uploads().read_blob(read(secret.digest.clone(), &other.job_id)).await), absent);
    assert_eq!(said(guest.uploads().read_blob(read("a".into(), &job.job_id)).await), gone);

    let logs = v1::StreamLogsRequest { job_id: other.job_id.clone(), follow: true, ..Default::default() };
    assert_eq!(said(guest.jobs().stream_logs(logs).await), absent);
    let history = v1::GetHistoryRequest { job_id: other.job_id.clone(), ..Default::default() };
    assert_eq!(said(guest.jobs().get_history(history).await), absent);
    let files = v1::ListArtifactsRequest { job_id: other.job_id.clone(), ..Default::default() };
    assert_eq!(said(guest.jobs().list_artifacts(files).await), absent);
    // Nor over HTTP.
    let address = cluster.coordinator.web_address().unwrap();
    let status = async |path: &str| {
        let request = reqwest::Client::new().get(format!("http://{address}/api/v1{path}"));
        request.bearer_auth(&link.secret).send().await.unwrap().status().as_u16()
    };
    for (path, expected) in [
        (format!("/jobs/{}", job.job_id), 200),
        (format!("/jobs/{}/history", job.job_id), 200),
        (format!("/jobs/{}/blobs/{manifest}", job.job_id), 200),
        (format!("/jobs/{}/blobs/{}", job.job_id, secret.digest), 404),
        (format!("/jobs/{}", other.job_id), 404),
        (format!("/jobs/{}/events", other.job_id), 404),
        (format!("/jobs/{}/logs", other.job_id), 404),
        (format!("/jobs/{}/files", other.job_id), 404),
        ("/datasets".to_owned(), 403),
        ("/tenants".to_owned(), 403),
    ] {
        assert_eq!(status(&path).await, expected, "{path}");
    }

    let refused = is(Code::PermissionDenied, "ROLE_REFUSED");
    let pause = v1::PauseJobRequest { job_id: job.job_id.clone(), reason: String::new() };
    assert_eq!(said(guest.jobs().pause_job(pause).await), refused);
    assert_eq!(said(share(&guest, &job.job_id, 3600).await), refused);
    assert_eq!(said(guest.uploads().list_datasets(v1::ListDatasetsRequest::default()).await), refused);
    assert_eq!(said(guest.admin().list_workers(ListWorkersRequest {}).await), refused);
    assert_eq!(said(guest.upload(b"anything").await), refused);

    // The link stays valid when its job is gone, and then shows nothing.
    let cancel = v1::CancelJobRequest { job_id: job.job_id.clone(), reason: String::new() };
    reef.jobs().cancel_job(cancel).await.unwrap();
    reef.jobs().delete_job(v1::DeleteJobRequest { job_id: job.job_id.clone() }).await.unwrap();
    assert!(guest.list().await.unwrap().is_empty());
    assert_eq!(said(guest.jobs().get_job(get(&job)).await), absent);
}

#[tokio::test]
async fn a_link_ends_with_the_token_that_made_it() {
    let cluster = GuardedCluster::start(|config, _| config.backoff_ms = 60_000).await;
    let (secret, token_id) = cluster.issue(Role::Submitter, "reef").await;
    let reef = cluster.with(Some(&secret));
    let job = reef.job("shared").await.unwrap().job_id;
    let guest = cluster.with(Some(&share(&reef, &job, 0).await.unwrap().secret));
    assert!(guest.list().await.is_ok());
    let revoke = RevokeTokenRequest { token_id, even_last: false };
    cluster.operator().admin().revoke_token(revoke).await.unwrap();
    assert_eq!(said(guest.list().await), is(Code::Unauthenticated, "TOKEN_REFUSED"));
}

#[tokio::test]
async fn a_link_is_listed_revoked_and_bounded() {
    let cluster = GuardedCluster::start(|config, _| {
        (config.backoff_ms, config.calls_per_second) = (60_000, 10_000);
    })
    .await;
    let reef = cluster.caller(Role::Submitter, "reef").await;
    let wreck = cluster.caller(Role::Submitter, "wreck").await;
    let looks = cluster.caller(Role::Viewer, "reef").await;
    let job = reef.job("shared").await.unwrap().job_id;
    assert_eq!(said(share(&wreck, &job, 0).await), is(Code::NotFound, "JOB_NOT_FOUND"));
    assert_eq!(said(share(&looks, &job, 0).await), is(Code::PermissionDenied, "ROLE_REFUSED"));
    for seconds in [59, 90 * 24 * 3600 + 1, u64::MAX] {
        assert_eq!(said(share(&reef, &job, seconds).await), is(Code::InvalidArgument, "BAD_ARGUMENT"));
    }
    let link = share(&reef, &job, 0).await.unwrap();
    let listed = cluster.operator().admin().list_tokens(ListTokensRequest {}).await.unwrap().into_inner();
    let listed = listed.tokens.into_iter().find(|token| token.token_id == link.token_id).unwrap();
    assert_eq!((listed.job_id, listed.expire_time), (job.clone(), link.expire_time));
    assert!(listed.name.starts_with("link to "), "{}", listed.name);

    let guest = cluster.with(Some(&link.secret));
    assert!(guest.list().await.is_ok());
    let revoke = RevokeTokenRequest { token_id: link.token_id, even_last: false };
    cluster.operator().admin().revoke_token(revoke).await.unwrap();
    assert_eq!(said(guest.list().await), is(Code::Unauthenticated, "TOKEN_REFUSED"));

    let mut made = 1;
    while share(&reef, &job, 60).await.is_ok() {
        made += 1;
        assert!(made <= 200, "{made} links in a day");
    }
    assert_eq!(made, 200);
    assert_eq!(said(share(&reef, &job, 60).await), is(Code::ResourceExhausted, "QUOTA_SPENT"));
}
