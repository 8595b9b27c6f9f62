//! Takes back the leases of silent workers, and notes what jobs lack.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;
use tracing::Level;

use crate::capacity;
use crate::schedule::Expired;
use crate::services::logs;
use crate::state::{State, stopped};
use crate::store::StoreError;

/// Shortest and longest pause between two looks at the leases.
const LOOK_EVERY: [Duration; 2] = [Duration::from_millis(50), Duration::from_millis(1000)];

/// Takes back the leases of silent workers until the coordinator stops.
///
/// # Errors
/// When the store fails: what is not durable must not be acknowledged, so the process has to end.
pub async fn sweep_leases(shared: Arc<State>) -> Result<(), StoreError> {
    let lease = Duration::from_millis(shared.lease_ms.into());
    let every = (lease / 20).clamp(LOOK_EVERY[0], LOOK_EVERY[1]);
    let mut stopping = shared.stopping.clone();
    let (mut looked, mut waits_until) = (Instant::now(), Instant::now());
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
        if now - looked > every + lease / 2 {
            // Whoever lives could not be heard while this process stood still, so all have a period to be heard again.
            tracing::warn!(
                seconds = (now - looked).as_secs_f64(),
                "stood still; no lease is taken back for a period"
            );
            waits_until = now + lease;
        }
        looked = now;
        if now < waits_until {
            continue;
        }
        let taken_back = shared.jobs.sweep(shared.clock.now_ms()).await?;
        for (lease, why) in &taken_back {
            let why = match why {
                Expired::Silent => "its worker fell silent",
                Expired::Stalled => "its worker comes no further",
            };
            tracing::warn!(job = %lease.job, task = %lease.task, attempt = lease.attempt, fence = lease.fence, why, "lease taken back");
            logs::note(&shared, lease, Level::WARN, &format!("the lease was taken back: {why}"));
        }
        if !taken_back.is_empty() {
            shared.wakeups.interrupted();
        }
        shared.workers.forget_silent();
        capacity::look(&shared).await?;
    }
}
