//! A week of calls of a busy service, played at full speed on a store.
//!
//! Users submit jobs by day more than at night, and pause, cancel and change them. Workers claim, renew, save
//! checkpoints, die, fail, leave, and repeat calls that were answered. Coordinators do their own tasks, sweep
//! leases, restart, and delete what ended a day ago. Each call has its simulated time, and is made when the
//! one before it is answered. All follows from the seed, except for the store's answers.
//!
//! The invariants are those of any history (`fathom-invariants`). Those of grants and changes are checked
//! every hour, and those of a job when it is deleted, so the memory of the week itself stays small. Pauses
//! before another attempt (I7) are not checked here.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fathom_coordinator::schedule::{
    Artifact, Event, FailClass, JobId, JobRecord, Lease, Outcome, Quota, Renewed, Rules, Stage, TaskId,
    TaskState, Tenant, WorkerProfile,
};
use fathom_coordinator::store::export::{Export, JobExport};
use fathom_coordinator::store::{Claim, Grant, MemoryStore, Store, StoreError};
use fathom_core::config::Method;
use fathom_core::scene::BlobRef;
use fathom_invariants::{Fact, Record};
use serde_json::Value;

use crate::memory::resident_mib;
use crate::random::Random;
use crate::scene::blob_ref;

mod output;
mod user;

use output::output;

/// Time of the first call, Unix milliseconds: the beginning of a working day.
const BEGIN_MS: u64 = 1_500_000_000_000;
const SECOND_MS: u64 = 1000;
const MINUTE_MS: u64 = 60 * SECOND_MS;
const HOUR_MS: u64 = 60 * MINUTE_MS;
const DAY_MS: u64 = 24 * HOUR_MS;
/// The lease of the store.
pub const LEASE_MS: u64 = MINUTE_MS;
const RENEW_MS: u64 = LEASE_MS / 4;
const CHECKPOINT_MS: u64 = 10 * MINUTE_MS;
/// Jobs are deleted this long after their end.
const KEPT_MS: u64 = DAY_MS;
/// Iterations of a second of training.
const PACE: u64 = 20;
const TENANTS: [&str; 3] = ["reef", "wreck", "cave"];
/// Most leases of a tenant at a time.
const OF_TENANT: u32 = 12;

/// Budgets and limits that the store must have.
pub fn rules() -> Rules {
    let quota = Quota { max_parallel: OF_TENANT, ..Quota::default() };
    Rules { max_losses: 40, max_errors: 10, quota, ..Rules::default() }
}

/// Who has the next turn.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Turn {
    User,
    Worker(usize),
    OwnTasks,
    Sweep,
    Hour,
}

/// What a worker will do with its task, decided when it takes it.
struct Work {
    grant: Grant,
    since_ms: u64,
    until_ms: u64,
    saved_ms: u64,
    end: End,
}

#[derive(Clone, Copy, PartialEq)]
enum End {
    Completes,
    Fails,
    Leaves,
    /// Its process dies; it makes no more calls until it is back.
    Dies,
}

#[derive(Default)]
struct Worker {
    /// Counts its processes.
    process: u32,
    calls: u64,
    work: Option<Work>,
    /// A lease of a process that died; the next one may still use it, too late.
    lost: Option<Lease>,
}

/// The outcome.
#[derive(Debug, Default)]
pub struct Played {
    /// Number of calls by kind.
    pub calls: BTreeMap<&'static str, u64>,
    /// Real time.
    pub took: Duration,
    /// Memory of the process after each day, MiB.
    pub memory_mib: Vec<f64>,
    /// A sentence for each violated invariant.
    pub violations: Vec<String>,
    /// A digest of all events of all jobs.
    pub history: String,
}

/// Opens the store, again after each restart.
#[allow(async_fn_in_trait, reason = "it is only used here")]
pub trait Opens {
    /// The store; the earlier one is closed.
    async fn open(&self) -> Result<Arc<dyn Store>, StoreError>;
}

/// A week that is being played.
struct Week {
    store: Arc<dyn Store>,
    random: Random,
    now_ms: u64,
    turns: BinaryHeap<Reverse<(u64, u64, Turn)>>,
    scheduled: u64,
    workers: Vec<Worker>,
    submitted: u32,
    /// Jobs that are not deleted, with the number of their partitions.
    jobs: BTreeMap<JobId, u32>,
    /// Fences granted on each task, and those of leases that have not ended.
    fences: BTreeMap<(JobId, TaskId), (u64, BTreeSet<u64>)>,
    /// Reports and manifests of merges, by digest.
    blobs: HashMap<String, Vec<u8>>,
    /// Of the last hour, and those about the existence of jobs since the beginning.
    facts: Vec<(Duration, Fact)>,
    existence: Vec<(Duration, Fact)>,
    /// Acknowledged checkpoints and results, by job.
    safe: BTreeMap<JobId, Vec<(Duration, Fact)>>,
    /// Jobs whose users have paused them and will resume them.
    paused: Vec<JobId>,
    history: blake3::Hasher,
    played: Played,
}

/// Plays `hours` hours with this many workers.
///
/// # Errors
/// When the store fails.
///
/// # Panics
/// When a job cannot be named.
pub async fn play(opens: &impl Opens, seed: u64, hours: u64, workers: usize) -> Result<Played, StoreError> {
    let begin = Instant::now();
    let mut week = Week {
        store: opens.open().await?,
        random: Random::new(seed, "week"),
        now_ms: BEGIN_MS,
        turns: BinaryHeap::new(),
        scheduled: 0,
        workers: (0..workers).map(|_| Worker::default()).collect(),
        submitted: 0,
        jobs: BTreeMap::new(),
        fences: BTreeMap::new(),
        blobs: HashMap::new(),
        facts: Vec::new(),
        existence: Vec::new(),
        safe: BTreeMap::new(),
        paused: Vec::new(),
        history: blake3::Hasher::new(),
        played: Played::default(),
    };
    week.store.recover(BEGIN_MS).await?;
    let all = [Turn::User, Turn::OwnTasks, Turn::Sweep, Turn::Hour];
    for turn in all.into_iter().chain((0..workers).map(Turn::Worker)) {
        week.after(SECOND_MS, turn);
    }
    let (end_ms, mut day) = (BEGIN_MS + hours * HOUR_MS, 1);
    while let Some(Reverse((at_ms, _, turn))) = week.turns.pop() {
        // Once the week is over, users rest, and all jobs end.
        if at_ms >= end_ms && (at_ms >= end_ms + DAY_MS || week.is_quiet().await?) {
            break;
        }
        week.now_ms = at_ms;
        match turn {
            Turn::User if at_ms >= end_ms => {}
            Turn::User => week.user().await?,
            Turn::Worker(index) => week.worker(index).await?,
            Turn::OwnTasks => week.own_tasks().await?,
            Turn::Sweep => week.sweep().await?,
            Turn::Hour => {
                week.hour().await?;
                if (at_ms - BEGIN_MS) / HOUR_MS % 8 == 3 {
                    // The earlier process is gone before the next one opens its files.
                    week.store = Arc::new(MemoryStore::new(rules(), LEASE_MS, 0));
                    week.store = opens.open().await?;
                    week.count("restart");
                    week.store.recover(at_ms).await?;
                }
                if at_ms >= BEGIN_MS + day * DAY_MS {
                    day += 1;
                    week.played.memory_mib.push(resident_mib());
                }
            }
        }
    }
    week.check(true).await?;
    week.played.took = begin.elapsed();
    week.played.history = week.history.finalize().to_hex().to_string();
    Ok(week.played)
}

impl Week {
    fn after(&mut self, ms: u64, turn: Turn) {
        self.scheduled += 1;
        self.turns.push(Reverse((self.now_ms + ms, self.scheduled, turn)));
    }

    fn count(&mut self, what: &'static str) {
        *self.played.calls.entry(what).or_default() += 1;
    }

    fn note(&mut self, fact: Fact) {
        let at = self.since_begin();
        match fact {
            Fact::Created { .. } | Fact::Deleting { .. } | Fact::Deleted { .. } => {
                self.existence.push((at, fact));
            }
            _ => self.facts.push((at, fact)),
        }
    }

    fn since_begin(&self) -> Duration {
        Duration::from_millis(self.now_ms - BEGIN_MS)
    }

    async fn is_quiet(&self) -> Result<bool, StoreError> {
        let has_work = self.workers.iter().any(|worker| worker.work.is_some());
        Ok(!has_work && self.store.open_work().await?.is_empty())
    }

    /// Applies an event; `None` if it was refused.
    async fn apply(
        &mut self,
        job: &JobId,
        event: Event,
        what: &'static str,
    ) -> Result<Option<Outcome>, StoreError> {
        self.count(what);
        match self.store.apply(job, event, self.now_ms).await {
            Ok(outcome) => Ok(Some(outcome)),
            Err(StoreError::Refused(_) | StoreError::JobNotFound(_)) => {
                self.count("refused");
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// An event under a lease.
    async fn report(&mut self, lease: &Lease, event: Event, how: &'static str) -> Result<bool, StoreError> {
        let key = (lease.job.clone(), lease.task);
        let running = self.fences.get(&key).map(|(_, running)| running.iter().copied().collect());
        let (is_result, is_checkpoint) = (how == "complete", how == "checkpoint");
        let saved = match &event {
            Event::Checkpoint { iteration, .. } => Some(u64::from(*iteration)),
            _ => None,
        };
        let outcome = self.apply(&lease.job, event, how).await?;
        if matches!(outcome, Some(Outcome::Changed(_))) {
            let running: Vec<u64> = running.unwrap_or_default();
            self.note(Fact::Changed { lease: lease.clone(), running, how });
            let (job, task, attempt) = (lease.job.to_string(), lease.task.to_string(), lease.attempt.into());
            let fact = match saved {
                Some(iteration) => Fact::CheckpointSafe { job, task, attempt, iteration },
                None => Fact::ResultTaken { job, task, attempt },
            };
            if is_result || is_checkpoint {
                let at = self.since_begin();
                self.safe.entry(lease.job.clone()).or_default().push((at, fact));
            }
            if let Some((_, running)) = self.fences.get_mut(&key).filter(|_| !is_checkpoint) {
                running.retain(|fence| !is_result && *fence != lease.fence);
            }
        }
        Ok(outcome.is_some())
    }

    async fn claim(
        &mut self,
        name: String,
        process: u32,
        call: u64,
        stages: Vec<Stage>,
    ) -> Result<Option<Grant>, StoreError> {
        // One worker has too little memory for a partition.
        let has = (!stages[0].is_own()).then_some(if name == "worker-0" { 1 << 29 } else { 8 << 30 });
        let worker = WorkerProfile {
            incarnation: format!("{name}-{process}"),
            name: name.clone(),
            stages,
            methods: Method::ALL.to_vec(),
            memory_bytes: has,
            tenant: None,
        };
        let claim = Claim { worker, peers: Arc::default(), request_id: format!("{name}-{process}-{call}") };
        self.count("claim");
        let Some(grant) = self.store.claim(&claim, self.now_ms).await? else { return Ok(None) };
        if self.random.permille(20) {
            let again = self.store.claim(&claim, self.now_ms).await?.map(|grant| grant.lease);
            if again.as_ref() != Some(&grant.lease) {
                self.note(Fact::TwoLeases { first: grant.lease.clone(), again });
            }
        }
        let leased = self.store.leased().await?;
        let of_job = leased.iter().filter(|(lease, _)| lease.job == grant.job.job_id).count() as u32;
        let mut of_tenant = 0;
        for (lease, _) in &leased {
            of_tenant += u32::from(self.store.job_row(&lease.job).await?.tenant == grant.job.tenant);
        }
        let key = (grant.job.job_id.clone(), grant.lease.task);
        let is_second = grant.task.second.as_ref().is_some_and(|second| second.fence == grant.lease.fence);
        let (highest, running) = self.fences.entry(key).or_default();
        let before = std::mem::replace(highest, grant.lease.fence);
        if !is_second {
            running.clear();
        }
        running.insert(grant.lease.fence);
        let limits = vec![
            ("the job".to_owned(), of_job, grant.job.max_parallel),
            ("the tenant".to_owned(), of_tenant, OF_TENANT),
        ];
        let need = grant.task.memory_bytes;
        self.note(Fact::Granted {
            lease: grant.lease.clone(),
            before,
            worker: name,
            need,
            has,
            limits,
            early_ms: 0,
        });
        Ok(Some(grant))
    }

    async fn worker(&mut self, index: usize) -> Result<(), StoreError> {
        let turn = Turn::Worker(index);
        if let Some(lease) = self.workers[index].lost.take() {
            // A new process; the one that died may have sent a last call that arrives now.
            self.workers[index].process += 1;
            let late =
                Event::Complete { output: output(&lease, 0, &mut self.blobs, &[]), lease: lease.clone() };
            self.report(&lease, late, "complete").await?;
        }
        let Some(mut work) = self.workers[index].work.take() else {
            self.workers[index].calls += 1;
            let Worker { process, calls, .. } = self.workers[index];
            let stages = Stage::of_workers();
            let granted = self.claim(format!("worker-{index}"), process, calls, stages).await?;
            let Some(grant) = granted else {
                let pause = self.random.within(20 * SECOND_MS, 60 * SECOND_MS);
                self.after(pause, turn);
                return Ok(());
            };
            let left = grant.task.iterations.saturating_sub(grant.task.resumed_from);
            let takes = (u64::from(left) * SECOND_MS / PACE).max(20 * SECOND_MS);
            let (mut until_ms, mut end) = (self.now_ms + takes, End::Completes);
            let other = [(15, End::Fails), (15, End::Leaves), (25, End::Dies)];
            if let Some((_, how)) = other.into_iter().find(|(share, _)| self.random.permille(*share)) {
                (until_ms, end) = (self.now_ms + self.random.within(0, takes), how);
            }
            let since_ms = self.now_ms;
            self.workers[index].work = Some(Work { grant, since_ms, until_ms, saved_ms: since_ms, end });
            self.after((until_ms - since_ms).min(RENEW_MS), turn);
            return Ok(());
        };
        let lease = work.grant.lease.clone();
        let iteration =
            work.grant.task.resumed_from + ((self.now_ms - work.since_ms) * PACE / SECOND_MS) as u32;
        if self.now_ms >= work.until_ms {
            let event = match work.end {
                End::Completes => {
                    Event::Complete { output: output(&lease, 0, &mut self.blobs, &[]), lease: lease.clone() }
                }
                End::Fails => Event::Fail {
                    lease: lease.clone(),
                    class: FailClass::Training,
                    message: "a loss was not finite".into(),
                },
                End::Leaves => Event::Release { lease: lease.clone(), reason: "released: it leaves".into() },
                End::Dies => {
                    self.workers[index].lost = Some(lease);
                    let back = self.random.within(2 * LEASE_MS, 20 * LEASE_MS);
                    self.after(back, turn);
                    return Ok(());
                }
            };
            let how = if work.end == End::Completes { "complete" } else { "end" };
            let repeated = event.clone();
            let is_accepted = self.report(&lease, event, how).await?;
            if is_accepted && self.random.permille(50) {
                let again = self.apply(&lease.job, repeated, "repeated").await?;
                if matches!(again, Some(Outcome::Changed(_))) {
                    self.note(Fact::ChangedTwice { lease, how });
                }
            }
            self.after(SECOND_MS, turn);
            return Ok(());
        }
        self.count("renew");
        match self.store.renew(&lease, None, self.now_ms).await? {
            Renewed::Runs => {}
            Renewed::ToBeReleased => {
                let release = Event::Release { lease: lease.clone(), reason: "released: paused".into() };
                self.report(&lease, release, "end").await?;
                self.after(SECOND_MS, turn);
                return Ok(());
            }
            Renewed::Over => {
                self.after(SECOND_MS, turn);
                return Ok(());
            }
        }
        let trains = lease.task.stage.spec().trains && iteration < work.grant.task.iterations;
        if trains && self.now_ms >= work.saved_ms + CHECKPOINT_MS {
            work.saved_ms = self.now_ms;
            let blob = blob_ref(format!("{} {iteration}", lease.fence).as_bytes());
            let checkpoint = Event::Checkpoint { lease: lease.clone(), blob, iteration };
            self.report(&lease, checkpoint, "checkpoint").await?;
        }
        let next = (work.until_ms - self.now_ms).min(RENEW_MS);
        self.workers[index].work = Some(work);
        self.after(next, turn);
        Ok(())
    }

    /// The coordinator's own tasks; sometimes it stops in the middle of one.
    async fn own_tasks(&mut self) -> Result<(), StoreError> {
        self.after(20 * SECOND_MS, Turn::OwnTasks);
        loop {
            let (process, call) = (0, self.scheduled + self.played.calls.get("claim").copied().unwrap_or(0));
            let Some(grant) = self.claim("coordinator".into(), process, call, Stage::own()).await? else {
                return Ok(());
            };
            if self.random.permille(10) {
                continue;
            }
            let lease = grant.lease.clone();
            let partitions = self.jobs.get(&lease.job).copied().unwrap_or(1);
            let merged: Vec<String> = self
                .store
                .job(&lease.job)
                .await?
                .tasks
                .iter()
                .filter_map(|(task, _)| match (&task.state, task.task.stage) {
                    (TaskState::Done { result, .. }, Stage::Partition) => Some(result.digest.clone()),
                    _ => None,
                })
                .collect();
            let output = output(&lease, partitions, &mut self.blobs, &merged);
            let event = Event::Complete { lease: lease.clone(), output };
            self.report(&lease, event, "complete").await?;
        }
    }

    async fn sweep(&mut self) -> Result<(), StoreError> {
        self.after(20 * SECOND_MS, Turn::Sweep);
        self.count("sweep");
        for (lease, _) in self.store.sweep(self.now_ms).await? {
            self.count("taken back");
            if let Some((_, running)) = self.fences.get_mut(&(lease.job, lease.task)) {
                running.remove(&lease.fence);
            }
        }
        Ok(())
    }

    /// Checks the facts of the last hour, and deletes jobs that ended a day ago.
    async fn hour(&mut self) -> Result<(), StoreError> {
        self.after(HOUR_MS, Turn::Hour);
        self.check(false).await?;
        for job in std::mem::take(&mut self.paused) {
            self.apply(&job, Event::Resume, "steer").await?;
        }
        for job in self.jobs.keys().cloned().collect::<Vec<_>>() {
            let row = self.store.job_row(&job).await?;
            if row.ended_ms.is_none_or(|ended_ms| self.now_ms < ended_ms + KEPT_MS) {
                continue;
            }
            let export = self.job(&row).await?;
            let safe = self.safe.remove(&job).unwrap_or_default();
            self.look(&Export { jobs: vec![export], ..Export::default() }, &safe, true);
            let user = 0;
            self.note(Fact::Deleting { user, job: job.clone() });
            self.store.delete(&job).await?;
            self.note(Fact::Deleted { user, job: job.clone() });
            self.count("delete");
            for artifact in [Artifact::MergeReport, Artifact::Model] {
                if let Some(blob) = row.output(artifact)
                    && let Some(report) = self.blobs.remove(&blob.digest)
                    && let Ok(report) = serde_json::from_slice::<Value>(&report)
                {
                    self.blobs.remove(report["manifest"]["digest"].as_str().unwrap_or_default());
                }
            }
            self.fences.retain(|(of, _), _| *of != job);
            self.jobs.remove(&job);
        }
        Ok(())
    }

    async fn job(&self, row: &JobRecord) -> Result<JobExport, StoreError> {
        let view = self.store.job(&row.job_id).await?;
        let mut events = Vec::new();
        loop {
            let more = self.store.events(&row.job_id, events.len() as u64, 1000).await?;
            if more.is_empty() {
                break;
            }
            events.extend(more);
        }
        Ok(JobExport { job: view.job, tasks: view.tasks.into_iter().map(|(task, _)| task).collect(), events })
    }

    /// Checks the facts of the last hour, and at the end all jobs that are left.
    async fn check(&mut self, at_the_end: bool) -> Result<(), StoreError> {
        let mut export = Export::default();
        let mut facts = std::mem::take(&mut self.facts);
        if at_the_end {
            facts.append(&mut self.existence);
            facts.extend(std::mem::take(&mut self.safe).into_values().flatten());
            for job in self.jobs.keys().cloned().collect::<Vec<_>>() {
                let row = self.store.job_row(&job).await?;
                export.jobs.push(self.job(&row).await?);
            }
        }
        self.look(&export, &facts, at_the_end);
        Ok(())
    }

    fn look(&mut self, export: &Export, facts: &[(Duration, Fact)], all_end: bool) {
        for job in &export.jobs {
            self.history.update(&serde_json::to_vec(&job.events).unwrap_or_default());
        }
        let Rules { max_errors, max_losses, .. } = rules();
        let record = Record {
            facts,
            export,
            budgets: (max_errors, max_losses),
            all_end,
            loses_results: false,
            tenant_of: &|user| TENANTS[user % TENANTS.len()].to_owned(),
            read: &|_: &Tenant, blob: &BlobRef| self.blobs.get(&blob.digest).cloned(),
        };
        let found = record.violations();
        self.played.violations.extend(found);
    }
}
