//! What the coordinator computes itself: the plan and the merge (the consensus is in `consensus.rs`). The thin border between tasks on one side,
//! [`partition`](crate::partition) and [`merge`](crate::merge) on the other.

use std::collections::BTreeMap;

use bytes::Bytes;
use fathom_core::config::{JobConfig, WaterPartitions};
use fathom_core::ply;
use fathom_core::scene::{BlobRef, Manifest, Points};
use fathom_core::views::TrainView;
use fathom_core::water::WaterRecord;
use fathom_proto::worker::v1::{FocusBox, TaskSpec};
use prost::Message;
use serde::{Deserialize, Serialize};

use crate::launcher::OwnTaskError;
use crate::merge::{PartitionResult, merge};
use crate::objects::BlobStore;
use crate::partition::{PartitionId, Plan, PlanInput, Rect, picture, plan};
use crate::schedule::{
    FailClass, JobRecord, Lease, Planned, PlannedTask, TaskId, TaskOutput, TaskState, TaskStats,
};
use crate::store::JobView;

/// Version of [`TaskSpec`]'s layout.
const SPEC_FORMAT: u32 = 1;

/// A job's configuration, manifest and points.
pub struct JobInput {
    /// Resolved configuration.
    pub config: JobConfig,
    /// The scene.
    pub manifest: Manifest,
}

fn config_of(job: &JobRecord) -> Result<JobConfig, OwnTaskError> {
    JobConfig::from_json(&job.config_json)
        .map_err(|e| OwnTaskError::input(format!("the job's configuration: {e}")))
}

impl JobInput {
    /// Reads what a job refers to.
    pub async fn read(objects: &BlobStore, job: &JobRecord) -> Result<Self, OwnTaskError> {
        let config = config_of(job)?;
        let bytes = objects.read(&job.manifest).await?;
        let manifest: Manifest =
            serde_json::from_slice(&bytes).map_err(|e| OwnTaskError::input(format!("the manifest: {e}")))?;
        if manifest.format != 1 {
            return Err(OwnTaskError::input(format!(
                "the manifest has format {}; this coordinator reads format 1",
                manifest.format
            )));
        }
        Ok(Self { config, manifest })
    }

    /// All views with their undistorted cameras at full size.
    pub fn views(&self) -> Result<Vec<TrainView>, OwnTaskError> {
        let cameras: BTreeMap<u32, _> =
            self.manifest.cameras.iter().map(|camera| (camera.id, camera)).collect();
        let view = |view: &fathom_core::scene::ManifestView| {
            let camera = cameras.get(&view.camera_id).ok_or_else(|| {
                OwnTaskError::input(format!("{}: the manifest has no camera {}", view.name, view.camera_id))
            })?;
            let camera = camera.pinhole().map_err(|e| OwnTaskError::input(format!("{}: {e}", view.name)))?;
            Ok(TrainView { name: view.name.clone(), camera, pose: view.pose })
        };
        self.manifest.views.iter().map(view).collect()
    }
}

/// Cuts the scene of a job and stores the plan, its picture and the specification of every task.
pub async fn plan_job(objects: &BlobStore, job: &JobRecord) -> Result<TaskOutput, OwnTaskError> {
    let input = JobInput::read(objects, job).await?;
    require_uploads(objects, &input.manifest).await?;
    let points = objects.read(&input.manifest.points).await?;
    let config = input.config.clone();
    let title = job.name.clone();
    let (plan, plan_json, plan_png) = blocking(move || {
        let points = Points::from_bytes(&points).map_err(|e| OwnTaskError::input(e.to_string()))?;
        let views = input.views()?;
        let plan_input = PlanInput { views: &views, points: &points, config: &input.config };
        let plan = plan(&plan_input).map_err(|e| OwnTaskError::input(e.to_string()))?;
        plan.require_points().map_err(|e| OwnTaskError::input(e.to_string()))?;
        let json = serde_json::to_vec_pretty(&plan).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        let png = picture::draw(&plan, &views, &points, &title).map_err(OwnTaskError::failed)?;
        Ok((plan, json, png))
    })
    .await?;
    let mut warnings = plan.warnings(&config.train);
    let refines = config.water.is_refined(plan.partitions.len() as u32);
    if config.water.partitions == WaterPartitions::Refine && !refines {
        warnings.push(
            "water.partitions = \"refine\" changes nothing here: it takes more than one partition and a medium".into(),
        );
    }
    let resolution = config.data.max_resolution;
    let scene_extent = plan.extent.learning_scale() as f32;
    let viewing_distance = plan.extent.viewing_distance.map(|distance| distance as f32);
    let spec = |partition: u32, views: &[u32], max_resolution_px: u32| TaskSpec {
        format: SPEC_FORMAT,
        partition,
        views: views.to_vec(),
        max_resolution_px,
        iterations: 0,
        max_gaussians: 0,
        scene_extent,
        focus: None,
        viewing_distance,
        held_out: Vec::new(),
        from_iteration: 0,
        until_iteration: 0,
    };
    // Only a run that trains the whole scene can be measured on views of all of it.
    let measured = if config.train.eval_every > 0 { plan.held_out.clone() } else { Vec::new() };
    let global = match &plan.global {
        Some(stage) => {
            let (iterations, max_gaussians) = (stage.iterations, stage.max_gaussians);
            let spec = spec(0, &plan.training_views(), stage.max_resolution);
            let held_out = measured.clone();
            Some(put_spec(objects, TaskSpec { iterations, max_gaussians, held_out, ..spec }).await?)
        }
        None => None,
    };
    let (mut refine, mut partitions) = (Vec::new(), Vec::with_capacity(plan.partitions.len()));
    for partition in &plan.partitions {
        let focus = plan.global.is_some().then(|| focus_box(&plan, &partition.focus));
        let (iterations, max_gaussians) = (partition.iterations, partition.max_gaussians);
        let spec = spec(partition.id.0, &partition.chosen_views, resolution);
        let held_out = if plan.global.is_none() { measured.clone() } else { Vec::new() };
        let mut spec = TaskSpec { iterations, max_gaussians, focus, held_out, ..spec };
        if refines {
            let exchange = config.water.free_iterations(iterations);
            refine.push(put_spec(objects, TaskSpec { until_iteration: exchange, ..spec.clone() }).await?);
            spec.from_iteration = exchange;
        }
        partitions.push(put_spec(objects, spec).await?);
    }
    let evaluate = if plan.held_out.is_empty() {
        None
    } else {
        Some(put_spec(objects, spec(0, &plan.held_out, resolution)).await?.spec)
    };
    Ok(TaskOutput::Plan(Box::new(Planned {
        plan: objects.put(plan_json.into()).await?,
        picture: objects.put(plan_png.into()).await?,
        global,
        refine,
        partitions,
        evaluate,
        warnings,
    })))
}

/// Every photograph must be there before anybody trains for hours on the others.
async fn require_uploads(objects: &BlobStore, manifest: &Manifest) -> Result<(), OwnTaskError> {
    objects.require(&manifest.points).await?;
    for view in &manifest.views {
        for blob in std::iter::once(&view.image).chain(&view.mask) {
            if !objects.contains(blob).await? {
                return Err(OwnTaskError::input(format!(
                    "{}: blob {} has not been uploaded; upload all files of the manifest and submit again",
                    view.name, blob.digest
                )));
            }
        }
    }
    Ok(())
}

async fn put_spec(objects: &BlobStore, spec: TaskSpec) -> Result<PlannedTask, OwnTaskError> {
    let iterations = spec.own_iterations();
    Ok(PlannedTask { spec: objects.put(spec.encode_to_vec().into()).await?, iterations })
}

fn focus_box(plan: &Plan, focus: &Rect) -> FocusBox {
    FocusBox {
        align_quat_wxyz: plan.alignment.world_to_aligned_quat_wxyz.to_vec(),
        min_x: focus.x.lo.unwrap_or(f64::NEG_INFINITY),
        max_x: focus.x.hi.unwrap_or(f64::INFINITY),
        min_z: focus.z.lo.unwrap_or(f64::NEG_INFINITY),
        max_z: focus.z.hi.unwrap_or(f64::INFINITY),
    }
}

/// The plan that a job was given.
pub async fn read_plan(objects: &BlobStore, job: &JobRecord) -> Result<Plan, OwnTaskError> {
    let blob = job.plan.as_ref().ok_or_else(|| OwnTaskError::failed("the job has no plan".into()))?;
    serde_json::from_slice(&objects.read(blob).await?).map_err(|e| OwnTaskError::failed(format!("plan: {e}")))
}

/// What each partition gave to the merged model.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct MergeReport {
    /// Gaussians of each partition in the model, by index: those of its own cell.
    pub kept: Vec<u64>,
    /// Gaussians of its own cell that went because all cells together passed the cap, by index.
    #[serde(default)]
    pub thinned: Vec<u64>,
    /// Gaussians of its margins, which its neighbours keep, by index.
    pub cropped: Vec<u64>,
    /// The water that the model carries; absent where there is no medium.
    #[serde(default)]
    pub water: Option<WaterRecord>,
}

/// Makes one model of the partitions' results.
pub async fn merge_job(
    objects: &BlobStore,
    view: &JobView,
    lease: &Lease,
) -> Result<TaskOutput, OwnTaskError> {
    let plan = read_plan(objects, &view.job).await?;
    let cap = u64::from(config_of(&view.job)?.train.max_gaussians);
    let mut results = Vec::with_capacity(plan.partitions.len());
    for (task, _) in &view.tasks {
        if let (TaskId::Partition(index), TaskState::Done { result, .. }) = (task.task, &task.state) {
            check_on_disk(objects, result).await?;
            results
                .push(PartitionResult { partition: PartitionId(index), path: objects.local_path(result)? });
        }
    }
    // The fence in the name: a merge of an earlier process can still be writing.
    let staged = format!("merge-{}-{}.ply", lease.job, lease.fence);
    let out = objects.staging_path(&staged);
    let (merged, water) = blocking(move || {
        let merged = merge(&plan, &results, cap, &out).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        let water = ply::water_record(&out).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        Ok((merged, water))
    })
    .await?;
    let thinned: u64 = merged.partitions.iter().map(|partition| partition.thinned).sum();
    if thinned > 0 {
        tracing::info!(job = %lease.job, thinned, cap, "dropped the most transparent Gaussians to keep under the cap");
    }
    for partition in merged.partitions.iter().filter(|partition| partition.not_finite > 0) {
        let (id, count) = (partition.partition, partition.not_finite);
        tracing::warn!(job = %lease.job, partition = %id, count, "dropped Gaussians whose centre or opacity is not finite");
    }
    let report = MergeReport {
        kept: merged.partitions.iter().map(|partition| partition.kept).collect(),
        thinned: merged.partitions.iter().map(|partition| partition.thinned).collect(),
        cropped: merged.partitions.iter().map(|partition| partition.cropped).collect(),
        water,
    };
    let report = serde_json::to_vec(&report).map_err(|e| OwnTaskError::failed(e.to_string()))?;
    Ok(TaskOutput::Merged {
        model: objects.adopt(&staged).await?,
        report: objects.put(Bytes::from(report)).await?,
        stats: TaskStats {
            gaussians: u32::try_from(merged.gaussians).unwrap_or(u32::MAX),
            ..TaskStats::default()
        },
    })
}

/// The merge reads files, not blobs; so their digests are checked here.
async fn check_on_disk(objects: &BlobStore, blob: &BlobRef) -> Result<(), OwnTaskError> {
    let (path, digest) = (objects.local_path(blob)?, blob.digest.clone());
    blocking(move || {
        let failed = |e: std::io::Error| OwnTaskError::failed(format!("{}: {e}", path.display()));
        let mut hasher = blake3::Hasher::new();
        std::io::copy(&mut std::fs::File::open(&path).map_err(failed)?, &mut hasher).map_err(failed)?;
        let found = hasher.finalize().to_hex();
        if found.as_str() == digest {
            return Ok(());
        }
        Err(OwnTaskError::failed(format!("{} has the digest {found}: the disk changed it", path.display())))
    })
    .await
}

/// Runs work that computes on a thread for it.
pub async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, OwnTaskError> + Send + 'static,
) -> Result<T, OwnTaskError> {
    match tokio::task::spawn_blocking(work).await {
        Ok(result) => result,
        Err(error) => Err(OwnTaskError { class: FailClass::Training, message: format!("panicked: {error}") }),
    }
}
