//! The store of a single machine, in sled 0.34.7.
//!
//! Trees and keys (all numbers big endian, so that keys sort as their contents do):
//!
//! | tree | key | row |
//! |---|---|---|
//! | `jobs` | job | [`JobRecord`] |
//! | `tasks` | job, kind, index | [`TaskRecord`] |
//! | `ready` | as `tasks` | not before, ms, and what is needed: the tasks that are ready |
//! | `leased` | as `tasks` | nothing: the tasks that are leased |
//! | `events` | job, seq | [`StoredEvent`] |
//! | `requests` | request id | job |
//! | `workers` | incarnation | [`WorkerMark`] |
//! | `meta` | "last_fence" | number |
//!
//! Every change is one transaction over all trees that it touches, then a sync (see [`super::flusher`]), then
//! the reply. sled runs a transaction's closure again after a conflict, so closures only read and write rows.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};
use sled::transaction::{ConflictableTransactionError, TransactionError, Transactional, TransactionalTree};
use sled::{Mode, Tree};
use tonic::async_trait;

use super::dump::{Dump, JobDump};
use super::flusher::Flusher;
use super::record::{decode, encode};
use super::{
    Claim, Grant, JobFilter, JobView, Levels, NewJob, ReadyTask, Store, StoreError, StoredEvent, WorkerMark,
};
use crate::schedule::{
    Attempt, Event, EventBody, Expired, JobId, JobRecord, JobRows, JobState, Lease, LeaseTable, LiveProgress,
    Need, Outcome, Refusal, Renewed, Rules, TaskId, TaskKind, TaskRecord, TaskState, Touched, step, touched,
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

/// A row of `ready`.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(untagged)]
enum ReadyRow {
    /// As it is written.
    Full {
        /// Not to be taken before, Unix milliseconds.
        not_before_ms: u64,
        /// See [`TaskRecord::memory_bytes`].
        memory_bytes: u64,
    },
    /// As programs wrote it that knew no need of memory.
    Time(u64),
}

impl ReadyRow {
    fn into_task(self, job: JobId, task: TaskId) -> ReadyTask {
        let (not_before_ms, memory_bytes) = match self {
            Self::Full { not_before_ms, memory_bytes } => (not_before_ms, memory_bytes),
            Self::Time(not_before_ms) => (not_before_ms, 0),
        };
        ReadyTask { job, need: Need { task, memory_bytes }, not_before_ms }
    }
}

/// Jobs in sled.
pub struct SledStore {
    trees: Trees,
    flusher: Flusher,
    rules: Rules,
    lease_ms: u64,
    stall_ms: u64,
    leases: Mutex<LeaseTable>,
    /// Jobs by state: counted at start, then by what each transaction changed.
    jobs: Mutex<BTreeMap<JobState, i64>>,
}

struct Trees {
    jobs: Tree,
    tasks: Tree,
    ready: Tree,
    leased: Tree,
    events: Tree,
    requests: Tree,
    workers: Tree,
    meta: Tree,
}

/// The same trees inside a transaction.
struct Tx<'a> {
    jobs: &'a TransactionalTree,
    tasks: &'a TransactionalTree,
    ready: &'a TransactionalTree,
    leased: &'a TransactionalTree,
    events: &'a TransactionalTree,
    requests: &'a TransactionalTree,
    meta: &'a TransactionalTree,
}

type TxResult<T> = Result<T, ConflictableTransactionError<StoreError>>;

const LAST_FENCE: &[u8] = b"last_fence";

impl SledStore {
    /// Opens or creates the store.
    ///
    /// # Errors
    /// When another process has it open, the disk fails, it is damaged, or a newer program wrote it. Nothing
    /// is ever deleted or repaired here.
    pub fn open(options: &SledOptions) -> Result<Self, StoreError> {
        let path = options.dir.join("sled");
        let db = sled::Config::new()
            .path(&path)
            .mode(Mode::LowSpace)
            .cache_capacity(64 << 20)
            // The periodic flusher is also what collects garbage; acknowledgements never wait for it.
            .flush_every_ms(Some(500))
            .open()
            .map_err(|e| open_error(&path, e))?;
        let tree = |name: &str| db.open_tree(name).map_err(|e| open_error(&path, e));
        let trees = Trees {
            jobs: tree("jobs")?,
            tasks: tree("tasks")?,
            ready: tree("ready")?,
            leased: tree("leased")?,
            events: tree("events")?,
            requests: tree("requests")?,
            workers: tree("workers")?,
            meta: tree("meta")?,
        };
        let flusher = Flusher::start(db, &path.join("db"))?;
        // Reads the number that every transaction needs: a newer layout or a damaged store shows at once.
        if let Some(bytes) = trees.meta.get(LAST_FENCE).map_err(|e| open_error(&path, e))? {
            decode::<u64>("meta", &bytes)?;
        }
        Ok(Self {
            trees,
            flusher,
            rules: options.rules.clone(),
            lease_ms: options.lease_ms,
            stall_ms: options.stall_ms,
            leases: Mutex::default(),
            jobs: Mutex::default(),
        })
    }

    fn leases(&self) -> MutexGuard<'_, LeaseTable> {
        self.leases.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that a job is in the state `now` and was in `before`.
    fn count_job(&self, before: Option<JobState>, now: Option<JobState>) {
        let mut jobs = self.jobs.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(now) = now {
            *jobs.entry(now).or_default() += 1;
        }
        // Below 0 for a moment when transactions are counted in another order than they were committed in.
        if let Some(before) = before {
            *jobs.entry(before).or_default() -= 1;
        }
    }

    /// Runs `body` in one transaction over all trees. Not durable yet.
    fn transact<T>(&self, body: impl Fn(&Tx) -> TxResult<T>) -> Result<T, StoreError> {
        if let Some(failure) = self.flusher.failure() {
            return Err(StoreError::Failed(failure.clone()));
        }
        let t = &self.trees;
        let all = (&t.jobs, &t.tasks, &t.ready, &t.leased, &t.events, &t.requests, &t.meta);
        let result = all.transaction(|(jobs, tasks, ready, leased, events, requests, meta)| {
            body(&Tx { jobs, tasks, ready, leased, events, requests, meta })
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
    fn apply_event(&self, id: &JobId, event: &Event, now_ms: u64) -> Result<(Outcome, JobRows), StoreError> {
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
        self.count_job(Some(before), Some(after.job.state));
        self.follow_leases(id, &after);
        Ok((outcome, after))
    }

    /// Forgets leases that are over by these rows. Other transactions may have committed since, and their
    /// leases run already: those must stay, or nobody would ever take them back.
    fn follow_leases(&self, id: &JobId, rows: &JobRows) {
        let mut leases = self.leases();
        if rows.job.state.is_open() {
            leases.note_paused(id, rows.job.state == JobState::Paused, rows.job.last_seq);
            leases.retain_of_job(id, |lease| rows.tasks.get(&lease.task).is_none_or(|t| !t.is_past(lease)));
        } else {
            leases.end_job(id);
        }
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

    /// All leases that the rows hold.
    fn held_leases(&self) -> Result<Vec<(Lease, TaskRecord)>, StoreError> {
        let mut held = Vec::new();
        for key in self.trees.leased.iter().keys() {
            let (id, task) = parse_task_key(&key.map_err(|e| self.storage_error(e))?)?;
            // The row may have moved on since the index was read.
            let record = self.task_record(&id, task)?;
            held.extend(record.and_then(|record| Some((record.lease(&id)?, record))));
        }
        Ok(held)
    }

    fn ready_tasks(&self) -> Result<Vec<ReadyTask>, StoreError> {
        let mut ready = Vec::new();
        for entry in self.trees.ready.iter() {
            let (key, row) = entry.map_err(|e| self.storage_error(e))?;
            let (id, task) = parse_task_key(&key)?;
            ready.push(decode::<ReadyRow>("ready", &row)?.into_task(id, task));
        }
        Ok(ready)
    }

    /// Ready tasks of running jobs, each with its job's row.
    fn ready_of_running(&self) -> Result<Vec<(ReadyTask, Arc<JobRecord>)>, StoreError> {
        let mut jobs = HashMap::<JobId, Option<Arc<JobRecord>>>::new();
        let mut found = Vec::new();
        for ready in self.ready_tasks()? {
            let job = match jobs.get(&ready.job) {
                Some(known) => known.clone(),
                None => {
                    let job: Option<JobRecord> =
                        self.read("jobs", &self.trees.jobs, ready.job.as_str().as_bytes())?;
                    let job = job.filter(|job| job.state == JobState::Running).map(Arc::new);
                    jobs.insert(ready.job.clone(), job.clone());
                    job
                }
            };
            found.extend(job.map(|job| (ready, job)));
        }
        Ok(found)
    }

    /// A sentence for each entry of an index that no row stands behind, and for each row that none leads to. The rows
    /// themselves: [`super::verify`].
    ///
    /// # Errors
    /// When a row cannot be read.
    pub fn index_faults(&self) -> Result<Vec<String>, StoreError> {
        let mut faults = Vec::new();
        let (mut ready, mut leased) = (0, 0);
        for row in &self.trees.tasks {
            let (key, bytes) = row.map_err(|e| self.storage_error(e))?;
            let (id, task) = parse_task_key(&key)?;
            let record: TaskRecord = decode("tasks", &bytes)?;
            let is_in = |tree: &Tree| tree.contains_key(&key).map_err(|e| self.storage_error(e));
            let [is_ready, is_leased] = [is_in(&self.trees.ready)?, is_in(&self.trees.leased)?];
            let should = (
                matches!(record.state, TaskState::Ready { .. }),
                matches!(record.state, TaskState::Leased(_)),
            );
            ready += usize::from(is_ready);
            leased += usize::from(is_leased);
            if (is_ready, is_leased) != should || record.task != task {
                faults.push(format!("{task} of job {id} is not where its state belongs"));
            }
            if self.read::<JobRecord>("jobs", &self.trees.jobs, id.as_str().as_bytes())?.is_none() {
                faults.push(format!("{task} belongs to job {id}, which is not there"));
            }
        }
        for (name, tree, known) in
            [("ready", &self.trees.ready, ready), ("leased", &self.trees.leased, leased)]
        {
            if tree.len() != known {
                faults.push(format!(
                    "the index {name} has {} entries, {known} of which are of tasks",
                    tree.len()
                ));
            }
        }
        let mut events = 0;
        for row in &self.trees.jobs {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            let job: JobRecord = decode("jobs", &bytes)?;
            events += job.last_seq;
            let known: Option<JobId> =
                self.read("requests", &self.trees.requests, job.request_id.as_bytes())?;
            if known.as_ref() != Some(&job.job_id) {
                faults.push(format!("request {} does not lead to its job {}", job.request_id, job.job_id));
            }
        }
        let found = self.trees.events.len() as u64;
        if found != events {
            faults.push(format!("there are {found} events, and jobs have {events}"));
        }
        Ok(faults)
    }

    /// Tasks that a worker may be given, so far as the index tells: those of the highest priority first, among equals of the
    /// oldest job.
    fn tasks_to_give(&self, claim: &Claim, now_ms: u64) -> Result<Vec<(JobId, TaskId)>, StoreError> {
        let mut found = self.ready_of_running()?;
        found.retain(|(ready, job)| {
            claim.worker.fits(ready.need)
                && self.rules.is_due(ready.not_before_ms, now_ms)
                && !job.is_at_its_limit()
        });
        // Stable: what follows the priority is the order of the index.
        found.sort_by_key(|(_, job)| Reverse(job.priority));
        Ok(found.into_iter().map(|(ready, _)| (ready.job, ready.need.task)).collect())
    }
}

impl Tx<'_> {
    fn get<T: serde::de::DeserializeOwned>(
        &self,
        name: &'static str,
        tree: &TransactionalTree,
        key: &[u8],
    ) -> TxResult<Option<T>> {
        tree.get(key)?.map(|bytes| decode(name, &bytes)).transpose().map_err(abort)
    }

    fn put<T: serde::Serialize>(
        &self,
        name: &'static str,
        tree: &TransactionalTree,
        key: &[u8],
        row: &T,
    ) -> TxResult<()> {
        tree.insert(key, encode(name, row).map_err(abort)?)?;
        Ok(())
    }

    fn next_fence(&self) -> TxResult<u64> {
        let fence = self.get::<u64>("meta", self.meta, LAST_FENCE)?.unwrap_or(0) + 1;
        self.put("meta", self.meta, LAST_FENCE, &fence)?;
        Ok(fence)
    }

    /// Writes the rows that changed, and their entries in the indexes.
    fn write(&self, id: &JobId, before: &JobRows, after: &JobRows) -> TxResult<()> {
        self.put("jobs", self.jobs, id.as_str().as_bytes(), &after.job)?;
        for (task, record) in &after.tasks {
            if before.tasks.get(task) != Some(record) {
                self.write_task(id, record)?;
            }
        }
        Ok(())
    }

    fn write_task(&self, id: &JobId, record: &TaskRecord) -> TxResult<()> {
        let key = task_key(id, record.task);
        self.put("tasks", self.tasks, &key, record)?;
        match &record.state {
            TaskState::Ready { not_before_ms } => {
                let (not_before_ms, memory_bytes) = (*not_before_ms, record.memory_bytes);
                self.put("ready", self.ready, &key, &ReadyRow::Full { not_before_ms, memory_bytes })?;
            }
            _ => drop(self.ready.remove(key.as_slice())?),
        }
        match &record.state {
            TaskState::Leased(_) => drop(self.leased.insert(key, &[])?),
            _ => drop(self.leased.remove(key)?),
        }
        Ok(())
    }

    fn append_events(&self, id: &JobId, last_seq: u64, told: &[EventBody], now_ms: u64) -> TxResult<()> {
        for (seq, body) in (last_seq + 1..).zip(told) {
            let event = StoredEvent { seq, time_ms: now_ms, body: body.clone() };
            self.put("events", self.events, &event_key(id, seq), &event)?;
        }
        Ok(())
    }
}

#[async_trait]
impl Store for SledStore {
    async fn submit(&self, new: NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        let (job, is_new) = self.transact(|tx| {
            if let Some(id) = tx.get::<JobId>("requests", tx.requests, new.request_id.as_bytes())? {
                let known: Option<JobRecord> = tx.get("jobs", tx.jobs, id.as_str().as_bytes())?;
                return match known {
                    Some(job) if new.is_same_as(&job) => Ok((job, false)),
                    _ => Err(abort(StoreError::RequestIdReused { request_id: new.request_id.clone() })),
                };
            }
            let first = new.first_event();
            let (job, plan) = new.clone().into_rows(now_ms);
            let id = &job.job_id;
            tx.put("requests", tx.requests, new.request_id.as_bytes(), id)?;
            tx.put("jobs", tx.jobs, id.as_str().as_bytes(), &job)?;
            tx.write_task(id, &plan)?;
            tx.append_events(id, 0, &[first], now_ms)?;
            Ok((job, true))
        })?;
        if is_new {
            self.count_job(None, Some(job.state));
        }
        // A repeated request waits too: the first one's reply may not have gone out.
        self.flusher.sync().await?;
        Ok(job)
    }

    async fn claim(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        for (lease, task) in self.held_leases()? {
            let TaskState::Leased(attempt) = &task.state else { continue };
            if attempt.request_id == claim.request_id && attempt.incarnation == claim.worker.incarnation {
                let job = self.job_record(&lease.job)?;
                self.flusher.sync().await?;
                return Ok(Some(Grant { lease, job, task }));
            }
        }
        for (id, task) in self.tasks_to_give(claim, now_ms)? {
            let event = Event::Claim {
                task,
                worker: claim.worker.clone(),
                peers: claim.peers.clone(),
                request_id: claim.request_id.clone(),
                // Numbered in the transaction.
                fence: 0,
            };
            let rows = match self.apply_event(&id, &event, now_ms) {
                Ok((_, rows)) => rows,
                // Somebody else was faster since the index was read.
                Err(StoreError::Refused(_)) => continue,
                Err(error) => return Err(error),
            };
            let granted = rows.tasks.get(&task).and_then(|record| {
                Some(Grant { lease: record.lease(&id)?, job: rows.job.clone(), task: record.clone() })
            });
            if let Some(grant) = &granted {
                self.leases().grant(grant.lease.clone(), now_ms, now_ms + self.lease_ms);
            }
            self.flusher.sync().await?;
            return Ok(granted);
        }
        Ok(None)
    }

    async fn renew(
        &self,
        lease: &Lease,
        progress: Option<LiveProgress>,
        now_ms: u64,
    ) -> Result<Renewed, StoreError> {
        Ok(self.leases().renew(lease, now_ms, now_ms + self.lease_ms, progress))
    }

    async fn apply(&self, job: &JobId, event: Event, now_ms: u64) -> Result<Outcome, StoreError> {
        let (outcome, _) = self.apply_event(job, &event, now_ms)?;
        // Also when nothing changed: the first reply may not have gone out.
        self.flusher.sync().await?;
        Ok(outcome)
    }

    async fn sweep(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError> {
        let mut taken_back = Vec::new();
        // Out of the lock before the transactions, which take it too.
        let expired = self.leases().expired(now_ms, self.stall_ms);
        for (lease, why) in expired {
            match self.apply_event(&lease.job, &Event::Expire { lease: lease.clone(), why }, now_ms) {
                Ok(_) => taken_back.push((lease, why)),
                // Its holder was faster with a result.
                Err(StoreError::Refused(_)) => self.leases().end(&lease),
                Err(error) => return Err(error),
            }
        }
        if !taken_back.is_empty() {
            self.flusher.sync().await?;
        }
        Ok(taken_back)
    }

    async fn recover(&self, now_ms: u64) -> Result<(), StoreError> {
        self.jobs.lock().unwrap_or_else(PoisonError::into_inner).clear();
        for row in &self.trees.jobs {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            let job: JobRecord = decode("jobs", &bytes)?;
            self.count_job(None, Some(job.state));
            if job.state == JobState::Paused {
                self.leases().note_paused(&job.job_id, true, job.last_seq);
            }
        }
        for (lease, _) in self.held_leases()? {
            if TaskKind::OWN.contains(&lease.task.kind()) {
                let reason = "the coordinator was restarted".to_owned();
                let job = lease.job.clone();
                self.apply_event(&job, &Event::Release { lease, reason }, now_ms)?;
            } else {
                self.leases().grant(lease, now_ms, now_ms + self.lease_ms);
            }
        }
        self.flusher.sync().await
    }

    async fn job(&self, id: &JobId) -> Result<JobView, StoreError> {
        let job = self.job_record(id)?;
        let mut records = Vec::new();
        for task in job.tasks() {
            records.extend(self.task_record(id, task)?);
        }
        let leases = self.leases();
        let with_progress = |record: TaskRecord| {
            let progress = leases.progress(id, record.task);
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
        let state = self.transact(|tx| {
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
        })?;
        self.count_job(Some(state), None);
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
        admitted.take(limit).collect()
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
        decoded.collect()
    }

    async fn progress(&self, job: &JobId) -> Result<(Vec<(TaskId, LiveProgress)>, f64), StoreError> {
        let record = self.job_record(job)?;
        let leases = self.leases();
        Ok((leases.progress_of_job(job), record.progress(leases.live_iterations(job))))
    }

    async fn ready(&self) -> Result<Vec<ReadyTask>, StoreError> {
        Ok(self.ready_of_running()?.into_iter().map(|(ready, _)| ready).collect())
    }

    async fn leased(&self) -> Result<Vec<(Lease, Attempt)>, StoreError> {
        let held = self.held_leases()?.into_iter();
        let with_attempt = held.filter_map(|(lease, record)| match record.state {
            TaskState::Leased(attempt) => Some((lease, attempt)),
            _ => None,
        });
        Ok(with_attempt.collect())
    }

    async fn levels(&self) -> Result<Levels, StoreError> {
        let ready = self.ready().await?;
        let counts = self.jobs.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let there = counts.into_iter().filter(|(_, count)| *count > 0);
        let jobs = there.map(|(state, count)| (state, count as usize)).collect();
        Ok(Levels::of(jobs, &ready, self.leases().levels()))
    }

    async fn mark_worker(&self, incarnation: &str, mark: Option<&WorkerMark>) -> Result<(), StoreError> {
        if let Some(failure) = self.flusher.failure() {
            return Err(StoreError::Failed(failure.clone()));
        }
        // A row of its own, which no other row depends on.
        let written = match mark {
            Some(mark) => self.trees.workers.insert(incarnation, encode("workers", mark)?),
            None => self.trees.workers.remove(incarnation),
        };
        written.map_err(|e| self.storage_error(e))?;
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
        let mut dump = Dump::default();
        for row in &self.trees.jobs {
            let (_, bytes) = row.map_err(|e| self.storage_error(e))?;
            let job: JobRecord = decode("jobs", &bytes)?;
            let mut tasks = Vec::new();
            for task in job.tasks() {
                tasks.extend(self.task_record(&job.job_id, task)?);
            }
            let events = match self.events(&job.job_id, 0, usize::MAX).await {
                Ok(events) => events,
                // Deleted since its row was read.
                Err(StoreError::JobNotFound(_)) => continue,
                Err(error) => return Err(error),
            };
            dump.jobs.push(JobDump { job, tasks, events });
        }
        for row in &self.trees.requests {
            let (request, bytes) = row.map_err(|e| self.storage_error(e))?;
            let job: JobId = decode("requests", &bytes)?;
            if dump.jobs.binary_search_by(|known| known.job.job_id.cmp(&job)).is_err() {
                dump.taken_requests.push((String::from_utf8_lossy(&request).into_owned(), job));
            }
        }
        dump.last_fence = self.read("meta", &self.trees.meta, LAST_FENCE)?.unwrap_or(0);
        Ok(dump)
    }

    async fn import(&self, dump: &Dump) -> Result<(), StoreError> {
        if !self.trees.requests.is_empty() {
            return Err(StoreError::NotEmpty);
        }
        for JobDump { job, tasks, events } in &dump.jobs {
            let id = &job.job_id;
            self.transact(|tx| {
                tx.put("requests", tx.requests, job.request_id.as_bytes(), id)?;
                tx.put("jobs", tx.jobs, id.as_str().as_bytes(), job)?;
                for record in tasks {
                    tx.write_task(id, record)?;
                }
                for event in events {
                    tx.put("events", tx.events, &event_key(id, event.seq), event)?;
                }
                Ok(())
            })?;
        }
        self.transact(|tx| {
            for (request, job) in &dump.taken_requests {
                tx.put("requests", tx.requests, request.as_bytes(), job)?;
            }
            tx.put("meta", tx.meta, LAST_FENCE, &dump.last_fence)
        })?;
        self.flusher.sync().await
    }

    fn failure(&self) -> Option<String> {
        self.flusher.failure().cloned()
    }
}

fn abort(error: StoreError) -> ConflictableTransactionError<StoreError> {
    ConflictableTransactionError::Abort(error)
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

fn task_key(id: &JobId, task: TaskId) -> Vec<u8> {
    let (kind, index): (u8, u32) = match task {
        TaskId::Plan => (1, 0),
        TaskId::Global => (2, 0),
        TaskId::Partition(index) => (3, index),
        TaskId::Merge => (4, 0),
        TaskId::Evaluate => (5, 0),
        TaskId::Artifacts => (6, 0),
        // Keys of stores that are there do not change, so these are not in the order of tasks.
        TaskId::Refine(index) => (7, index),
        TaskId::Consensus => (8, 0),
        TaskId::Select => (10, 0),
        TaskId::Borders => (9, 0),
    };
    let mut key = id.as_str().as_bytes().to_vec();
    key.push(kind);
    key.extend_from_slice(&index.to_be_bytes());
    key
}

fn parse_task_key(key: &[u8]) -> Result<(JobId, TaskId), StoreError> {
    let corrupt = || StoreError::Corrupt { tree: "tasks", message: format!("a key is {key:02x?}") };
    let (id, rest) = key.split_at_checked(JobId::LENGTH).ok_or_else(corrupt)?;
    let id = std::str::from_utf8(id).ok().and_then(|id| id.parse().ok()).ok_or_else(corrupt)?;
    let task = match *rest {
        [1, ..] => TaskId::Plan,
        [2, ..] => TaskId::Global,
        [3, a, b, c, d] => TaskId::Partition(u32::from_be_bytes([a, b, c, d])),
        [4, ..] => TaskId::Merge,
        [5, ..] => TaskId::Evaluate,
        [6, ..] => TaskId::Artifacts,
        [7, a, b, c, d] => TaskId::Refine(u32::from_be_bytes([a, b, c, d])),
        [8, ..] => TaskId::Consensus,
        [10, ..] => TaskId::Select,
        [9, ..] => TaskId::Borders,
        _ => return Err(corrupt()),
    };
    Ok((id, task))
}

fn event_key(id: &JobId, seq: u64) -> Vec<u8> {
    let mut key = id.as_str().as_bytes().to_vec();
    key.extend_from_slice(&seq.to_be_bytes());
    key
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use fathom_core::scene::BlobRef;

    use super::*;
    use crate::schedule::{FailClass, Peer, Planned, PlannedTask, TaskOutput};

    const NOW_MS: u64 = 1_700_000_000_000;

    fn blob() -> BlobRef {
        BlobRef { digest: "0".repeat(64), bytes: 1 }
    }

    async fn claim(store: &SledStore, kind: TaskKind, request_id: &str) -> Lease {
        let (name, incarnation) = ("worker".into(), "incarnation".into());
        let worker = Peer { name, incarnation, kinds: vec![kind], memory_bytes: None };
        let claim = Claim { worker, peers: Arc::default(), request_id: request_id.into() };
        store.claim(&claim, NOW_MS).await.unwrap().unwrap().lease
    }

    #[test]
    fn a_directory_that_is_open_says_so_to_the_second_one() {
        let dir = tempfile::tempdir().unwrap();
        let options =
            SledOptions { dir: dir.path().to_owned(), rules: Rules::default(), lease_ms: 1000, stall_ms: 0 };
        let first = SledStore::open(&options).unwrap();
        let Err(error) = SledStore::open(&options) else { panic!("opened twice") };
        assert!(matches!(error, StoreError::InUse { .. }), "{error:?}");
        assert!(error.to_string().contains(dir.path().to_str().unwrap()), "{error}");
        drop(first);
        // sled's threads let go of the lock a moment after the last handle is dropped.
        let begin = std::time::Instant::now();
        while let Err(error) = SledStore::open(&options) {
            assert!(begin.elapsed().as_secs() < 10, "{error}");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
    }

    /// Transactions commit in one order and may look after the leases in another.
    #[tokio::test]
    async fn a_lease_that_was_granted_meanwhile_outlives_an_older_transactions_rows() {
        let dir = tempfile::tempdir().unwrap();
        let options =
            SledOptions { dir: dir.path().to_owned(), rules: Rules::default(), lease_ms: 1000, stall_ms: 0 };
        let store = SledStore::open(&options).unwrap();
        let new = NewJob {
            job_id: JobId::new(NOW_MS, 1),
            request_id: "request".into(),
            name: "job".into(),
            config_json: "{}".into(),
            manifest: blob(),
            ingest_seconds: 0.0,
            priority: 0,
            max_parallel: 0,
        };
        let id = store.submit(new, NOW_MS).await.unwrap().job_id;
        let plan = claim(&store, TaskKind::Plan, "plan").await;
        let planned = Planned {
            refine: Vec::new(),
            borders: None,
            plan: blob(),
            picture: blob(),
            global: None,
            select: false,
            partitions: vec![PlannedTask { spec: blob(), iterations: 1, memory_bytes: 0 }; 2],
            evaluate: None,
            warnings: Vec::new(),
        };
        store.complete(&plan, TaskOutput::Plan(Box::new(planned)), NOW_MS).await.unwrap();

        let failing = claim(&store, TaskKind::Partition, "first").await;
        let fail = Event::Fail { lease: failing.clone(), class: FailClass::Training, message: "x".into() };
        let (_, rows) = store.apply_event(&id, &fail, NOW_MS).unwrap();
        let granted_meanwhile = claim(&store, TaskKind::Partition, "second").await;
        store.follow_leases(&id, &rows);
        let renewed = async |lease| store.renew(lease, None, NOW_MS).await.unwrap();
        assert_eq!(renewed(&failing).await, Renewed::Over, "a lease that is over still runs");
        assert_eq!(renewed(&granted_meanwhile).await, Renewed::Runs, "a lease was forgotten");
        assert_eq!(store.sweep(NOW_MS + 1000).await.unwrap(), [(granted_meanwhile, Expired::Silent)]);
    }
}
