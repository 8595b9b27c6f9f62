//! The coordinator's own tasks, one file each: `plan`, `exchange`, `merge`, `artifacts`.
//!
//! They have leases like all others. When the process is killed during one, the next process releases it
//! (`Store::recover`) and runs it again from its beginning. Each is a function of its job's input and of
//! committed results alone.

pub mod artifacts;
mod error;
pub mod evaluation;
pub mod exchange;
pub mod input;
mod merge;
pub mod plan;
mod sets;
mod viewing_copy;

use std::sync::Arc;
use std::time::Duration;

use fathom_observe::{attempt_span, capture};
use tokio::sync::watch;
use tokio::time::Instant;
use tracing::Instrument;
use uuid::Uuid;

use crate::schedule::{Event, Renewed, Stage, TaskOutput, WorkerProfile};
use crate::state::{State, stopped};
use crate::store::{Claim, Grant, StoreError};
pub use error::OwnTaskError;

/// Maximum concurrent own tasks: a long merge must not delay the plan of another job.
const OWN_TASKS_AT_ONCE: usize = 2;
/// Longest interval between checks: the end of a back-off wakes no one.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Longest pause before a task that a bucket's outage interrupted begins again; each request has been tried
/// for some seconds before.
const LONGEST_PAUSE: Duration = Duration::from_secs(15);

/// Claims and runs own tasks until the coordinator stops.
pub async fn run_own_tasks(shared: Arc<State>) {
    let incarnation = Uuid::new_v4().to_string();
    let lanes = (0..OWN_TASKS_AT_ONCE).map(|_| run_lane(Arc::clone(&shared), incarnation.clone()));
    futures::future::join_all(lanes).await;
}

async fn run_lane(shared: Arc<State>, incarnation: String) {
    let mut changes = shared.wakeups.work.subscribe();
    let mut stopping = shared.stopping.clone();
    while !*stopping.borrow_and_update() {
        changes.mark_unchanged();
        let worker = WorkerProfile {
            name: "coordinator".into(),
            incarnation: incarnation.clone(),
            stages: Stage::own(),
            methods: fathom_core::config::Method::ALL.to_vec(),
            memory_bytes: None,
            tenant: None,
        };
        let claim = Claim { worker, peers: Arc::default(), request_id: Uuid::new_v4().to_string() };
        match shared.jobs.claim(&claim, shared.clock.now_ms()).await {
            Ok(Some(grant)) => {
                shared.wakeups.changed();
                let lease = &grant.lease;
                let span =
                    attempt_span(lease.job.as_str(), &lease.task.to_string(), lease.attempt, "coordinator");
                capture::attach(&span, shared.own_lines.sink(lease.clone()));
                run_task(&shared, grant, &mut stopping).instrument(span).await;
                continue;
            }
            Ok(None) => {}
            // The sweeper reports it, four times a second would be too often.
            Err(StoreError::Unavailable(_)) => {}
            // A failed store ends the server; see `sweep_leases`.
            Err(error) => tracing::error!(%error, "cannot claim own tasks"),
        }
        tokio::select! {
            biased;
            _ = stopping.changed() => {}
            _ = changes.changed() => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
}

/// Runs one own task and renews its lease meanwhile.
async fn run_task(shared: &State, grant: Grant, stopping: &mut watch::Receiver<bool>) {
    let lease = grant.lease.clone();
    let mut renewals = tokio::time::interval(Duration::from_millis(u64::from(shared.lease_ms / 4).max(1)));
    let begin = Instant::now();
    tracing::info!("task taken");
    let work = execute_through_outages(shared, &grant);
    tokio::pin!(work);
    let result = loop {
        tokio::select! {
            biased;
            result = &mut work => break result,
            _ = renewals.tick() => {
                if let Ok(Renewed::Over) = shared.jobs.renew(&lease, None, shared.clock.now_ms()).await {
                    tracing::warn!("the lease is over; discarding the work");
                    return;
                }
            }
            () = stopped(stopping) => {
                // Otherwise the next process would wait for the end of the lease.
                let reason = "the coordinator stops".to_owned();
                if let Err(error) = shared.jobs.release(&lease, reason, shared.clock.now_ms()).await {
                    tracing::debug!(%error, "the next process finds the lease of an own task");
                }
                return;
            }
        }
    };
    let event = match result {
        Ok(output) => {
            tracing::info!(seconds = begin.elapsed().as_secs_f64(), "task done");
            Event::Complete { lease: lease.clone(), output }
        }
        Err(OwnTaskError { message, lost, .. }) if !lost.is_empty() => {
            tracing::error!(%message, "results are damaged; their tasks are requeued");
            Event::ResultsLost { lease: lease.clone(), tasks: lost, message }
        }
        Err(OwnTaskError { class, message, .. }) => {
            tracing::warn!(?class, %message, "own task failed");
            Event::Fail { lease: lease.clone(), class, message }
        }
    };
    let answer = loop {
        let applied = shared.jobs.apply(&lease.job, event.clone(), shared.clock.now_ms()).await;
        // A merge may have taken hours. Leases are extended when the database is available again.
        if !matches!(applied, Err(StoreError::Unavailable(_))) {
            break applied;
        }
        tokio::select! {
            biased;
            () = stopped(stopping) => break applied,
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    };
    if let Err(error) = answer {
        tracing::warn!(%error, "could not report the end of an own task");
    }
    shared.wakeups.changed();
}

/// Runs a task, again when the bucket is available again: an outage is no failed attempt.
async fn execute_through_outages(shared: &State, grant: &Grant) -> Result<TaskOutput, OwnTaskError> {
    let mut pause = LOOK_EVERY;
    loop {
        let result = execute(shared, grant).await;
        let is_outage = match &result {
            Ok(_) => false,
            // In a bucket that is gone, nothing is found.
            Err(error) => error.is_outage || shared.objects.answers().await.is_err(),
        };
        match result {
            Err(error) if is_outage => {
                tracing::warn!(%error, seconds = pause.as_secs_f64(), "the task begins again after a pause");
                tokio::time::sleep(pause).await;
                pause = (pause * 2).min(LONGEST_PAUSE);
            }
            result => return result,
        }
    }
}

async fn execute(shared: &State, grant: &Grant) -> Result<TaskOutput, OwnTaskError> {
    let view = shared.jobs.job(&grant.lease.job).await.map_err(|e| OwnTaskError::failed(e.to_string()))?;
    let objects = shared.objects.of(&view.job.tenant).await?;
    match grant.lease.task.stage {
        Stage::Plan => plan::plan_job(&objects, &view.job, shared.workers.connected(&view.job.tenant)).await,
        Stage::Exchange => exchange::exchange_results(&objects, &view).await,
        Stage::Merge => merge::merge_job(&objects, &view, &grant.lease).await,
        Stage::Artifacts => artifacts::assemble(&objects, &view).await,
        stage => Err(OwnTaskError::failed(format!("{stage} is a stage of workers"))),
    }
}
