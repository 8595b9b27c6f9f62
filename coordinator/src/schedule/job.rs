//! A job as it is stored.
//!
//! ```text
//!            plan done        global done       all partitions done     merge done          evaluate done
//!  PLANNING ───────────► GLOBAL ───────────► PARTITIONS ───────────► MERGE ───────────► EVALUATE ───────────► ARTIFACTS ──► SUCCEEDED
//!                 │ (1x1)                        ▲                       │ (nothing held out)                   ▲
//!                 └──────────────────────────────┘                       └───────────────────────────────────────┘
//!
//!  where partitions choose cameras by the coarse model:
//!            global done        select done
//!  GLOBAL ───────────► SELECT ───────────────► PARTITIONS, or REFINE
//!
//!  where partitions refine the water:
//!            global done        all first parts done           consensus done
//!  GLOBAL ───────────► REFINE ───────────────────────► CONSENSUS ───────────────► PARTITIONS
//!
//!  where borders are refined:
//!         merge done          borders done
//!  MERGE ───────────► BORDERS ─────────────► EVALUATE
//!
//!  from every stage: a dead task ──► FAILED, the user ──► CANCELLED; the user ──► PAUSED ──► back to the stage
//!  MERGE, where results of partitions are lost ──► back to PARTITIONS, for those
//!  FAILED, by its user ──► back to the stage: dead tasks are ready again with new budgets
//! ```
//!
//! What must always hold: a job that has ended has no task that is ready or leased; no task of a paused job is
//! given out; `open_tasks` is the number of tasks of the current stage that are not done, `leased_tasks` that of tasks that are
//! leased; `last_seq` is the number of its events.

use std::collections::BTreeMap;

use fathom_core::scene::BlobRef;
use serde::{Deserialize, Serialize};

use super::{JobId, TaskId, Tenant};
use crate::datasets::DatasetId;

/// Where a job stands as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Under way.
    Running,
    /// Held by its user: no task is given out.
    Paused,
    /// Its artifacts are there.
    Succeeded,
    /// Given up.
    Failed,
    /// Stopped by its user.
    Cancelled,
}

impl JobState {
    /// Whether it may still come to a result by itself or when it is resumed.
    pub fn is_open(self) -> bool {
        matches!(self, Self::Running | Self::Paused)
    }
}

/// What a job that is under way does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// The scene is cut.
    Planning,
    /// The coarse model of the whole scene is trained.
    Global,
    /// The cameras of the partitions are chosen by what they show of the coarse model.
    Select,
    /// The first parts of the partitions are trained, each with a water of its own.
    Refine,
    /// One water is made of these.
    Consensus,
    /// The partitions are trained, or what is left of them.
    Partitions,
    /// One model is made of them.
    Merge,
    /// What of it lies near the borders of partitions is trained once more.
    Borders,
    /// Metrics are taken on held-out views.
    Evaluate,
    /// Files are laid out for the user.
    Artifacts,
}

/// Which tasks a job has; known once it is planned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobShape {
    /// Number of partitions.
    pub partitions: u32,
    /// Whether there is a global stage.
    pub global: bool,
    /// Whether there are held-out views.
    pub evaluate: bool,
    /// Whether partitions are two tasks each, with a consensus on the water between.
    #[serde(default)]
    pub refine: bool,
    /// Whether cameras are chosen once the coarse model is there.
    #[serde(default)]
    pub select: bool,
    /// Whether what lies near borders is trained once more after the merge.
    #[serde(default)]
    pub borders: bool,
}

impl JobShape {
    /// The tasks of one stage.
    pub fn tasks_of(&self, stage: Stage) -> Vec<TaskId> {
        match stage {
            Stage::Planning => vec![TaskId::Plan],
            Stage::Global if self.global => vec![TaskId::Global],
            Stage::Evaluate if self.evaluate => vec![TaskId::Evaluate],
            Stage::Refine if self.refine => (0..self.partitions).map(TaskId::Refine).collect(),
            Stage::Consensus if self.refine => vec![TaskId::Consensus],
            Stage::Select if self.select => vec![TaskId::Select],
            Stage::Borders if self.borders => vec![TaskId::Borders],
            Stage::Global
            | Stage::Select
            | Stage::Evaluate
            | Stage::Refine
            | Stage::Consensus
            | Stage::Borders => Vec::new(),
            Stage::Partitions => (0..self.partitions).map(TaskId::Partition).collect(),
            Stage::Merge => vec![TaskId::Merge],
            Stage::Artifacts => vec![TaskId::Artifacts],
        }
    }

    /// The next stage that has tasks; `None` after the last.
    pub fn after(&self, stage: Stage) -> Option<Stage> {
        use Stage::{Artifacts, Borders, Consensus, Evaluate, Global, Merge, Partitions, Refine, Select};
        [Global, Select, Refine, Consensus, Partitions, Merge, Borders, Evaluate, Artifacts]
            .into_iter()
            .find(|&next| next > stage && !self.tasks_of(next).is_empty())
    }
}

/// A job as it is stored. Lists that grow with the scene are blobs; this row stays small.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobRecord {
    /// Its name.
    pub job_id: JobId,
    /// Whose it is.
    #[serde(default)]
    pub tenant: Tenant,
    /// For people.
    pub name: String,
    /// The id of the call that created it.
    pub request_id: String,
    /// Resolved configuration, JSON.
    pub config_json: String,
    /// The scene.
    pub manifest: BlobRef,
    /// The dataset that has its files, if it was made of one; held as long as there is this row.
    #[serde(default)]
    pub dataset: Option<DatasetId>,
    /// Time that the client spent on reading and uploading, seconds; 0 when unknown.
    pub ingest_seconds: f64,
    /// Where it stands as a whole.
    pub state: JobState,
    /// What it does, or did last.
    pub stage: Stage,
    /// Since when it is at `stage`, Unix milliseconds; later by the time for which it was paused there.
    pub stage_since_ms: u64,
    /// Since when it is paused, Unix milliseconds; `None` where it is not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paused_since_ms: Option<u64>,
    /// Why it is paused, for people; empty where it is not.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub pause_reason: String,
    /// Tasks of `stage` that are not done.
    pub open_tasks: u32,
    /// Leases that run; a task that is slow may have two.
    #[serde(default)]
    pub leased_tasks: u32,
    /// Tasks of jobs with a higher number are given out first.
    #[serde(default)]
    pub priority: i32,
    /// Tasks that may be leased at a time; 0: no limit.
    #[serde(default)]
    pub max_parallel: u32,
    /// Creation, Unix milliseconds.
    pub created_ms: u64,
    /// End, Unix milliseconds.
    pub ended_ms: Option<u64>,
    /// Why it failed or was cancelled.
    pub error: String,
    /// Number of its durable events.
    pub last_seq: u64,
    /// Its tasks, once it is planned.
    pub shape: Option<JobShape>,
    /// The plan, JSON.
    pub plan: Option<BlobRef>,
    /// The picture of the plan, PNG.
    pub plan_picture: Option<BlobRef>,
    /// Coarse model of the whole scene, PLY.
    pub global_model: Option<BlobRef>,
    /// The water that all partitions go on with, JSON; only where they refine it.
    #[serde(default)]
    pub consensus: Option<BlobRef>,
    /// The model of the whole scene, PLY: as merged, then with what border refinement made of it.
    pub merged_model: Option<BlobRef>,
    /// What each partition gave to it, JSON.
    pub merge_report: Option<BlobRef>,
    /// What the evaluation found.
    pub evaluation: Option<BlobRef>,
    /// Index of the artifacts.
    pub artifacts: Option<BlobRef>,
    /// Iterations of all its training tasks.
    pub iterations_total: u64,
    /// Iterations of those that are done.
    pub iterations_done: u64,
    /// Time spent in stages that are over, without pauses, seconds.
    pub stage_seconds: BTreeMap<Stage, f64>,
}

impl JobRecord {
    /// All tasks that it has so far, in order.
    pub fn tasks(&self) -> Vec<TaskId> {
        use Stage::{
            Artifacts, Borders, Consensus, Evaluate, Global, Merge, Partitions, Planning, Refine, Select,
        };
        match self.shape {
            None => vec![TaskId::Plan],
            Some(shape) => {
                [Planning, Global, Select, Refine, Consensus, Partitions, Merge, Borders, Evaluate, Artifacts]
                    .into_iter()
                    .flat_map(|stage| shape.tasks_of(stage))
                    .collect()
            }
        }
    }

    /// Time for which it has been paused at its stage since it was last, milliseconds.
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

    /// Whether no further task of it is given out for now.
    pub fn is_at_its_limit(&self) -> bool {
        self.max_parallel > 0 && self.leased_tasks >= self.max_parallel
    }

    /// Work done as a share of the whole, counting `live_iterations` of tasks that are under way.
    ///
    /// Training is all but a hundredth; the rest is what comes after.
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
