//! Which blobs a job or a dataset refers to. What keeps them (`retention`) and what looks whether they are there (`maintenance`) go by this
//! one list.

use fathom_core::scene::BlobRef;

use crate::datasets::DatasetRecord;
use crate::schedule::{JobRecord, TaskKind, TaskRecord, TaskState};

/// A blob that a row names.
pub struct Reference<'a> {
    /// What it is there, for people.
    pub what: String,
    /// Which.
    pub blob: &'a BlobRef,
    /// Whether it may name others in turn, as a manifest does its photographs: all may but models, checkpoints and pictures.
    pub names_others: bool,
}

/// The blob that the row of a dataset names, its list of files.
pub fn reference_of(dataset: &DatasetRecord) -> Reference<'_> {
    let what = format!("list of files of dataset {} of {}", dataset.id, dataset.tenant);
    Reference { what, blob: &dataset.root, names_others: true }
}

/// All blobs that the rows of a job name.
pub fn references<'a>(
    job: &'a JobRecord,
    tasks: impl IntoIterator<Item = &'a TaskRecord>,
) -> Vec<Reference<'a>> {
    let id = &job.job_id;
    let of_job = [
        ("manifest", Some(&job.manifest), true),
        ("plan", job.plan.as_ref(), true),
        ("picture of the plan", job.plan_picture.as_ref(), false),
        ("coarse model", job.global_model.as_ref(), false),
        ("consensus", job.consensus.as_ref(), true),
        ("merged model", job.merged_model.as_ref(), false),
        ("report of the merge", job.merge_report.as_ref(), true),
        ("evaluation", job.evaluation.as_ref(), true),
        ("index of artifacts", job.artifacts.as_ref(), true),
    ];
    let mut found: Vec<Reference> = of_job
        .into_iter()
        .filter_map(|(what, blob, names_others)| {
            Some(Reference { what: format!("{what} of job {id}"), blob: blob?, names_others })
        })
        .collect();
    for record in tasks {
        let (result, contributions) = match &record.state {
            TaskState::Done { result, stats, .. } => (Some(result), stats.contributions.as_ref()),
            _ => (None, None),
        };
        let gives_a_model = matches!(
            record.task.kind(),
            TaskKind::Global | TaskKind::Partition | TaskKind::Merge | TaskKind::Borders
        );
        let of_task = [
            ("specification", record.spec.as_ref(), true),
            ("input", record.input.as_ref(), true),
            ("result", result, !gives_a_model),
            ("what the views show", contributions, true),
            ("checkpoint", record.checkpoint.as_ref().map(|checkpoint| &checkpoint.blob), false),
        ];
        let task = record.task;
        found.extend(of_task.into_iter().filter_map(|(what, blob, names_others)| {
            Some(Reference { what: format!("{what} of {task} of job {id}"), blob: blob?, names_others })
        }));
    }
    found
}
