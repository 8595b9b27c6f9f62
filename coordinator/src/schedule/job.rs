//! A job as it is stored.
//!
//! ```text
//!  PLAN ─► GLOBAL ─► FIRST_PART ─► EXCHANGE ─► PARTITION ─► MERGE ─► BORDERS ─► EVALUATE ─► ARTIFACTS ─► succeeded
//!
//!  A job goes to the next stage that it has when all tasks of the present one are done. `stages.rs` says what each stage does;
//!  the plan decides which a job has: GLOBAL for several partitions, FIRST_PART and EXCHANGE
//!  where partitions exchange something, BORDERS with `borders.enabled`, EVALUATE where views are held out.
//!
//!  from every stage: a dead task ──► FAILED, the user ──► CANCELLED; the user ──► PAUSED ──► back to the stage
//!  MERGE, where results of partitions are lost ──► back to PARTITION, for those
//!  FAILED, by its user ──► back to the stage: dead tasks are ready again with new budgets
//! ```
//!
//! Invariants: a job that has ended has no ready or leased task. No task of a paused job is assigned.
//! `open_tasks` is the number of tasks of the current stage that are not done, `leased_tasks` that of leased
//! tasks. `last_seq` is the number of its events.

use std::collections::{BTreeMap, BTreeSet};

use fathom_core::scene::BlobRef;
use serde::{Deserialize, Serialize};

use super::stages::Tasks;
use super::{Artifact, JobId, Stage, TaskId, Tenant};
use crate::datasets::DatasetId;

/// State of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// In progress.
    Running,
    /// Paused by its user: no task is assigned.
    Paused,
    /// Its artifacts are complete.
    Succeeded,
    /// Failed.
    Failed,
    /// Stopped by its user.
    Cancelled,
}

impl JobState {
    /// Every state.
    pub const ALL: [Self; 5] = [Self::Running, Self::Paused, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// Its name in metrics and in columns of a database.
    pub fn name(self) -> &'static str {
        match self {
            Self::Running => "running",
            Self::Paused => "paused",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// Whether it may still succeed, by itself or when resumed.
    pub fn is_open(self) -> bool {
        matches!(self, Self::Running | Self::Paused)
    }
}

/// The tasks of a job; known once it is planned.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobShape {
    /// Number of partitions.
    pub partitions: u32,
    /// Number of tasks that evaluate a part of the held-out views each; 0 where one evaluates all.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub evaluations: u32,
    /// Stages that it has, in order.
    pub stages: BTreeSet<Stage>,
}

fn is_zero(count: &u32) -> bool {
    *count == 0
}

impl JobShape {
    /// The shape of a job before it is planned.
    pub fn unplanned() -> Self {
        Self { stages: BTreeSet::from([Stage::Plan]), ..Self::default() }
    }

    /// The tasks of one stage.
    pub fn tasks_of(&self, stage: Stage) -> Vec<TaskId> {
        match stage.spec().tasks {
            _ if !self.stages.contains(&stage) => Vec::new(),
            Tasks::Partitions => (0..self.partitions).map(|partition| stage.task_of(partition)).collect(),
            Tasks::Views if self.evaluations > 0 => {
                (1..=self.evaluations).map(|part| stage.task_of(part)).collect()
            }
            Tasks::One | Tasks::Views => vec![stage.task()],
        }
    }

    /// All tasks, in order.
    pub fn tasks(&self) -> Vec<TaskId> {
        self.stages.iter().flat_map(|stage| self.tasks_of(*stage)).collect()
    }

    /// The next stage that has tasks; `None` after the last.
    pub fn after(&self, stage: Stage) -> Option<Stage> {
        self.stages.iter().copied().find(|next| *next > stage && !self.tasks_of(*next).is_empty())
    }
}

/// A job as it is stored. Lists that grow with the scene are blobs; this row stays small.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobRecord {
    /// Its name.
    pub job_id: JobId,
    /// Its tenant.
    pub tenant: Tenant,
    /// Its display name.
    pub name: String,
    /// The id of the call that created it.
    pub request_id: String,
    /// Resolved configuration, JSON.
    pub config_json: String,
    /// The scene.
    pub manifest: BlobRef,
    /// The dataset with its files, if it uses one; kept as long as this row exists.
    pub dataset: Option<DatasetId>,
    /// Time the client took to read and upload the scene, seconds; 0 when unknown.
    pub ingest_seconds: f64,
    /// Its state.
    pub state: JobState,
    /// The current stage, or the last one.
    pub stage: Stage,
    /// Since when it is at `stage`, Unix milliseconds, shifted by the time for which it was paused there.
    pub stage_since_ms: u64,
    /// Since when it is paused, Unix milliseconds; `None` where it is not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paused_since_ms: Option<u64>,
    /// The reason of the pause, free text; empty if it is not paused.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub pause_reason: String,
    /// Tasks of `stage` that are not done.
    pub open_tasks: u32,
    /// Number of leases; a slow task may have two.
    pub leased_tasks: u32,
    /// Tasks of jobs with a higher priority are assigned first.
    pub priority: i32,
    /// Tasks that may be leased at a time; 0: no limit.
    pub max_parallel: u32,
    /// Creation, Unix milliseconds.
    pub created_ms: u64,
    /// End, Unix milliseconds.
    pub ended_ms: Option<u64>,
    /// Whether the webhook knows of its end.
    #[serde(default, skip_serializing_if = "Announcement::is_not_wanted")]
    pub announcement: Announcement,
    /// Why it failed or was cancelled.
    pub error: String,
    /// Number of its durable events.
    pub last_seq: u64,
    /// Its tasks.
    pub shape: JobShape,
    /// Artifacts of its stages; those of single partitions are stored with their tasks.
    pub outputs: BTreeMap<Artifact, BlobRef>,
    /// Iterations of all its training tasks.
    pub iterations_total: u64,
    /// Iterations of those that are done.
    pub iterations_done: u64,
    /// Duration of finished stages, without pauses, seconds.
    pub stage_seconds: BTreeMap<Stage, f64>,
}

/// Whether the end of a job was announced to the webhook.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Announcement {
    /// There was no webhook when the job was created.
    #[default]
    NotWanted,
    /// Its end has to be announced.
    Due {
        /// A coordinator is at it until then, Unix milliseconds; 0 where none is.
        not_before_ms: u64,
    },
    /// It was announced, or given up.
    Made,
}

impl Announcement {
    /// Nobody announces it yet.
    pub const DUE: Self = Self::Due { not_before_ms: 0 };

    fn is_not_wanted(&self) -> bool {
        *self == Self::NotWanted
    }
}

impl JobRecord {
    /// An artifact of one of its stages; `None` before it is made.
    pub fn output(&self, artifact: Artifact) -> Option<&BlobRef> {
        self.outputs.get(&artifact)
    }

    /// Time for which it has been paused at its stage so far, milliseconds.
    fn paused_ms(&self, now_ms: u64) -> u64 {
        self.paused_since_ms.map_or(0, |since_ms| now_ms.saturating_sub(since_ms.max(self.stage_since_ms)))
    }

    /// Time at its stage, without pauses, milliseconds.
    pub(super) fn stage_ms(&self, now_ms: u64) -> u64 {
        now_ms.saturating_sub(self.stage_since_ms).saturating_sub(self.paused_ms(now_ms))
    }

    /// Ends a pause.
    pub(super) fn goes_on(&mut self, now_ms: u64) {
        self.stage_since_ms += self.paused_ms(now_ms);
        self.paused_since_ms = None;
        self.pause_reason.clear();
    }

    /// Whether none of its tasks may be assigned for now.
    pub fn is_at_its_limit(&self) -> bool {
        self.max_parallel > 0 && self.leased_tasks >= self.max_parallel
    }

    /// Share of the work that is done, including `live_iterations` of running tasks.
    ///
    /// Training counts as 99 %; later stages are the rest.
    pub fn progress(&self, live_iterations: u64) -> f64 {
        if self.state == JobState::Succeeded {
            return 1.0;
        }
        if self.iterations_total == 0 {
            return 0.0;
        }
        let done = (self.iterations_done + live_iterations).min(self.iterations_total);
        0.99 * done as f64 / self.iterations_total as f64
    }
}
