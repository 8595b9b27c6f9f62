//! The store of a single machine, in sled 0.34.7.
//!
//! Trees and keys (all numbers big endian, so that keys sort as their contents do):
//!
//! | tree | key | row |
//! |---|---|---|
//! | `jobs` | job | [`JobRecord`] |
//! | `tasks` | job, stage, index | [`TaskRecord`] |
//! | `events` | job, seq | [`StoredEvent`] |
//! | `requests` | [`request_key`] | job |
//! | `workers` | incarnation | [`WorkerMark`] |
//! | `quotas` | tenant | [`Quota`] |
//! | `tokens` | id | [`TokenRecord`] |
//! | `datasets` | tenant, 0, name | [`DatasetRecord`] |
//! | `meta` | "last_fence" | number |
//! | `meta` | "deployment" | text |
//! | `meta` | "written_by" | [`written_by::WrittenBy`], plain JSON |
//!
//! Ready and leased tasks are kept in memory ([`Queue`]), built from the rows of open jobs when the store is
//! opened. A lock over both keeps the queue consistent with the rows.
//!
//! Every change is one transaction over all trees that it touches, then a sync (see [`super::flusher`]), then
//! the reply. After a conflict, sled runs a transaction's closure again, so closures only read and write
//! rows.

mod changes;
mod copy;
mod datasets;
mod live;
mod migrate;
mod opening;
mod rows;
mod snapshots;
mod whole;
mod written_by;

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use sled::Tree;
use tonic::async_trait;

use self::live::Live;
pub(crate) use self::opening::sync_folder;
use self::rows::{DEPLOYMENT, event_key, task_key};
use super::export::Export;
use super::flusher::Flusher;
use super::record::decode;
use super::{
    AccessStore, Claim, DatasetStore, Grant, JobFilter, JobStore, JobView, Levels, NewJob, Store, StoreError,
    StoredEvent, WorkerMark, new_deployment,
};
use crate::access::TokenRecord;
use crate::datasets::{DatasetId, DatasetRecord, NewDataset};
use crate::schedule::{
    Attempt, Event, Expired, JobId, JobRecord, Lease, LiveProgress, OpenWork, Outcome, Quota, ReadyTask,
    Refusal, Renewed, Rules, TaskId, TaskRecord, Tenant, Usage,
};

/// Options for opening a [`SledStore`].
#[derive(Clone, Debug)]
pub struct SledOptions {
    /// Its own directory; created if missing.
    pub dir: PathBuf,
    /// Budgets and back-off.
    pub rules: Rules,
    /// Lease duration, milliseconds.
    pub lease_ms: u64,
    /// Time without progress after which a worker's lease is revoked, milliseconds; 0 disables it.
    pub stall_ms: u64,
}

/// Jobs in sled.
pub struct SledStore {
    trees: Trees,
    flusher: Flusher,
    rules: Rules,
    lease_ms: u64,
    stall_ms: u64,
    live: Mutex<Live>,
    /// The folder of a copied store ([`SledStore::open_copy`]), deleted with it.
    _copy: Option<tempfile::TempDir>,
}

#[derive(Clone)]
struct Trees {
    jobs: Tree,
    tasks: Tree,
    events: Tree,
    requests: Tree,
    workers: Tree,
    quotas: Tree,
    tokens: Tree,
    datasets: Tree,
    meta: Tree,
}

impl SledStore {
    fn live(&self) -> MutexGuard<'_, Live> {
        self.live.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn quota_rows(&self) -> Result<Vec<(Tenant, Quota)>, StoreError> {
        let rows = self.trees.quotas.iter().collect::<Result<_, _>>().map_err(|e| self.storage_error(e))?;
        whole::quotas(&rows)
    }

    /// A failed write leaves the log in an unknown state, so it ends all writing.
    fn storage_error(&self, error: sled::Error) -> StoreError {
        self.flusher.fail(error.to_string());
        StoreError::Failed(error.to_string())
    }

    fn read<T: serde::de::DeserializeOwned>(
        &self,
        name: &'static str,
        tree: &Tree,
        key: &[u8],
    ) -> Result<Option<T>, StoreError> {
        let bytes = tree.get(key).map_err(|e| self.storage_error(e))?;
        bytes.map(|bytes| decode(name, &bytes)).transpose()
    }

    fn job_record(&self, id: &JobId) -> Result<JobRecord, StoreError> {
        let found = self.read("jobs", &self.trees.jobs, id.as_str().as_bytes())?;
        found.ok_or_else(|| StoreError::JobNotFound(id.clone()))
    }

    fn task_record(&self, id: &JobId, task: TaskId) -> Result<Option<TaskRecord>, StoreError> {
        self.read("tasks", &self.trees.tasks, &task_key(id, task))
    }

    /// All leases that are held, each with its attempt.
    fn held_leases(&self, live: &Live) -> Result<Vec<(Lease, Attempt)>, StoreError> {
        let mut held = Vec::new();
        for (id, task) in live.queue.leased() {
            let record = self.task_record(&id, task)?;
            let Some(record) = record else { continue };
            held.extend(record.running().map(|attempt| (record.lease_of(&id, attempt), attempt.clone())));
        }
        Ok(held)
    }
}

#[async_trait]
impl JobStore for SledStore {
    async fn submit(&self, new: NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        let job = self.create(&new, now_ms)?;
        // A repeated request waits too: the first reply may not have been sent.
        self.flusher.sync().await?;
        Ok(job)
    }

    async fn claim(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        let granted = self.give(claim, now_ms)?;
        if granted.is_some() {
            // A repeated claim waits too: the first reply may not have been sent.
            self.flusher.sync().await?;
        }
        Ok(granted)
    }

    async fn standing(&self, lease: &Lease) -> Result<Renewed, StoreError> {
        Ok(self.live().leases.standing(lease))
    }

    async fn renew(
        &self,
        lease: &Lease,
        progress: Option<LiveProgress>,
        now_ms: u64,
    ) -> Result<Renewed, StoreError> {
        Ok(self.live().leases.renew(lease, now_ms, now_ms + self.lease_ms, progress))
    }

    async fn apply(&self, job: &JobId, event: Event, now_ms: u64) -> Result<Outcome, StoreError> {
        let (outcome, _) = self.apply_event(&mut self.live(), job, &event, now_ms)?;
        // Also when nothing changed: the first reply may not have been sent.
        self.flusher.sync().await?;
        Ok(outcome)
    }

    async fn sweep(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError> {
        let taken_back = self.take_back(now_ms)?;
        if !taken_back.is_empty() {
            self.flusher.sync().await?;
        }
        Ok(taken_back)
    }

    async fn recover(&self, now_ms: u64) -> Result<(), StoreError> {
        self.grant_again(now_ms)?;
        self.flusher.sync().await
    }

    async fn job(&self, id: &JobId) -> Result<JobView, StoreError> {
        let job = self.job_record(id)?;
        let mut records = Vec::new();
        for task in job.shape.tasks() {
            records.extend(self.task_record(id, task)?);
        }
        self.flusher.sync_what_was_read().await?;
        let live = self.live();
        let with_progress = |record: TaskRecord| {
            let progress = live.leases.progress(id, record.task);
            (record, progress)
        };
        Ok(JobView { tasks: records.into_iter().map(with_progress).collect(), job })
    }

    async fn job_row(&self, job: &JobId) -> Result<JobRecord, StoreError> {
        self.job_record(job)
    }

    async fn task_row(&self, job: &JobId, task: TaskId) -> Result<TaskRecord, StoreError> {
        self.task_record(job, task)?.ok_or(StoreError::Refused(Refusal::NoSuchTask(task)))
    }

    async fn delete(&self, id: &JobId) -> Result<(), StoreError> {
        self.forget_job(id)?;
        self.flusher.sync().await
    }

    async fn list(
        &self,
        filter: &JobFilter,
        before: Option<&JobId>,
        limit: usize,
    ) -> Result<Vec<JobRecord>, StoreError> {
        let rows = match before {
            Some(before) => self.trees.jobs.range(..before.as_str().as_bytes()),
            None => self.trees.jobs.iter(),
        };
        let decoded = rows.rev().map(|row| {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            decode("jobs", &bytes)
        });
        let admitted = decoded.filter(|job| job.as_ref().map_or(true, |job| filter.admits(job)));
        let jobs = admitted.take(limit).collect::<Result<Vec<_>, _>>()?;
        self.flusher.sync_what_was_read().await?;
        Ok(jobs)
    }

    async fn events(
        &self,
        job: &JobId,
        after_seq: u64,
        limit: usize,
    ) -> Result<Vec<StoredEvent>, StoreError> {
        self.job_record(job)?;
        let range = event_key(job, after_seq.saturating_add(1))..=event_key(job, u64::MAX);
        let decoded = self.trees.events.range(range).take(limit).map(|row| {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            decode("events", &bytes)
        });
        let events = decoded.collect::<Result<Vec<_>, _>>()?;
        self.flusher.sync_what_was_read().await?;
        Ok(events)
    }

    async fn progress(&self, job: &JobId) -> Result<(Vec<(TaskId, LiveProgress)>, f64), StoreError> {
        let record = self.job_record(job)?;
        let leases = &self.live().leases;
        Ok((leases.progress_of_job(job), record.progress(leases.live_iterations(job))))
    }

    async fn ready(&self) -> Result<Vec<ReadyTask>, StoreError> {
        Ok(self.live().queue.ready())
    }

    async fn open_work(&self) -> Result<Vec<OpenWork>, StoreError> {
        Ok(self.live().queue.open_work())
    }

    async fn leased(&self) -> Result<Vec<(Lease, Attempt)>, StoreError> {
        self.held_leases(&self.live())
    }

    async fn levels(&self) -> Result<Levels, StoreError> {
        let live = self.live();
        Ok(Levels::of(live.jobs.clone(), &live.queue.ready(), live.leases.levels()))
    }

    async fn mark_worker(&self, incarnation: &str, mark: Option<&WorkerMark>) -> Result<(), StoreError> {
        self.put_alone("workers", &self.trees.workers, incarnation, mark)?;
        self.flusher.sync().await
    }

    async fn worker_marks(&self) -> Result<Vec<(String, WorkerMark)>, StoreError> {
        let rows = self.trees.workers.iter().map(|row| {
            let (incarnation, bytes) = row.map_err(|e| self.storage_error(e))?;
            Ok((String::from_utf8_lossy(&incarnation).into_owned(), decode("workers", &bytes)?))
        });
        rows.collect()
    }

    fn failure(&self) -> Option<String> {
        self.flusher.failure().cloned()
    }
}

#[async_trait]
impl DatasetStore for SledStore {
    async fn begin_dataset(&self, new: NewDataset, now_ms: u64) -> Result<DatasetRecord, StoreError> {
        let row = self.begin(new, now_ms)?;
        self.flusher.sync().await?;
        Ok(row)
    }

    async fn commit_dataset(
        &self,
        tenant: &Tenant,
        id: &DatasetId,
        root: &BlobRef,
        now_ms: u64,
    ) -> Result<DatasetRecord, StoreError> {
        let row = self.commit(tenant, id, root, now_ms)?;
        self.flusher.sync().await?;
        Ok(row)
    }

    async fn dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<DatasetRecord, StoreError> {
        let row = self.dataset_row(tenant, id)?;
        self.flusher.sync_what_was_read().await?;
        Ok(row)
    }

    async fn datasets(
        &self,
        tenant: Option<&Tenant>,
        after: Option<(&Tenant, &DatasetId)>,
        limit: usize,
    ) -> Result<Vec<DatasetRecord>, StoreError> {
        let rows = self.dataset_rows(tenant, after, limit)?;
        self.flusher.sync_what_was_read().await?;
        Ok(rows)
    }

    async fn delete_dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<(), StoreError> {
        self.forget(tenant, id)?;
        self.flusher.sync().await
    }

    async fn forget_given_up(&self, before_ms: u64) -> Result<Vec<DatasetRecord>, StoreError> {
        let given_up = self.forget_old_uploads(before_ms)?;
        if !given_up.is_empty() {
            self.flusher.sync().await?;
        }
        Ok(given_up)
    }
}

#[async_trait]
impl AccessStore for SledStore {
    async fn set_quota(&self, tenant: &Tenant, quota: Option<Quota>) -> Result<(), StoreError> {
        {
            let mut live = self.live();
            self.put_alone("quotas", &self.trees.quotas, tenant.as_str(), quota.as_ref())?;
            match quota {
                Some(quota) => drop(live.quotas.insert(tenant.clone(), quota)),
                None => drop(live.quotas.remove(tenant)),
            }
        }
        self.flusher.sync().await
    }

    async fn quota(&self, tenant: &Tenant) -> Result<Quota, StoreError> {
        Ok(self.live().quotas.get(tenant).copied().unwrap_or(self.rules.quota))
    }

    async fn quotas(&self) -> Result<Vec<(Tenant, Quota)>, StoreError> {
        self.quota_rows()
    }

    async fn usage(&self) -> Result<Vec<(Tenant, Usage)>, StoreError> {
        let live = self.live();
        let mut usage: Vec<(Tenant, Usage)> =
            live.queue.usage().into_iter().map(|(tenant, usage)| (tenant.clone(), usage)).collect();
        usage.sort_by(|(a, _), (b, _)| a.cmp(b));
        Ok(usage)
    }

    async fn put_token(&self, token: &TokenRecord) -> Result<(), StoreError> {
        self.put_alone("tokens", &self.trees.tokens, &token.id, Some(token))?;
        self.flusher.sync().await
    }

    async fn forget_token(&self, id: &str) -> Result<(), StoreError> {
        self.put_alone::<TokenRecord>("tokens", &self.trees.tokens, id, None)?;
        self.flusher.sync().await
    }

    async fn tokens(&self) -> Result<Vec<TokenRecord>, StoreError> {
        let rows = self.trees.tokens.iter().map(|row| {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            decode("tokens", &bytes)
        });
        rows.collect()
    }
}

#[async_trait]
impl Store for SledStore {
    async fn deployment(&self) -> Result<String, StoreError> {
        let meta = &self.trees.meta;
        if let Some(bytes) = meta.get(DEPLOYMENT).map_err(|error| self.storage_error(error))? {
            return decode("meta", &bytes);
        }
        let name = new_deployment();
        self.put_alone("meta", meta, DEPLOYMENT, Some(&name))?;
        self.flusher.sync().await?;
        Ok(name)
    }

    async fn export(&self) -> Result<Export, StoreError> {
        let rows = self.all_rows()?;
        self.flusher.sync_what_was_read().await?;
        let export = threads::blocking(move || rows.into_export()).await;
        export.map_err(|error| StoreError::Failed(error.to_string()))?
    }

    async fn import(&self, export: &Export) -> Result<(), StoreError> {
        self.take_all(export)?;
        self.flusher.sync().await
    }
}

#[cfg(test)]
mod tests;
