//! JobService: users and their jobs.

use std::sync::{Arc, PoisonError};

use fathom_core::config::JobConfig;
use fathom_core::scene::BlobRef;
use fathom_proto::v1;
use fathom_proto::v1::job_service_server::JobService;
use futures::stream::BoxStream;
use tonic::{Request, Response, Status, async_trait};
use uuid::Uuid;

use super::{datasets, encode, inspection, links, logs, manifests, watch};
use crate::access::Principal;
use crate::access::guard::caller;
use crate::capacity::{self, Gap};
use crate::history;
use crate::own_tasks::artifacts::ArtifactIndex;
use crate::schedule::{Artifact, Event, JobId, JobState, TaskRecord, TaskState, Tenant};
use crate::service_error::{ServiceError, check_line, check_request_id, limit_of};
use crate::state::State;
use crate::store::{JobFilter, JobView, NewJob, StoreError};

/// Longest name of a job, bytes.
const MAX_NAME_BYTES: usize = 200;
/// Longest reason of a cancellation, bytes.
const MAX_REASON_BYTES: usize = 1000;
/// Largest priority of a job, and with a minus sign the smallest.
const MAX_PRIORITY: i32 = 1000;
/// Longest configuration, bytes: a row of the store holds it.
const MAX_CONFIG_BYTES: usize = 32 << 10;

/// Artifacts in one answer.
const MAX_ARTIFACTS: usize = 1000;

/// The service.
pub struct Jobs(pub Arc<State>);

impl Jobs {
    /// The shortfall of a job, and its start.
    fn gap(&self, view: &JobView) -> Option<Gap> {
        if view.job.state != JobState::Running {
            return None;
        }
        let ready = |(task, _): &(TaskRecord, _)| match task.state {
            TaskState::Ready { .. } => Some(task.need()),
            _ => None,
        };
        let shortfall = capacity::shortfall(
            &view.job.tenant,
            view.tasks.iter().filter_map(ready),
            &self.0.workers.peers(),
        )?;
        Some(capacity::noted(&self.0, &view.job.job_id, shortfall))
    }

    fn encoded(&self, view: &JobView) -> v1::Job {
        let workers = self.0.workers.connected(&view.job.tenant).workers;
        encode::job_view(view, self.gap(view).as_ref(), workers as usize)
    }

    /// The id of a job that the caller may see.
    async fn known(&self, caller: &Principal, job_id: &str) -> Result<JobId, ServiceError> {
        let id: JobId = job_id.parse()?;
        self.0.owner(caller, &id).await?;
        Ok(id)
    }

    async fn view(&self, caller: &Principal, job_id: &str) -> Result<JobView, ServiceError> {
        Ok(self.0.jobs.job(&self.known(caller, job_id).await?).await?)
    }

    async fn create(
        &self,
        caller: &Principal,
        request: v1::CreateJobRequest,
    ) -> Result<v1::Job, ServiceError> {
        let v1::CreateJobRequest {
            request_id,
            name,
            config_json,
            manifest,
            ingest_seconds,
            priority,
            max_parallel,
            dataset_id,
        } = request;
        check_priority(priority)?;
        check_request_id(&request_id)?;
        check_line("name", &name, MAX_NAME_BYTES)?;
        let tenant = caller.home();
        let dataset = match dataset_id.as_str() {
            "" => None,
            id => Some(datasets::committed(&self.0, &tenant, &id.parse()?).await?),
        };
        let config_json = resolve_config(&config_json)?;
        let objects = self.0.objects.of(&tenant).await?;
        let (dataset, list) = dataset.map(|(dataset, list)| (dataset.id, list)).unzip();
        let of_dataset = || list.as_ref().and_then(|list| datasets::manifest_in(&list.value));
        let (manifest, list) = match (manifest.or_else(of_dataset), list) {
            (None, Some(list)) => {
                self.0.objects.check_space(0).await?;
                self.0.check_bytes(&tenant, 0).await?;
                // What it names is in the dataset.
                (inspection::manifest_of(&objects, list, &config_of(&config_json)?).await?, None)
            }
            (manifest, list) => (encode::required_blob("manifest", manifest)?, list),
        };
        manifests::check(&objects, &manifest, list).await?;
        self.0.objects.check_space(0).await?;
        self.0.check_bytes(&tenant, 0).await?;
        let new = NewJob {
            job_id: JobId::new(self.0.clock.now_ms(), random_bits()),
            tenant,
            request_id,
            name,
            config_json,
            manifest,
            dataset,
            priority,
            max_parallel,
            announce: self.0.has_webhook,
            ingest_seconds: if ingest_seconds.is_finite() { ingest_seconds.max(0.0) } else { 0.0 },
        };
        let job = self.0.jobs.submit(new, self.0.clock.now_ms()).await?;
        self.0.wakeups.changed();
        tracing::info!(job = %job.job_id, name = %job.name, tenant = %job.tenant, by = %caller.name, "job accepted");
        let view = self.0.jobs.job(&job.job_id).await?;
        Ok(self.encoded(&view))
    }

    async fn list(
        &self,
        caller: &Principal,
        request: v1::ListJobsRequest,
    ) -> Result<v1::ListJobsResponse, ServiceError> {
        let limit = match request.page_size {
            0 => 100,
            size => size.min(1000) as usize,
        };
        check_line("name_contains", &request.name_contains, MAX_NAME_BYTES)?;
        let states = request.states().map(encode::state_of_filter).collect::<Option<Vec<_>>>();
        let states = states.ok_or_else(|| ServiceError::BadArgument {
            field: "states",
            message: "contains an unknown state".into(),
        })?;
        let asked = Some(&request.tenant).filter(|tenant| !tenant.is_empty());
        let asked = asked.map(|tenant| tenant.parse::<Tenant>()).transpose()?;
        if asked.as_ref().is_some_and(|tenant| !caller.sees(tenant)) {
            // As for an unknown tenant.
            return Ok(v1::ListJobsResponse::default());
        }
        let tenant = asked.or_else(|| caller.tenant.clone());
        let filter = JobFilter { tenant, states, name_contains: request.name_contains };
        let before = page_after(&request.page_token, &filter)?;
        let jobs = match &caller.job {
            None => self.0.jobs.list(&filter, before.as_ref(), limit).await?,
            Some(_) if before.is_some() => Vec::new(),
            Some(job) => match self.0.jobs.job_row(job).await {
                Ok(row) => vec![row],
                Err(StoreError::JobNotFound(_)) => Vec::new(),
                Err(error) => return Err(error.into()),
            },
        };
        let jobs: Vec<_> = jobs.into_iter().filter(|job| filter.admits(job)).collect();
        let next_page_token = match jobs.last() {
            Some(last) if jobs.len() == limit => page_token(&last.job_id, &filter),
            _ => String::new(),
        };
        let mut encoded = Vec::with_capacity(jobs.len());
        for job in &jobs {
            let progress = if job.state == JobState::Paused {
                // No worker is on it: its progress is in its tasks.
                self.0.jobs.job(&job.job_id).await?.progress()
            } else if job.state.is_open() {
                self.0.jobs.progress(&job.job_id).await?.1
            } else {
                job.progress(0)
            };
            let gap = {
                let gaps = self.0.gaps.lock().unwrap_or_else(PoisonError::into_inner);
                gaps.get(&job.job_id).filter(|_| job.state == JobState::Running).cloned()
            };
            encoded.push(encode::job(job, progress, gap.as_ref()));
        }
        Ok(v1::ListJobsResponse { jobs: encoded, next_page_token })
    }

    /// Applies a user's control event to a job, and returns the job after it.
    async fn steer(&self, caller: &Principal, job_id: &str, event: Event) -> Result<v1::Job, ServiceError> {
        let id = self.known(caller, job_id).await?;
        let what = format!("{event:?}");
        let view = self.0.jobs.steer(&id, event, self.0.clock.now_ms()).await?;
        tracing::info!(job = %id, by = %caller.name, %what, state = ?view.job.state, "job steered");
        self.0.wakeups.interrupted();
        Ok(self.encoded(&view))
    }

    async fn artifacts(
        &self,
        caller: &Principal,
        request: v1::ListArtifactsRequest,
    ) -> Result<v1::ListArtifactsResponse, ServiceError> {
        let limit = match request.page_size {
            0 => MAX_ARTIFACTS,
            size => MAX_ARTIFACTS.min(size as usize),
        };
        let job = self.view(caller, &request.job_id).await?.job;
        let Some(index) = job.output(Artifact::Index) else {
            first_artifact(&request.page_token, None)?;
            return Ok(v1::ListArtifactsResponse::default());
        };
        let first = first_artifact(&request.page_token, Some(index))?;
        let objects = self.0.objects.of(&job.tenant).await?;
        let files = ArtifactIndex::from_bytes(&objects.read(index).await?)?.files;
        let next = first.saturating_add(limit);
        let next_page_token = if next < files.len() { artifact_token(next, index) } else { String::new() };
        let page = files.into_iter().skip(first).take(limit);
        let artifacts = page.map(|(path, blob)| v1::Artifact { path, blob: Some(encode::blob(&blob)) });
        Ok(v1::ListArtifactsResponse { artifacts: artifacts.collect(), next_page_token })
    }
}

#[async_trait]
impl JobService for Jobs {
    async fn create_job(&self, request: Request<v1::CreateJobRequest>) -> Result<Response<v1::Job>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.create(&caller, request.into_inner()).await?))
    }

    async fn get_job(&self, request: Request<v1::GetJobRequest>) -> Result<Response<v1::Job>, Status> {
        let view = self.view(&caller(&request)?, &request.get_ref().job_id).await?;
        Ok(Response::new(self.encoded(&view)))
    }

    async fn list_jobs(
        &self,
        request: Request<v1::ListJobsRequest>,
    ) -> Result<Response<v1::ListJobsResponse>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.list(&caller, request.into_inner()).await?))
    }

    type WatchJobStream = BoxStream<'static, Result<v1::JobEvent, Status>>;

    async fn watch_job(
        &self,
        request: Request<v1::WatchJobRequest>,
    ) -> Result<Response<Self::WatchJobStream>, Status> {
        let caller = caller(&request)?;
        let v1::WatchJobRequest { job_id, after_seq } = request.into_inner();
        let job = self.known(&caller, &job_id).await?;
        Ok(Response::new(watch::events(Arc::clone(&self.0), caller, job, after_seq)))
    }

    async fn cancel_job(&self, request: Request<v1::CancelJobRequest>) -> Result<Response<v1::Job>, Status> {
        let caller = caller(&request)?;
        let v1::CancelJobRequest { job_id, reason } = request.into_inner();
        check_line("reason", &reason, MAX_REASON_BYTES)?;
        Ok(Response::new(self.steer(&caller, &job_id, Event::Cancel { reason }).await?))
    }

    async fn pause_job(&self, request: Request<v1::PauseJobRequest>) -> Result<Response<v1::Job>, Status> {
        let caller = caller(&request)?;
        let v1::PauseJobRequest { job_id, reason } = request.into_inner();
        check_line("reason", &reason, MAX_REASON_BYTES)?;
        Ok(Response::new(self.steer(&caller, &job_id, Event::Pause { reason }).await?))
    }

    async fn resume_job(&self, request: Request<v1::ResumeJobRequest>) -> Result<Response<v1::Job>, Status> {
        Ok(Response::new(self.steer(&caller(&request)?, &request.get_ref().job_id, Event::Resume).await?))
    }

    async fn retry_job(&self, request: Request<v1::RetryJobRequest>) -> Result<Response<v1::Job>, Status> {
        Ok(Response::new(self.steer(&caller(&request)?, &request.get_ref().job_id, Event::Retry).await?))
    }

    async fn update_job(&self, request: Request<v1::UpdateJobRequest>) -> Result<Response<v1::Job>, Status> {
        let caller = caller(&request)?;
        let v1::UpdateJobRequest { job_id, priority, max_parallel } = request.into_inner();
        check_priority(priority.unwrap_or_default())?;
        if priority.is_none() && max_parallel.is_none() {
            let message = "neither it nor max_parallel is set, so there is nothing to change".into();
            return Err(ServiceError::BadArgument { field: "priority", message }.into());
        }
        Ok(Response::new(self.steer(&caller, &job_id, Event::Update { priority, max_parallel }).await?))
    }

    async fn delete_job(
        &self,
        request: Request<v1::DeleteJobRequest>,
    ) -> Result<Response<v1::DeleteJobResponse>, Status> {
        let caller = caller(&request)?;
        let id = self.known(&caller, &request.get_ref().job_id).await?;
        self.0.jobs.delete(&id).await.map_err(ServiceError::from)?;
        logs::forget(&self.0, &id).await;
        tracing::info!(job = %id, by = %caller.name, "job deleted");
        self.0.wakeups.changed();
        Ok(Response::new(v1::DeleteJobResponse {}))
    }

    type StreamLogsStream = BoxStream<'static, Result<v1::LogEntry, Status>>;

    async fn stream_logs(
        &self,
        request: Request<v1::StreamLogsRequest>,
    ) -> Result<Response<Self::StreamLogsStream>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(logs::stream(Arc::clone(&self.0), caller, request.into_inner()).await?))
    }

    async fn get_history(
        &self,
        request: Request<v1::GetHistoryRequest>,
    ) -> Result<Response<v1::History>, Status> {
        let caller = caller(&request)?;
        let v1::GetHistoryRequest { job_id, task_id } = request.into_inner();
        let job = self.known(&caller, &job_id).await?;
        let task = Some(task_id).filter(|task| !task.is_empty()).map(|task| task.parse()).transpose();
        let task = task.map_err(ServiceError::from)?;
        Ok(Response::new(history::of_job(&self.0, &job, task).await.map_err(ServiceError::from)?))
    }

    async fn share_job(
        &self,
        request: Request<v1::ShareJobRequest>,
    ) -> Result<Response<v1::ShareJobResponse>, Status> {
        let caller = caller(&request)?;
        let v1::ShareJobRequest { job_id, expires_in_seconds } = request.into_inner();
        let job = self.known(&caller, &job_id).await?;
        Ok(Response::new(links::share(&self.0, &caller, job, expires_in_seconds).await?))
    }

    async fn list_artifacts(
        &self,
        request: Request<v1::ListArtifactsRequest>,
    ) -> Result<Response<v1::ListArtifactsResponse>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.artifacts(&caller, request.into_inner()).await?))
    }
}

/// The configuration with every default written out, so that a stored job does not change with the defaults.
fn resolve_config(json: &str) -> Result<String, ServiceError> {
    serde_json::to_string(&config_of(json)?).map_err(|e| bad_config(e.to_string()))
}

/// The settings of a job from a request.
pub fn config_of(json: &str) -> Result<JobConfig, ServiceError> {
    limit_of("config_json", json, MAX_CONFIG_BYTES)?;
    let config = JobConfig::from_json(json).map_err(|e| bad_config(e.to_string()))?;
    config.validate().map_err(|e| bad_config(e.to_string()))?;
    Ok(config)
}

fn bad_config(message: String) -> ServiceError {
    ServiceError::BadArgument { field: "config_json", message }
}

fn check_priority(priority: i32) -> Result<(), ServiceError> {
    if (-MAX_PRIORITY..=MAX_PRIORITY).contains(&priority) {
        return Ok(());
    }
    let message = format!("is {priority}, it must lie between -{MAX_PRIORITY} and {MAX_PRIORITY}");
    Err(ServiceError::BadArgument { field: "priority", message })
}

/// Where the next page begins; it belongs to a filter.
fn page_token(last: &JobId, filter: &JobFilter) -> String {
    format!("{last}-{:08x}", crc32c::crc32c(format!("{filter:?}").as_bytes()))
}

/// The job before the page of a token; `None` for the first page.
fn page_after(token: &str, filter: &JobFilter) -> Result<Option<JobId>, ServiceError> {
    if token.is_empty() {
        return Ok(None);
    }
    let id = token.split('-').next().and_then(|id| id.parse::<JobId>().ok());
    match id.filter(|id| page_token(id, filter) == token) {
        Some(id) => Ok(Some(id)),
        None => {
            let message = "is not from ListJobs with this filter; begin at the first page".into();
            Err(ServiceError::BadArgument { field: "page_token", message })
        }
    }
}

/// Where the next page of artifacts begins; it belongs to an index, which never changes.
fn artifact_token(first: usize, index: &BlobRef) -> String {
    format!("{first}-{:08x}", crc32c::crc32c(format!("{first}-{}", index.digest).as_bytes()))
}

/// Index of the first artifact of a token's page.
fn first_artifact(token: &str, index: Option<&BlobRef>) -> Result<usize, ServiceError> {
    if token.is_empty() {
        return Ok(0);
    }
    let first = token.split('-').next().and_then(|first| first.parse::<usize>().ok());
    let known = first.filter(|&first| index.is_some_and(|index| artifact_token(first, index) == token));
    known.ok_or_else(|| {
        let message = "is not from ListArtifacts for this job; begin at the first page".into();
        ServiceError::BadArgument { field: "page_token", message }
    })
}

fn random_bits() -> u32 {
    let (_, low) = Uuid::new_v4().as_u64_pair();
    low as u32
}
