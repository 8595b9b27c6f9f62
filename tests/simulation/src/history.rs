//! What happened, in order: what clients and workers were told, what the store did for whom, and which faults
//! there were.
//!
//! A fact is written down by whoever knows it: a client's when it has the answer, the store's when it has
//! answered. What nobody was told need not hold.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use fathom_coordinator::schedule::{JobId, Lease, TaskId};

/// Lines of logs that are kept for the report of a failure.
const LINES_KEPT: usize = 60;

/// Something that happened.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "the fields are named for what they are")]
pub enum Fact {
    /// A user has the answer that a request made this job.
    Created { user: usize, request: String, job: JobId },
    /// A user asked for its own job, and it was said that there is none.
    Denied { user: usize, job: JobId, said: String },
    /// A watcher was told a durable event: its number and a digest of the whole.
    Seen { user: usize, job: JobId, seq: u64, digest: String },
    /// The same, when it is all over, by a stream from the beginning.
    Reread { user: usize, job: JobId, seq: u64, digest: String },
    /// A user of another tenant was told something of a job.
    Betrayed { user: usize, job: JobId, how: String },
    /// A user has the model of a job that succeeded.
    Fetched { user: usize, job: JobId, model: String },
    /// A user has the answer that its dataset is frozen.
    Committed { user: usize, dataset: String, root: String },
    /// A user is about to delete its job, and its dataset if it has one.
    Deleting { user: usize, job: JobId },
    /// A user has the answer that its job is forgotten, and its dataset.
    Deleted { user: usize, job: JobId },
    /// A job that was deleted was there once more.
    Revived { user: usize, job: JobId, how: String },
    /// What a user wanted of a job, and the answer.
    Steered { user: usize, job: JobId, what: &'static str, answer: String },
    /// All jobs of a user have ended and it has seen all of them.
    Finished { user: usize },
    /// A worker was told that a checkpoint is safe.
    CheckpointSafe { job: String, task: String, attempt: u64, iteration: u64 },
    /// A worker was told that its result is taken.
    ResultTaken { job: String, task: String, attempt: u64 },
    /// The store gave a lease: the highest fence of the task before it, what the task needs and the worker
    /// has, and how the limits stand with it.
    Granted {
        lease: Lease,
        before: u64,
        worker: String,
        need: u64,
        has: Option<u64>,
        limits: Vec<(String, u32, u32)>,
        early_ms: u64,
    },
    /// The store changed a task for whoever showed this lease, while leases ran on the task under these
    /// fences.
    Changed { lease: Lease, running: Vec<u64>, how: &'static str },
    /// The store refused what came under a lease.
    Refused { lease: Lease, how: &'static str, why: String },
    /// What came twice under a lease changed the task twice.
    ChangedTwice { lease: Lease, how: &'static str },
    /// A claim that came twice was given two leases, or the second time none.
    TwoLeases { first: Lease, again: Option<Lease> },
    /// The store took leases back.
    TakenBack { job: JobId, task: TaskId, fence: u64 },
    /// A coordinator opened the store.
    Opened { jobs: usize },
    /// A fault, or its end.
    Fault(String),
}

/// Everything, by one simulated clock.
#[derive(Default)]
pub struct History {
    inner: Mutex<Inner>,
}

#[derive(Default)]
struct Inner {
    now: Duration,
    facts: Vec<(Duration, Fact)>,
    lines: VecDeque<String>,
}

impl History {
    /// The simulation has come so far.
    pub fn set_now(&self, now: Duration) {
        self.lock().now = now;
    }

    /// Simulated time since the beginning.
    pub fn now(&self) -> Duration {
        turmoil::sim_elapsed().unwrap_or_else(|| self.lock().now)
    }

    /// Writes a fact down.
    pub fn note(&self, fact: Fact) {
        let now = self.now();
        self.lock().facts.push((now, fact));
    }

    /// A line of somebody's log, for people who look into a failure.
    pub fn line(&self, line: String) {
        let now = self.now();
        let mut inner = self.lock();
        if inner.lines.len() == LINES_KEPT {
            inner.lines.pop_front();
        }
        inner.lines.push_back(format!("{:>9.3} {line}", now.as_secs_f64()));
    }

    /// All facts so far.
    pub fn facts(&self) -> Vec<(Duration, Fact)> {
        self.lock().facts.clone()
    }

    /// All facts with their times, a line each.
    pub fn told(&self) -> Vec<String> {
        self.lock().facts.iter().map(|(at, fact)| format!("{} {fact:?}", at.as_micros())).collect()
    }

    /// The last facts and lines.
    pub fn tail(&self, facts: usize) -> String {
        let inner = self.lock();
        // What is read once more at the end is of no interest.
        let first_time: Vec<_> =
            inner.facts.iter().filter(|(_, fact)| !matches!(fact, Fact::Reread { .. })).collect();
        let from = first_time.len().saturating_sub(facts);
        let mut told = String::new();
        for (at, fact) in &first_time[from..] {
            told += &format!("{:>9.3} {fact}\n", at.as_secs_f64());
        }
        told += "log:\n";
        for line in &inner.lines {
            told += &format!("{line}\n");
        }
        told
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
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
