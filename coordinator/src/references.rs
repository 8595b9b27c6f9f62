//! The blobs that a job or a dataset references. Retention and verification (`maintenance`) share this list.

use fathom_core::scene::BlobRef;

use crate::datasets::DatasetRecord;
use crate::schedule::{JobRecord, TaskRecord, TaskState};

/// A blob that a row names.
pub struct Reference<'a> {
    /// Its role, for messages.
    pub what: String,
    /// The blob.
    pub blob: &'a BlobRef,
    /// Whether it may name others in turn, as a manifest names photographs: all may except models,
    /// checkpoints and pictures.
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
    let what = format!("manifest of job {id}");
    let mut found = vec![Reference { what, blob: &job.manifest, names_others: true }];
    found.extend(job.outputs.iter().map(|(artifact, blob)| {
        let what = format!("{} of job {id}", artifact.title());
        Reference { what, blob, names_others: artifact.names_others() }
    }));
    for record in tasks {
        let task = record.task;
        let mut add = |what: &str, blob, names_others| {
            found.push(Reference { what: format!("{what} of {task} of job {id}"), blob, names_others });
        };
        if let Some(spec) = &record.spec {
            add("specification", spec, true);
        }
        for (artifact, blob) in &record.inputs {
            add(artifact.title(), blob, artifact.names_others());
        }
        if let TaskState::Done { result, .. } = &record.state {
            add("result", result, task.stage.result().names_others());
        }
        if let Some(checkpoint) = &record.checkpoint {
            add("checkpoint", &checkpoint.blob, false);
        }
    }
    found
}
