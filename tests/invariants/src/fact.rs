//! What clients and workers were answered, what the store did, and faults.
//!
//! Clients record a fact when they have the answer, the store when it has answered. Changes that were never
//! acknowledged need not hold. A service of real processes has no facts of its store.

use std::fmt;

use fathom_coordinator::schedule::{JobId, Lease, TaskId};

/// An event of the history.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "the fields are named for what they are")]
pub enum Fact {
    /// A user has the answer that a request made this job.
    Created { user: usize, request: String, job: JobId },
    /// A user asked for its own job, and the answer was that it does not exist.
    Denied { user: usize, job: JobId, said: String },
    /// A watcher received a durable event: its number and a digest of the whole.
    Seen { user: usize, job: JobId, seq: u64, digest: String },
    /// The same at the end of the run, from a stream that starts at the first event.
    Reread { user: usize, job: JobId, seq: u64, digest: String },
    /// A user of another tenant received data of a job.
    Betrayed { user: usize, job: JobId, how: String },
    /// A user has the model of a job that succeeded.
    Fetched { user: usize, job: JobId, model: String },
    /// A user has the answer that its dataset is committed.
    Committed { user: usize, dataset: String, root: String },
    /// A user is about to delete its job, and its dataset if it has one.
    Deleting { user: usize, job: JobId },
    /// A user has the answer that its job and its dataset are deleted.
    Deleted { user: usize, job: JobId },
    /// A deleted job existed again.
    Revived { user: usize, job: JobId, how: String },
    /// A user's request about a job, and the answer.
    Steered { user: usize, job: JobId, what: &'static str, answer: String },
    /// All jobs of a user have ended, and the user has seen it.
    Finished { user: usize },
    /// A worker received the answer that a checkpoint is stored.
    CheckpointSafe { job: String, task: String, attempt: u64, iteration: u64 },
    /// A worker received the answer that its result is accepted.
    ResultTaken { job: String, task: String, attempt: u64 },
    /// The store granted a lease: the highest previous fence of the task, the memory that the task needs and
    /// the worker has, and the limits with their use.
    Granted {
        lease: Lease,
        before: u64,
        worker: String,
        need: u64,
        has: Option<u64>,
        limits: Vec<(String, u32, u32)>,
        early_ms: u64,
    },
    /// The store changed a task for the holder of this lease, while leases with these fences ran on the task.
    Changed { lease: Lease, running: Vec<u64>, how: &'static str },
    /// The store refused an event under a lease.
    Refused { lease: Lease, how: &'static str, why: String },
    /// An event that arrived twice under a lease changed the task twice.
    ChangedTwice { lease: Lease, how: &'static str },
    /// A repeated claim got two leases, or none the second time.
    TwoLeases { first: Lease, again: Option<Lease> },
    /// The store revoked leases.
    TakenBack { job: JobId, task: TaskId, fence: u64 },
    /// A coordinator opened the store.
    Opened { jobs: usize },
    /// A fault, or its end.
    Fault(String),
}

impl fmt::Display for Fact {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let under = |lease: &Lease| {
            format!("{} of {} (attempt {}, fence {})", lease.task, lease.job, lease.attempt, lease.fence)
        };
        match self {
            Self::Granted { lease, worker, .. } => write!(f, "store: {worker} gets {}", under(lease)),
            Self::Changed { lease, how, .. } => write!(f, "store: {how} {}", under(lease)),
            Self::Refused { lease, how, why } => write!(f, "store: refused {how} {}: {why}", under(lease)),
            Self::TakenBack { job, task, fence } => {
                write!(f, "store: took back {task} of {job} (fence {fence})")
            }
            Self::Fault(what) => write!(f, "fault: {what}"),
            other => write!(f, "{other:?}"),
        }
    }
}
