//! Merges the partitions of a job; `fathom_merge` does the work.

use std::sync::Arc;

use bytes::Bytes;
use fathom_core::ply;
use fathom_core::scene::BlobRef;
use fathom_core::water::WaterRecord;
use fathom_merge::{ModelManifest, PartitionResult, merge_from};
use fathom_plan::PartitionId;
use serde::{Deserialize, Serialize};

use super::OwnTaskError;
use super::input::{blocking, config_of, made, read_plan};
use crate::objects::BlobStore;
use crate::schedule::{Artifact, Lease, Stage, TaskId, TaskOutput, TaskState, TaskStats};
use crate::store::JobView;

/// The contribution of each partition to the merged model.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct MergeReport {
    /// Gaussians of each partition in the model, by index: those of its own cell.
    pub kept: Vec<u64>,
    /// Gaussians of its own cell that were removed as duplicates of a neighbour's, by index.
    pub duplicates: Vec<u64>,
    /// Gaussians of its own cell that were removed because all cells together exceeded the cap, by index.
    pub thinned: Vec<u64>,
    /// Gaussians of its margins, which its neighbours keep, by index.
    pub cropped: Vec<u64>,
    /// `model.json`.
    pub manifest: BlobRef,
    /// The water of the model; absent where there is no medium.
    pub water: Option<WaterRecord>,
}

/// Merges the partitions' results into one model.
pub async fn merge_job(
    objects: &Arc<BlobStore>,
    view: &JobView,
    lease: &Lease,
) -> Result<TaskOutput, OwnTaskError> {
    let plan = read_plan(objects, &view.job).await?;
    let plan_digest = made(&view.job, Artifact::Plan)?.digest.clone();
    let config = config_of(&view.job)?;
    let cap = u64::from(config.train.max_gaussians);
    let mut results = Vec::with_capacity(plan.partitions.len());
    let mut handed_in = Vec::with_capacity(plan.partitions.len());
    for (task, _) in &view.tasks {
        let TaskId { stage, part: partition } = task.task;
        if let (Stage::Partition, Some(index), TaskState::Done { result, .. }) =
            (stage, partition, &task.state)
        {
            handed_in.push((task.task, result));
            results.push(PartitionResult {
                partition: PartitionId(index),
                path: objects.path_of(result)?,
                digest: result.digest.clone(),
            });
        }
    }
    // The fence in the name: a merge of an earlier process can still be writing.
    let staged = format!("merge-{}-{}.ply", lease.job, lease.fence);
    let out = objects.staging_path(&staged);
    let files = objects.files();
    let made = blocking(move || {
        let merged = merge_from(&files, &plan, &results, &config.merge, cap, &out)
            .map_err(|error| OwnTaskError::of_merge(&error))?;
        let manifest = ModelManifest::new(&plan, &plan_digest, &results, &merged);
        let manifest = serde_json::to_vec(&manifest).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        let water = ply::water_record(&out).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        Ok((merged, manifest, water))
    })
    .await;
    let (merged, manifest, water) = match made {
        Ok(made) => made,
        Err(error) if error.is_outage => return Err(error),
        Err(error) => return Err(lost_results(objects, &handed_in, error).await?),
    };
    let duplicates: u64 = merged.partitions.iter().map(|partition| partition.duplicates).sum();
    if duplicates > 0 {
        tracing::info!(job = %lease.job, duplicates, "removed duplicate Gaussians across borders");
    }
    let thinned: u64 = merged.partitions.iter().map(|partition| partition.thinned).sum();
    if thinned > 0 {
        tracing::info!(job = %lease.job, thinned, cap, "removed the most transparent Gaussians to stay within the cap");
    }
    for partition in merged.partitions.iter().filter(|partition| partition.not_finite > 0) {
        let (id, count) = (partition.partition, partition.not_finite);
        tracing::warn!(job = %lease.job, partition = %id, count, "removed Gaussians whose centre or opacity is not finite");
    }
    let report = MergeReport {
        kept: merged.partitions.iter().map(|partition| partition.kept).collect(),
        thinned: merged.partitions.iter().map(|partition| partition.thinned).collect(),
        duplicates: merged.partitions.iter().map(|partition| partition.duplicates).collect(),
        cropped: merged.partitions.iter().map(|partition| partition.cropped).collect(),
        manifest: objects.put(Bytes::from(manifest)).await?,
        water,
    };
    let report = serde_json::to_vec(&report).map_err(|e| OwnTaskError::failed(e.to_string()))?;
    let model = objects.adopt(&staged, BlobRef { digest: merged.digest, bytes: merged.bytes }).await?;
    let report = objects.put(Bytes::from(report)).await?;
    let gaussians = u32::try_from(merged.gaussians).unwrap_or(u32::MAX);
    Ok(TaskOutput::merged(model, report, TaskStats { gaussians, ..TaskStats::default() }))
}

/// The error of a failed merge: damaged results if there are any, else its own error.
async fn lost_results(
    objects: &BlobStore,
    handed_in: &[(TaskId, &BlobRef)],
    error: OwnTaskError,
) -> Result<OwnTaskError, OwnTaskError> {
    let mut lost = Vec::new();
    for (task, result) in handed_in {
        if objects.set_aside_if_damaged(&result.digest).await? || !objects.contains(result).await? {
            lost.push(*task);
        }
    }
    Ok(if lost.is_empty() { error } else { OwnTaskError::lost(lost, error.message) })
}
