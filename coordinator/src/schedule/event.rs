//! What may happen to a job, and what comes of it: the words between stores, services and the rules.

use std::collections::BTreeMap;
use std::sync::Arc;

use fathom_core::scene::BlobRef;
use serde::{Deserialize, Serialize};

use super::fit::Peer;
use super::job::JobState;
use super::task::{Lease, TaskStats};
use super::{Artifact, Stage, TaskId};

/// Why an attempt failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailClass {
    /// The input cannot be used by anybody: the task is dead at once.
    Input,
    /// Training failed.
    Training,
    /// The GPU's memory, or what of it the worker may take, is too small.
    OutOfMemory,
    /// The GPU failed or was lost.
    Device,
    /// The worker's surroundings failed: counts as a lost worker.
    Environment,
}

/// A task of a plan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlannedTask {
    /// What exactly to do; `None` for the coordinator's own tasks.
    pub spec: Option<BlobRef>,
    /// Iterations of its training; 0 where nothing is trained.
    pub iterations: u32,
    /// GPU memory that it will need by the plan's forecast, bytes; 0 where there is none.
    pub memory_bytes: u64,
}

/// The tasks that a plan gives a job, or those that the selection of cameras gives anew.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planned {
    /// By name. A plan has all tasks of all later stages; the selection of cameras those of the partitions.
    pub tasks: BTreeMap<TaskId, PlannedTask>,
    /// What the user should know.
    pub warnings: Vec<String>,
}

/// What a task gave.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TaskOutput {
    /// What it made, of the outputs of its stage.
    pub made: BTreeMap<Artifact, BlobRef>,
    /// How it went.
    pub stats: TaskStats,
    /// The tasks that follow from it; of a plan and of a selection of cameras.
    pub planned: Option<Planned>,
}

impl Planned {
    /// Number of partitions.
    pub fn partitions(&self) -> u32 {
        self.tasks.keys().filter(|task| task.stage == Stage::Partition).count() as u32
    }
}

impl PlannedTask {
    /// A task with this specification and so many iterations.
    pub fn new(spec: BlobRef, iterations: u32) -> Self {
        Self { spec: Some(spec), iterations, memory_bytes: 0 }
    }
}

impl TaskOutput {
    /// Of a plan, or of a selection of cameras, which makes the plan anew.
    pub fn planned(plan: BlobRef, picture: BlobRef, planned: Planned) -> Self {
        let made = BTreeMap::from([(Artifact::Plan, plan), (Artifact::PlanPicture, picture)]);
        Self { made, stats: TaskStats::default(), planned: Some(planned) }
    }

    /// Of a merge.
    pub fn merged(model: BlobRef, report: BlobRef, stats: TaskStats) -> Self {
        let made = BTreeMap::from([(Artifact::Model, model), (Artifact::MergeReport, report)]);
        Self { made, stats, planned: None }
    }

    /// Of a task of `stage` that made one thing, its result.
    pub fn of(stage: Stage, result: BlobRef, stats: TaskStats) -> Self {
        Self { made: BTreeMap::from([(stage.result(), result)]), stats, planned: None }
    }
}

/// Why a lease is taken back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Expired {
    /// Its holder did not renew it.
    Silent,
    /// Its holder renews it and reports no progress.
    Stalled,
}

/// Something that happens to a job.
#[derive(Clone, Debug)]
pub enum Event {
    /// A worker takes a ready task, or one that another is slow with.
    Claim {
        /// Which.
        task: TaskId,
        /// By whom.
        worker: Peer,
        /// All workers that are connected.
        peers: Arc<[Peer]>,
        /// The id of the call.
        request_id: String,
        /// A number that no lease had before.
        fence: u64,
        /// Whether it is taken beside the worker that has it, which is slow.
        beside: bool,
    },
    /// A checkpoint has been uploaded.
    Checkpoint {
        /// By whom.
        lease: Lease,
        /// The bytes.
        blob: BlobRef,
        /// Iterations done in it.
        iteration: u32,
    },
    /// A result has been uploaded.
    Complete {
        /// By whom.
        lease: Lease,
        /// The result.
        output: TaskOutput,
    },
    /// An attempt failed.
    Fail {
        /// Whose.
        lease: Lease,
        /// How.
        class: FailClass,
        /// What happened.
        message: String,
    },
    /// A worker gives a task back.
    Release {
        /// Whose.
        lease: Lease,
        /// Why.
        reason: String,
    },
    /// The holder of a lease fell silent, or came no further.
    Expire {
        /// Whose.
        lease: Lease,
        /// Why.
        why: Expired,
    },
    /// The holder of a lease cannot use what tasks before it handed in: it is not there, or not what it was.
    ResultsLost {
        /// Whose.
        lease: Lease,
        /// Which tasks, all of one stage.
        tasks: Vec<TaskId>,
        /// What it found.
        message: String,
    },
    /// No worker can go on with the job, and none is waited for any longer.
    GiveUp {
        /// What is lacking.
        reason: String,
    },
    /// The user stops the job.
    Cancel {
        /// Why.
        reason: String,
    },
    /// The user holds the job.
    Pause {
        /// Why.
        reason: String,
    },
    /// The user goes on with a paused job.
    Resume,
    /// The user goes on with a failed job.
    Retry,
    /// The user changes what may change.
    Update {
        /// See [`super::JobRecord::priority`]; `None` leaves it.
        priority: Option<i32>,
        /// See [`super::JobRecord::max_parallel`]; `None` leaves it.
        max_parallel: Option<u32>,
    },
}

/// What watchers are told; durable.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventBody {
    /// The job was created, paused, resumed, tried again or ended.
    JobState {
        /// The new state.
        state: JobState,
        /// Why.
        message: String,
    },
    /// What of the job may change was changed.
    Updated {
        /// See [`super::JobRecord::priority`].
        priority: i32,
        /// See [`super::JobRecord::max_parallel`].
        max_parallel: u32,
    },
    /// The job went on.
    Stage {
        /// The new stage.
        stage: Stage,
        /// Its tasks.
        tasks: u32,
    },
    /// A task was leased, came back or ended.
    Task {
        /// Which.
        task: TaskId,
        /// The new state's name.
        state: TaskChange,
        /// The attempt.
        attempt: u32,
        /// Who holds or held the lease.
        worker: String,
        /// Why.
        message: String,
        /// Iteration at which a leased attempt begins.
        resumed_from: u32,
    },
    /// A checkpoint is safe.
    Checkpoint {
        /// Of which task.
        task: TaskId,
        /// By which attempt.
        attempt: u32,
        /// Iterations done in it.
        iteration: u32,
    },
    /// Something that the user should know.
    Warning {
        /// One sentence.
        message: String,
    },
}

/// States that a task's change is told of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the states of TaskState")]
pub enum TaskChange {
    Ready,
    Leased,
    Done,
    Dead,
}

/// An event that was not refused.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The rows changed; watchers are to be told.
    Changed(Vec<EventBody>),
    /// The event had been applied before; nothing changed.
    Already,
}

/// An event that changes nothing because it may not.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// The lease is over, or never was.
    #[error("{task}: fence {given} is stale, the latest is {latest}; stop this work and throw it away")]
    StaleFence {
        /// Which task.
        task: TaskId,
        /// The fence that came.
        given: u64,
        /// The latest that was granted.
        latest: u64,
    },
    /// The job has ended.
    #[error("the job has ended: it takes no more work, and can be neither paused, resumed nor changed")]
    JobEnded,
    /// The job is held by its user.
    #[error("the job is paused")]
    JobPaused,
    /// As many tasks of the job are leased as it may have.
    #[error("{0} tasks of the job are worked on, which is as many as it may have")]
    AtItsLimit(u32),
    /// A job that did not fail is not tried again.
    #[error("the job has {0}; only failed jobs are tried again")]
    NotFailed(&'static str),
    /// A job that may still come to a result is not forgotten.
    #[error("the job has not ended; cancel it before it is deleted")]
    NotEnded,
    /// The job has no such task.
    #[error("the job has no task {0}")]
    NoSuchTask(TaskId),
    /// A worker that may not have it.
    #[error("this worker may not take {0}: another one has more memory, or has not failed it yet")]
    Unfit(TaskId),
    /// Somebody else was faster, or the pause is not over.
    #[error("{0} is not ready")]
    NotReady(TaskId),
    /// A result came twice under one fence, and they differ.
    #[error("{0} has another result under this fence already")]
    OtherResult(TaskId),
    /// A result that such a task cannot have.
    #[error("this is not a result of {0}")]
    WrongOutput(TaskId),
}
