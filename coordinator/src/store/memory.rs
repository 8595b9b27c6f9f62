//! The simplest store: ordered maps under one lock. Nothing survives the process.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};

use fathom_core::scene::BlobRef;
use tonic::async_trait;

use super::export::{Export, JobExport};
use super::{
    AccessStore, Claim, DatasetStore, Grant, JobFilter, JobStore, JobView, Levels, NewJob, OpenWork,
    ReadyTask, Store, StoreError, StoredEvent, WorkerMark, check_new_dataset, new_deployment, request_key,
};
use crate::access::TokenRecord;
use crate::datasets::{DatasetId, DatasetRecord, NewDataset};
use crate::schedule::{
    Attempt, Event, Expired, JobId, JobRecord, JobRows, JobState, Lease, LeaseTable, LiveProgress, Outcome,
    Quota, Refusal, Renewed, Rules, Stage, TaskId, TaskRecord, TaskState, Tenant, Usage, step, usual_pace_ms,
};

/// The model for comparison with other stores.
pub struct MemoryStore {
    rules: Rules,
    lease_ms: u64,
    stall_ms: u64,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    jobs: BTreeMap<JobId, JobRows>,
    events: HashMap<JobId, Vec<StoredEvent>>,
    requests: HashMap<String, JobId>,
    last_fence: u64,
    marks: BTreeMap<String, WorkerMark>,
    quotas: BTreeMap<Tenant, Quota>,
    tokens: BTreeMap<String, TokenRecord>,
    datasets: BTreeMap<(Tenant, DatasetId), DatasetRecord>,
    deployment: Option<String>,
    leases: LeaseTable,
}

impl MemoryStore {
    /// An empty store.
    pub fn new(rules: Rules, lease_ms: u64, stall_ms: u64) -> Self {
        Self { rules, lease_ms, stall_ms, state: Mutex::default() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn quota(&self, tenant: &Tenant, rules: &Rules) -> Quota {
        self.quotas.get(tenant).copied().unwrap_or(rules.quota)
    }

    fn dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<&DatasetRecord, StoreError> {
        let found = self.datasets.get(&(tenant.clone(), id.clone()));
        found.ok_or_else(|| StoreError::DatasetNotFound(id.clone()))
    }

    fn usage_of(&self, tenant: &Tenant) -> Usage {
        let open = self.jobs.values().filter(|rows| rows.job.state.is_open() && rows.job.tenant == *tenant);
        let leased = |rows: &JobRows| rows.job.leased_tasks;
        Usage { open_jobs: open.clone().count() as u32, leased_tasks: open.map(leased).sum() }
    }

    fn apply(&mut self, id: &JobId, event: Event, now_ms: u64, rules: &Rules) -> Result<Outcome, StoreError> {
        let rows = self.jobs.get_mut(id).ok_or_else(|| StoreError::JobNotFound(id.clone()))?;
        let mut seq = rows.job.last_seq;
        let outcome = step(rows, event, now_ms, rules)?;
        if let Outcome::Changed(changes) = &outcome {
            let events = self.events.entry(id.clone()).or_default();
            for body in changes {
                seq += 1;
                events.push(StoredEvent { seq, time_ms: now_ms, body: body.clone() });
            }
        }
        self.forget_leases(id);
        Ok(outcome)
    }

    /// Removes the leases of a job that no row holds any more.
    fn forget_leases(&mut self, id: &JobId) {
        let Some(rows) = self.jobs.get(id) else { return };
        if !rows.job.state.is_open() {
            self.leases.end_job(id);
            return;
        }
        self.leases.note_paused(id, rows.job.state == JobState::Paused);
        self.leases
            .retain_of_job(id, |lease| rows.tasks.get(&lease.task).is_some_and(|t| t.is_held_by(lease)));
    }
}

/// The time from which the attempt `first` counts as slow, by the done tasks of its stage.
fn slow_from_ms(rows: &JobRows, record: &TaskRecord, first: &Attempt, rules: &Rules) -> Option<u64> {
    let siblings = rows.tasks.values().filter(|other| other.task.stage == record.task.stage);
    let usual_ms = usual_pace_ms(siblings.filter_map(TaskRecord::pace_ms))?;
    rules.slow_from_ms(first.since_ms, record.iterations_of(first), usual_ms)
}

#[async_trait]
impl JobStore for MemoryStore {
    async fn submit(&self, new: NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        let mut state = self.lock();
        let request = request_key(&new.tenant, &new.request_id);
        if let Some(id) = state.requests.get(&request) {
            return match state.jobs.get(id) {
                Some(rows) if new.is_same_as(&rows.job) => Ok(rows.job.clone()),
                _ => Err(StoreError::RequestIdReused { request_id: new.request_id }),
            };
        }
        if let Some(id) = &new.dataset
            && !state.dataset(&new.tenant, id)?.is_committed()
        {
            return Err(StoreError::DatasetNotCommitted(id.clone()));
        }
        let limit = state.quota(&new.tenant, &self.rules).max_open_jobs;
        if limit > 0 && state.usage_of(&new.tenant).open_jobs >= limit {
            return Err(StoreError::TooManyJobs { tenant: new.tenant, limit });
        }
        let first = StoredEvent { seq: 1, time_ms: now_ms, body: new.first_event() };
        let (job, plan) = new.into_rows(now_ms);
        let id = job.job_id.clone();
        state.requests.insert(request, id.clone());
        state.events.insert(id.clone(), vec![first]);
        state
            .jobs
            .insert(id, JobRows { job: job.clone(), tasks: BTreeMap::from([(Stage::Plan.task(), plan)]) });
        Ok(job)
    }

    async fn claim(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        let mut state = self.lock();
        let mut found = None;
        let mut slow = None;
        let mut jobs: Vec<(&JobId, &JobRows)> = state.jobs.iter().collect();
        jobs.sort_by_key(|(id, rows)| {
            let leased = state.usage_of(&rows.job.tenant).leased_tasks;
            (leased, std::cmp::Reverse(rows.job.priority), *id)
        });
        for (id, rows) in jobs {
            let limit = state.quota(&rows.job.tenant, &self.rules).max_parallel;
            let tenant_may = limit == 0 || state.usage_of(&rows.job.tenant).leased_tasks < limit;
            let may_go = |record: &TaskRecord| {
                rows.job.state == JobState::Running
                    && !rows.job.is_at_its_limit()
                    && tenant_may
                    && record.may_go_to(&rows.job.tenant, &claim.worker, &claim.peers)
            };
            for (task, record) in &rows.tasks {
                match &record.state {
                    TaskState::Leased(first) => {
                        if let Some(grant) = Grant::of_call(claim, rows.job.clone(), record.clone()) {
                            return Ok(Some(grant));
                        }
                        if slow.is_none()
                            && may_go(record)
                            && record.may_have_second_attempt()
                            && first.incarnation != claim.worker.incarnation
                            && slow_from_ms(rows, record, first, &self.rules).is_some_and(|at| at <= now_ms)
                        {
                            slow = Some((id.clone(), *task));
                        }
                    }
                    TaskState::Ready { not_before_ms }
                        if found.is_none() && may_go(record) && self.rules.is_due(*not_before_ms, now_ms) =>
                    {
                        found = Some((id.clone(), *task));
                    }
                    _ => {}
                }
            }
        }
        let is_second = found.is_none();
        let Some((id, task)) = found.or(slow) else { return Ok(None) };
        state.last_fence += 1;
        let event = Event::Claim {
            task,
            worker: claim.worker.clone(),
            peers: claim.peers.clone(),
            request_id: claim.request_id.clone(),
            fence: state.last_fence,
            is_second,
        };
        state.apply(&id, event, now_ms, &self.rules)?;
        let rows = state.jobs.get(&id).ok_or_else(|| StoreError::JobNotFound(id.clone()))?;
        let record = rows.tasks.get(&task).cloned();
        let granted = record.and_then(|record| Grant::of_call(claim, rows.job.clone(), record));
        if let Some(grant) = &granted {
            state.leases.grant(grant.lease.clone(), now_ms, now_ms + self.lease_ms);
        }
        Ok(granted)
    }

    async fn standing(&self, lease: &Lease) -> Result<Renewed, StoreError> {
        Ok(self.lock().leases.standing(lease))
    }

    async fn renew(
        &self,
        lease: &Lease,
        progress: Option<LiveProgress>,
        now_ms: u64,
    ) -> Result<Renewed, StoreError> {
        Ok(self.lock().leases.renew(lease, now_ms, now_ms + self.lease_ms, progress))
    }

    async fn apply(&self, job: &JobId, event: Event, now_ms: u64) -> Result<Outcome, StoreError> {
        self.lock().apply(job, event, now_ms, &self.rules)
    }

    async fn sweep(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError> {
        let mut state = self.lock();
        let expired = state.leases.expired(now_ms, self.stall_ms);
        let mut taken_back = Vec::new();
        for (lease, why) in expired {
            let event = Event::Expire { lease: lease.clone(), why };
            match state.apply(&lease.job, event, now_ms, &self.rules) {
                Ok(_) => taken_back.push((lease, why)),
                // The first one of a job may have ended the job, and with it the others.
                Err(StoreError::Refused(_)) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(taken_back)
    }

    async fn recover(&self, now_ms: u64) -> Result<(), StoreError> {
        let mut state = self.lock();
        let paused: Vec<JobId> = state
            .jobs
            .iter()
            .filter(|(_, rows)| rows.job.state == JobState::Paused)
            .map(|(id, _)| id.clone())
            .collect();
        paused.into_iter().for_each(|id| state.leases.note_paused(&id, true));
        let held: Vec<Lease> = state
            .jobs
            .iter()
            .flat_map(|(id, rows)| rows.tasks.values().flat_map(|record| record.leases(id)))
            .collect();
        for lease in held {
            if lease.task.stage.is_own() {
                let reason = "the coordinator was restarted".to_owned();
                let job = lease.job.clone();
                state.apply(&job, Event::Release { lease, reason }, now_ms, &self.rules)?;
            } else {
                state.leases.grant(lease, now_ms, now_ms + self.lease_ms);
            }
        }
        Ok(())
    }

    async fn job(&self, job: &JobId) -> Result<JobView, StoreError> {
        let state = self.lock();
        let rows = state.jobs.get(job).ok_or_else(|| StoreError::JobNotFound(job.clone()))?;
        let with_progress =
            |record: &crate::schedule::TaskRecord| (record.clone(), state.leases.progress(job, record.task));
        Ok(JobView { job: rows.job.clone(), tasks: rows.tasks.values().map(with_progress).collect() })
    }

    async fn job_row(&self, job: &JobId) -> Result<JobRecord, StoreError> {
        let state = self.lock();
        state.jobs.get(job).map(|rows| rows.job.clone()).ok_or_else(|| StoreError::JobNotFound(job.clone()))
    }

    async fn task_row(&self, job: &JobId, task: TaskId) -> Result<TaskRecord, StoreError> {
        let state = self.lock();
        let found = state.jobs.get(job).and_then(|rows| rows.tasks.get(&task)).cloned();
        found.ok_or(StoreError::Refused(Refusal::NoSuchTask(task)))
    }

    async fn delete(&self, job: &JobId) -> Result<(), StoreError> {
        let mut state = self.lock();
        let rows = state.jobs.get(job).ok_or_else(|| StoreError::JobNotFound(job.clone()))?;
        if rows.job.state.is_open() {
            return Err(Refusal::NotEnded.into());
        }
        state.jobs.remove(job);
        state.events.remove(job);
        Ok(())
    }

    async fn list(
        &self,
        filter: &JobFilter,
        before: Option<&JobId>,
        limit: usize,
    ) -> Result<Vec<JobRecord>, StoreError> {
        let state = self.lock();
        let older = state.jobs.iter().rev().filter(|(id, _)| before.is_none_or(|before| *id < before));
        let older = older.filter(|(_, rows)| filter.admits(&rows.job));
        Ok(older.take(limit).map(|(_, rows)| rows.job.clone()).collect())
    }

    async fn events(
        &self,
        job: &JobId,
        after_seq: u64,
        limit: usize,
    ) -> Result<Vec<StoredEvent>, StoreError> {
        let state = self.lock();
        let events = state.events.get(job).ok_or_else(|| StoreError::JobNotFound(job.clone()))?;
        Ok(events.iter().filter(|event| event.seq > after_seq).take(limit).cloned().collect())
    }

    async fn progress(&self, job: &JobId) -> Result<(Vec<(TaskId, LiveProgress)>, f64), StoreError> {
        let state = self.lock();
        let rows = state.jobs.get(job).ok_or_else(|| StoreError::JobNotFound(job.clone()))?;
        let live = state.leases.live_iterations(job);
        Ok((state.leases.progress_of_job(job), rows.job.progress(live)))
    }

    async fn ready(&self) -> Result<Vec<ReadyTask>, StoreError> {
        let state = self.lock();
        let running = state.jobs.iter().filter(|(_, rows)| rows.job.state == JobState::Running);
        let tasks = running.flat_map(|(id, rows)| rows.tasks.values().map(move |record| (id, record)));
        let ready = tasks.filter_map(|(id, record)| match record.state {
            TaskState::Ready { not_before_ms } => {
                let tenant = state.jobs.get(id).map(|rows| rows.job.tenant.clone()).unwrap_or_default();
                Some(ReadyTask { job: id.clone(), tenant, need: record.need(), not_before_ms })
            }
            _ => None,
        });
        Ok(ready.collect())
    }

    async fn open_work(&self) -> Result<Vec<OpenWork>, StoreError> {
        let state = self.lock();
        let running = state.jobs.values().filter(|rows| rows.job.state == JobState::Running);
        let work = running.map(|rows| {
            let waits = |task: &TaskRecord| match task.state {
                TaskState::Ready { not_before_ms } => Some((task.need(), not_before_ms)),
                _ => None,
            };
            OpenWork {
                tenant: rows.job.tenant.clone(),
                max_parallel: rows.job.max_parallel,
                waiting: rows.tasks.values().filter_map(waits).collect(),
                leased: rows.tasks.values().flat_map(|task| task.running().map(|_| task.need())).collect(),
            }
        });
        Ok(work.collect())
    }

    async fn leased(&self) -> Result<Vec<(Lease, Attempt)>, StoreError> {
        let state = self.lock();
        let tasks = state.jobs.iter().flat_map(|(id, rows)| rows.tasks.values().map(move |task| (id, task)));
        let held = tasks.flat_map(|(id, record)| {
            record.running().map(|attempt| (record.lease_of(id, attempt), attempt.clone()))
        });
        Ok(held.collect())
    }

    async fn levels(&self) -> Result<Levels, StoreError> {
        let ready = self.ready().await?;
        let state = self.lock();
        let mut jobs = BTreeMap::new();
        for rows in state.jobs.values() {
            *jobs.entry(rows.job.state).or_default() += 1;
        }
        Ok(Levels::of(jobs, &ready, state.leases.levels()))
    }

    async fn mark_worker(&self, incarnation: &str, mark: Option<&WorkerMark>) -> Result<(), StoreError> {
        let marks = &mut self.lock().marks;
        match mark {
            Some(mark) => drop(marks.insert(incarnation.to_owned(), mark.clone())),
            None => drop(marks.remove(incarnation)),
        }
        Ok(())
    }

    async fn worker_marks(&self) -> Result<Vec<(String, WorkerMark)>, StoreError> {
        Ok(self.lock().marks.clone().into_iter().collect())
    }

    fn failure(&self) -> Option<String> {
        None
    }
}

#[async_trait]
impl DatasetStore for MemoryStore {
    async fn begin_dataset(&self, new: NewDataset, now_ms: u64) -> Result<DatasetRecord, StoreError> {
        let datasets = &mut self.lock().datasets;
        let of_tenant = datasets.values().filter(|row| row.tenant == new.tenant);
        let row = match check_new_dataset(&new, of_tenant)? {
            Some(known) => DatasetRecord { asked_ms: now_ms, ..known.clone() },
            None => new.into_row(now_ms),
        };
        datasets.insert((row.tenant.clone(), row.id.clone()), row.clone());
        Ok(row)
    }

    async fn commit_dataset(
        &self,
        tenant: &Tenant,
        id: &DatasetId,
        root: &BlobRef,
        now_ms: u64,
    ) -> Result<DatasetRecord, StoreError> {
        let mut state = self.lock();
        let mut row = state.dataset(tenant, id)?.clone();
        if row.root != *root {
            return Err(StoreError::DatasetExists(id.clone()));
        }
        row.committed_ms.get_or_insert(now_ms);
        state.datasets.insert((tenant.clone(), id.clone()), row.clone());
        Ok(row)
    }

    async fn dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<DatasetRecord, StoreError> {
        self.lock().dataset(tenant, id).cloned()
    }

    async fn datasets(
        &self,
        tenant: Option<&Tenant>,
        after: Option<(&Tenant, &DatasetId)>,
        limit: usize,
    ) -> Result<Vec<DatasetRecord>, StoreError> {
        let state = self.lock();
        let of_tenant =
            state.datasets.values().filter(|row| tenant.is_none_or(|tenant| *tenant == row.tenant));
        let later = of_tenant.filter(|row| after.is_none_or(|after| after < (&row.tenant, &row.id)));
        Ok(later.take(limit).cloned().collect())
    }

    async fn delete_dataset(&self, tenant: &Tenant, id: &DatasetId) -> Result<(), StoreError> {
        let mut state = self.lock();
        state.dataset(tenant, id)?;
        let mut jobs = state.jobs.values().map(|rows| &rows.job);
        if let Some(job) = jobs.find(|job| job.tenant == *tenant && job.dataset.as_ref() == Some(id)) {
            return Err(StoreError::DatasetInUse { dataset: id.clone(), job: job.job_id.clone() });
        }
        state.datasets.remove(&(tenant.clone(), id.clone()));
        Ok(())
    }

    async fn forget_given_up(&self, before_ms: u64) -> Result<Vec<DatasetRecord>, StoreError> {
        let datasets = &mut self.lock().datasets;
        let given_up = datasets.values().filter(|row| row.is_given_up(before_ms)).cloned().collect();
        datasets.retain(|_, row| !row.is_given_up(before_ms));
        Ok(given_up)
    }
}

#[async_trait]
impl AccessStore for MemoryStore {
    async fn set_quota(&self, tenant: &Tenant, quota: Option<Quota>) -> Result<(), StoreError> {
        let quotas = &mut self.lock().quotas;
        match quota {
            Some(quota) => drop(quotas.insert(tenant.clone(), quota)),
            None => drop(quotas.remove(tenant)),
        }
        Ok(())
    }

    async fn quota(&self, tenant: &Tenant) -> Result<Quota, StoreError> {
        Ok(self.lock().quota(tenant, &self.rules))
    }

    async fn quotas(&self) -> Result<Vec<(Tenant, Quota)>, StoreError> {
        Ok(self.lock().quotas.clone().into_iter().collect())
    }

    async fn usage(&self) -> Result<Vec<(Tenant, Usage)>, StoreError> {
        let state = self.lock();
        let tenants: BTreeSet<&Tenant> = state
            .jobs
            .values()
            .filter(|rows| rows.job.state.is_open())
            .map(|rows| &rows.job.tenant)
            .collect();
        Ok(tenants.into_iter().map(|tenant| (tenant.clone(), state.usage_of(tenant))).collect())
    }

    async fn put_token(&self, token: &TokenRecord) -> Result<(), StoreError> {
        self.lock().tokens.insert(token.id.clone(), token.clone());
        Ok(())
    }

    async fn forget_token(&self, id: &str) -> Result<(), StoreError> {
        self.lock().tokens.remove(id);
        Ok(())
    }

    async fn tokens(&self) -> Result<Vec<TokenRecord>, StoreError> {
        Ok(self.lock().tokens.values().cloned().collect())
    }
}

#[async_trait]
impl Store for MemoryStore {
    async fn deployment(&self) -> Result<String, StoreError> {
        Ok(self.lock().deployment.get_or_insert_with(new_deployment).clone())
    }

    async fn export(&self) -> Result<Export, StoreError> {
        let state = self.lock();
        let jobs = state.jobs.iter().map(|(id, rows)| JobExport {
            job: rows.job.clone(),
            tasks: rows.tasks.values().cloned().collect(),
            events: state.events.get(id).cloned().unwrap_or_default(),
        });
        let taken = state.requests.iter().filter(|(_, id)| !state.jobs.contains_key(id));
        let mut taken_requests: Vec<(String, JobId)> =
            taken.map(|(request, id)| (request.clone(), id.clone())).collect();
        taken_requests.sort();
        Ok(Export {
            jobs: jobs.collect(),
            taken_requests,
            marks: state.marks.clone().into_iter().collect(),
            quotas: state.quotas.clone().into_iter().collect(),
            tokens: state.tokens.values().cloned().collect(),
            datasets: state.datasets.values().cloned().collect(),
            last_fence: state.last_fence,
            deployment: state.deployment.clone(),
        })
    }

    async fn import(&self, export: &Export) -> Result<(), StoreError> {
        let mut state = self.lock();
        if !state.requests.is_empty() {
            return Err(StoreError::NotEmpty);
        }
        for JobExport { job, tasks, events } in &export.jobs {
            let id = job.job_id.clone();
            state.requests.insert(request_key(&job.tenant, &job.request_id), id.clone());
            state.events.insert(id.clone(), events.clone());
            let tasks = tasks.iter().map(|record| (record.task, record.clone())).collect();
            state.jobs.insert(id, JobRows { job: job.clone(), tasks });
        }
        state.requests.extend(export.taken_requests.iter().cloned());
        state.marks.extend(export.marks.iter().cloned());
        state.quotas.extend(export.quotas.iter().cloned());
        state.tokens.extend(export.tokens.iter().map(|token| (token.id.clone(), token.clone())));
        let datasets = export.datasets.iter().map(|row| ((row.tenant.clone(), row.id.clone()), row.clone()));
        state.datasets.extend(datasets);
        state.last_fence = export.last_fence;
        state.deployment.clone_from(&export.deployment);
        Ok(())
    }
}
