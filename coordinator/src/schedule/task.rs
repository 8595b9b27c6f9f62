//! A task as it is stored.
//!
//! ```text
//!            stage reached        claim (fence = next, attempt + 1)       complete (fence matches)
//!  BLOCKED ───────────────► READY ────────────────────────────────► LEASED ───────────────────────► DONE
//!                             ▲ │                                    │ │ │ └─ checkpoint keeps LEASED
//!                             │ └── budgets spent ──► DEAD ◄─────────┘ │ │    input unusable
//!                             ├── released: nothing is counted ────────┘ │
//!                             ├── failed: errors + 1, pause ─────────────┤
//!                             └── lease expired: losses + 1, pause ──────┘
//!  from DONE: a disk has lost the result of a partition ──► READY, losses + 1; the merge that found it out ──► BLOCKED
//!  from LEASED, when it is slow: a second worker takes it too (fence = next, attempt + 1); of the two, the first result is the
//!  task's, and an attempt that ends without a result leaves the task to the other: nothing is counted
//!  from BLOCKED, READY, LEASED: the job ends ──► CANCELLED
//! ```
//!
//! Invariants: `fence` is the highest ever granted for this task. Only a message with the fence of a running
//! attempt changes the task. A result is committed once, unless it is lost.

use std::collections::BTreeMap;

use fathom_core::config::Method;
use fathom_core::scene::BlobRef;
use serde::{Deserialize, Serialize};

use super::{Artifact, JobId, TaskId};

/// The right to work on a task. It does not belong to a connection.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Lease {
    /// The job.
    pub job: JobId,
    /// The task.
    pub task: TaskId,
    /// The attempt, from 1.
    pub attempt: u32,
    /// Unique to this lease and larger than every earlier fence.
    pub fence: u64,
}

/// One attempt at a task.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Attempt {
    /// Display name of the worker.
    pub worker: String,
    /// Identifies its process.
    pub incarnation: String,
    /// The id of the call that claimed it; a repeated call gets the same lease.
    pub request_id: String,
    /// See [`Lease::attempt`].
    pub number: u32,
    /// See [`Lease::fence`].
    pub fence: u64,
    /// Since when, Unix milliseconds.
    pub since_ms: u64,
    /// Iteration of its initial checkpoint; 0 when there was none.
    pub resumed_from: u32,
    /// GPU memory that the worker may use, bytes; `None` if it reports none.
    pub memory_bytes: Option<u64>,
}

/// State of a task, with its data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskState {
    /// Waits for earlier stages.
    Blocked,
    /// Waits for a worker.
    Ready {
        /// Earliest time of a claim, Unix milliseconds.
        not_before_ms: u64,
    },
    /// A worker runs it; the record's `second` may run too.
    Leased(Attempt),
    /// Its result is committed.
    Done {
        /// The result.
        result: BlobRef,
        /// Statistics of the attempt.
        stats: TaskStats,
        /// From the claim to the result, seconds.
        seconds: f64,
    },
    /// Failed for good.
    Dead,
    /// Its job ended first.
    Cancelled,
}

/// Statistics of an attempt, from its worker.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TaskStats {
    /// Time of the attempt on the worker, seconds.
    pub seconds: f64,
    /// Iterations of the task.
    pub iterations: u32,
    /// Gaussians in the result.
    pub gaussians: u32,
    /// Name of the adapter.
    pub adapter: String,
    /// Iteration at which the attempt began.
    pub resumed_from: u32,
    /// Measurements on held-out views while it ran, in order; at most [`HeldOut::MOST`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub held_out: Vec<HeldOut>,
}

/// Metrics of held-out views during training. Always finite, because JSON has no other numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeldOut {
    /// Iterations done.
    pub iteration: u32,
    /// Mean PSNR, dB.
    pub psnr_db: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Views measured.
    pub views: u32,
}

impl HeldOut {
    /// Maximum measurements kept for a task: a row of the store has a limited size.
    pub const MOST: usize = 256;
}

/// A checkpoint of an attempt.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CheckpointRecord {
    /// The bytes.
    pub blob: BlobRef,
    /// Iterations done in it.
    pub iteration: u32,
    /// The attempt that wrote it.
    pub attempt: u32,
}

/// A task as it is stored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TaskRecord {
    /// Its name.
    pub task: TaskId,
    /// Its specification; `None` for the coordinator's own tasks.
    pub spec: Option<BlobRef>,
    /// Iterations of its training; 0 where nothing is trained.
    pub iterations: u32,
    /// The method of its job.
    pub method: Method,
    /// GPU memory that a worker needs for it, bytes: the plan's forecast, or more once that was too little;
    /// 0: any worker fits.
    pub memory_bytes: u64,
    /// Processes whose attempts failed, the latest last.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub failed_on: Vec<String>,
    /// Its state.
    pub state: TaskState,
    /// Artifacts of earlier tasks of its own partition.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub inputs: BTreeMap<Artifact, BlobRef>,
    /// Number of attempts begun.
    pub attempts: u32,
    /// Number of attempts that ended with an error.
    pub errors: u32,
    /// Number of attempts whose worker was lost or could not work.
    pub losses: u32,
    /// The highest fence granted for it; 0 before the first claim.
    pub fence: u64,
    /// The fence of the attempt whose Complete, Fail or Release was applied last; it identifies a repeated
    /// call.
    pub returned_fence: u64,
    /// The second attempt beside a slow one; only of a leased task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub second: Option<Box<Attempt>>,
    /// Number of second attempts ever begun.
    pub second_attempts: u32,
    /// The worker that holds or last held the lease; of two, the one that began first.
    pub worker: String,
    /// Iteration at which that attempt began.
    pub resumed_from: u32,
    /// The latest checkpoint.
    pub checkpoint: Option<CheckpointRecord>,
    /// The latest errors, the newest last.
    pub last_errors: Vec<String>,
}

impl TaskRecord {
    /// Maximum processes kept that have failed it.
    pub const FAILED_ON_KEPT: usize = 16;
    /// Maximum errors kept for display.
    pub const ERRORS_KEPT: usize = 3;

    /// A task that waits for its stage.
    pub fn new(task: TaskId, spec: Option<BlobRef>, iterations: u32) -> Self {
        Self {
            task,
            spec,
            iterations,
            method: Method::default(),
            memory_bytes: 0,
            failed_on: Vec::new(),
            state: TaskState::Blocked,
            inputs: BTreeMap::new(),
            attempts: 0,
            errors: 0,
            losses: 0,
            fence: 0,
            returned_fence: 0,
            second: None,
            second_attempts: 0,
            worker: String::new(),
            resumed_from: 0,
            checkpoint: None,
            last_errors: Vec::new(),
        }
    }

    /// The running attempts, the first one before the second.
    pub fn running(&self) -> impl Iterator<Item = &Attempt> {
        let first = if let TaskState::Leased(attempt) = &self.state { Some(attempt) } else { None };
        first.into_iter().chain(self.second.as_deref())
    }

    /// The leases that are held on it.
    pub fn leases(&self, job: &JobId) -> Vec<Lease> {
        self.running().map(|attempt| self.lease_of(job, attempt)).collect()
    }

    /// The lease of a call, if it is still held.
    pub fn lease_of_call(&self, job: &JobId, incarnation: &str, request_id: &str) -> Option<Lease> {
        let is_it = |attempt: &&Attempt| {
            (attempt.incarnation.as_str(), attempt.request_id.as_str()) == (incarnation, request_id)
        };
        self.running().find(is_it).map(|attempt| self.lease_of(job, attempt))
    }

    /// The lease of one of the running attempts.
    pub fn lease_of(&self, job: &JobId, attempt: &Attempt) -> Lease {
        Lease { job: job.clone(), task: self.task, attempt: attempt.number, fence: attempt.fence }
    }

    /// The attempt that runs under `lease`.
    pub fn held_under(&self, lease: &Lease) -> Option<&Attempt> {
        let is_it = |attempt: &&Attempt| (attempt.number, attempt.fence) == (lease.attempt, lease.fence);
        if self.task == lease.task { self.running().find(is_it) } else { None }
    }

    /// Whether `lease` is one that is held on it now.
    pub fn is_held_by(&self, lease: &Lease) -> bool {
        self.held_under(lease).is_some()
    }

    /// Removes the attempt under `fence` if another runs too, which then continues alone.
    pub(super) fn leave_to_other(&mut self, fence: u64) -> Option<Attempt> {
        let second = self.second.take()?;
        if second.fence == fence {
            return Some(*second);
        }
        (self.worker, self.resumed_from) = (second.worker.clone(), second.resumed_from);
        match std::mem::replace(&mut self.state, TaskState::Leased(*second)) {
            TaskState::Leased(first) => Some(first),
            _ => None,
        }
    }

    /// Ends all attempts.
    pub(super) fn become_state(&mut self, state: TaskState) {
        self.second = None;
        self.state = state;
    }

    /// Whether its state is final.
    pub fn is_final(&self) -> bool {
        matches!(self.state, TaskState::Done { .. } | TaskState::Dead | TaskState::Cancelled)
    }
}
