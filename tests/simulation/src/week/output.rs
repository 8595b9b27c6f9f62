//! Results of the tasks of a week. Only reports of merges have a content.

use std::collections::{BTreeMap, HashMap};

use fathom_coordinator::schedule::{Lease, Planned, PlannedTask, Stage, TaskOutput, TaskStats};
use serde_json::{Value, json};

use super::PACE;
use crate::scene::blob_ref;

/// The output of a task: of a plan the tasks of `partitions` partitions, of a merge a report of `merged`.
pub fn output(
    lease: &Lease,
    partitions: u32,
    blobs: &mut HashMap<String, Vec<u8>>,
    merged: &[String],
) -> TaskOutput {
    let named = |what: &str| blob_ref(format!("{what} of {} under {}", lease.task, lease.fence).as_bytes());
    let stats = TaskStats { iterations: 1, ..TaskStats::default() };
    match lease.task.stage {
        Stage::Plan => {
            let own = |stage: Stage| (stage.task(), PlannedTask::default());
            let mut tasks = BTreeMap::from([own(Stage::Merge), own(Stage::Artifacts)]);
            let iterations = |minutes: u64| (minutes * 60 * PACE) as u32;
            if partitions > 1 {
                tasks.insert(Stage::Global.task(), PlannedTask::new(named("spec"), iterations(10)));
            }
            for index in 0..partitions {
                let minutes = 5 + u64::from(index * 7 % 25);
                let task = PlannedTask {
                    memory_bytes: 1 << 30,
                    ..PlannedTask::new(named("spec"), iterations(minutes))
                };
                tasks.insert(Stage::Partition.task_of(index), task);
            }
            match partitions {
                0..4 => tasks.extend([(Stage::Evaluate.task(), PlannedTask::new(named("spec"), 0))]),
                _ => tasks.extend(
                    (1..=3).map(|part| (Stage::Evaluate.task_of(part), PlannedTask::new(named("spec"), 0))),
                ),
            }
            TaskOutput::planned(named("plan"), named("picture"), Planned { tasks, warnings: Vec::new() })
        }
        Stage::Merge => {
            let mut keep = |value: Value| {
                let bytes = value.to_string().into_bytes();
                let blob = blob_ref(&bytes);
                blobs.insert(blob.digest.clone(), bytes);
                blob
            };
            let partitions: Vec<Value> = merged.iter().map(|digest| json!({ "result": digest })).collect();
            let manifest = keep(json!({ "fence": lease.fence, "partitions": partitions }));
            let report = keep(json!({ "manifest": manifest }));
            TaskOutput::merged(named("model"), report, stats)
        }
        stage => TaskOutput::of(stage, named("result"), stats),
    }
}
