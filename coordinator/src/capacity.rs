//! Jobs that no connected worker can go on with: what is lacking, and since when.
//!
//! A job waits as long as its user likes, but never without saying why. Kept in memory: after a restart a job waits since
//! then.

use std::collections::HashMap;
use std::sync::PoisonError;

use crate::schedule::{Event, JobId, Lack, Need, Peer, Tenant};
use crate::state::State;
use crate::store::StoreError;

/// What a job waits for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// What is lacking.
    pub lack: Lack,
    /// Since when it is, Unix milliseconds.
    pub since_ms: u64,
}

/// What is lacking for the tasks of one job that are ready; `None` when each of them has a worker that can take it.
pub fn lack(tenant: &Tenant, needs: impl Iterator<Item = Need>, peers: &[Peer]) -> Option<Lack> {
    let mut of_workers = needs.filter(|need| !need.task.stage.is_own());
    of_workers.find_map(|need| Lack::of(tenant, need, peers))
}

/// What a job lacks, and since when, as it is noted now if it was not before: who asks twice must not hear of two beginnings.
pub fn noted(shared: &State, job: &JobId, lack: Lack) -> Gap {
    let mut gaps = shared.gaps.lock().unwrap_or_else(PoisonError::into_inner);
    let since_ms = match gaps.get(job) {
        Some(gap) => gap.since_ms,
        None => begin(job, &lack, shared.clock.now_ms()),
    };
    let gap = Gap { lack, since_ms };
    gaps.insert(job.clone(), gap.clone());
    gap
}

/// Says in the log that a job begins to wait.
fn begin(job: &JobId, lack: &Lack, now_ms: u64) -> u64 {
    tracing::warn!(%job, %lack, "a job waits");
    now_ms
}

/// Looks at all ready tasks, notes which jobs wait, and gives up those that have waited too long for memory.
///
/// # Errors
/// When the store fails.
pub async fn look(shared: &State) -> Result<(), StoreError> {
    let (now_ms, peers) = (shared.clock.now_ms(), shared.workers.peers());
    let mut needs = HashMap::<JobId, (Tenant, Vec<Need>)>::new();
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
            let Some(lack) = lack(&tenant, needs.into_iter(), &peers) else { continue };
            let since_ms = match before.get(&job) {
                Some(gap) => gap.since_ms,
                None => begin(&job, &lack, now_ms),
            };
            let (waited_ms, limit_ms) =
                (now_ms.saturating_sub(since_ms), u64::from(shared.capacity_timeout_ms));
            if limit_ms > 0 && waited_ms >= limit_ms && matches!(lack, Lack::Memory { .. }) {
                over.push((job.clone(), lack.to_string()));
            }
            gaps.insert(job, Gap { lack, since_ms });
        }
    }
    for (job, reason) in over {
        match shared.jobs.apply(&job, Event::GiveUp { reason }, now_ms).await {
            // It ended, or was deleted, since we looked.
            Ok(_) | Err(StoreError::Refused(_) | StoreError::JobNotFound(_)) => shared.wakeups.interrupted(),
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
