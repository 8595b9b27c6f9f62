//! The store on a simulated disk: synced changes survive a crash, others are lost.
//!
//! Each process of the coordinator opens the disk's contents as its own [`MemoryStore`]. A change reaches the
//! disk some time after it is made; only then are its caller and its readers answered. The disk may fail
//! before a change, or after it, so that the change exists without an answer. A failed store accepts nothing
//! more, and its coordinator ends. Some calls arrive late, and some twice.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fathom_coordinator::access::TokenRecord;
use fathom_coordinator::datasets::{DatasetId, DatasetRecord, NewDataset};
use fathom_coordinator::schedule::{
    Attempt, Event, Expired, JobId, JobRecord, Lease, LiveProgress, Outcome, Quota, Renewed, TaskId,
    TaskRecord, Tenant, Usage,
};
use fathom_coordinator::store::export::{Export, JobExport};
use fathom_coordinator::store::{
    AccessStore, Claim, DatasetStore, Grant, JobFilter, JobStore, JobView, Levels, MemoryStore, NewJob,
    OpenWork, ReadyTask, Store, StoreError, StoredEvent, WorkerMark,
};
use fathom_core::scene::BlobRef;
use fathom_invariants::Fact;
use tonic::async_trait;

use crate::random::Random;
use crate::world::{Safeguard, World};

/// Contents of the disk.
#[derive(Default)]
pub struct Disk {
    synced: Export,
    /// The process that has it open; earlier processes can no longer write.
    opened: u64,
}

/// The store of one process.
pub struct DiskStore {
    world: Arc<World>,
    memory: MemoryStore,
    random: Mutex<Random>,
    /// Number of this process.
    opened: u64,
    /// Number of changes made, and of those on the disk.
    made: AtomicU64,
    synced: AtomicU64,
    failed: Mutex<Option<String>>,
    /// Leases granted on each task.
    fences: Mutex<BTreeMap<(JobId, TaskId), Fences>>,
}

/// Leases granted on a task, as an observer sees them.
#[derive(Default)]
struct Fences {
    highest: u64,
    /// Fences of leases that have not ended.
    running: BTreeSet<u64>,
}

impl DiskStore {
    /// Opens the disk.
    pub async fn open(world: &Arc<World>, random: Random) -> Result<Self, StoreError> {
        let config = world.coordinator_config();
        let memory = MemoryStore::new(config.rules(), config.lease_ms.into(), config.stall_ms.into());
        let (export, opened) = {
            let mut disk = world.disk.lock().unwrap_or_else(PoisonError::into_inner);
            disk.opened += 1;
            (disk.synced.clone(), disk.opened)
        };
        world.history.note(Fact::Opened { jobs: export.jobs.len() });
        memory.import(&export).await?;
        let of_job = |job: &JobExport| {
            let id = &job.job.job_id;
            let of_task = |task: &TaskRecord| {
                let running = task.leases(id).iter().map(|lease| lease.fence).collect();
                ((id.clone(), task.task), Fences { highest: task.fence, running })
            };
            job.tasks.iter().map(of_task).collect::<Vec<_>>()
        };
        let fences = export.jobs.iter().flat_map(of_job);
        Ok(Self {
            world: Arc::clone(world),
            memory,
            random: Mutex::new(random),
            opened,
            made: AtomicU64::new(0),
            synced: AtomicU64::new(0),
            failed: Mutex::default(),
            fences: Mutex::new(fences.collect()),
        })
    }

    fn draw<T>(&self, what: impl FnOnce(&mut Random) -> T) -> T {
        what(&mut self.random.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn fences(&self) -> MutexGuard<'_, BTreeMap<(JobId, TaskId), Fences>> {
        self.fences.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Fences of the leases that run on this lease's task.
    fn running_beside(&self, lease: &Lease) -> Vec<u64> {
        let fences = self.fences();
        let of_task = fences.get(&(lease.job.clone(), lease.task));
        of_task.map(|of_task| of_task.running.iter().copied().collect()).unwrap_or_default()
    }

    /// Records that a lease has ended; a result ends all leases of its task.
    fn ended(&self, lease: &Lease, with_result: bool) {
        let mut fences = self.fences();
        let Some(of_task) = fences.get_mut(&(lease.job.clone(), lease.task)) else { return };
        of_task.running.retain(|fence| !with_result && *fence != lease.fence);
    }

    fn check(&self) -> Result<(), StoreError> {
        match self.failure() {
            Some(failure) => Err(StoreError::Failed(failure)),
            None => Ok(()),
        }
    }

    fn fail(&self, how: &str) -> StoreError {
        self.world.history.note(Fact::Fault(format!("the disk fails {how}")));
        self.world.counts(|counts| counts.disks += 1);
        let failure = format!("a simulated disk, {how}");
        *self.failed.lock().unwrap_or_else(PoisonError::into_inner) = Some(failure.clone());
        StoreError::Failed(failure)
    }

    fn fails_now(&self) -> bool {
        self.world.has_faults() && self.draw(|random| random.permille(3))
    }

    /// Delays this many calls per thousand, so that they arrive outdated.
    async fn delay(&self, share: u64) {
        if self.world.has_faults() && self.draw(|random| random.permille(share)) {
            let takes = self.draw(|random| random.ms(200, 7000));
            tokio::time::sleep(takes).await;
        }
    }

    /// Whether a call arrives twice.
    fn arrives_twice(&self) -> bool {
        let twice = self.world.has_faults() && self.draw(|random| random.permille(100));
        self.world.counts(|counts| counts.repeated += u64::from(twice));
        twice
    }

    /// Makes a change: it is on the disk when this returns.
    async fn change<T>(
        &self,
        has_changed: impl Fn(&T) -> bool,
        make: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T, StoreError> {
        self.check()?;
        if self.fails_now() {
            return Err(self.fail("before a change"));
        }
        let made = make.await?;
        if has_changed(&made) {
            self.made.fetch_add(1, Ordering::SeqCst);
        }
        self.settled().await?;
        if has_changed(&made) && self.fails_now() {
            return Err(self.fail("after a change"));
        }
        Ok(made)
    }

    /// Reads something; all that it may have seen is on the disk when this returns.
    async fn look<T>(&self, look: impl Future<Output = Result<T, StoreError>>) -> Result<T, StoreError> {
        self.check()?;
        let seen = look.await;
        self.settled().await?;
        seen
    }

    /// Waits until all changes so far are on the disk.
    async fn settled(&self) -> Result<(), StoreError> {
        let made = self.made.load(Ordering::SeqCst);
        if self.synced.load(Ordering::SeqCst) >= made || self.world.is_off(Safeguard::Sync) {
            return Ok(());
        }
        let takes =
            self.draw(|random| if random.permille(20) { random.ms(100, 900) } else { random.ms(1, 25) });
        tokio::time::sleep(takes).await;
        self.sync().await
    }

    /// Writes all changes so far to the disk.
    pub async fn sync(&self) -> Result<(), StoreError> {
        self.check()?;
        let made = self.made.load(Ordering::SeqCst);
        if self.synced.load(Ordering::SeqCst) >= made {
            return Ok(());
        }
        let export = self.memory.export().await?;
        let mut disk = self.world.disk.lock().unwrap_or_else(PoisonError::into_inner);
        if disk.opened == self.opened {
            disk.synced = export;
            self.synced.fetch_max(made, Ordering::SeqCst);
        }
        Ok(())
    }

    /// The record of a granted lease: the limits that apply and their current use.
    async fn granted(
        &self,
        grant: &Grant,
        claim: &Claim,
        not_before_ms: u64,
        now_ms: u64,
    ) -> Result<Fact, StoreError> {
        let leased = self.memory.leased().await?;
        let of_job = leased.iter().filter(|(lease, _)| lease.job == grant.job.job_id).count() as u32;
        let quota = self.memory.quota(&grant.job.tenant).await?;
        let mut of_tenant = 0;
        for (lease, _) in &leased {
            of_tenant += u32::from(self.memory.job_row(&lease.job).await?.tenant == grant.job.tenant);
        }
        let is_second = grant.task.second.as_ref().is_some_and(|second| second.fence == grant.lease.fence);
        self.world.counts(|counts| counts.second_attempts += u64::from(is_second));
        let before = {
            let mut fences = self.fences();
            let of_task = fences.entry((grant.job.job_id.clone(), grant.lease.task)).or_default();
            if !is_second {
                // A waiting task has no lease.
                of_task.running.clear();
            }
            of_task.running.insert(grant.lease.fence);
            std::mem::replace(&mut of_task.highest, grant.lease.fence)
        };
        Ok(Fact::Granted {
            lease: grant.lease.clone(),
            before,
            worker: claim.worker.name.clone(),
            need: grant.task.memory_bytes,
            has: claim.worker.memory_bytes,
            limits: vec![
                (format!("job {}", grant.job.job_id), of_job, grant.job.max_parallel),
                (format!("tenant {}", grant.job.tenant), of_tenant, quota.max_parallel),
            ],
            early_ms: not_before_ms.saturating_sub(now_ms),
        })
    }

    /// The event as accepted by rules without fences: under the currently held lease.
    async fn without_fence(&self, event: Event) -> Result<Event, StoreError> {
        let held = self.memory.leased().await?;
        let current = |lease: Lease| {
            let same = held.iter().find(|(held, _)| held.job == lease.job && held.task == lease.task);
            same.map_or(lease, |(held, _)| held.clone())
        };
        Ok(match event {
            Event::Complete { lease, output } => Event::Complete { lease: current(lease), output },
            Event::Checkpoint { lease, blob, iteration } => {
                Event::Checkpoint { lease: current(lease), blob, iteration }
            }
            other => other,
        })
    }
}

/// The lease of an event, and a description of the event.
fn came_under(event: &Event) -> Option<(Lease, &'static str)> {
    match event {
        Event::Checkpoint { lease, .. } => Some((lease.clone(), "a checkpoint under")),
        Event::Complete { lease, .. } => Some((lease.clone(), "the end of")),
        Event::Fail { lease, .. } => Some((lease.clone(), "the failure of")),
        Event::Release { lease, .. } => Some((lease.clone(), "the return of")),
        _ => None,
    }
}

#[async_trait]
impl JobStore for DiskStore {
    async fn submit(&self, mut new: NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        self.delay(40).await;
        if self.world.is_off(Safeguard::Requests) {
            // Forget all earlier requests.
            new.request_id = format!("{} {}", new.request_id, new.job_id);
        }
        self.change(|_| true, self.memory.submit(new, now_ms)).await
    }

    async fn claim(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        self.delay(40).await;
        let ready = self.memory.ready().await?;
        let claimed = async {
            let Some(grant) = self.memory.claim(claim, now_ms).await? else { return Ok(None) };
            if self.arrives_twice() {
                let again = self.memory.claim(claim, now_ms).await?.map(|grant| grant.lease);
                if again.as_ref() != Some(&grant.lease) {
                    self.world.history.note(Fact::TwoLeases { first: grant.lease.clone(), again });
                }
            }
            let of_task =
                |ready: &&ReadyTask| ready.job == grant.lease.job && ready.need.task == grant.lease.task;
            let not_before_ms = ready.iter().find(of_task).map_or(0, |ready| ready.not_before_ms);
            // A repeated call gets the lease of the first one.
            let fact = if self.running_beside(&grant.lease).contains(&grant.lease.fence) {
                None
            } else {
                Some(self.granted(&grant, claim, not_before_ms, now_ms).await?)
            };
            Ok(Some((grant, fact)))
        };
        let Some((grant, fact)) = self.change(Option::is_some, claimed).await? else { return Ok(None) };
        fact.into_iter().for_each(|fact| self.world.history.note(fact));
        Ok(Some(grant))
    }

    async fn standing(&self, lease: &Lease) -> Result<Renewed, StoreError> {
        self.check()?;
        self.memory.standing(lease).await
    }

    async fn renew(
        &self,
        lease: &Lease,
        progress: Option<LiveProgress>,
        now_ms: u64,
    ) -> Result<Renewed, StoreError> {
        self.delay(40).await;
        self.check()?;
        let renewed = self.memory.renew(lease, progress, now_ms).await?;
        if renewed == Renewed::Over {
            self.world.counts(|counts| counts.stale += 1);
        }
        Ok(renewed)
    }

    async fn apply(&self, job: &JobId, event: Event, now_ms: u64) -> Result<Outcome, StoreError> {
        self.delay(100).await;
        let came = came_under(&event).map(|(lease, how)| {
            let running = self.running_beside(&lease);
            (lease, how, running)
        });
        let (is_result, is_checkpoint) =
            (matches!(event, Event::Complete { .. }), matches!(event, Event::Checkpoint { .. }));
        let event =
            if self.world.is_off(Safeguard::Fence) { self.without_fence(event).await? } else { event };
        let applied = async {
            let outcome = self.memory.apply(job, event.clone(), now_ms).await?;
            if let (Some((lease, ..)), Outcome::Changed(_), false) = (&came, &outcome, is_checkpoint) {
                self.ended(lease, is_result);
            }
            if self.arrives_twice() {
                // Whatever the answer to the second call, the history must be as if it had not happened.
                let again = self.memory.apply(job, event, now_ms).await;
                if let (Some((lease, how, _)), Ok(Outcome::Changed(_))) = (came.clone(), again) {
                    self.world.history.note(Fact::ChangedTwice { lease, how });
                }
            }
            Ok(outcome)
        };
        let outcome = self.change(|outcome| matches!(outcome, Outcome::Changed(_)), applied).await;
        if let Some((lease, how, running)) = came.clone() {
            match &outcome {
                Ok(Outcome::Changed(_)) => self.world.history.note(Fact::Changed { lease, running, how }),
                Ok(Outcome::Already) => {}
                Err(StoreError::Refused(why)) => {
                    self.world.counts(|counts| counts.stale += 1);
                    self.world.history.note(Fact::Refused { lease, how, why: why.to_string() });
                }
                Err(_) => {}
            }
        }
        outcome
    }

    async fn sweep(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError> {
        if self.world.is_off(Safeguard::Sweeper) {
            return Ok(Vec::new());
        }
        let taken_back = self.change(|taken: &Vec<_>| !taken.is_empty(), self.memory.sweep(now_ms)).await?;
        for (lease, _) in taken_back.clone() {
            self.ended(&lease, false);
            let Lease { job, task, fence, .. } = lease;
            self.world.history.note(Fact::TakenBack { job, task, fence });
        }
        if self.world.is_off(Safeguard::Sync) {
            // Eventually, the system writes its buffers.
            self.sync().await?;
        }
        Ok(taken_back)
    }

    async fn recover(&self, now_ms: u64) -> Result<(), StoreError> {
        self.change(|()| true, self.memory.recover(now_ms)).await
    }

    async fn job(&self, job: &JobId) -> Result<JobView, StoreError> {
        self.look(self.memory.job(job)).await
    }

    async fn job_row(&self, job: &JobId) -> Result<JobRecord, StoreError> {
        self.look(self.memory.job_row(job)).await
    }

    async fn task_row(&self, job: &JobId, task: TaskId) -> Result<TaskRecord, StoreError> {
        self.look(self.memory.task_row(job, task)).await
    }

    async fn list(
        &self,
        filter: &JobFilter,
        before: Option<&JobId>,
        limit: usize,
    ) -> Result<Vec<JobRecord>, StoreError> {
        self.look(self.memory.list(filter, before, limit)).await
    }

    async fn delete(&self, job: &JobId) -> Result<(), StoreError> {
        self.change(|()| true, self.memory.delete(job)).await
    }

    async fn events(
        &self,
        job: &JobId,
        after_seq: u64,
        limit: usize,
    ) -> Result<Vec<StoredEvent>, StoreError> {
        self.look(self.memory.events(job, after_seq, limit)).await
    }

    async fn progress(&self, job: &JobId) -> Result<(Vec<(TaskId, LiveProgress)>, f64), StoreError> {
        self.look(self.memory.progress(job)).await
    }

    async fn ready(&self) -> Result<Vec<ReadyTask>, StoreError> {
        self.look(self.memory.ready()).await
    }

    async fn open_work(&self) -> Result<Vec<OpenWork>, StoreError> {
        self.look(self.memory.open_work()).await
    }

    async fn leased(&self) -> Result<Vec<(Lease, Attempt)>, StoreError> {
        self.look(self.memory.leased()).await
    }

    async fn levels(&self) -> Result<Levels, StoreError> {
        self.look(self.memory.levels()).await
    }

    async fn mark_worker(&self, incarnation: &str, mark: Option<&WorkerMark>) -> Result<(), StoreError> {
        self.change(|()| true, self.memory.mark_worker(incarnation, mark)).await
    }

    async fn worker_marks(&self) -> Result<Vec<(String, WorkerMark)>, StoreError> {
        self.look(self.memory.worker_marks()).await
    }

    fn failure(&self) -> Option<String> {
        self.failed.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

#[async_trait]
impl DatasetStore for DiskStore {
    async fn begin_dataset(&self, new: NewDataset, now_ms: u64) -> Result<DatasetRecord, StoreError> {
        self.change(|_| true, self.memory.begin_dataset(new, now_ms)).await
    }

    async fn commit_dataset(
        &self,
        tenant: &Tenant,
        id: &DatasetId,
        root: &BlobRef,
        now_ms: u64,
    ) -> Result<DatasetRecord, StoreError> {
        self.change(|_| true, self.memory.commit_dataset(tenant, id, root, now_ms)).await
    }

    async fn dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<DatasetRecord, StoreError> {
        self.look(self.memory.dataset(tenant, id)).await
    }

    async fn datasets(
        &self,
        tenant: Option<&Tenant>,
        after: Option<(&Tenant, &DatasetId)>,
        limit: usize,
    ) -> Result<Vec<DatasetRecord>, StoreError> {
        self.look(self.memory.datasets(tenant, after, limit)).await
    }

    async fn delete_dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<(), StoreError> {
        self.change(|()| true, self.memory.delete_dataset(tenant, id)).await
    }

    async fn forget_given_up(&self, before_ms: u64) -> Result<Vec<DatasetRecord>, StoreError> {
        self.change(|given_up: &Vec<_>| !given_up.is_empty(), self.memory.forget_given_up(before_ms)).await
    }
}

#[async_trait]
impl AccessStore for DiskStore {
    async fn set_quota(&self, tenant: &Tenant, quota: Option<Quota>) -> Result<(), StoreError> {
        self.change(|()| true, self.memory.set_quota(tenant, quota)).await
    }

    async fn quota(&self, tenant: &Tenant) -> Result<Quota, StoreError> {
        self.look(self.memory.quota(tenant)).await
    }

    async fn quotas(&self) -> Result<Vec<(Tenant, Quota)>, StoreError> {
        self.look(self.memory.quotas()).await
    }

    async fn usage(&self) -> Result<Vec<(Tenant, Usage)>, StoreError> {
        self.look(self.memory.usage()).await
    }

    async fn put_token(&self, token: &TokenRecord) -> Result<(), StoreError> {
        self.change(|()| true, self.memory.put_token(token)).await
    }

    async fn forget_token(&self, id: &str) -> Result<(), StoreError> {
        self.change(|()| true, self.memory.forget_token(id)).await
    }

    async fn tokens(&self) -> Result<Vec<TokenRecord>, StoreError> {
        self.look(self.memory.tokens()).await
    }
}

#[async_trait]
impl Store for DiskStore {
    async fn deployment(&self) -> Result<String, StoreError> {
        self.change(|_| true, self.memory.deployment()).await
    }

    async fn export(&self) -> Result<Export, StoreError> {
        self.look(self.memory.export()).await
    }

    async fn import(&self, export: &Export) -> Result<(), StoreError> {
        self.change(|()| true, self.memory.import(export)).await
    }
}

impl Disk {
    /// A disk with these tokens on it.
    pub fn with_tokens(tokens: Vec<TokenRecord>) -> Self {
        Self { synced: Export { tokens, ..Export::default() }, opened: 0 }
    }

    /// The contents after a crash now.
    pub fn synced(&self) -> Export {
        self.synced.clone()
    }
}
