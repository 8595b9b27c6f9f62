//! The table of stages: where each runs, in how many tasks, with input and output artifacts.
//!
//! All generic code about stages uses this table: the rules, the queue, the time forecast, metrics, messages,
//! and retention. `docs/internals/extending.md` lists the files that a new stage touches.

use std::cmp::Ordering;
use std::fmt;

use fathom_proto::{v1, worker::v1 as worker_v1};
use serde::{Deserialize, Serialize};

/// A stage of a job. Stages follow each other, and compare, in the order of [`STAGES`]. Their numbers are
/// those of `Stage` in `job.proto` and part of keys in the store, so they never change. A new stage takes the
/// next free number, wherever it is in the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Stage {
    /// Partitions the scene.
    Plan = 1,
    /// Trains the coarse model of the whole scene.
    Global = 2,
    /// Trains the part of a partition's run before the exchange.
    FirstPart = 3,
    /// Collects the results that partitions exchange: one water for all, the Gaussians of their cells, or
    /// both.
    Exchange = 4,
    /// Trains one partition, or the rest of it after its first part.
    Partition = 5,
    /// Merges the partitions into one model.
    Merge = 6,
    /// Trains the merged model once more near the borders of cells.
    Borders = 7,
    /// Computes the metrics on held-out views.
    Evaluate = 8,
    /// Writes the files for the user.
    Artifacts = 9,
}

/// Results that stages make for each other and for the user. The numbers are those of `Artifact` in
/// `worker.proto`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Artifact {
    /// The plan, JSON.
    Plan = 1,
    /// The picture of the plan, PNG.
    PlanPicture = 2,
    /// The coarse model of the whole scene, PLY.
    CoarseModel = 3,
    /// The result of a partition's first part.
    FirstPart = 4,
    /// The data that partitions exchange, JSON.
    Exchange = 5,
    /// The Gaussians of a partition, PLY.
    PartitionModel = 6,
    /// The model of the whole scene, PLY: as merged, later as the border stage changed it.
    Model = 7,
    /// The contribution of each partition to the merged model, JSON.
    MergeReport = 8,
    /// The results of the evaluation.
    Evaluation = 9,
    /// The index of the files for the user, JSON.
    Index = 10,
}

/// Where the tasks of a stage run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunsOn {
    /// The coordinator itself, under a lease like all others.
    Coordinator,
    /// A worker with a GPU.
    Worker,
}

/// How many tasks a stage has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tasks {
    /// One.
    One,
    /// One for each partition.
    Partitions,
    /// One, or several that take a part of the held-out views each.
    Views,
}

/// A row of the table.
#[derive(Clone, Copy, Debug)]
pub struct StageSpec {
    /// The stage.
    pub stage: Stage,
    /// Its name in names of tasks, in metrics, in logs and on the command line.
    pub name: &'static str,
    /// Where its tasks run.
    pub runs_on: RunsOn,
    /// How many tasks it has.
    pub tasks: Tasks,
    /// Whether its tasks are training, which takes nearly all of the time of a job.
    pub trains: bool,
    /// Artifacts that its tasks start from, where the job has them. Of an artifact that is made for each
    /// partition, a task gets that of its own partition.
    pub inputs: &'static [Artifact],
    /// Artifacts that its tasks make; the first is the result of the task. A worker may omit the others, the
    /// coordinator may not.
    pub outputs: &'static [Artifact],
}

/// All stages, in order.
pub const STAGES: [StageSpec; 9] = [
    StageSpec {
        stage: Stage::Plan,
        name: "plan",
        runs_on: RunsOn::Coordinator,
        tasks: Tasks::One,
        trains: false,
        inputs: &[],
        outputs: &[Artifact::Plan, Artifact::PlanPicture],
    },
    StageSpec {
        stage: Stage::Global,
        name: "global",
        runs_on: RunsOn::Worker,
        tasks: Tasks::One,
        trains: true,
        inputs: &[],
        outputs: &[Artifact::CoarseModel],
    },
    StageSpec {
        stage: Stage::FirstPart,
        name: "first_part",
        runs_on: RunsOn::Worker,
        tasks: Tasks::Partitions,
        trains: true,
        inputs: &[Artifact::CoarseModel],
        outputs: &[Artifact::FirstPart],
    },
    StageSpec {
        stage: Stage::Exchange,
        name: "exchange",
        runs_on: RunsOn::Coordinator,
        tasks: Tasks::One,
        trains: false,
        inputs: &[Artifact::CoarseModel, Artifact::FirstPart],
        outputs: &[Artifact::Exchange],
    },
    StageSpec {
        stage: Stage::Partition,
        name: "partition",
        runs_on: RunsOn::Worker,
        tasks: Tasks::Partitions,
        trains: true,
        inputs: &[Artifact::CoarseModel, Artifact::FirstPart, Artifact::Exchange],
        outputs: &[Artifact::PartitionModel],
    },
    StageSpec {
        stage: Stage::Merge,
        name: "merge",
        runs_on: RunsOn::Coordinator,
        tasks: Tasks::One,
        trains: false,
        inputs: &[Artifact::Plan, Artifact::PartitionModel],
        outputs: &[Artifact::Model, Artifact::MergeReport],
    },
    StageSpec {
        stage: Stage::Borders,
        name: "borders",
        runs_on: RunsOn::Worker,
        tasks: Tasks::One,
        trains: true,
        inputs: &[Artifact::Model],
        outputs: &[Artifact::Model],
    },
    StageSpec {
        stage: Stage::Evaluate,
        name: "evaluate",
        runs_on: RunsOn::Worker,
        tasks: Tasks::Views,
        trains: false,
        inputs: &[Artifact::Model],
        outputs: &[Artifact::Evaluation],
    },
    StageSpec {
        stage: Stage::Artifacts,
        name: "artifacts",
        runs_on: RunsOn::Coordinator,
        tasks: Tasks::One,
        trains: false,
        inputs: &[
            Artifact::Plan,
            Artifact::Model,
            Artifact::MergeReport,
            Artifact::Exchange,
            Artifact::Evaluation,
        ],
        outputs: &[Artifact::Index],
    },
];

impl Stage {
    /// All stages, in order.
    pub fn all() -> impl Iterator<Item = Self> {
        STAGES.iter().map(|spec| spec.stage)
    }

    /// Its place in the table.
    const fn place(self) -> usize {
        let mut place = 0;
        while STAGES[place].stage as u8 != self as u8 {
            place += 1;
        }
        place
    }

    /// Its row in the table.
    pub fn spec(self) -> &'static StageSpec {
        &STAGES[self.place()]
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        self.spec().name
    }

    /// Whether it has one task for each partition.
    pub fn is_per_partition(self) -> bool {
        self.spec().tasks == Tasks::Partitions
    }

    /// Whether the coordinator does its tasks itself.
    pub fn is_own(self) -> bool {
        self.spec().runs_on == RunsOn::Coordinator
    }

    /// The stages that the coordinator does itself.
    pub fn own() -> Vec<Self> {
        Self::all().filter(|stage| stage.is_own()).collect()
    }

    /// The stages whose tasks are leased to workers.
    pub fn of_workers() -> Vec<Self> {
        Self::all().filter(|stage| !stage.is_own()).collect()
    }

    /// Whether a task of it starts from `artifact`.
    pub fn takes(self, artifact: Artifact) -> bool {
        self.spec().inputs.contains(&artifact)
    }

    /// The artifact that is the result of its tasks.
    pub fn result(self) -> Artifact {
        self.spec().outputs[0]
    }

    /// The stage of a message; `None` for a number that this program does not know.
    pub fn from_proto(stage: v1::Stage) -> Option<Self> {
        Self::all().find(|known| *known as i32 == i32::from(stage))
    }
}

impl Ord for Stage {
    fn cmp(&self, other: &Self) -> Ordering {
        self.place().cmp(&other.place())
    }
}

impl PartialOrd for Stage {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl From<Stage> for v1::Stage {
    fn from(stage: Stage) -> Self {
        Self::try_from(i32::from(stage as u8)).unwrap_or_default()
    }
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Artifact {
    /// Whether it may name other blobs, as an evaluation names its images. Models and images name none.
    pub fn names_others(self) -> bool {
        !matches!(self, Self::PlanPicture | Self::CoarseModel | Self::PartitionModel | Self::Model)
    }

    /// Its name in messages.
    pub fn title(self) -> &'static str {
        match self {
            Self::Plan => "plan",
            Self::PlanPicture => "picture of the plan",
            Self::CoarseModel => "coarse model",
            Self::FirstPart => "first part",
            Self::Exchange => "exchange",
            Self::PartitionModel => "model of the partition",
            Self::Model => "merged model",
            Self::MergeReport => "report of the merge",
            Self::Evaluation => "evaluation",
            Self::Index => "index of the files",
        }
    }
}

impl Artifact {
    /// The artifact of a message; `None` for a number that this program does not know.
    pub fn from_proto(artifact: worker_v1::Artifact) -> Option<Self> {
        let made = STAGES.iter().flat_map(|spec| spec.outputs);
        made.copied().find(|known| *known as i32 == i32::from(artifact))
    }
}

impl From<Artifact> for worker_v1::Artifact {
    fn from(artifact: Artifact) -> Self {
        Self::try_from(i32::from(artifact as u8)).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn the_table_and_the_messages_name_the_same_stages() {
        for spec in &STAGES {
            let message = v1::Stage::from(spec.stage);
            assert_eq!(message.as_str_name(), format!("STAGE_{}", spec.name.to_uppercase()));
            assert_eq!(Stage::from_proto(message), Some(spec.stage));
            assert_eq!(serde_json::to_value(spec.stage).ok(), Some(spec.name.into()));
        }
        assert_eq!(Stage::from_proto(v1::Stage::Unspecified), None);
        let messages = (1..=255).filter_map(|number| v1::Stage::try_from(number).ok());
        assert_eq!(messages.count(), STAGES.len(), "job.proto has a stage that the table lacks");
    }

    #[test]
    fn stages_compare_by_their_place_in_the_table() {
        let mut sorted: Vec<Stage> = Stage::all().collect();
        sorted.sort_by_key(|stage| std::cmp::Reverse(*stage as u8));
        sorted.sort_unstable();
        assert!(sorted.into_iter().eq(STAGES.iter().map(|spec| spec.stage)));
        assert!(Stage::Partition.task_of(7) < Stage::Merge.task(), "tasks follow their stages");
    }

    #[test]
    fn every_input_is_made_by_an_earlier_stage() {
        let mut made = BTreeSet::new();
        for spec in &STAGES {
            for input in spec.inputs {
                assert!(
                    made.contains(input),
                    "{} starts from {input:?}, which is made later or never",
                    spec.name
                );
            }
            made.extend(spec.outputs);
        }
        for artifact in &made {
            let name =
                serde_json::to_value(artifact).ok().and_then(|name| name.as_str().map(str::to_uppercase));
            let message = worker_v1::Artifact::from(*artifact);
            assert_eq!(Artifact::from_proto(message), Some(*artifact));
            let message = message.as_str_name();
            assert_eq!(Some(message), name.map(|name| format!("ARTIFACT_{name}")).as_deref());
        }
    }
}
