//! The connection to a coordinator: every call with its retries and error messages.
//!
//! All calls are safe to repeat (see `job.proto`), so calls are retried while a coordinator restarts.

use std::time::Duration;

use backon::{ExponentialBuilder, Retryable as _};
use fathom_observe::shown;
use fathom_proto::admin::v1::admin_service_client::AdminServiceClient;
use fathom_proto::admin::v1::{
    BackUpStoreRequest, CordonWorkerRequest, DrainWorkerRequest, IssueTokenRequest, IssueTokenResponse,
    ListTenantsRequest, ListTokensRequest, ListWorkersRequest, RevokeTokenRequest, SetQuotaRequest, Tenant,
    Token, UncordonWorkerRequest, Worker,
};
use fathom_proto::dial::{Connection, Dial, DialError, cause, reason};
use fathom_proto::direct::Direct;
use fathom_proto::v1::job_service_client::JobServiceClient;
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_proto::v1::{
    Artifact, BeginUploadRequest, BeginUploadResponse, BlobRef, CancelJobRequest, CommitDatasetRequest,
    CreateJobRequest, Dataset, DeleteDatasetRequest, DeleteJobRequest, GetDatasetRequest, GetJobRequest, Job,
    JobEvent, ListArtifactsRequest, ListDatasetsRequest, ListJobsRequest, LogEntry, PauseJobRequest,
    ReadBlobRequest, ResumeJobRequest, RetryJobRequest, StreamLogsRequest, UpdateJobRequest, WatchJobRequest,
};
use tonic::{Code, Status, Streaming};

use crate::error::{CliError, Result};

/// A coordinator.
#[derive(Clone)]
pub struct Client {
    pub url: String,
    dial: Dial,
    pub jobs: JobServiceClient<Connection>,
    pub uploads: UploadServiceClient<Connection>,
    pub admin: AdminServiceClient<Connection>,
    /// Fetches files from the coordinator's bucket.
    pub direct: Direct,
}

/// A lost connection is retried for about a minute; a coordinator restarts within seconds.
pub fn patience() -> ExponentialBuilder {
    ExponentialBuilder::default()
        .with_min_delay(Duration::from_millis(200))
        .with_max_delay(Duration::from_secs(5))
        .with_max_times(16)
        .with_jitter()
}

/// Whether the same call may succeed a little later.
pub fn passing(status: &Status) -> bool {
    // Either end cancels a call that times out; the coordinator cancels no call for another reason.
    let is_too_late =
        matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled) && reason(status).is_none();
    matches!(status.code(), Code::Unavailable | Code::Aborted)
        || is_too_often(status)
        || is_too_late
        || is_broken_stream(status)
}

/// Whether the tenant exceeded its call rate.
fn is_too_often(status: &Status) -> bool {
    status.code() == Code::ResourceExhausted && reason(status).as_deref() == Some("RATE_LIMITED")
}

/// tonic reports a connection that broke inside a stream as Unknown or Cancelled, with a source of the
/// transport.
fn is_broken_stream(status: &Status) -> bool {
    matches!(status.code(), Code::Unknown | Code::Cancelled | Code::Internal)
        && std::error::Error::source(status).is_some()
}

/// The error for a call of the coordinator at `url` that was answered with `status`.
fn fault(url: String, action: &'static str, status: &Status) -> CliError {
    let message = shown(&cause(status)).into_owned();
    if is_too_often(status) {
        CliError::TooOften { url, message }
    } else if passing(status) {
        CliError::Unreachable { url, message }
    } else {
        CliError::Refused { url, action, message }
    }
}

impl Client {
    /// Connects, and checks at once that a coordinator answers.
    pub async fn connect(dial: &Dial) -> Result<Self> {
        let connection = dial.now().await.map_err(|error| unreachable(dial, error))?;
        Ok(Self {
            url: dial.url.clone(),
            dial: dial.clone(),
            jobs: JobServiceClient::new(connection.clone()).max_decoding_message_size(64 << 20),
            uploads: UploadServiceClient::new(connection.clone()).max_decoding_message_size(64 << 20),
            admin: AdminServiceClient::new(connection).max_decoding_message_size(64 << 20),
            direct: Direct::default(),
        })
    }

    /// The error for a call that was answered with `status`.
    pub fn fault(&self, action: &'static str, status: &Status) -> CliError {
        fault(self.url.clone(), action, status)
    }

    pub async fn create_job(&self, request: CreateJobRequest) -> Result<Job> {
        let call = || async { self.jobs.clone().create_job(request.clone()).await };
        self.patient("create the job", call).await
    }

    pub async fn job(&self, id: &str) -> Result<Job> {
        let request = GetJobRequest { job_id: id.to_owned() };
        let call = || async { self.jobs.clone().get_job(request.clone()).await };
        self.patient("show the job", call).await
    }

    /// The same, without waiting for a coordinator that is down.
    pub async fn job_now(&self, id: &str) -> Result<Job> {
        let answer = self.jobs.clone().get_job(GetJobRequest { job_id: id.to_owned() }).await;
        answer.map(tonic::Response::into_inner).map_err(|status| self.fault("show the job", &status))
    }

    /// Checks that the caller may submit, before much is read and sent. The coordinator checks the token
    /// first; with a valid token it rejects this call only for its missing fields.
    pub async fn may_upload(&self) -> Result<()> {
        let call = || async {
            match self.uploads.clone().begin_upload(BeginUploadRequest::default()).await {
                Err(status) if reason(&status).as_deref() == Some("BAD_ARGUMENT") => {
                    Ok(tonic::Response::new(()))
                }
                Err(status) => Err(status),
                Ok(_) => Ok(tonic::Response::new(())),
            }
        };
        self.patient("take a scene", call).await
    }

    /// At most `limit` jobs that match a filter, newest first; this function sets the page.
    pub async fn list(&self, filter: ListJobsRequest, limit: usize) -> Result<Vec<Job>> {
        let mut jobs = Vec::new();
        let mut page_token = String::new();
        loop {
            let page_size = (limit - jobs.len()).min(1000) as u32;
            let request = ListJobsRequest { page_size, page_token: page_token.clone(), ..filter.clone() };
            let call = || async { self.jobs.clone().list_jobs(request.clone()).await };
            let page = self.patient("list the jobs", call).await?;
            jobs.extend(page.jobs);
            page_token = page.next_page_token;
            if page_token.is_empty() || jobs.len() >= limit {
                return Ok(jobs);
            }
        }
    }

    pub async fn cancel(&self, id: &str, reason: &str) -> Result<Job> {
        let request = CancelJobRequest { job_id: id.to_owned(), reason: reason.to_owned() };
        let call = || async { self.jobs.clone().cancel_job(request.clone()).await };
        self.patient("cancel the job", call).await
    }

    pub async fn pause(&self, id: &str, reason: &str) -> Result<Job> {
        let request = PauseJobRequest { job_id: id.to_owned(), reason: reason.to_owned() };
        let call = || async { self.jobs.clone().pause_job(request.clone()).await };
        self.patient("pause the job", call).await
    }

    pub async fn resume(&self, id: &str) -> Result<Job> {
        let request = ResumeJobRequest { job_id: id.to_owned() };
        let call = || async { self.jobs.clone().resume_job(request.clone()).await };
        self.patient("resume the job", call).await
    }

    pub async fn retry(&self, id: &str) -> Result<Job> {
        let request = RetryJobRequest { job_id: id.to_owned() };
        let call = || async { self.jobs.clone().retry_job(request.clone()).await };
        self.patient("retry the job", call).await
    }

    pub async fn update(&self, request: UpdateJobRequest) -> Result<Job> {
        let call = || async { self.jobs.clone().update_job(request.clone()).await };
        self.patient("change the job", call).await
    }

    pub async fn delete(&self, id: &str) -> Result<()> {
        let request = DeleteJobRequest { job_id: id.to_owned() };
        let call = || async { self.jobs.clone().delete_job(request.clone()).await };
        self.patient("delete the job", call).await.map(drop)
    }

    pub async fn workers(&self) -> Result<Vec<Worker>> {
        let call = || async { self.admin.clone().list_workers(ListWorkersRequest {}).await };
        Ok(self.patient("list the workers", call).await?.workers)
    }

    pub async fn cordon(&self, id: &str, reason: &str) -> Result<Worker> {
        let request = CordonWorkerRequest { worker_id: id.to_owned(), reason: reason.to_owned() };
        let call = || async { self.admin.clone().cordon_worker(request.clone()).await };
        self.patient("cordon the worker", call).await
    }

    pub async fn drain(&self, id: &str, reason: &str) -> Result<Worker> {
        let request = DrainWorkerRequest { worker_id: id.to_owned(), reason: reason.to_owned() };
        let call = || async { self.admin.clone().drain_worker(request.clone()).await };
        self.patient("drain the worker", call).await
    }

    pub async fn uncordon(&self, id: &str) -> Result<Worker> {
        let request = UncordonWorkerRequest { worker_id: id.to_owned() };
        let call = || async { self.admin.clone().uncordon_worker(request.clone()).await };
        self.patient("uncordon the worker", call).await
    }

    pub async fn tenants(&self) -> Result<Vec<Tenant>> {
        let call = || async { self.admin.clone().list_tenants(ListTenantsRequest {}).await };
        Ok(self.patient("list the tenants", call).await?.tenants)
    }

    pub async fn set_quota(&self, request: SetQuotaRequest) -> Result<Tenant> {
        let call = || async { self.admin.clone().set_quota(request.clone()).await };
        self.patient("limit the tenant", call).await
    }

    /// Not retried: each call makes a token.
    pub async fn issue_token(&self, request: IssueTokenRequest) -> Result<IssueTokenResponse> {
        let issued = self.admin.clone().issue_token(request).await;
        issued.map(tonic::Response::into_inner).map_err(|status| self.fault("make a token", &status))
    }

    pub async fn tokens(&self) -> Result<Vec<Token>> {
        let call = || async { self.admin.clone().list_tokens(ListTokensRequest {}).await };
        Ok(self.patient("list the tokens", call).await?.tokens)
    }

    pub async fn revoke_token(&self, id: &str, even_last: bool) -> Result<Token> {
        let request = RevokeTokenRequest { token_id: id.to_owned(), even_last };
        let call = || async { self.admin.clone().revoke_token(request.clone()).await };
        self.patient("revoke the token", call).await
    }

    /// The whole store, as a file. A backup that breaks off is useless and starts over.
    pub async fn back_up_store(&self) -> Result<Vec<u8>> {
        let call = || async {
            let mut pieces = self.admin.clone().back_up_store(BackUpStoreRequest {}).await?.into_inner();
            let mut file = Vec::new();
            while let Some(piece) = pieces.message().await? {
                file.extend_from_slice(&piece.data);
            }
            Ok(tonic::Response::new(file))
        };
        self.patient("back up its store", call).await
    }

    pub async fn begin_upload(&self, request: BeginUploadRequest) -> Result<BeginUploadResponse> {
        let call = || async { self.uploads.clone().begin_upload(request.clone()).await };
        self.patient("begin the dataset", call).await
    }

    pub async fn commit_dataset(&self, id: &str) -> Result<Dataset> {
        let request = CommitDatasetRequest { dataset_id: id.to_owned() };
        let call = || async { self.uploads.clone().commit_dataset(request.clone()).await };
        self.patient("commit the dataset", call).await
    }

    pub async fn dataset(&self, id: &str) -> Result<Dataset> {
        let request = GetDatasetRequest { dataset_id: id.to_owned() };
        let call = || async { self.uploads.clone().get_dataset(request.clone()).await };
        self.patient("show the dataset", call).await
    }

    pub async fn datasets(&self) -> Result<Vec<Dataset>> {
        let (mut datasets, mut page_token) = (Vec::new(), String::new());
        loop {
            let request = ListDatasetsRequest { page_size: 1000, page_token };
            let call = || async { self.uploads.clone().list_datasets(request.clone()).await };
            let page = self.patient("list the datasets", call).await?;
            datasets.extend(page.datasets);
            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok(datasets);
            }
        }
    }

    pub async fn delete_dataset(&self, id: &str) -> Result<()> {
        let request = DeleteDatasetRequest { dataset_id: id.to_owned() };
        let call = || async { self.uploads.clone().delete_dataset(request.clone()).await };
        self.patient("delete the dataset", call).await.map(drop)
    }

    /// The content of a small blob that the caller owns, checked against its digest.
    pub async fn read(&self, blob: &BlobRef) -> Result<Vec<u8>> {
        let request = ReadBlobRequest { digest: blob.digest.clone(), ..Default::default() };
        let read = || async {
            let mut pieces = self.uploads.clone().read_blob(request.clone()).await?.into_inner();
            let mut content = Vec::new();
            while let Some(piece) = pieces.message().await? {
                content.extend_from_slice(&piece.data);
            }
            Ok(tonic::Response::new(content))
        };
        let content = self.patient("send a file", read).await?;
        if blake3::hash(&content).to_hex().as_str() != blob.digest {
            let message = format!("blob {} does not match its digest; try again", blob.digest);
            return Err(CliError::Message(message));
        }
        Ok(content)
    }

    /// The events of a job. The caller reports an unreachable coordinator and retries.
    pub async fn watch(&self, id: &str, after_seq: u64) -> Result<Streaming<JobEvent>> {
        let request = WatchJobRequest { job_id: id.to_owned(), after_seq };
        let answer = self.jobs.clone().watch_job(request).await;
        answer.map(tonic::Response::into_inner).map_err(|status| self.fault("watch the job", &status))
    }

    pub async fn logs(&self, request: StreamLogsRequest) -> Result<Streaming<LogEntry>> {
        let call = || async { self.jobs.clone().stream_logs(request.clone()).await };
        self.patient("send the log of the job", call).await
    }

    pub async fn artifacts(&self, id: &str) -> Result<Vec<Artifact>> {
        let (mut artifacts, mut page_token) = (Vec::new(), String::new());
        loop {
            let request = ListArtifactsRequest { job_id: id.to_owned(), page_token, page_size: 0 };
            let call = || async { self.jobs.clone().list_artifacts(request.clone()).await };
            let page = self.patient("list the files of the job", call).await?;
            artifacts.extend(page.artifacts);
            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok(artifacts);
            }
        }
    }

    /// Retries a call while its failure is temporary.
    pub async fn patient<T, F, Fut>(&self, action: &'static str, mut call: F) -> Result<T>
    where
        F: FnMut() -> Fut,
        Fut: Future<Output = std::result::Result<tonic::Response<T>, Status>>,
    {
        match call().await {
            Ok(answer) => return Ok(answer.into_inner()),
            Err(status) if !passing(&status) => return Err(self.fault(action, &status)),
            // A server that is no coordinator does not become one within a minute.
            Err(status) => {
                if let Some(error) = self.dial.misdialled(&status).await {
                    return Err(unreachable(&self.dial, error));
                }
            }
        }
        call.retry(patience())
            .when(passing)
            .await
            .map(tonic::Response::into_inner)
            .map_err(|status| self.fault(action, &status))
    }
}

/// Nothing answers there, or a server that is no coordinator.
fn unreachable(dial: &Dial, error: DialError) -> CliError {
    match error {
        DialError::Connect(message) => {
            CliError::Unreachable { url: dial.url.clone(), message: shown(&message).into_owned() }
        }
        other => CliError::Message(other.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use tonic_types::{ErrorDetails, StatusExt as _};

    use super::*;

    #[test]
    fn a_rate_limit_is_not_reported_as_unreachable() {
        let error_of = |code, reason: &str| {
            let details = ErrorDetails::with_error_info(reason, fathom_proto::ERROR_DOMAIN, []);
            fault("http://wreck".into(), "list", &Status::with_error_details(code, "its sentence", details))
        };
        let often = error_of(Code::ResourceExhausted, "RATE_LIMITED");
        assert!(matches!(often, CliError::TooOften { .. }), "{often}");
        assert!(!often.to_string().contains("start one with"), "{often}");
        let spent = error_of(Code::ResourceExhausted, "QUOTA_EXCEEDED");
        assert!(matches!(spent, CliError::Refused { .. }), "{spent}");
        let gone = fault("http://wreck".into(), "list", &Status::unavailable("nobody"));
        assert!(matches!(gone, CliError::Unreachable { .. }), "{gone}");
    }
}
