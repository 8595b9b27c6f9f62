//! Events of a job and their outcomes: the vocabulary of stores, services and rules.

use std::collections::BTreeMap;
use std::sync::Arc;

use fathom_core::config::Method;
use fathom_core::scene::BlobRef;
use serde::{Deserialize, Serialize};

use super::fit::WorkerProfile;
use super::job::JobState;
use super::task::{Lease, TaskStats};
use super::{Artifact, Stage, TaskId};

/// Why an attempt failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailClass {
    /// No worker can use the input: the task is dead at once.
    Input,
    /// Training failed.
    Training,
    /// The GPU memory, or the worker's limit on it, is too small.
    OutOfMemory,
    /// The GPU failed or was lost.
    Device,
    /// The worker's environment failed: counts as a lost worker.
    Environment,
}

/// A task of a plan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlannedTask {
    /// Its specification; `None` for the coordinator's own tasks.
    pub spec: Option<BlobRef>,
    /// Iterations of its training; 0 where nothing is trained.
    pub iterations: u32,
    /// The method of its job.
    pub method: Method,
    /// The plan's forecast of its GPU memory, bytes; 0 where there is none.
    pub memory_bytes: u64,
}

/// The tasks of a plan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planned {
    /// By name: all tasks of all later stages.
    pub tasks: BTreeMap<TaskId, PlannedTask>,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// The output of a task.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TaskOutput {
    /// Its artifacts, from the outputs of its stage.
    pub made: BTreeMap<Artifact, BlobRef>,
    /// Its statistics.
    pub stats: TaskStats,
    /// The planned tasks; only for a plan.
    pub planned: Option<Planned>,
}

impl Planned {
    /// Number of partitions.
    pub fn partitions(&self) -> u32 {
        self.tasks.keys().filter(|task| task.stage == Stage::Partition).count() as u32
    }

    /// Number of tasks that evaluate a part of the held-out views each.
    pub fn evaluations(&self) -> u32 {
        let is_part = |task: &&TaskId| task.stage == Stage::Evaluate && task.part.is_some();
        self.tasks.keys().filter(is_part).count() as u32
    }
}

impl PlannedTask {
    /// A task with this specification and number of iterations.
    pub fn new(spec: BlobRef, iterations: u32) -> Self {
        Self { spec: Some(spec), iterations, method: Method::default(), memory_bytes: 0 }
    }
}

impl TaskOutput {
    /// The output of a plan.
    pub fn planned(plan: BlobRef, picture: BlobRef, planned: Planned) -> Self {
        let made = BTreeMap::from([(Artifact::Plan, plan), (Artifact::PlanPicture, picture)]);
        Self { made, stats: TaskStats::default(), planned: Some(planned) }
    }

    /// The output of a merge.
    pub fn merged(model: BlobRef, report: BlobRef, stats: TaskStats) -> Self {
        let made = BTreeMap::from([(Artifact::Model, model), (Artifact::MergeReport, report)]);
        Self { made, stats, planned: None }
    }

    /// The output of a task of `stage` whose result is its only artifact.
    pub fn of(stage: Stage, result: BlobRef, stats: TaskStats) -> Self {
        Self { made: BTreeMap::from([(stage.result(), result)]), stats, planned: None }
    }
}

/// Why a lease is revoked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Expired {
    /// Its holder did not renew it.
    Silent,
    /// Its holder renews it but reports no progress.
    Stalled,
}

/// An event of a job.
#[derive(Clone, Debug)]
pub enum Event {
    /// A worker takes a ready task, or starts a second attempt at a slow one.
    Claim {
        /// The task.
        task: TaskId,
        /// The worker.
        worker: WorkerProfile,
        /// All workers that are connected.
        peers: Arc<[WorkerProfile]>,
        /// The id of the call.
        request_id: String,
        /// A new number, larger than all earlier fences.
        fence: u64,
        /// Whether it is a second attempt beside a slow worker.
        is_second: bool,
    },
    /// A checkpoint has been uploaded.
    Checkpoint {
        /// The lease.
        lease: Lease,
        /// The bytes.
        blob: BlobRef,
        /// Iterations done in it.
        iteration: u32,
    },
    /// A result has been uploaded.
    Complete {
        /// The lease.
        lease: Lease,
        /// The result.
        output: TaskOutput,
    },
    /// An attempt failed.
    Fail {
        /// The lease.
        lease: Lease,
        /// The class of the failure.
        class: FailClass,
        /// The error.
        message: String,
    },
    /// A worker gives a task back.
    Release {
        /// The lease.
        lease: Lease,
        /// The reason.
        reason: String,
    },
    /// The holder of a lease stopped renewing, or makes no progress.
    Expire {
        /// The lease.
        lease: Lease,
        /// The reason.
        why: Expired,
    },
    /// The holder of a lease cannot use results of earlier tasks: they are missing or damaged.
    ResultsLost {
        /// The lease.
        lease: Lease,
        /// The tasks, all of one stage.
        tasks: Vec<TaskId>,
        /// The fault.
        message: String,
    },
    /// No worker can continue the job, and the wait for one is over.
    GiveUp {
        /// The shortfall.
        reason: String,
    },
    /// The user stops the job.
    Cancel {
        /// The reason.
        reason: String,
    },
    /// The user pauses the job.
    Pause {
        /// The reason.
        reason: String,
    },
    /// The user resumes a paused job.
    Resume,
    /// The user retries a failed job.
    Retry,
    /// A coordinator is about to tell the webhook of the job's end.
    Announce {
        /// [`super::JobRecord::ended_ms`] of that end.
        ended_ms: u64,
        /// The time in [`super::Announcement::Due`] that the coordinator knows.
        known_ms: u64,
        /// No other coordinator does before this time, Unix milliseconds.
        until_ms: u64,
    },
    /// The webhook knows of the job's end.
    Announced {
        /// As above.
        ended_ms: u64,
    },
    /// The user changes settings of the job.
    Update {
        /// See [`super::JobRecord::priority`]; `None` keeps the current value.
        priority: Option<i32>,
        /// See [`super::JobRecord::max_parallel`]; `None` keeps the current value.
        max_parallel: Option<u32>,
    },
}

/// Events for watchers; durable.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventBody {
    /// The job was created, paused, resumed, retried, or ended.
    JobState {
        /// The new state.
        state: JobState,
        /// The reason.
        message: String,
    },
    /// The settings of the job were changed.
    Updated {
        /// See [`super::JobRecord::priority`].
        priority: i32,
        /// See [`super::JobRecord::max_parallel`].
        max_parallel: u32,
    },
    /// The job entered another stage.
    Stage {
        /// The new stage.
        stage: Stage,
        /// Its tasks.
        tasks: u32,
    },
    /// A task was leased, requeued or ended.
    Task {
        /// The task.
        task: TaskId,
        /// The new state.
        state: TaskChange,
        /// The attempt.
        attempt: u32,
        /// The worker that holds or held the lease.
        worker: String,
        /// The reason.
        message: String,
        /// Iteration at which a leased attempt begins.
        resumed_from: u32,
    },
    /// A checkpoint is durable.
    Checkpoint {
        /// Its task.
        task: TaskId,
        /// The attempt that wrote it.
        attempt: u32,
        /// Iterations done in it.
        iteration: u32,
    },
    /// A warning for the user.
    Warning {
        /// One sentence.
        message: String,
    },
}

/// States of a task that have events.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the states of TaskState")]
pub enum TaskChange {
    Ready,
    Leased,
    Done,
    Dead,
}

/// The outcome of an event that was not refused.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The rows changed; the events are for watchers.
    Changed(Vec<EventBody>),
    /// The event had been applied before; nothing changed.
    Already,
}

/// Why an event is refused; it changes nothing.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// The lease is over, or never was.
    #[error("{task}: fence {given} is stale, the latest is {latest}; stop this work and discard it")]
    StaleFence {
        /// The task.
        task: TaskId,
        /// The fence given.
        given: u64,
        /// The latest fence granted.
        latest: u64,
    },
    /// The job has ended.
    #[error("the job has ended: it accepts no more work, and cannot be paused, resumed or changed")]
    JobEnded,
    /// The job is paused by its user.
    #[error("the job is paused")]
    JobPaused,
    /// The job has reached its limit of leased tasks.
    #[error("{0} tasks of the job are running, which is its limit")]
    AtItsLimit(u32),
    /// Only failed jobs can be retried.
    #[error("the job has {0}; only failed jobs can be retried")]
    NotFailed(&'static str),
    /// A job that has not ended cannot be deleted.
    #[error("the job has not ended; cancel it before you delete it")]
    NotEnded,
    /// The job has no such task.
    #[error("the job has no task {0}")]
    NoSuchTask(TaskId),
    /// The worker may not take the task.
    #[error("this worker may not take {0}: another one has more memory, or has not failed it yet")]
    Unfit(TaskId),
    /// Another worker was faster, or its back-off is not over.
    #[error("{0} is not ready")]
    NotReady(TaskId),
    /// Two different results arrived under one fence.
    #[error("{0} already has another result under this fence")]
    OtherResult(TaskId),
    /// A result of the wrong kind.
    #[error("this is not a result of {0}")]
    WrongOutput(TaskId),
}
