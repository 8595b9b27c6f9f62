//! The store of a single machine, in sled 0.34.7.
//!
//! Trees and keys (all numbers big endian, so that keys sort as their contents do):
//!
//! | tree | key | row |
//! |---|---|---|
//! | `jobs` | job | [`JobRecord`] |
//! | `tasks` | job, kind, index | [`TaskRecord`] |
//! | `events` | job, seq | [`StoredEvent`] |
//! | `requests` | [`request_key`] | job |
//! | `workers` | incarnation | [`WorkerMark`] |
//! | `quotas` | tenant | [`Quota`] |
//! | `tokens` | id | [`TokenRecord`] |
//! | `datasets` | tenant, 0, name | [`DatasetRecord`] |
//! | `meta` | "last_fence" | number |
//! | `meta` | "written_by" | [`written_by::WrittenBy`], plain JSON |
//!
//! Which tasks are ready and which are leased is kept in memory ([`Queue`]), made of the rows of open jobs when the store is
//! opened; a lock over both makes that whoever looks there sees what the rows say.
//!
//! Every change is one transaction over all trees that it touches, then a sync (see [`super::flusher`]), then
//! the reply. sled runs a transaction's closure again after a conflict, so closures only read and write rows.

mod copy;
mod datasets;
mod live;
mod rows;
mod snapshots;
mod whole;
mod written_by;

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use sled::transaction::{TransactionError, Transactional};
use sled::{Mode, Tree};
use tonic::async_trait;

use self::live::Live;
use self::rows::{LAST_FENCE, Tx, TxResult, abort, event_key, task_key};
use super::dump::Dump;
use super::flusher::{Disk, Flusher, SledDisk};
use super::record::{decode, encode};
use super::{
    Claim, Grant, JobFilter, JobView, Levels, NewJob, Store, StoreError, StoredEvent, WorkerMark, request_key,
};
use crate::access::TokenRecord;
use crate::datasets::{DatasetId, DatasetRecord, NewDataset};
use crate::schedule::{
    Attempt, Event, Expired, JobId, JobRecord, JobRows, JobState, Lease, LiveProgress, Next, Outcome, Quota,
    ReadyTask, Refusal, Renewed, Rules, TaskId, TaskKind, TaskRecord, Tenant, Touched, Usage, step, touched,
};

/// How a [`SledStore`] is opened.
#[derive(Clone, Debug)]
pub struct SledOptions {
    /// Its own directory; created when it is not there.
    pub dir: PathBuf,
    /// Budgets and pauses.
    pub rules: Rules,
    /// Silence after which a lease is over, milliseconds.
    pub lease_ms: u64,
    /// Time without progress after which a worker's lease is taken back, milliseconds; 0: never.
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
    /// Goes with a store that is the copy of another one ([`SledStore::open_copy`]).
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

/// Indexes that earlier programs kept in the database.
const OBSOLETE: [&str; 2] = ["ready", "leased"];

impl SledStore {
    /// Opens or creates the store.
    ///
    /// # Errors
    /// When another process has it open, the disk fails, it is damaged, or a program with another layout wrote it. No row is repaired here, and
    /// nothing deleted but the indexes of earlier programs, once all that is needed has been read. Snapshots that sled did not finish
    /// or cannot read are set aside: its log says the same.
    pub fn open(options: &SledOptions) -> Result<Self, StoreError> {
        Self::open_on(options, |disk| disk)
    }

    /// As [`SledStore::open`], with something before the disk.
    pub(super) fn open_on<D: Disk>(
        options: &SledOptions,
        before: impl FnOnce(SledDisk) -> D,
    ) -> Result<Self, StoreError> {
        let path = options.dir.join("sled");
        let aside = snapshots::set_aside(&path)
            .map_err(|e| StoreError::Failed(format!("{}: a snapshot: {e}", path.display())))?;
        for snapshots::Aside { name, why, now } in aside {
            tracing::warn!(
                "the store's snapshot {name} was set aside: {why}; nothing is lost, it is made again from the log; {} may be deleted",
                now.display()
            );
        }
        let db = sled::Config::new()
            .path(&path)
            .mode(Mode::LowSpace)
            .cache_capacity(64 << 20)
            // The periodic flusher is also what collects garbage; acknowledgements never wait for it.
            .flush_every_ms(Some(500))
            .open()
            .map_err(|e| open_error(&path, e))?;
        // Before a tree is made or a row looked at.
        let written_by = written_by::check(&db, &path)?;
        let tree = |name: &str| db.open_tree(name).map_err(|e| open_error(&path, e));
        let trees = Trees {
            jobs: tree("jobs")?,
            tasks: tree("tasks")?,
            events: tree("events")?,
            requests: tree("requests")?,
            workers: tree("workers")?,
            quotas: tree("quotas")?,
            tokens: tree("tokens")?,
            datasets: tree("datasets")?,
            meta: tree("meta")?,
        };
        sync_names(&options.dir)
            .map_err(|e| StoreError::Failed(format!("{}: {e}", options.dir.display())))?;
        let flusher = Flusher::start(before(SledDisk::open(db.clone(), &path.join("db"))?))?;
        // Reads the number that every transaction needs: another layout or a damaged store shows at once.
        if let Some(bytes) = trees.meta.get(LAST_FENCE).map_err(|e| open_error(&path, e))? {
            decode::<u64>("meta", &bytes)?;
        }
        let store = Self {
            trees,
            flusher,
            rules: options.rules.clone(),
            lease_ms: options.lease_ms,
            stall_ms: options.stall_ms,
            live: Mutex::default(),
            _copy: None,
        };
        *store.live() = store.read_live()?;
        store.note_program(written_by.as_ref())?;
        for name in OBSOLETE {
            db.drop_tree(name).map_err(|e| open_error(&path, e))?;
        }
        Ok(store)
    }

    fn live(&self) -> MutexGuard<'_, Live> {
        self.live.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the rows say of open jobs. Leases begin to run in [`Store::recover`].
    fn read_live(&self) -> Result<Live, StoreError> {
        let mut live = Live::default();
        for row in &self.trees.jobs {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            let job: JobRecord = decode("jobs", &bytes)?;
            *live.jobs.entry(job.state).or_default() += 1;
            if !job.state.is_open() {
                continue;
            }
            let mut tasks = Vec::new();
            for task in job.tasks() {
                tasks.extend(self.task_record(&job.job_id, task)?);
            }
            live.queue.note(&job, &tasks);
            live.leases.note_paused(&job.job_id, job.state == JobState::Paused);
        }
        live.quotas = self.quota_rows()?.into_iter().collect();
        Ok(live)
    }

    fn quota_rows(&self) -> Result<Vec<(Tenant, Quota)>, StoreError> {
        let rows = self.trees.quotas.iter().collect::<Result<_, _>>().map_err(|e| self.storage_error(e))?;
        whole::quotas(&rows)
    }

    /// Writes or removes a row of its own, which no other row depends on. Not durable yet.
    fn put_alone<T: serde::Serialize>(
        &self,
        name: &'static str,
        tree: &Tree,
        key: &str,
        row: Option<&T>,
    ) -> Result<(), StoreError> {
        if let Some(failure) = self.flusher.failure() {
            return Err(StoreError::Failed(failure.clone()));
        }
        let _writing = self.flusher.writing();
        let written = match row {
            Some(row) => tree.insert(key, encode(name, row)?),
            None => tree.remove(key),
        };
        written.map(drop).map_err(|e| self.storage_error(e))
    }

    /// Runs `body` in one transaction over all trees. Not durable yet.
    fn transact<T>(&self, body: impl Fn(&Tx) -> TxResult<T>) -> Result<T, StoreError> {
        if let Some(failure) = self.flusher.failure() {
            return Err(StoreError::Failed(failure.clone()));
        }
        let _writing = self.flusher.writing();
        let t = &self.trees;
        let all = (&t.jobs, &t.tasks, &t.events, &t.requests, &t.meta);
        let result = all.transaction(|(jobs, tasks, events, requests, meta)| {
            body(&Tx { jobs, tasks, events, requests, meta })
        });
        result.map_err(|e| match e {
            TransactionError::Abort(error) => error,
            TransactionError::Storage(error) => self.storage_error(error),
        })
    }

    /// A failed write leaves the log in a state that nobody knows, so it ends all writing.
    fn storage_error(&self, error: sled::Error) -> StoreError {
        self.flusher.fail(error.to_string());
        StoreError::Failed(error.to_string())
    }

    /// The transaction of one event; gives what happened and the rows after it.
    fn apply_event(
        &self,
        live: &mut Live,
        id: &JobId,
        event: &Event,
        now_ms: u64,
    ) -> Result<(Outcome, JobRows), StoreError> {
        let applied = self.transact(|tx| {
            let job: JobRecord = tx
                .get("jobs", tx.jobs, id.as_str().as_bytes())?
                .ok_or_else(|| abort(StoreError::JobNotFound(id.clone())))?;
            let needed = match touched(&job, event) {
                Touched::All => job.tasks(),
                Touched::Some(tasks) => tasks,
            };
            let mut before = JobRows { job, tasks: BTreeMap::new() };
            for task in needed {
                if let Some(record) = tx.get("tasks", tx.tasks, &task_key(id, task))? {
                    before.tasks.insert(task, record);
                }
            }
            let mut event = event.clone();
            if let Event::Claim { fence, .. } = &mut event {
                *fence = tx.next_fence()?;
            }
            let mut after = before.clone();
            let outcome = step(&mut after, event, now_ms, &self.rules).map_err(|e| abort(e.into()))?;
            if let Outcome::Changed(told) = &outcome {
                tx.write(id, &before, &after)?;
                tx.append_events(id, before.job.last_seq, told, now_ms)?;
            }
            Ok((outcome, after, before.job.state))
        })?;
        let (outcome, after, before) = applied;
        live.count_job(Some(before), Some(after.job.state));
        live.follow(&after);
        Ok((outcome, after))
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

    /// Creates a job, or finds the one that this request created; not durable yet.
    fn create(&self, new: &NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        let mut live = self.live();
        let open_jobs = live.queue.usage_of(&new.tenant).open_jobs;
        let limit = live.quotas.get(&new.tenant).unwrap_or(&self.rules.quota).max_open_jobs;
        let request = request_key(&new.tenant, &new.request_id);
        // Under the lock under which datasets are forgotten.
        let dataset = new.dataset.as_ref();
        let is_committed = dataset.map(|id| self.is_committed(&new.tenant, id)).transpose()?;
        let (job, plan) = self.transact(|tx| {
            if let Some(id) = tx.get::<JobId>("requests", tx.requests, request.as_bytes())? {
                let known: Option<JobRecord> = tx.get("jobs", tx.jobs, id.as_str().as_bytes())?;
                return match known {
                    Some(job) if new.is_same_as(&job) => Ok((job, None)),
                    _ => Err(abort(StoreError::RequestIdReused { request_id: new.request_id.clone() })),
                };
            }
            match (dataset, is_committed.flatten()) {
                (None, _) | (Some(_), Some(true)) => {}
                (Some(id), Some(false)) => return Err(abort(StoreError::DatasetNotCommitted(id.clone()))),
                (Some(id), None) => return Err(abort(StoreError::DatasetNotFound(id.clone()))),
            }
            if limit > 0 && open_jobs >= limit {
                return Err(abort(StoreError::TooManyJobs { tenant: new.tenant.clone(), limit }));
            }
            let first = new.first_event();
            let (job, plan) = new.clone().into_rows(now_ms);
            let id = &job.job_id;
            tx.put("requests", tx.requests, request.as_bytes(), id)?;
            tx.put("jobs", tx.jobs, id.as_str().as_bytes(), &job)?;
            tx.write_task(id, &plan)?;
            tx.append_events(id, 0, &[first], now_ms)?;
            Ok((job, Some(plan)))
        })?;
        if plan.is_some() {
            live.count_job(None, Some(job.state));
            live.queue.note(&job, &plan);
        }
        Ok(job)
    }

    /// Takes back the leases that are over; not durable yet.
    fn take_back(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError> {
        let mut live = self.live();
        let mut taken_back = Vec::new();
        let expired = live.leases.expired(now_ms, self.stall_ms);
        for (lease, why) in expired {
            let event = Event::Expire { lease: lease.clone(), why };
            match self.apply_event(&mut live, &lease.job, &event, now_ms) {
                Ok(_) => taken_back.push((lease, why)),
                // The first one of a job has ended it, and with it the others.
                Err(StoreError::Refused(_)) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(taken_back)
    }

    /// Gives every lease a full period, and takes back those of the coordinator's own tasks; not durable yet.
    fn grant_again(&self, now_ms: u64) -> Result<(), StoreError> {
        let mut live = self.live();
        for (lease, _) in self.held_leases(&live)? {
            if TaskKind::OWN.contains(&lease.task.kind()) {
                let reason = "the coordinator was restarted".to_owned();
                let job = lease.job.clone();
                self.apply_event(&mut live, &job, &Event::Release { lease, reason }, now_ms)?;
            } else {
                live.leases.grant(lease, now_ms, now_ms + self.lease_ms);
            }
        }
        Ok(())
    }

    /// The lease that a claim gets; not durable yet.
    fn give(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        let mut live = self.live();
        if let Some((id, task)) = live.queue.given(&claim.worker, &claim.request_id) {
            let job = self.job_record(&id)?;
            let record = self.task_record(&id, task)?;
            return Ok(record.and_then(|task| Grant::of_call(claim, job, task)));
        }
        let quota_of = |tenant: &Tenant| live.quotas.get(tenant).copied().unwrap_or(self.rules.quota);
        let next = live.queue.next(&claim.worker, &claim.peers, quota_of, now_ms, &self.rules);
        let Some(Next { job: id, task, beside }) = next else { return Ok(None) };
        let event = Event::Claim {
            task,
            worker: claim.worker.clone(),
            peers: claim.peers.clone(),
            request_id: claim.request_id.clone(),
            // Numbered in the transaction.
            fence: 0,
            beside,
        };
        let (_, rows) = self.apply_event(&mut live, &id, &event, now_ms)?;
        let record = rows.tasks.get(&task).cloned();
        let granted = record.and_then(|record| Grant::of_call(claim, rows.job, record));
        if let Some(grant) = &granted {
            live.leases.grant(grant.lease.clone(), now_ms, now_ms + self.lease_ms);
        }
        Ok(granted)
    }
}

#[async_trait]
impl Store for SledStore {
    async fn submit(&self, new: NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        let job = self.create(&new, now_ms)?;
        // A repeated request waits too: the first one's reply may not have gone out.
        self.flusher.sync().await?;
        Ok(job)
    }

    async fn claim(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        let granted = self.give(claim, now_ms)?;
        if granted.is_some() {
            // A repeated claim waits too: the first one's reply may not have gone out.
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
        // Also when nothing changed: the first reply may not have gone out.
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
        for task in job.tasks() {
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
        let forgotten = |tx: &Tx| {
            let job: JobRecord = tx
                .get("jobs", tx.jobs, id.as_str().as_bytes())?
                .ok_or_else(|| abort(StoreError::JobNotFound(id.clone())))?;
            if job.state.is_open() {
                return Err(abort(Refusal::NotEnded.into()));
            }
            tx.jobs.remove(id.as_str().as_bytes())?;
            for task in job.tasks() {
                tx.tasks.remove(task_key(id, task))?;
            }
            for seq in 1..=job.last_seq {
                tx.events.remove(event_key(id, seq))?;
            }
            Ok(job.state)
        };
        {
            let mut live = self.live();
            let state = self.transact(forgotten)?;
            live.count_job(Some(state), None);
        }
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

    async fn leased(&self) -> Result<Vec<(Lease, Attempt)>, StoreError> {
        self.held_leases(&self.live())
    }

    async fn levels(&self) -> Result<Levels, StoreError> {
        let live = self.live();
        Ok(Levels::of(live.jobs.clone(), &live.queue.ready(), live.leases.levels()))
    }

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

    async fn tokens(&self) -> Result<Vec<TokenRecord>, StoreError> {
        let rows = self.trees.tokens.iter().map(|row| {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            decode("tokens", &bytes)
        });
        rows.collect()
    }

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

    async fn export(&self) -> Result<Dump, StoreError> {
        let rows = self.all_rows()?;
        self.flusher.sync_what_was_read().await?;
        let dump = threads::blocking(move || rows.into_dump()).await;
        dump.map_err(|error| StoreError::Failed(error.to_string()))?
    }

    async fn import(&self, dump: &Dump) -> Result<(), StoreError> {
        self.take_all(dump)?;
        self.flusher.sync().await
    }

    fn failure(&self) -> Option<String> {
        self.flusher.failure().cloned()
    }
}

/// Makes the folders and files durable that opening has made. sled syncs what it writes into its log, but neither its settings nor any
/// folder: after a power cut the whole store could be gone with all that was acknowledged.
fn sync_names(dir: &Path) -> std::io::Result<()> {
    let sled = dir.join("sled");
    File::open(sled.join("conf"))?.sync_all()?;
    for folder in [&sled.join("blobs"), &sled, dir].into_iter().chain(dir.parent()) {
        sync_folder(folder)?;
    }
    Ok(())
}

/// Makes the names in a folder durable.
#[cfg(unix)]
pub(crate) fn sync_folder(folder: &Path) -> std::io::Result<()> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    File::open(folder)?.sync_all()
}

/// Where a folder cannot be opened as a file, the system sees to its names.
#[cfg(not(unix))]
pub(crate) fn sync_folder(_folder: &Path) -> std::io::Result<()> {
    Ok(())
}

fn open_error(path: &Path, error: sled::Error) -> StoreError {
    match error {
        sled::Error::Corruption { at, .. } => StoreError::Corrupt {
            tree: "sled",
            message: format!("{} cannot be read at {at:?}; nothing in it was changed", path.display()),
        },
        // sled's own words; the system's would say no more than "would block".
        sled::Error::Io(error) if error.to_string().contains("could not acquire lock") => {
            StoreError::InUse { path: path.display().to_string() }
        }
        other => StoreError::Failed(format!("{}: {other}", path.display())),
    }
}

#[cfg(test)]
mod tests;
