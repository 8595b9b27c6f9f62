//! A store that counts all changes of jobs, from every caller.

use std::sync::Arc;
use std::time::Instant;

use tonic::async_trait;

use super::{Metrics, labels};
use crate::schedule::{
    Attempt, Event, EventBody, Expired, JobId, JobRecord, JobState, Lease, LiveProgress, Outcome, Refusal,
    Renewed, Stage, TaskId, TaskRecord,
};
use crate::store::{
    Claim, Grant, JobFilter, JobStore, JobView, Levels, NewJob, OpenWork, ReadyTask, Store, StoreError,
    StoredEvent, WorkerMark,
};

/// Another store, counted.
pub struct CountedStore {
    /// The store.
    pub store: Arc<dyn Store>,
    /// Where it is counted.
    pub metrics: Arc<Metrics>,
}

impl CountedStore {
    fn acknowledged(&self, since: Instant) {
        self.metrics.acknowledgement_seconds.observe(since.elapsed().as_secs_f64());
    }

    fn count_change(&self, event: &Counted) {
        let m = &self.metrics;
        match event {
            Counted::Complete(kind) => drop(m.attempts_completed.get_or_create(&[("stage", kind)]).inc()),
            Counted::Fail(kind, class) => {
                m.attempts_failed.get_or_create(&[("stage", kind), ("class", class)]).inc();
            }
            Counted::Release(kind) => drop(m.attempts_released.get_or_create(&[("stage", kind)]).inc()),
            Counted::Other => {}
        }
    }

    /// Observes the duration of a stage that a task's end has ended.
    async fn observe_stage(&self, id: &JobId, stage: Stage) {
        // A job that was deleted meanwhile is not observed.
        if let Ok(job) = self.store.job_row(id).await
            && let Some(&seconds) = job.stage_seconds.get(&stage)
        {
            self.metrics.stage_seconds.get_or_create(&[("stage", stage.name())]).observe(seconds);
        }
    }
}

/// The counters of an applied event.
enum Counted {
    Complete(&'static str),
    Fail(&'static str, &'static str),
    Release(&'static str),
    Other,
}

impl Counted {
    fn of(event: &Event) -> Self {
        match event {
            Event::Complete { lease, .. } => Self::Complete(lease.task.stage.name()),
            Event::Fail { lease, class, .. } => Self::Fail(lease.task.stage.name(), labels::class(*class)),
            Event::Release { lease, .. } => Self::Release(lease.task.stage.name()),
            _ => Self::Other,
        }
    }
}

/// Whether a job has left a stage.
fn ends_stage(events: &[EventBody]) -> bool {
    events.iter().any(|body| {
        matches!(body, EventBody::Stage { .. } | EventBody::JobState { state: JobState::Succeeded, .. })
    })
}

#[async_trait]
impl JobStore for CountedStore {
    async fn submit(&self, new: NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        let since = Instant::now();
        let job = self.store.submit(new, now_ms).await?;
        self.acknowledged(since);
        self.metrics.jobs_submitted.inc();
        Ok(job)
    }

    async fn claim(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        let since = Instant::now();
        let grant = self.store.claim(claim, now_ms).await?;
        if let Some(Grant { lease, .. }) = &grant {
            self.acknowledged(since);
            let kind = [("stage", lease.task.stage.name())];
            self.metrics.attempts_granted.get_or_create(&kind).inc();
            if lease.attempt > 1 {
                self.metrics.retries.get_or_create(&kind).inc();
            }
        }
        Ok(grant)
    }

    async fn standing(&self, lease: &Lease) -> Result<Renewed, StoreError> {
        self.store.standing(lease).await
    }

    async fn renew(
        &self,
        lease: &Lease,
        progress: Option<LiveProgress>,
        now_ms: u64,
    ) -> Result<Renewed, StoreError> {
        self.store.renew(lease, progress, now_ms).await
    }

    async fn apply(&self, job: &JobId, event: Event, now_ms: u64) -> Result<Outcome, StoreError> {
        let since = Instant::now();
        let counted = Counted::of(&event);
        let completes = match &event {
            Event::Complete { lease, .. } => Some(lease.task.stage),
            _ => None,
        };
        let outcome = self.store.apply(job, event, now_ms).await;
        match &outcome {
            Ok(outcome) => {
                self.acknowledged(since);
                if let Outcome::Changed(events) = outcome {
                    self.count_change(&counted);
                    if let Some(kind) = completes.filter(|_| ends_stage(events)) {
                        self.observe_stage(job, kind).await;
                    }
                }
            }
            Err(StoreError::Refused(Refusal::StaleFence { .. })) => drop(self.metrics.stale_fences.inc()),
            Err(_) => {}
        }
        outcome
    }

    async fn sweep(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError> {
        let taken_back = self.store.sweep(now_ms).await?;
        for (lease, why) in &taken_back {
            let labels = [("stage", lease.task.stage.name()), ("why", labels::expired(*why))];
            self.metrics.leases_expired.get_or_create(&labels).inc();
        }
        Ok(taken_back)
    }

    async fn recover(&self, now_ms: u64) -> Result<(), StoreError> {
        self.store.recover(now_ms).await
    }

    async fn answers(&self) -> Result<(), StoreError> {
        self.store.answers().await
    }

    async fn extend_leases(&self, now_ms: u64) -> Result<(), StoreError> {
        self.store.extend_leases(now_ms).await
    }

    async fn job(&self, job: &JobId) -> Result<JobView, StoreError> {
        self.store.job(job).await
    }

    async fn job_row(&self, job: &JobId) -> Result<JobRecord, StoreError> {
        self.store.job_row(job).await
    }

    async fn task_row(&self, job: &JobId, task: TaskId) -> Result<TaskRecord, StoreError> {
        self.store.task_row(job, task).await
    }

    async fn levels(&self) -> Result<Levels, StoreError> {
        self.store.levels().await
    }

    async fn list(
        &self,
        filter: &JobFilter,
        before: Option<&JobId>,
        limit: usize,
    ) -> Result<Vec<JobRecord>, StoreError> {
        self.store.list(filter, before, limit).await
    }

    async fn delete(&self, job: &JobId) -> Result<(), StoreError> {
        self.store.delete(job).await
    }

    async fn events(
        &self,
        job: &JobId,
        after_seq: u64,
        limit: usize,
    ) -> Result<Vec<StoredEvent>, StoreError> {
        self.store.events(job, after_seq, limit).await
    }

    async fn progress(&self, job: &JobId) -> Result<(Vec<(TaskId, LiveProgress)>, f64), StoreError> {
        self.store.progress(job).await
    }

    async fn ready(&self) -> Result<Vec<ReadyTask>, StoreError> {
        self.store.ready().await
    }

    async fn open_work(&self) -> Result<Vec<OpenWork>, StoreError> {
        self.store.open_work().await
    }

    async fn leased(&self) -> Result<Vec<(Lease, Attempt)>, StoreError> {
        self.store.leased().await
    }

    async fn mark_worker(&self, incarnation: &str, mark: Option<&WorkerMark>) -> Result<(), StoreError> {
        self.store.mark_worker(incarnation, mark).await
    }

    async fn worker_marks(&self) -> Result<Vec<(String, WorkerMark)>, StoreError> {
        self.store.worker_marks().await
    }

    fn failure(&self) -> Option<String> {
        self.store.failure()
    }
}
