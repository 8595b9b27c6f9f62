//! Acts: takes the coordinator's own tasks, and takes back the leases of silent workers.
//!
//! Own tasks have leases as all others. When the process is killed in one, the next process releases it
//! (`Store::recover`) and does it again from its beginning: planning and merging have no state of their own, nor have the
//! choice of cameras and the consensus.

use std::sync::Arc;
use std::time::Duration;

use fathom_observe::{attempt_span, capture};
use tokio::sync::watch;
use tokio::time::Instant;
use tracing::{Instrument, Level};
use uuid::Uuid;

use crate::objects::ObjectError;
use crate::schedule::{Event, Expired, FailClass, Peer, Renewed, TaskId, TaskKind, TaskOutput};
use crate::services::{Shared, capacity, logs, stopped};
use crate::store::{Claim, Grant, StoreError};
use crate::{artifacts, consensus, pipeline, select};

/// Own tasks that run at the same time: a long merge must not keep another job from being planned.
const OWN_TASKS_AT_ONCE: usize = 2;
/// The launcher looks at least so often; pauses end without any change that would wake it.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Why one of the coordinator's own tasks failed.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct OwnTaskError {
    /// What follows from it.
    pub class: FailClass,
    /// What happened, and what helps.
    pub message: String,
    /// Tasks whose results are not what they handed in: they are done again, and then this one.
    pub lost: Vec<TaskId>,
}

impl OwnTaskError {
    /// The job's input is at fault: trying again is of no use.
    pub fn input(message: String) -> Self {
        Self { class: FailClass::Input, message, lost: Vec::new() }
    }

    /// Something else is: it is tried again.
    pub fn failed(message: String) -> Self {
        Self { class: FailClass::Training, message, lost: Vec::new() }
    }

    /// The results of other tasks are damaged.
    pub fn lost(lost: Vec<TaskId>, message: String) -> Self {
        Self { class: FailClass::Environment, message, lost }
    }
}

impl From<ObjectError> for OwnTaskError {
    fn from(error: ObjectError) -> Self {
        match error {
            ObjectError::NotFound(_) | ObjectError::BadDigest(_) | ObjectError::TooLarge { .. } => {
                Self::input(error.to_string())
            }
            _ => Self { class: FailClass::Environment, message: error.to_string(), lost: Vec::new() },
        }
    }
}

/// Takes own tasks until the coordinator stops.
pub async fn run_own_tasks(shared: Arc<Shared>) {
    let incarnation = Uuid::new_v4().to_string();
    let lanes = (0..OWN_TASKS_AT_ONCE).map(|_| run_lane(Arc::clone(&shared), incarnation.clone()));
    futures::future::join_all(lanes).await;
}

async fn run_lane(shared: Arc<Shared>, incarnation: String) {
    let mut changes = shared.work.subscribe();
    let mut stopping = shared.stopping.clone();
    while !*stopping.borrow_and_update() {
        changes.mark_unchanged();
        let worker = Peer {
            name: "coordinator".into(),
            incarnation: incarnation.clone(),
            kinds: TaskKind::OWN.to_vec(),
            memory_bytes: None,
            tenant: None,
        };
        let claim = Claim { worker, peers: Arc::default(), request_id: Uuid::new_v4().to_string() };
        match shared.store.claim(&claim, shared.clock.now_ms()).await {
            Ok(Some(grant)) => {
                shared.changed();
                let lease = &grant.lease;
                let span =
                    attempt_span(lease.job.as_str(), &lease.task.to_string(), lease.attempt, "coordinator");
                capture::attach(&span, shared.own_lines.sink(lease.clone()));
                run_task(&shared, grant, &mut stopping).instrument(span).await;
                continue;
            }
            Ok(None) => {}
            // A failed store ends the server; see `sweep_leases`.
            Err(error) => tracing::error!(%error, "own tasks cannot be claimed"),
        }
        tokio::select! {
            biased;
            _ = stopping.changed() => {}
            _ = changes.changed() => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
}

/// Does one own task and keeps its lease alive meanwhile.
async fn run_task(shared: &Shared, grant: Grant, stopping: &mut watch::Receiver<bool>) {
    let lease = grant.lease.clone();
    let mut renewals = tokio::time::interval(Duration::from_millis(u64::from(shared.lease_ms / 4).max(1)));
    let begin = Instant::now();
    tracing::info!("task taken");
    let work = execute(shared, &grant);
    tokio::pin!(work);
    let result = loop {
        tokio::select! {
            biased;
            result = &mut work => break result,
            _ = renewals.tick() => {
                if let Ok(Renewed::Over) = shared.store.renew(&lease, None, shared.clock.now_ms()).await {
                    tracing::warn!("the lease is over; the work is thrown away");
                    return;
                }
            }
            // The next process does it again.
            () = stopped(stopping) => return,
        }
    };
    let now_ms = shared.clock.now_ms();
    let answer = match result {
        Ok(output) => {
            tracing::info!(seconds = begin.elapsed().as_secs_f64(), "task done");
            shared.store.complete(&lease, output, now_ms).await
        }
        Err(OwnTaskError { message, lost, .. }) if !lost.is_empty() => {
            tracing::error!(%message, "results are damaged and made again");
            let event = Event::ResultsLost { lease: lease.clone(), tasks: lost, message };
            shared.store.apply(&lease.job, event, now_ms).await
        }
        Err(OwnTaskError { class, message, .. }) => {
            tracing::warn!(?class, %message, "own task failed");
            shared.store.fail(&lease, class, message, now_ms).await
        }
    };
    if let Err(error) = answer {
        tracing::warn!(%error, "the end of an own task was refused");
    }
    shared.changed();
}

async fn execute(shared: &Shared, grant: &Grant) -> Result<TaskOutput, OwnTaskError> {
    let view = shared.store.job(&grant.lease.job).await.map_err(|e| OwnTaskError::failed(e.to_string()))?;
    let objects = shared.objects.of(&view.job.tenant)?;
    match grant.lease.task.kind() {
        TaskKind::Plan => pipeline::plan_job(&objects, &view.job, shared.connected(&view.job.tenant)).await,
        TaskKind::Select => select::choose(&objects, &view).await,
        TaskKind::Consensus => consensus::find(&objects, &view).await,
        TaskKind::Merge => pipeline::merge_job(&objects, &view, &grant.lease).await,
        TaskKind::Artifacts => artifacts::assemble(&objects, &view).await,
        kind @ (TaskKind::Global
        | TaskKind::Refine
        | TaskKind::Partition
        | TaskKind::Borders
        | TaskKind::Evaluate) => Err(OwnTaskError::failed(format!("{kind:?} is a worker's task"))),
    }
}

/// Takes back the leases of silent workers until the coordinator stops.
///
/// # Errors
/// When the store fails: what is not durable must not be acknowledged, so the process has to end.
pub async fn sweep_leases(shared: Arc<Shared>) -> Result<(), StoreError> {
    let lease = Duration::from_millis(shared.lease_ms.into());
    let every = (lease / 20).clamp(LOOK_EVERY / 5, LOOK_EVERY * 4);
    let mut stopping = shared.stopping.clone();
    let (mut looked, mut waits_until) = (Instant::now(), Instant::now());
    loop {
        tokio::select! {
            biased;
            () = stopped(&mut stopping) => return Ok(()),
            () = tokio::time::sleep(every) => {}
        }
        if let Some(failure) = shared.store.failure() {
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
        let taken_back = shared.store.sweep(shared.clock.now_ms()).await?;
        for (lease, why) in &taken_back {
            let why = match why {
                Expired::Silent => "its worker fell silent",
                Expired::Stalled => "its worker comes no further",
            };
            tracing::warn!(job = %lease.job, task = %lease.task, attempt = lease.attempt, fence = lease.fence, why, "lease taken back");
            logs::note(&shared, lease, Level::WARN, &format!("the lease was taken back: {why}"));
        }
        if !taken_back.is_empty() {
            shared.interrupted();
        }
        shared.forget_silent_workers();
        capacity::look(&shared).await?;
    }
}
