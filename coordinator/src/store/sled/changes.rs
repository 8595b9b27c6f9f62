//! Changes of jobs, each one transaction. None of them is durable when it returns: callers sync before they
//! reply.

use std::collections::BTreeMap;

use sled::Tree;
use sled::transaction::{TransactionError, Transactional};

use super::super::record::encode;
use super::super::{Claim, Grant, NewJob, StoreError, request_key};
use super::SledStore;
use super::live::Live;
use super::rows::{Tx, TxResult, abort, event_key, task_key};
use crate::schedule::{
    Event, Expired, JobId, JobRecord, JobRows, Lease, Next, Outcome, Refusal, RowsNeeded, Tenant,
    rows_needed, step,
};

impl SledStore {
    /// Writes or removes an independent row. Not durable yet.
    pub(super) fn put_alone<T: serde::Serialize>(
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
    pub(super) fn transact<T>(&self, body: impl Fn(&Tx) -> TxResult<T>) -> Result<T, StoreError> {
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

    /// The transaction of one event; returns its outcome and the rows after it.
    pub(super) fn apply_event(
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
            let needed = match rows_needed(&job, event) {
                RowsNeeded::All => job.shape.tasks(),
                RowsNeeded::Some(tasks) => tasks,
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
            if let Outcome::Changed(events) = &outcome {
                tx.write(id, &before, &after)?;
                tx.append_events(id, before.job.last_seq, events, now_ms)?;
            }
            Ok((outcome, after, before.job.state))
        })?;
        let (outcome, after, before) = applied;
        live.count_job(Some(before), Some(after.job.state));
        live.follow(&after);
        Ok((outcome, after))
    }

    /// Creates a job, or finds the one that this request created; not durable yet.
    pub(super) fn create(&self, new: &NewJob, now_ms: u64) -> Result<JobRecord, StoreError> {
        let mut live = self.live();
        let open_jobs = live.queue.usage_of(&new.tenant).open_jobs;
        let limit = live.quotas.get(&new.tenant).unwrap_or(&self.rules.quota).max_open_jobs;
        let request = request_key(&new.tenant, &new.request_id);
        // Under the same lock as the deletion of datasets.
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

    /// Revokes expired leases; not durable yet.
    pub(super) fn take_back(&self, now_ms: u64) -> Result<Vec<(Lease, Expired)>, StoreError> {
        let mut live = self.live();
        let mut taken_back = Vec::new();
        let expired = live.leases.expired(now_ms, self.stall_ms);
        for (lease, why) in expired {
            let event = Event::Expire { lease: lease.clone(), why };
            match self.apply_event(&mut live, &lease.job, &event, now_ms) {
                Ok(_) => taken_back.push((lease, why)),
                // The first one of a job may have ended the job, and with it the others.
                Err(StoreError::Refused(_)) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(taken_back)
    }

    /// Gives every lease a full period, and revokes those of the coordinator's own tasks; not durable yet.
    pub(super) fn grant_again(&self, now_ms: u64) -> Result<(), StoreError> {
        let mut live = self.live();
        for (lease, _) in self.held_leases(&live)? {
            if lease.task.stage.is_own() {
                let reason = "the coordinator was restarted".to_owned();
                let job = lease.job.clone();
                self.apply_event(&mut live, &job, &Event::Release { lease, reason }, now_ms)?;
            } else {
                live.leases.grant(lease, now_ms, now_ms + self.lease_ms);
            }
        }
        Ok(())
    }

    /// The lease for a claim; not durable yet.
    pub(super) fn give(&self, claim: &Claim, now_ms: u64) -> Result<Option<Grant>, StoreError> {
        let mut live = self.live();
        if let Some((id, task)) = live.queue.given(&claim.worker, &claim.request_id) {
            let job = self.job_record(&id)?;
            let record = self.task_record(&id, task)?;
            return Ok(record.and_then(|task| Grant::of_call(claim, job, task)));
        }
        let quota_of = |tenant: &Tenant| live.quotas.get(tenant).copied().unwrap_or(self.rules.quota);
        let next = live.queue.next(&claim.worker, &claim.peers, quota_of, now_ms, &self.rules);
        let Some(Next { job: id, task, is_second }) = next else { return Ok(None) };
        let event = Event::Claim {
            task,
            worker: claim.worker.clone(),
            peers: claim.peers.clone(),
            request_id: claim.request_id.clone(),
            // Numbered in the transaction.
            fence: 0,
            is_second,
        };
        let (_, rows) = self.apply_event(&mut live, &id, &event, now_ms)?;
        let record = rows.tasks.get(&task).cloned();
        let granted = record.and_then(|record| Grant::of_call(claim, rows.job, record));
        if let Some(grant) = &granted {
            live.leases.grant(grant.lease.clone(), now_ms, now_ms + self.lease_ms);
        }
        Ok(granted)
    }

    /// Deletes a job that has ended, except its request id; not durable yet.
    pub(super) fn forget_job(&self, id: &JobId) -> Result<(), StoreError> {
        let forgotten = |tx: &Tx| {
            let job: JobRecord = tx
                .get("jobs", tx.jobs, id.as_str().as_bytes())?
                .ok_or_else(|| abort(StoreError::JobNotFound(id.clone())))?;
            if job.state.is_open() {
                return Err(abort(Refusal::NotEnded.into()));
            }
            tx.jobs.remove(id.as_str().as_bytes())?;
            for task in job.shape.tasks() {
                tx.tasks.remove(task_key(id, task))?;
            }
            for seq in 1..=job.last_seq {
                tx.events.remove(event_key(id, seq))?;
            }
            Ok(job.state)
        };
        let mut live = self.live();
        let state = self.transact(forgotten)?;
        live.count_job(Some(state), None);
        Ok(())
    }
}
