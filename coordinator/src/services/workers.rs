//! WorkerService: leases.

use std::collections::HashMap;
use std::mem;
use std::sync::Arc;
use std::time::Duration;

use fathom_proto::WORKER_PROTOCOL_VERSION;
use fathom_proto::worker::v1;
use fathom_proto::worker::v1::worker_service_server::WorkerService;
use futures::stream::BoxStream;
use tonic::{Request, Response, Status, Streaming, async_trait};
use uuid::Uuid;

use super::{encode, logs, manifests, results, session};
use crate::access::Principal;
use crate::access::guard::caller;
use crate::objects::BlobStore;
use crate::schedule::{FailClass, Lease, Renewed, TaskOutput, WorkerProfile};
use crate::service_error::ServiceError;
use crate::state::{State, stopped};
use crate::store::{Claim, Grant};
use crate::worker_registry::KnownWorker;

/// Longest time that a claim waits.
const MAX_CLAIM_WAIT: Duration = Duration::from_secs(30);
/// Longest interval between checks of a waiting claim: the end of a back-off wakes no one.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// Time during which leases of a worker with an invalid token are revoked.
const DISOWNED_FOR: Duration = Duration::from_secs(5);
/// Longest message of a failure, bytes; it goes into a row of the store.
const MAX_MESSAGE_BYTES: usize = 4000;
/// Longest name of a worker, bytes.
const MAX_NAME_BYTES: usize = 200;

/// The service.
pub struct Workers(pub Arc<State>);

impl Workers {
    /// The lease of a message, if the caller may see its job.
    async fn lease(&self, caller: &Principal, lease: Option<v1::Lease>) -> Result<Lease, ServiceError> {
        let lease = encode::required_lease(lease)?;
        // Workers of all tenants see every job, so no lookup is needed.
        if caller.tenant.is_some() {
            self.0.owner(caller, &lease.job).await?;
        }
        Ok(lease)
    }

    async fn register(
        &self,
        caller: &Principal,
        request: v1::RegisterRequest,
    ) -> Result<v1::RegisterResponse, ServiceError> {
        let v1::RegisterRequest {
            worker_name,
            incarnation,
            build_version,
            protocol_version,
            capabilities,
            held,
        } = request;
        if protocol_version != WORKER_PROTOCOL_VERSION {
            return Err(ServiceError::ProtocolVersion {
                worker: protocol_version,
                coordinator: WORKER_PROTOCOL_VERSION,
            });
        }
        // In canonical form: it is a key of rows, and part of log lines.
        if Uuid::parse_str(&incarnation).map(|id| id.to_string()).as_ref() != Ok(&incarnation) {
            let message = "must be a UUID that is new in every process, in lower case with hyphens".into();
            return Err(ServiceError::BadArgument { field: "incarnation", message });
        }
        let capabilities = capabilities.unwrap_or_default();
        let now_ms = self.0.clock.now_ms();
        let worker = KnownWorker {
            profile: WorkerProfile {
                name: line(worker_name, MAX_NAME_BYTES),
                incarnation: incarnation.clone(),
                stages: capabilities.stages().filter_map(encode::worker_stage).collect(),
                methods: encode::methods(&capabilities.methods),
                memory_bytes: Some(capabilities.memory_bytes).filter(|&bytes| bytes > 0),
                tenant: caller.tenant.clone(),
            },
            adapter: line(capabilities.adapter, MAX_NAME_BYTES),
            build_version: line(build_version, MAX_NAME_BYTES),
            seen_ms: now_ms,
            owner: caller.clone(),
        };
        let (name, adapter) = (worker.profile.name.clone(), worker.adapter.clone());
        if let Some(members) = self.0.store.members() {
            // Another coordinator may know it, and its owner.
            if !members.register(&incarnation, worker.owner_key(), &worker.to_row()?).await? {
                return Err(ServiceError::OtherWorker);
            }
        }
        self.0.workers.add(incarnation, worker)?;
        tracing::info!(worker = %name, %adapter, held = held.len(), "worker registered");

        let (mut accepted, mut abandon) = (Vec::new(), Vec::new());
        for lease in held {
            let known = self.lease(caller, Some(lease.clone())).await?;
            let holds = self.0.jobs.renew(&known, None, now_ms).await?;
            if holds == Renewed::Over { abandon.push(lease) } else { accepted.push(lease) }
        }
        self.0.wakeups.changed();
        let lease_ms = self.0.lease_ms;
        Ok(v1::RegisterResponse { lease_ms, renew_every_ms: lease_ms / 4, accepted, abandon })
    }

    async fn claim(
        &self,
        caller: &Principal,
        request: v1::ClaimRequest,
    ) -> Result<Option<Grant>, ServiceError> {
        let v1::ClaimRequest { incarnation, request_id, wait_ms } = request;
        let deadline =
            tokio::time::Instant::now() + Duration::from_millis(wait_ms.into()).min(MAX_CLAIM_WAIT);
        let mut changes = self.0.wakeups.work.subscribe();
        let mut stopping = self.0.stopping.clone();
        loop {
            changes.mark_unchanged();
            let worker = self.0.workers.touch(caller, &incarnation).ok_or(ServiceError::UnknownWorker)?;
            let mut worker = worker.profile;
            if self.0.workers.mark_of(&incarnation).is_some() {
                // It gets nothing new, but keeps a task assigned under this id whose answer was lost.
                worker.stages.clear();
            }
            let claim = Claim { worker, peers: self.0.workers.peers(), request_id: request_id.clone() };
            if let Some(grant) = self.0.jobs.claim(&claim, self.0.clock.now_ms()).await? {
                self.0.wakeups.progressed();
                return Ok(Some(grant));
            }
            let look_again = (tokio::time::Instant::now() + LOOK_EVERY).min(deadline);
            tokio::select! {
                biased;
                () = stopped(&mut stopping) => return Ok(None),
                _ = changes.changed() => {}
                () = tokio::time::sleep_until(look_again) => {}
            }
            if tokio::time::Instant::now() >= deadline {
                return Ok(None);
            }
        }
    }

    pub(super) async fn renew(
        &self,
        caller: &Principal,
        request: v1::RenewRequest,
    ) -> Result<v1::RenewResponse, ServiceError> {
        let v1::RenewRequest { incarnation, renewals } = request;
        self.0.workers.touch(caller, &incarnation).ok_or(ServiceError::UnknownWorker)?;
        let drains = self.0.workers.drains(&incarnation);
        let mut outcomes = Vec::with_capacity(renewals.len());
        for renewal in renewals {
            let lease = self.lease(caller, renewal.lease.clone()).await?;
            let progress = renewal.progress.as_ref().map(encode::live_progress);
            let now_ms = self.0.clock.now_ms();
            let holds = self.0.jobs.renew(&lease, progress, now_ms).await?;
            // Its last points may arrive behind its result.
            if !renewal.measured.is_empty() && (holds != Renewed::Over || self.ended_it(&lease).await) {
                self.0.history.add(&lease, renewal.measured, now_ms);
            }
            let (verdict, reason) = verdict(holds, drains);
            outcomes.push(v1::RenewOutcome {
                lease: renewal.lease,
                verdict: verdict.into(),
                reason: reason.to_owned(),
            });
        }
        self.0.wakeups.progressed();
        Ok(v1::RenewResponse { outcomes })
    }

    async fn checkpoint(
        &self,
        caller: &Principal,
        request: v1::CheckpointRequest,
    ) -> Result<(), ServiceError> {
        let lease = self.lease(caller, request.lease).await?;
        let blob = encode::required_blob("blob", request.blob)?;
        results::require(&*self.objects(&lease).await?, &blob).await?;
        self.0.jobs.checkpoint(&lease, blob, request.iteration, self.0.clock.now_ms()).await?;
        self.0.wakeups.progressed();
        Ok(())
    }

    async fn complete(&self, caller: &Principal, request: v1::CompleteRequest) -> Result<(), ServiceError> {
        let lease = self.lease(caller, request.lease).await?;
        let blob = encode::required_blob("result", request.result)?;
        let objects = self.objects(&lease).await?;
        results::check(&objects, lease.task.stage, &blob).await?;
        let mut sent = request.stats.unwrap_or_default();
        let measured = mem::take(&mut sent.measured);
        let stats = encode::stats(&sent);
        let mut output = TaskOutput::of(lease.task.stage, blob, stats);
        for further in request.further {
            let made = encode::named_blob("further", further)?;
            results::require(&objects, &made.1).await?;
            output.made.extend([made]);
        }
        let result = self.0.jobs.complete(&lease, output, self.0.clock.now_ms()).await;
        if let Err(error) = &result {
            tracing::warn!(job = %lease.job, task = %lease.task, attempt = lease.attempt, fence = lease.fence, %error, "result refused");
        }
        result?;
        self.0.history.add(&lease, measured, self.0.clock.now_ms());
        // Another worker may run a second attempt, which stops.
        let had_second_attempt =
            self.0.jobs.task_row(&lease.job, lease.task).await.is_ok_and(|row| row.second_attempts > 0);
        if had_second_attempt {
            self.0.wakeups.interrupted()
        } else {
            self.0.wakeups.changed()
        }
        Ok(())
    }

    async fn fail(&self, caller: &Principal, request: v1::FailRequest) -> Result<(), ServiceError> {
        let mut class = encode::fail_class(request.class());
        let lease = self.lease(caller, request.lease).await?;
        let mut message = cut(request.message, MAX_MESSAGE_BYTES);
        if class == FailClass::Environment
            && let Some(lost) = self.lost_files(&lease).await
        {
            // No other worker would succeed.
            (class, message) = (FailClass::Input, lost);
        }
        tracing::warn!(job = %lease.job, task = %lease.task, attempt = lease.attempt, ?class, %message, "attempt failed");
        let row = self.0.jobs.task_row(&lease.job, lease.task).await.ok();
        let said = format!("{} failed: {message}", lease.task);
        self.0.jobs.fail(&lease, class, message, self.0.clock.now_ms()).await?;
        if let Some(attempt) = row.as_ref().and_then(|row| row.held_under(&lease)) {
            self.0.workers.heard(&attempt.incarnation, &said, self.0.clock.now_ms());
        }
        // It may have ended the job.
        self.0.wakeups.interrupted();
        Ok(())
    }

    async fn release(&self, caller: &Principal, request: v1::ReleaseRequest) -> Result<(), ServiceError> {
        let lease = self.lease(caller, request.lease).await?;
        let reason = format!("released: {}", cut(request.reason, MAX_MESSAGE_BYTES));
        self.0.jobs.release(&lease, reason, self.0.clock.now_ms()).await?;
        self.0.wakeups.changed();
        Ok(())
    }

    /// Whether the holder of a lease ended it: the worker knows that, and its answer may still be in flight.
    pub(super) async fn ended_it(&self, lease: &Lease) -> bool {
        let task = self.0.jobs.task_row(&lease.job, lease.task).await;
        task.is_ok_and(|task| task.returned_fence == lease.fence)
    }

    /// The lost files of the scene, if any: workers only know digests, and one at a time.
    async fn lost_files(&self, lease: &Lease) -> Option<String> {
        let job = self.0.jobs.job_row(&lease.job).await.ok()?;
        let objects = self.0.objects.of(&job.tenant).await.ok()?;
        let lost = manifests::lost(&objects, &job.manifest).await;
        let lost =
            lost.inspect_err(|error| tracing::warn!(job = %lease.job, %error, "cannot check for lost files"));
        lost.ok().filter(|lost| !lost.is_empty()).map(|lost| manifests::message_of_lost(&lost))
    }

    /// The blob store of a lease's job.
    async fn objects(&self, lease: &Lease) -> Result<Arc<BlobStore>, ServiceError> {
        let tenant = self.0.jobs.job_row(&lease.job).await?.tenant;
        Ok(self.0.objects.of(&tenant).await?)
    }
}

/// Requeues the tasks of workers whose tokens are no longer valid, until the coordinator stops. This does not
/// count as a lost worker.
pub async fn release_disowned(shared: Arc<State>) {
    let mut stopping = shared.stopping.clone();
    let mut disowned = HashMap::new();
    loop {
        tokio::select! {
            biased;
            () = stopped(&mut stopping) => return,
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
        let now = tokio::time::Instant::now();
        let gone = shared.workers.take_disowned(&shared.access);
        if let Some(members) = shared.store.members()
            && !gone.is_empty()
            && let Err(error) = members.forget(&gone).await
        {
            // The next look finds them again.
            tracing::debug!(%error, "cannot forget workers with revoked tokens");
        }
        disowned.extend(gone.into_iter().map(|incarnation| (incarnation, now)));
        // For a while: a claim may have been answered just when the token ended.
        disowned.retain(|_, since| now - *since < DISOWNED_FOR);
        if disowned.is_empty() {
            continue;
        }
        // A store that fails ends the server by itself.
        let held = shared.jobs.leased().await.unwrap_or_default();
        for (lease, attempt) in held {
            if !disowned.contains_key(&attempt.incarnation) {
                continue;
            }
            let reason = "released: the token of its worker was revoked or has expired";
            match shared.jobs.release(&lease, reason.into(), shared.clock.now_ms()).await {
                Ok(_) => {
                    tracing::warn!(job = %lease.job, task = %lease.task, attempt = lease.attempt, worker = %attempt.worker, "its worker's token is no longer valid; the task is requeued");
                    shared.wakeups.interrupted();
                }
                Err(error) => tracing::debug!(job = %lease.job, task = %lease.task, %error, "not released"),
            }
        }
    }
}

/// The verdict for a lease, and its reason.
pub fn verdict(standing: Renewed, drains: bool) -> (v1::RenewVerdict, &'static str) {
    match standing {
        Renewed::Runs if drains => (v1::RenewVerdict::Release, "the worker is drained"),
        Renewed::Runs => (v1::RenewVerdict::Continue, ""),
        Renewed::ToBeReleased => (v1::RenewVerdict::Release, "the job is paused"),
        Renewed::Over => {
            (v1::RenewVerdict::Abandon, "the lease is over: expired, cancelled or assigned to another worker")
        }
    }
}

#[async_trait]
impl WorkerService for Workers {
    async fn register(
        &self,
        request: Request<v1::RegisterRequest>,
    ) -> Result<Response<v1::RegisterResponse>, Status> {
        Ok(Response::new(self.register(&caller(&request)?, request.into_inner()).await?))
    }

    async fn claim(&self, request: Request<v1::ClaimRequest>) -> Result<Response<v1::ClaimResponse>, Status> {
        let grant = self.claim(&caller(&request)?, request.into_inner()).await?;
        let assignment = grant.map(|grant| encode::assignment(&grant, self.0.lease_ms));
        Ok(Response::new(v1::ClaimResponse { assignment }))
    }

    async fn renew(&self, request: Request<v1::RenewRequest>) -> Result<Response<v1::RenewResponse>, Status> {
        Ok(Response::new(self.renew(&caller(&request)?, request.into_inner()).await?))
    }

    type SessionStream = BoxStream<'static, Result<v1::SessionResponse, Status>>;

    async fn session(
        &self,
        request: Request<Streaming<v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let caller = caller(&request)?;
        Ok(Response::new(session::answers(Workers(Arc::clone(&self.0)), caller, request.into_inner())))
    }

    async fn checkpoint(
        &self,
        request: Request<v1::CheckpointRequest>,
    ) -> Result<Response<v1::CheckpointResponse>, Status> {
        self.checkpoint(&caller(&request)?, request.into_inner()).await?;
        Ok(Response::new(v1::CheckpointResponse {}))
    }

    async fn complete(
        &self,
        request: Request<v1::CompleteRequest>,
    ) -> Result<Response<v1::CompleteResponse>, Status> {
        self.complete(&caller(&request)?, request.into_inner()).await?;
        Ok(Response::new(v1::CompleteResponse {}))
    }

    async fn fail(&self, request: Request<v1::FailRequest>) -> Result<Response<v1::FailResponse>, Status> {
        self.fail(&caller(&request)?, request.into_inner()).await?;
        Ok(Response::new(v1::FailResponse {}))
    }

    async fn release(
        &self,
        request: Request<v1::ReleaseRequest>,
    ) -> Result<Response<v1::ReleaseResponse>, Status> {
        self.release(&caller(&request)?, request.into_inner()).await?;
        Ok(Response::new(v1::ReleaseResponse {}))
    }

    async fn append_logs(
        &self,
        request: Request<v1::AppendLogsRequest>,
    ) -> Result<Response<v1::AppendLogsResponse>, Status> {
        let caller = caller(&request)?;
        logs::append(&self.0, &caller, request.into_inner()).await?;
        Ok(Response::new(v1::AppendLogsResponse {}))
    }
}

/// At most `max_bytes` of a text, truncated between characters, without control characters: in JSON each
/// takes six bytes of a row of limited size.
fn cut(mut text: String, max_bytes: usize) -> String {
    text.truncate(text.floor_char_boundary(max_bytes));
    text.replace(|c: char| c.is_control() && c != '\n', " ")
}

/// The same on one line.
fn line(text: String, max_bytes: usize) -> String {
    cut(text, max_bytes).replace('\n', " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_messages_are_truncated_and_lose_control_characters() {
        assert_eq!(cut("ab\u{0}\u{1b}[1m\nc".into(), 100), "ab  [1m\nc");
        assert_eq!(line("a\nINFO forged\u{9b}2J".into(), 100), "a INFO forged 2J");
        assert_eq!(cut("tiefe\u{fc}\u{fc}".into(), 6), "tiefe");
    }
}
