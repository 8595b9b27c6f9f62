//! Jobs that no connected worker can continue: the shortfall, and its start.
//!
//! A job may wait forever, but always reports why. Shortfalls are kept in memory: after a restart, waiting
//! counts from the restart.

use std::collections::HashMap;
use std::sync::PoisonError;

use crate::schedule::{Event, JobId, Requirements, Shortfall, Tenant, WorkerProfile};
use crate::state::State;
use crate::store::StoreError;

/// The shortfall of a waiting job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// The shortfall.
    pub shortfall: Shortfall,
    /// Its start, Unix milliseconds.
    pub since_ms: u64,
}

/// The shortfall of the ready tasks of one job; `None` when each of them has a worker that can take it.
pub fn shortfall(
    tenant: &Tenant,
    needs: impl Iterator<Item = Requirements>,
    peers: &[WorkerProfile],
) -> Option<Shortfall> {
    let mut of_workers = needs.filter(|need| !need.task.stage.is_own());
    of_workers.find_map(|need| Shortfall::of(tenant, need, peers))
}

/// The shortfall of a job with its start, recorded now if it is new: repeated calls return the same start.
pub fn noted(shared: &State, job: &JobId, shortfall: Shortfall) -> Gap {
    let mut gaps = shared.gaps.lock().unwrap_or_else(PoisonError::into_inner);
    let since_ms = match gaps.get(job) {
        Some(gap) => gap.since_ms,
        None => log_start(job, &shortfall, shared.clock.now_ms()),
    };
    let gap = Gap { shortfall, since_ms };
    gaps.insert(job.clone(), gap.clone());
    gap
}

/// Logs that a job begins to wait, and returns the time.
fn log_start(job: &JobId, shortfall: &Shortfall, now_ms: u64) -> u64 {
    tracing::warn!(%job, %shortfall, "a job waits for workers");
    now_ms
}

/// Checks all ready tasks, records which jobs wait, and fails those that have waited too long for memory.
///
/// # Errors
/// When the store fails.
pub async fn look(shared: &State) -> Result<(), StoreError> {
    let (now_ms, peers) = (shared.clock.now_ms(), shared.workers.peers());
    let mut needs = HashMap::<JobId, (Tenant, Vec<Requirements>)>::new();
    for ready in shared.jobs.ready().await? {
        if ready.not_before_ms <= now_ms {
            needs.entry(ready.job).or_insert((ready.tenant, Vec::new())).1.push(ready.need);
        }
    }
    let mut over = Vec::new();
    {
        let mut gaps = shared.gaps.lock().unwrap_or_else(PoisonError::into_inner);
        let before = std::mem::take(&mut *gaps);
        for (job, (tenant, needs)) in needs {
            let Some(shortfall) = shortfall(&tenant, needs.into_iter(), &peers) else { continue };
            let since_ms = match before.get(&job) {
                Some(gap) => gap.since_ms,
                None => log_start(&job, &shortfall, now_ms),
            };
            let (waited_ms, limit_ms) =
                (now_ms.saturating_sub(since_ms), u64::from(shared.capacity_timeout_ms));
            if limit_ms > 0 && waited_ms >= limit_ms && matches!(shortfall, Shortfall::Memory { .. }) {
                over.push((job.clone(), shortfall.to_string()));
            }
            gaps.insert(job, Gap { shortfall, since_ms });
        }
    }
    for (job, reason) in over {
        match shared.jobs.apply(&job, Event::GiveUp { reason }, now_ms).await {
            // An error here means that it has ended or was deleted since the check.
            Ok(_) | Err(StoreError::Refused(_) | StoreError::JobNotFound(_)) => shared.wakeups.interrupted(),
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
