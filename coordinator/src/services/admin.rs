//! AdminService, for operators. Tenants and tokens are in `tenants.rs`, backups in `backup.rs`.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use fathom_proto::admin::v1;
use fathom_proto::admin::v1::admin_service_server::AdminService;
use tonic::{Request, Response, Status, async_trait};

use super::backup::BackupStream;
use super::encode;
use super::tenants::encode_role;
use crate::access::guard::caller;
use crate::schedule::{Attempt, JobId, Lease, LiveProgress, TaskId};
use crate::service_error::{ServiceError, check_line};
use crate::state::State;
use crate::store::{StoreError, WorkerMark};
use crate::worker_registry::KnownWorker;

/// Longest reason, bytes; it goes into a row of the store.
const MAX_REASON_BYTES: usize = 1000;

/// A lease that is held.
struct Held {
    lease: Lease,
    attempt: Attempt,
    /// Iterations per second that it reported last; 0 where that is not known.
    rate: f64,
}

/// The service.
pub struct Admin(pub Arc<State>);

impl Admin {
    /// Workers that have called recently, by name, then those with only a mark left.
    async fn list(&self) -> Result<Vec<v1::Worker>, ServiceError> {
        let held = self.held().await?;
        let mut all: HashMap<String, Option<KnownWorker>> =
            self.0.workers.marked().into_iter().map(|id| (id, None)).collect();
        all.extend(self.0.workers.all().into_iter().map(|(id, worker)| (id, Some(worker))));
        let workers = all.iter().map(|(id, worker)| self.worker(id, worker.as_ref(), &held));
        let mut workers: Vec<v1::Worker> = workers.collect();
        let key =
            |worker: &v1::Worker| (worker.last_seen.is_none(), worker.name.clone(), worker.worker_id.clone());
        workers.sort_by_cached_key(key);
        Ok(workers)
    }

    /// All leases that are held, each with the iterations per second that its task reported last. Of two
    /// attempts at a task only one is known, and not which: they have none.
    async fn held(&self) -> Result<Vec<Held>, ServiceError> {
        let leased = self.0.jobs.leased().await?;
        let jobs: BTreeSet<JobId> = leased.iter().map(|(lease, _)| lease.job.clone()).collect();
        let mut rates = HashMap::new();
        for job in jobs {
            match self.0.jobs.progress(&job).await {
                Ok((live, _)) => {
                    let of_task = |(task, live): (TaskId, LiveProgress)| {
                        ((job.clone(), task), f64::from(live.iterations_per_second))
                    };
                    rates.extend(live.into_iter().map(of_task));
                }
                // It ended or was deleted meanwhile.
                Err(StoreError::JobNotFound(_)) => {}
                Err(error) => return Err(error.into()),
            }
        }
        let mut attempts: HashMap<(JobId, TaskId), usize> = HashMap::new();
        for (lease, _) in &leased {
            *attempts.entry((lease.job.clone(), lease.task)).or_default() += 1;
        }
        let held = leased.into_iter().map(|(lease, attempt)| {
            let task = (lease.job.clone(), lease.task);
            let rate = rates.get(&task).filter(|_| attempts[&task] == 1).copied().unwrap_or_default();
            Held { lease, attempt, rate }
        });
        Ok(held.collect())
    }

    /// The known data of a worker; `None` if it has not called since the coordinator started, or not
    /// recently.
    fn worker(&self, id: &str, worker: Option<&KnownWorker>, held: &[Held]) -> v1::Worker {
        let mark = self.0.workers.mark_of(id);
        let state = match &mark {
            None => v1::WorkerState::Active,
            Some(mark) if mark.drains => v1::WorkerState::Draining,
            Some(_) => v1::WorkerState::Cordoned,
        };
        let of_worker = held.iter().filter(|held| held.attempt.incarnation == id);
        let rates = of_worker.clone().map(|held| held.rate).filter(|rate| rate.is_finite());
        let said = self.0.workers.last_words(id);
        let held = of_worker.map(|Held { lease, attempt, .. }| v1::HeldTask {
            job_id: lease.job.to_string(),
            task_id: lease.task.to_string(),
            attempt: lease.attempt,
            since: Some(encode::timestamp(attempt.since_ms)),
        });
        let seen = worker.map(|worker| v1::Worker {
            name: worker.profile.name.clone(),
            connected: self.0.workers.lives(worker),
            last_seen: Some(encode::timestamp(worker.seen_ms)),
            adapter: worker.adapter.clone(),
            memory_bytes: worker.profile.memory_bytes.unwrap_or(0),
            build_version: worker.build_version.clone(),
            stages: worker
                .profile
                .stages
                .iter()
                .map(|&stage| fathom_proto::v1::Stage::from(stage).into())
                .collect(),
            ..v1::Worker::default()
        });
        v1::Worker {
            worker_id: id.to_owned(),
            state: state.into(),
            reason: mark.map(|mark| mark.reason).unwrap_or_default(),
            held: held.collect(),
            iterations_per_second: rates.sum(),
            last_words_time: said.as_ref().map(|(_, time_ms)| encode::timestamp(*time_ms)),
            last_words: said.map(|(line, _)| line).unwrap_or_default(),
            ..seen.unwrap_or_default()
        }
    }

    /// Marks a worker, or removes its mark. It also works for a worker that has not called since the
    /// coordinator started: otherwise it could come back and get no tasks. Durable when this returns.
    async fn mark(&self, worker_id: &str, mark: Option<WorkerMark>) -> Result<v1::Worker, ServiceError> {
        let worker = self.0.workers.get(worker_id);
        if worker.is_none() && self.0.workers.mark_of(worker_id).is_none() {
            return Err(ServiceError::NoSuchWorker(worker_id.to_owned()));
        }
        self.0.jobs.mark_worker(worker_id, mark.as_ref()).await?;
        let name = worker.as_ref().map_or(worker_id, |worker| worker.profile.name.as_str());
        tracing::info!(worker = %name, ?mark, "worker marked");
        self.0.workers.note_mark(worker_id, mark);
        self.0.wakeups.interrupted();
        let held = self.held().await?;
        Ok(self.worker(worker_id, worker.as_ref(), &held))
    }

    fn mark_with(&self, reason: String, drains: bool) -> Result<WorkerMark, ServiceError> {
        check_line("reason", &reason, MAX_REASON_BYTES)?;
        Ok(WorkerMark { drains, reason, since_ms: self.0.clock.now_ms() })
    }
}

#[async_trait]
impl AdminService for Admin {
    async fn get_caller(
        &self,
        request: Request<v1::GetCallerRequest>,
    ) -> Result<Response<v1::Caller>, Status> {
        let caller = caller(&request)?;
        let text = |text: Option<String>| text.unwrap_or_default();
        Ok(Response::new(v1::Caller {
            role: encode_role(caller.role).into(),
            tenant: text(caller.tenant.as_ref().map(ToString::to_string)),
            job_id: text(caller.job.as_ref().map(ToString::to_string)),
            expire_time: self.0.access.expires_ms(&caller).map(encode::timestamp),
            tokens_required: self.0.access.asks_for_tokens(),
            build_version: env!("CARGO_PKG_VERSION").to_owned(),
            // The guest of a link need not learn who made it.
            name: if caller.job.is_some() { "a link".to_owned() } else { caller.name },
        }))
    }

    async fn list_workers(
        &self,
        _request: Request<v1::ListWorkersRequest>,
    ) -> Result<Response<v1::ListWorkersResponse>, Status> {
        Ok(Response::new(v1::ListWorkersResponse { workers: self.list().await? }))
    }

    async fn cordon_worker(
        &self,
        request: Request<v1::CordonWorkerRequest>,
    ) -> Result<Response<v1::Worker>, Status> {
        let v1::CordonWorkerRequest { worker_id, reason } = request.into_inner();
        let mark = self.mark_with(reason, false)?;
        Ok(Response::new(self.mark(&worker_id, Some(mark)).await?))
    }

    async fn drain_worker(
        &self,
        request: Request<v1::DrainWorkerRequest>,
    ) -> Result<Response<v1::Worker>, Status> {
        let v1::DrainWorkerRequest { worker_id, reason } = request.into_inner();
        let mark = self.mark_with(reason, true)?;
        Ok(Response::new(self.mark(&worker_id, Some(mark)).await?))
    }

    async fn uncordon_worker(
        &self,
        request: Request<v1::UncordonWorkerRequest>,
    ) -> Result<Response<v1::Worker>, Status> {
        Ok(Response::new(self.mark(&request.get_ref().worker_id, None).await?))
    }

    async fn list_tenants(
        &self,
        _request: Request<v1::ListTenantsRequest>,
    ) -> Result<Response<v1::ListTenantsResponse>, Status> {
        Ok(Response::new(v1::ListTenantsResponse { tenants: self.tenants().await? }))
    }

    async fn set_quota(&self, request: Request<v1::SetQuotaRequest>) -> Result<Response<v1::Tenant>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.set_quota(&caller, request.into_inner()).await?))
    }

    async fn issue_token(
        &self,
        request: Request<v1::IssueTokenRequest>,
    ) -> Result<Response<v1::IssueTokenResponse>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.issue(&caller, request.into_inner()).await?))
    }

    async fn list_tokens(
        &self,
        _request: Request<v1::ListTokensRequest>,
    ) -> Result<Response<v1::ListTokensResponse>, Status> {
        Ok(Response::new(v1::ListTokensResponse { tokens: self.tokens().await? }))
    }

    async fn revoke_token(
        &self,
        request: Request<v1::RevokeTokenRequest>,
    ) -> Result<Response<v1::Token>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.revoke(&caller, request.into_inner()).await?))
    }

    type BackUpStoreStream = BackupStream;

    async fn back_up_store(
        &self,
        request: Request<v1::BackUpStoreRequest>,
    ) -> Result<Response<BackupStream>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(self.back_up(&caller).await?))
    }
}
