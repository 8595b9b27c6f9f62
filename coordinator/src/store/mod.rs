//! The stores of jobs. The API of a [`Store`] has jobs, leases and results, not keys and values, so that each
//! implementation can use the strengths of its database.
//!
//! Invariants of every implementation: acknowledged changes are durable. The rules of [`crate::schedule`] are
//! applied inside the transaction that commits. A fence is never granted twice. [`SledStore`] is for a single
//! machine, [`PostgresStore`] for a database server. Tests compare both with a [`MemoryStore`], the reference
//! model, which simulations also use.

#[cfg(test)]
pub(crate) mod conformance;
mod error;
pub mod export;
mod flusher;
pub mod ledger;
pub mod members;
pub(crate) mod memory;
mod postgres;
pub(crate) mod record;
mod sled;
pub mod verify;

use std::collections::BTreeMap;
use std::sync::Arc;

use fathom_core::scene::BlobRef;
use serde::{Deserialize, Serialize};
use tonic::async_trait;

pub use self::error::StoreError;
use self::export::Export;
use self::ledger::Ledger;
use self::members::Members;
pub use self::memory::MemoryStore;
pub use self::postgres::{Hold, PostgresOptions, PostgresStore};
pub(crate) use self::sled::sync_folder;
pub use self::sled::{SledOptions, SledStore};
use crate::access::TokenRecord;
use crate::datasets::{DatasetId, DatasetRecord, MAX_DATASETS, NewDataset};
use crate::logs::Logs;
use crate::schedule::{
    Announcement, Attempt, Event, EventBody, Expired, FailClass, JobId, JobRecord, JobShape, JobState, Lease,
    LiveProgress, Outcome, Quota, Renewed, Stage, TaskId, TaskOutput, TaskRecord, TaskState, Tenant, Usage,
    WorkerProfile,
};
pub use crate::schedule::{OpenWork, ReadyTask};

/// Version of this program.
const PROGRAM: &str = env!("CARGO_PKG_VERSION");

/// The outcome of a revocation.
#[derive(Clone, Debug, PartialEq)]
pub enum Revoked {
    /// The token, which is no longer valid.
    Token(TokenRecord),
    /// It is the last one that can issue others, and stays valid.
    Last,
    /// There is no such token.
    Unknown,
}

impl Revoked {
    /// The outcome for the token `id`, which has not been written yet.
    fn of(all: Vec<TokenRecord>, id: &str, now_ms: u64, even_last: bool) -> Self {
        let opens = |token: &&TokenRecord| token.makes_tokens() && token.holds_at(now_ms);
        let is_last = all.iter().filter(opens).all(|token| token.id == id);
        let Some(mut record) = all.into_iter().find(|token| token.id == id) else { return Self::Unknown };
        if !even_last && is_last && opens(&&record) {
            return Self::Last;
        }
        record.revoked_ms = record.revoked_ms.or(Some(now_ms));
        Self::Token(record)
    }
}

/// A new job.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// Its id, unless the request is a repeated one.
    pub job_id: JobId,
    /// Its tenant.
    pub tenant: Tenant,
    /// Chosen by the client; one id of a tenant makes one job.
    pub request_id: String,
    /// Its display name.
    pub name: String,
    /// Resolved configuration, JSON.
    pub config_json: String,
    /// The scene.
    pub manifest: BlobRef,
    /// See [`JobRecord::dataset`].
    pub dataset: Option<DatasetId>,
    /// Time the client took to read and upload the scene, seconds.
    pub ingest_seconds: f64,
    /// See [`JobRecord::priority`].
    pub priority: i32,
    /// See [`JobRecord::max_parallel`].
    pub max_parallel: u32,
    /// Whether its end is announced to the webhook.
    pub announce: bool,
}

#[cfg(test)]
impl NewJob {
    /// A sample for tests, distinguished by its number.
    pub(crate) fn sample(number: u32) -> Self {
        Self {
            job_id: JobId::new(1_700_000_000_000, number),
            tenant: Tenant::default(),
            request_id: format!("request {number}"),
            name: "wreck".into(),
            config_json: "{}".into(),
            manifest: BlobRef { digest: "0".repeat(64), bytes: 1 },
            dataset: None,
            ingest_seconds: 0.5,
            priority: 0,
            max_parallel: 0,
            announce: false,
        }
    }
}

impl NewJob {
    /// The row and the plan task of the new job.
    pub(crate) fn into_rows(self, now_ms: u64) -> (JobRecord, TaskRecord) {
        let job = JobRecord {
            job_id: self.job_id,
            tenant: self.tenant,
            name: self.name,
            request_id: self.request_id,
            config_json: self.config_json,
            manifest: self.manifest,
            dataset: self.dataset,
            ingest_seconds: self.ingest_seconds,
            state: JobState::Running,
            stage: Stage::Plan,
            stage_since_ms: now_ms,
            paused_since_ms: None,
            pause_reason: String::new(),
            open_tasks: 1,
            leased_tasks: 0,
            priority: self.priority,
            max_parallel: self.max_parallel,
            created_ms: now_ms,
            ended_ms: None,
            announcement: if self.announce { Announcement::DUE } else { Announcement::NotWanted },
            error: String::new(),
            last_seq: 1,
            shape: JobShape::unplanned(),
            outputs: BTreeMap::new(),
            iterations_total: 0,
            iterations_done: 0,
            stage_seconds: Default::default(),
        };
        let mut plan = TaskRecord::new(Stage::Plan.task(), None, 0);
        plan.state = TaskState::Ready { not_before_ms: now_ms };
        (job, plan)
    }

    /// Whether `job` was made by this request. The duration of the upload may differ, and later changes of
    /// settings.
    fn is_same_as(&self, job: &JobRecord) -> bool {
        self.name == job.name
            && self.config_json == job.config_json
            && self.manifest == job.manifest
            && self.dataset == job.dataset
    }

    /// The first event of every job.
    fn first_event(&self) -> EventBody {
        EventBody::JobState { state: JobState::Running, message: String::new() }
    }
}

/// A filter of jobs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct JobFilter {
    /// The tenant; `None` for all.
    pub tenant: Option<Tenant>,
    /// The states; empty for all.
    pub states: Vec<JobState>,
    /// A text that names contain; empty for all.
    pub name_contains: String,
}

impl JobFilter {
    /// Whether a job is listed.
    pub fn admits(&self, job: &JobRecord) -> bool {
        self.tenant.as_ref().is_none_or(|tenant| *tenant == job.tenant)
            && (self.states.is_empty() || self.states.contains(&job.state))
            && job.name.contains(&self.name_contains)
    }
}

/// A request for a task.
#[derive(Clone, Debug)]
pub struct Claim {
    /// The worker.
    pub worker: WorkerProfile,
    /// All workers that are connected.
    pub peers: Arc<[WorkerProfile]>,
    /// The id of the call: a repeated one gets the same lease.
    pub request_id: String,
}

/// The key of a call that made a job: ids of different tenants never collide. Ids have no control characters.
fn request_key(tenant: &Tenant, request_id: &str) -> String {
    if tenant.is_default() { request_id.to_owned() } else { format!("{tenant}\0{request_id}") }
}

/// The existing dataset of the tenant that `new` resumes; `None` if it may be a new one.
fn check_new_dataset<'a>(
    new: &NewDataset,
    of_tenant: impl IntoIterator<Item = &'a DatasetRecord>,
) -> Result<Option<&'a DatasetRecord>, StoreError> {
    let (mut known, mut count) = (None, 0);
    for row in of_tenant {
        count += 1;
        if row.id == new.id && row.root == new.root {
            known = Some(row);
        } else if row.request_id == new.request_id {
            return Err(StoreError::RequestIdReused { request_id: new.request_id.clone() });
        } else if row.id == new.id {
            return Err(StoreError::DatasetExists(new.id.clone()));
        }
    }
    if known.is_none() && count >= MAX_DATASETS {
        return Err(StoreError::TooManyDatasets(new.tenant.clone()));
    }
    Ok(known)
}

/// A mark: a worker gets no further task. Kept as long as its process may live.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerMark {
    /// Whether it also gives back its tasks.
    pub drains: bool,
    /// The reason, free text.
    pub reason: String,
    /// Since when, Unix milliseconds.
    pub since_ms: u64,
}

/// Gauges of a store at one moment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Levels {
    /// Jobs by state.
    pub jobs: BTreeMap<JobState, usize>,
    /// Waiting tasks of running jobs by stage, including those in back-off.
    pub ready: BTreeMap<Stage, usize>,
    /// Since when the longest-waiting one has been ready, Unix milliseconds.
    pub oldest_ready_ms: Option<u64>,
    /// Running leases, by stage.
    pub leased: BTreeMap<Stage, usize>,
    /// Sum of their last reported training speeds.
    pub iterations_per_second: f64,
}

impl Levels {
    fn of(
        jobs: BTreeMap<JobState, usize>,
        ready: &[ReadyTask],
        (leased, iterations_per_second): (BTreeMap<Stage, usize>, f64),
    ) -> Self {
        let mut by_stage = BTreeMap::new();
        for task in ready {
            *by_stage.entry(task.need.task.stage).or_default() += 1;
        }
        let oldest_ready_ms = ready.iter().map(|task| task.not_before_ms).min();
        Self { jobs, ready: by_stage, oldest_ready_ms, leased, iterations_per_second }
    }
}

/// A lease with its rows.
#[derive(Clone, Debug)]
pub struct Grant {
    /// The lease.
    pub lease: Lease,
    /// The job.
    pub job: JobRecord,
    /// The task.
    pub task: TaskRecord,
}

impl Grant {
    /// The lease of a call, from the rows after it.
    fn of_call(claim: &Claim, job: JobRecord, task: TaskRecord) -> Option<Self> {
        let lease = task.lease_of_call(&job.job_id, &claim.worker.incarnation, &claim.request_id)?;
        Some(Self { lease, job, task })
    }
}

/// A job with its tasks and the last reports of their workers.
#[derive(Clone, Debug)]
pub struct JobView {
    /// The job.
    pub job: JobRecord,
    /// Its tasks in order, with the progress of those that are leased.
    pub tasks: Vec<(TaskRecord, Option<LiveProgress>)>,
}

impl JobView {
    /// Share of the work that is done, including the checkpoints of tasks that are not running: a paused job
    /// has not lost them.
    pub fn progress(&self) -> f64 {
        let open = self.tasks.iter().filter(|(task, _)| !task.is_final());
        let done = open.map(|(task, live)| {
            let safe = task.checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.iteration);
            u64::from(live.map_or(safe, |live| live.iteration.max(safe)))
        });
        self.job.progress(done.sum())
    }
}

/// A durable event of a job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StoredEvent {
    /// Counts from 1 in each job, without a gap.
    pub seq: u64,
    /// When, Unix milliseconds.
    pub time_ms: u64,
    /// The event.
    pub body: EventBody,
}

/// A name for a new deployment.
fn new_deployment() -> String {
    uuid::Uuid::new_v4().to_string()
}

/// Jobs, tasks, leases and workers.
#[async_trait]
pub trait JobStore: Send + Sync {
    /// Creates a job, or returns the one that this request created before.
    async fn submit(&self, new: NewJob, now_ms: u64) -> Result<JobRecord, StoreError>;
    /// Takes a lease on the next task, see [`crate::schedule::Queue`].
    async fn claim(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError>;
    /// The outcome that a renewal would have; does not extend the lease.
    async fn standing(&self, lease: &Lease) -> Result<Renewed, StoreError>;
    /// Keeps a lease alive. Not durable: see [`crate::schedule::LeaseTable`].
    async fn renew(
        &self,
        lease: &Lease,
        progress: Option<LiveProgress>,
        now_ms: u64,
    ) -> Result<Renewed, StoreError>;
    /// Applies an event to the job; claims go through [`JobStore::claim`].
    async fn apply(&self, job: &JobId, event: Event, now_ms: u64) -> Result<Outcome, StoreError>;
    /// Revokes the leases whose holders stopped renewing or make no progress, and returns them.
    async fn sweep(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError>;
    /// Call once at the start: gives every stored lease a full period of grace, and revokes those of own
    /// tasks whose coordinator is gone.
    async fn recover(&self, now_ms: u64) -> Result<(), StoreError>;
    /// Whether the store answers now.
    async fn answers(&self) -> Result<(), StoreError> {
        Ok(())
    }
    /// Gives every lease a full period, after a time in which nobody could renew because the database was not
    /// available. A store of one process fails for good instead.
    async fn extend_leases(&self, _now_ms: u64) -> Result<(), StoreError> {
        Ok(())
    }
    /// One job with its tasks.
    async fn job(&self, job: &JobId) -> Result<JobView, StoreError>;
    /// One job alone.
    async fn job_row(&self, job: &JobId) -> Result<JobRecord, StoreError>;
    /// One task of a job.
    async fn task_row(&self, job: &JobId, task: TaskId) -> Result<TaskRecord, StoreError>;
    /// Jobs that match `filter` and are older than `before`, the newest first, at most `limit`.
    async fn list(
        &self,
        filter: &JobFilter,
        before: Option<&JobId>,
        limit: usize,
    ) -> Result<Vec<JobRecord>, StoreError>;
    /// Deletes a job that has ended, with its tasks and events. Its request id stays in use: a late call must
    /// not create the job again.
    async fn delete(&self, job: &JobId) -> Result<(), StoreError>;
    /// Durable events of a job after `after_seq`, at most `limit`.
    async fn events(&self, job: &JobId, after_seq: u64, limit: usize)
    -> Result<Vec<StoredEvent>, StoreError>;
    /// Progress of the tasks of a job that are leased, in order, and the share of the whole job.
    async fn progress(&self, job: &JobId) -> Result<(Vec<(TaskId, LiveProgress)>, f64), StoreError>;
    /// Waiting tasks of running jobs, including those in back-off.
    async fn ready(&self) -> Result<Vec<ReadyTask>, StoreError>;
    /// The tasks of each running job.
    async fn open_work(&self) -> Result<Vec<OpenWork>, StoreError>;
    /// All leases that are held, each with its attempt.
    async fn leased(&self) -> Result<Vec<(Lease, Attempt)>, StoreError>;
    /// The gauges, by a query whose cost does not grow with ended jobs.
    async fn levels(&self) -> Result<Levels, StoreError>;
    /// Marks a worker, or removes its mark.
    async fn mark_worker(&self, incarnation: &str, mark: Option<&WorkerMark>) -> Result<(), StoreError>;
    /// All marks, by incarnation.
    async fn worker_marks(&self) -> Result<Vec<(String, WorkerMark)>, StoreError>;
    /// The reason why this store no longer accepts writes, if so.
    fn failure(&self) -> Option<String>;
    /// Reports a checkpoint that has been uploaded.
    async fn checkpoint(
        &self,
        lease: &Lease,
        blob: BlobRef,
        iteration: u32,
        now_ms: u64,
    ) -> Result<Outcome, StoreError> {
        self.apply(&lease.job, Event::Checkpoint { lease: lease.clone(), blob, iteration }, now_ms).await
    }
    /// Submits a result that has been uploaded.
    async fn complete(&self, lease: &Lease, output: TaskOutput, now_ms: u64) -> Result<Outcome, StoreError> {
        self.apply(&lease.job, Event::Complete { lease: lease.clone(), output }, now_ms).await
    }
    /// Ends an attempt with an error.
    async fn fail(
        &self,
        lease: &Lease,
        class: FailClass,
        message: String,
        now_ms: u64,
    ) -> Result<Outcome, StoreError> {
        self.apply(&lease.job, Event::Fail { lease: lease.clone(), class, message }, now_ms).await
    }
    /// Gives a task back unfinished.
    async fn release(&self, lease: &Lease, reason: String, now_ms: u64) -> Result<Outcome, StoreError> {
        self.apply(&lease.job, Event::Release { lease: lease.clone(), reason }, now_ms).await
    }
    /// Applies a user's control event to a job, and returns the job after it.
    async fn steer(&self, job: &JobId, event: Event, now_ms: u64) -> Result<JobView, StoreError> {
        self.apply(job, event, now_ms).await?;
        self.job(job).await
    }
}

/// Datasets of tenants.
#[async_trait]
pub trait DatasetStore: Send + Sync {
    /// Begins a dataset, or returns the existing one with the same name and files, with its upload time
    /// refreshed.
    async fn begin_dataset(&self, new: NewDataset, now_ms: u64) -> Result<DatasetRecord, StoreError>;
    /// Freezes a dataset whose files are those of `root` and all present; a frozen one stays as it is.
    async fn commit_dataset(
        &self,
        tenant: &Tenant,
        id: &DatasetId,
        root: &BlobRef,
        now_ms: u64,
    ) -> Result<DatasetRecord, StoreError>;
    /// One dataset of a tenant.
    async fn dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<DatasetRecord, StoreError>;
    /// Datasets of a tenant, or of all, by tenant and name, after the given one; at most `limit`.
    async fn datasets(
        &self,
        tenant: Option<&Tenant>,
        after: Option<(&Tenant, &DatasetId)>,
        limit: usize,
    ) -> Result<Vec<DatasetRecord>, StoreError>;
    /// Deletes a dataset that no job uses.
    async fn delete_dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<(), StoreError>;
    /// Deletes uploads of datasets without activity since `before_ms`, and returns them.
    async fn forget_given_up(&self, before_ms: u64) -> Result<Vec<DatasetRecord>, StoreError>;
}

/// Tokens and quotas of tenants.
#[async_trait]
pub trait AccessStore: Send + Sync {
    /// Sets the quota of a tenant; `None`: the default quota ([`crate::schedule::Rules::quota`]).
    async fn set_quota(&self, tenant: &Tenant, quota: Option<Quota>) -> Result<(), StoreError>;
    /// The quota of a tenant.
    async fn quota(&self, tenant: &Tenant) -> Result<Quota, StoreError>;
    /// All quotas that were set, by tenant.
    async fn quotas(&self) -> Result<Vec<(Tenant, Quota)>, StoreError>;
    /// Usage of each tenant with any, by tenant.
    async fn usage(&self) -> Result<Vec<(Tenant, Usage)>, StoreError>;
    /// Writes a token, replacing an earlier one with its id.
    async fn put_token(&self, token: &TokenRecord) -> Result<(), StoreError>;
    /// Deletes the token of a link that has ended; others stay listed.
    async fn forget_token(&self, id: &str) -> Result<(), StoreError>;
    /// All tokens, by id.
    async fn tokens(&self) -> Result<Vec<TokenRecord>, StoreError>;
    /// Ends the validity of a token, which stays listed; a repeated call does not move the time. Unless
    /// `even_last`, the last one that can issue others stays valid. Callers in one process take turns.
    async fn revoke_token(&self, id: &str, now_ms: u64, even_last: bool) -> Result<Revoked, StoreError> {
        let revoked = Revoked::of(self.tokens().await?, id, now_ms, even_last);
        if let Revoked::Token(record) = &revoked {
            self.put_token(record).await?;
        }
        Ok(revoked)
    }
}

/// A whole store. All times are Unix milliseconds of the caller's clock.
#[async_trait]
pub trait Store: JobStore + DatasetStore + AccessStore {
    /// The name of this deployment: random, made by the first call, and part of every export. A bucket with
    /// its files bears the same name.
    async fn deployment(&self) -> Result<String, StoreError>;
    /// The blobs of a bucket as rows that several coordinators share; `None` in a store of one process.
    fn ledger(&self) -> Option<Arc<dyn Ledger>> {
        None
    }
    /// The coordinators that share the store; `None` in a store of one process.
    fn members(&self) -> Option<Arc<dyn Members>> {
        None
    }
    /// All data of the store, for a file.
    async fn export(&self) -> Result<Export, StoreError>;
    /// Imports all data of another store; only into an empty one.
    async fn import(&self, export: &Export) -> Result<(), StoreError>;
    /// Log lines of jobs, of which an attempt keeps at most `attempt_bytes`; `None` where they are in files
    /// beside the store.
    fn logs(&self, _attempt_bytes: u64) -> Option<Arc<dyn Logs>> {
        None
    }
}
