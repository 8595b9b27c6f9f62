//! Revokes the leases of silent workers, and records the shortfalls of jobs.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;
use tracing::Level;

use crate::capacity;
use crate::schedule::Expired;
use crate::services::logs;
use crate::state::{State, stopped};
use crate::store::StoreError;

/// Shortest and longest pause between two checks of the leases.
const LOOK_EVERY: [Duration; 2] = [Duration::from_millis(50), Duration::from_millis(1000)];

/// Revokes the leases of silent workers until the coordinator stops. While the database of the store is not
/// available, it waits.
///
/// # Errors
/// When the store fails: only durable changes may be acknowledged, so the process has to end.
pub async fn sweep_leases(shared: Arc<State>) -> Result<(), StoreError> {
    let lease = Duration::from_millis(shared.lease_ms.into());
    let every = (lease / 20).clamp(LOOK_EVERY[0], LOOK_EVERY[1]);
    let mut stopping = shared.stopping.clone();
    let (mut looked, mut waits_until) = (Instant::now(), Instant::now());
    let mut unavailable_since: Option<Instant> = None;
    loop {
        tokio::select! {
            biased;
            () = stopped(&mut stopping) => return Ok(()),
            () = tokio::time::sleep(every) => {}
        }
        if let Some(failure) = shared.jobs.failure() {
            return Err(StoreError::Failed(failure));
        }
        let now = Instant::now();
        if unavailable_since.is_none() && now - looked > every + lease / 2 {
            // Live workers could not renew while this process was suspended, so all of them get another
            // period.
            tracing::warn!(
                seconds = (now - looked).as_secs_f64(),
                "this process was suspended; leases are extended by one period"
            );
            waits_until = now + lease;
        }
        looked = now;
        if now < waits_until {
            continue;
        }
        let was_unavailable = unavailable_since.is_some();
        match sweep(&shared, was_unavailable).await {
            Ok(()) => {
                if let Some(since) = unavailable_since.take() {
                    let seconds = (Instant::now() - since).as_secs_f64();
                    tracing::warn!(
                        seconds,
                        "the database is available again; leases were extended by one period unless another coordinator had it"
                    );
                }
            }
            Err(StoreError::Unavailable(error)) => {
                if unavailable_since.is_none() {
                    unavailable_since = Some(now);
                    tracing::error!(%error, "the database is not available; calls are refused until it is");
                }
            }
            Err(error) => return Err(error),
        }
        // A call to a database that is gone takes long, and that is no suspension.
        if was_unavailable || unavailable_since.is_some() {
            looked = Instant::now();
        }
    }
}

/// `was_unavailable`: nobody could renew until now.
async fn sweep(shared: &State, was_unavailable: bool) -> Result<(), StoreError> {
    if was_unavailable {
        shared.jobs.extend_leases(shared.clock.now_ms()).await?;
    }
    let taken_back = shared.jobs.sweep(shared.clock.now_ms()).await?;
    for (lease, why) in &taken_back {
        let why = match why {
            Expired::Silent => "its worker stopped renewing",
            Expired::Stalled => "its worker makes no progress",
        };
        tracing::warn!(job = %lease.job, task = %lease.task, attempt = lease.attempt, fence = lease.fence, why, "lease expired");
        logs::note(shared, lease, Level::WARN, &format!("the lease was revoked: {why}"));
    }
    if !taken_back.is_empty() {
        shared.wakeups.interrupted();
    }
    shared.workers.forget_silent();
    capacity::look(shared).await
}
