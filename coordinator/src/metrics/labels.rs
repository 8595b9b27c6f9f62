//! Words of labels.

use crate::schedule::{Expired, FailClass, JobState, Stage, TaskKind};

pub fn kind(kind: TaskKind) -> &'static str {
    match kind {
        TaskKind::Plan => "plan",
        TaskKind::Global => "global",
        TaskKind::Select => "select",
        TaskKind::Refine => "refine",
        TaskKind::Consensus => "consensus",
        TaskKind::Partition => "partition",
        TaskKind::Merge => "merge",
        TaskKind::Borders => "borders",
        TaskKind::Evaluate => "evaluate",
        TaskKind::Artifacts => "artifacts",
    }
}

pub fn stage(stage: Stage) -> &'static str {
    match stage {
        Stage::Planning => "planning",
        Stage::Global => "global",
        Stage::Select => "select",
        Stage::Refine => "refine",
        Stage::Consensus => "consensus",
        Stage::Partitions => "partitions",
        Stage::Merge => "merge",
        Stage::Borders => "borders",
        Stage::Evaluate => "evaluate",
        Stage::Artifacts => "artifacts",
    }
}

pub fn state(state: JobState) -> &'static str {
    match state {
        JobState::Running => "running",
        JobState::Paused => "paused",
        JobState::Succeeded => "succeeded",
        JobState::Failed => "failed",
        JobState::Cancelled => "cancelled",
    }
}

pub fn class(class: FailClass) -> &'static str {
    match class {
        FailClass::Input => "input",
        FailClass::Training => "training",
        FailClass::OutOfMemory => "out_of_memory",
        FailClass::Device => "device",
        FailClass::Environment => "environment",
    }
}

pub fn expired(why: Expired) -> &'static str {
    match why {
        Expired::Silent => "silent",
        Expired::Stalled => "stalled",
    }
}
