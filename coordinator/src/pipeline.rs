//! What the coordinator computes itself: the plan and the merge (the choice of cameras is in `select.rs`, the consensus in
//! `consensus.rs`). The thin border between tasks on one side, [`partition`](crate::partition) and
//! [`merge`](crate::merge) on the other.

use std::collections::BTreeMap;

use bytes::Bytes;
use fathom_core::config::{CameraSelection, JobConfig, WaterPartitions};
use fathom_core::ply;
use fathom_core::scene::{BlobRef, Manifest, Points};
use fathom_core::seams::{self, Axis};
use fathom_core::views::TrainView;
use fathom_core::water::WaterRecord;
use fathom_observe::threads;
use fathom_proto::worker::v1::{FocusBox, SeamLine, SeamLines, TaskSpec};
use prost::Message;
use serde::{Deserialize, Serialize};

use crate::launcher::OwnTaskError;
use crate::merge::{ModelManifest, PartitionResult, merge};
use crate::objects::BlobStore;
use crate::partition::{
    BorderStage, Connected, PartitionId, Plan, PlanError, PlanInput, Rect, picture, plan_for,
};
use crate::schedule::{JobRecord, Lease, Planned, PlannedTask, TaskId, TaskOutput, TaskState, TaskStats};
use crate::store::JobView;

/// Version of [`TaskSpec`]'s layout.
const SPEC_FORMAT: u32 = 1;

/// Longest manifest, bytes: half a kB for each of some 500,000 photographs.
pub const MAX_MANIFEST_BYTES: u64 = 256 << 20;

/// A job's configuration, manifest and points.
pub struct JobInput {
    /// Resolved configuration.
    pub config: JobConfig,
    /// The scene.
    pub manifest: Manifest,
}

pub fn config_of(job: &JobRecord) -> Result<JobConfig, OwnTaskError> {
    JobConfig::from_json(&job.config_json)
        .map_err(|e| OwnTaskError::input(format!("the job's configuration: {e}")))
}

impl JobInput {
    /// Reads what a job refers to.
    pub async fn read(objects: &BlobStore, job: &JobRecord) -> Result<Self, OwnTaskError> {
        let config = config_of(job)?;
        Self::parse(config, &objects.read_at_most(&job.manifest, MAX_MANIFEST_BYTES).await?)
    }

    /// From the bytes of a manifest, which anybody may have uploaded.
    pub fn parse(config: JobConfig, manifest: &[u8]) -> Result<Self, OwnTaskError> {
        let manifest = Manifest::from_json(manifest).map_err(|e| OwnTaskError::input(e.to_string()))?;
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
            Ok(TrainView { name: view.name.clone(), camera, pose: view.pose, clear_range: 0.0 })
        };
        self.manifest.views.iter().map(view).collect()
    }
}

/// Cuts the scene of a job, for the workers that are connected where it may choose how, and stores the plan, its picture
/// and the specification of every task.
pub async fn plan_job(
    objects: &BlobStore,
    job: &JobRecord,
    connected: Connected,
) -> Result<TaskOutput, OwnTaskError> {
    let input = JobInput::read(objects, job).await?;
    require_uploads(objects, &input.manifest).await?;
    let config = input.config.clone();
    let cut = move |input: &PlanInput<'_>| plan_for(input, connected);
    let Drawn { plan, plan_json, plan_png } = draw(objects, job, input, cut).await?;
    tracing::info!(job = %job.job_id, partitions = plan.partitions.len(), reason = plan.cut.reason, "cut the scene");
    let mut warnings = plan.warnings(&config.train);
    if config.water.partitions == WaterPartitions::Refine
        && !config.water.is_refined(plan.partitions.len() as u32)
    {
        warnings.push(
            "water.partitions = \"refine\" changes nothing here: it takes more than one partition and a medium".into(),
        );
    }
    if config.borders.refine && plan.borders.is_none() {
        warnings.push("borders.refine changes nothing here: it takes more than one partition".into());
    }
    if config.partition.selection == CameraSelection::Contribution && plan.global.is_none() {
        warnings.push("partition.selection changes nothing here: it takes more than one partition".into());
    }
    if config.partition.auto && connected.workers == 0 && config.partition.workers == 0 {
        warnings.push(
            "no worker was there when the scene was cut, so it was cut for one; start workers first, or say with \
             partition.workers how many there will be"
                .into(),
        );
    }
    let select = plan.global.is_some() && config.partition.selection == CameraSelection::Contribution;
    let global = match &plan.global {
        Some(stage) => {
            let views = plan.training_views();
            let spec = task_spec(&plan, 0, &views, stage.max_resolution);
            let regions = if select {
                plan.partitions.iter().map(|partition| box_on_plane(&plan, &partition.focus)).collect()
            } else {
                Vec::new()
            };
            let spec = TaskSpec {
                iterations: stage.iterations,
                max_gaussians: stage.max_gaussians,
                held_out: measured(&plan, &config),
                view_weights: plan.view_weights(),
                regions,
                ..spec
            };
            Some(put_spec(objects, spec, stage.forecast.bytes).await?)
        }
        None => None,
    };
    let (refine, partitions) = put_partitions(objects, &plan, &config).await?;
    let borders = match &plan.borders {
        Some(stage @ BorderStage { views, iterations, .. }) => {
            let boxes = |rects: Vec<Rect>| rects.iter().map(|rect| box_on_plane(&plan, rect)).collect();
            let (band, surroundings) = (boxes(stage.band()), boxes(stage.surroundings()));
            let spec = task_spec(&plan, 0, views, config.data.max_resolution);
            let spec = TaskSpec { iterations: *iterations, band, surroundings, ..spec };
            // It holds the whole model, which nobody has forecast.
            Some(put_spec(objects, spec, 0).await?)
        }
        None => None,
    };
    let evaluate = if plan.held_out.is_empty() {
        None
    } else {
        let seams = plan.seam_lines(&config.seams).as_ref().map(seam_lines);
        let spec = task_spec(&plan, 0, &plan.held_out, config.data.max_resolution);
        Some(put_spec(objects, TaskSpec { seams, ..spec }, 0).await?.spec)
    };
    Ok(TaskOutput::Plan(Box::new(Planned {
        plan: objects.put(plan_json.into()).await?,
        picture: objects.put(plan_png.into()).await?,
        global,
        select,
        refine,
        partitions,
        borders,
        evaluate,
        warnings,
    })))
}

/// A plan, as JSON and as a picture.
pub struct Drawn {
    pub plan: Plan,
    pub plan_json: Vec<u8>,
    pub plan_png: Vec<u8>,
}

/// Cuts the scene of a job by `plan`, on a thread for it.
pub async fn draw(
    objects: &BlobStore,
    job: &JobRecord,
    input: JobInput,
    plan: impl FnOnce(&PlanInput<'_>) -> Result<Plan, PlanError> + Send + 'static,
) -> Result<Drawn, OwnTaskError> {
    let points = objects.read(&input.manifest.points).await?;
    let title = job.name.clone();
    blocking(move || {
        let points = Points::from_bytes(&points).map_err(|e| OwnTaskError::input(e.to_string()))?;
        let views = input.views()?;
        let plan_input = PlanInput { views: &views, points: &points, config: &input.config };
        let plan = plan(&plan_input).map_err(|e| OwnTaskError::input(e.to_string()))?;
        plan.require_points().map_err(|e| OwnTaskError::input(e.to_string()))?;
        let plan_json = serde_json::to_vec_pretty(&plan).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        let plan_png = picture::draw(&plan, &views, &points, &title).map_err(OwnTaskError::failed)?;
        Ok(Drawn { plan, plan_json, plan_png })
    })
    .await
}

/// What is said of every task on the photographs of this plan.
fn task_spec(plan: &Plan, partition: u32, views: &[u32], max_resolution_px: u32) -> TaskSpec {
    TaskSpec {
        format: SPEC_FORMAT,
        partition,
        views: views.to_vec(),
        max_resolution_px,
        iterations: 0,
        max_gaussians: 0,
        scene_extent: plan.extent.learning_scale() as f32,
        focus: None,
        viewing_distance: plan.extent.viewing_distance.map(|distance| distance as f32),
        held_out: Vec::new(),
        from_iteration: 0,
        until_iteration: 0,
        loss_factor: None,
        gradient_factor: None,
        view_weights: Vec::new(),
        regions: Vec::new(),
        band: Vec::new(),
        surroundings: Vec::new(),
        seams: None,
        clear_ranges: clear_ranges(plan, views),
        cell: None,
        neighbours: Vec::new(),
    }
}

/// How far each of `views` is clear; empty where nothing asks.
fn clear_ranges(plan: &Plan, views: &[u32]) -> Vec<f32> {
    views.iter().filter_map(|view| plan.clear_ranges.get(*view as usize).copied()).collect()
}

/// Views that a run measures on the way: only one that trains the whole scene can be measured on views of all of it.
fn measured(plan: &Plan, config: &JobConfig) -> Vec<u32> {
    if config.train.eval_every > 0 { plan.held_out.clone() } else { Vec::new() }
}

/// The tasks of all partitions by index: their first parts, if they have such, and what is left of them.
pub async fn put_partitions(
    objects: &BlobStore,
    plan: &Plan,
    config: &JobConfig,
) -> Result<(Vec<PlannedTask>, Vec<PlannedTask>), OwnTaskError> {
    let factor = |factor: f64| (factor != 1.0).then_some(factor as f32);
    let count = plan.partitions.len() as u32;
    let (mut refine, mut partitions) = (Vec::new(), Vec::with_capacity(plan.partitions.len()));
    for partition in &plan.partitions {
        let spec = task_spec(plan, partition.id.0, &partition.chosen_views, config.data.max_resolution);
        let mut spec = TaskSpec {
            iterations: partition.iterations,
            max_gaussians: partition.max_gaussians,
            focus: plan.global.is_some().then(|| box_on_plane(plan, &partition.focus)),
            held_out: if plan.global.is_none() { measured(plan, config) } else { Vec::new() },
            loss_factor: factor(partition.weighed.loss_factor),
            gradient_factor: factor(partition.weighed.gradient_factor),
            ..spec
        };
        if let Some(exchange) = config.exchange_at(partition.iterations, count) {
            if config.partition.has_neighbours(count) {
                spec.cell = Some(box_on_plane(plan, &partition.cell));
            }
            let first = TaskSpec { until_iteration: exchange, ..spec.clone() };
            refine.push(put_spec(objects, first, partition.forecast.bytes).await?);
            spec.from_iteration = exchange;
            if spec.cell.is_some() {
                spec.neighbours = plan.neighbours_of(partition).map(|neighbour| neighbour.id.0).collect();
            }
        }
        partitions.push(put_spec(objects, spec, partition.forecast.bytes).await?);
    }
    Ok((refine, partitions))
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

/// `memory_bytes` is the forecast of what it needs, 0 where there is none.
async fn put_spec(
    objects: &BlobStore,
    spec: TaskSpec,
    memory_bytes: u64,
) -> Result<PlannedTask, OwnTaskError> {
    let iterations = spec.own_iterations();
    Ok(PlannedTask { spec: objects.put(spec.encode_to_vec().into()).await?, iterations, memory_bytes })
}

fn box_on_plane(plan: &Plan, rect: &Rect) -> FocusBox {
    FocusBox {
        align_quat_wxyz: plan.alignment.world_to_aligned_quat_wxyz.to_vec(),
        min_x: rect.x.lo.unwrap_or(f64::NEG_INFINITY),
        max_x: rect.x.hi.unwrap_or(f64::INFINITY),
        min_z: rect.z.lo.unwrap_or(f64::NEG_INFINITY),
        max_z: rect.z.hi.unwrap_or(f64::INFINITY),
    }
}

fn seam_lines(lines: &seams::SeamLines) -> SeamLines {
    let line = |line: &seams::Line| {
        let (from, to) = match line.axis {
            Axis::X => ([line.at, line.from], [line.at, line.to]),
            Axis::Z => ([line.from, line.at], [line.to, line.at]),
        };
        SeamLine { from_x: from[0], from_z: from[1], to_x: to[0], to_z: to[1] }
    };
    let glam::DQuat { x, y, z, w } = lines.world_to_aligned;
    SeamLines {
        align_quat_wxyz: vec![w, x, y, z],
        borders: lines.borders.iter().map(line).collect(),
        controls: lines.controls.iter().map(line).collect(),
        band: lines.band,
    }
}

/// The plan that a job was given.
pub async fn read_plan(objects: &BlobStore, job: &JobRecord) -> Result<Plan, OwnTaskError> {
    let blob = job.plan.as_ref().ok_or_else(|| OwnTaskError::failed("the job has no plan".into()))?;
    Plan::from_json(&objects.read(blob).await?).map_err(OwnTaskError::input)
}

/// What each partition gave to the merged model.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct MergeReport {
    /// Gaussians of each partition in the model, by index: those of its own cell.
    pub kept: Vec<u64>,
    /// Gaussians of its own cell that went because a neighbour has the same, by index.
    #[serde(default)]
    pub duplicates: Vec<u64>,
    /// Gaussians of its own cell that went because all cells together passed the cap, by index.
    #[serde(default)]
    pub thinned: Vec<u64>,
    /// Gaussians of its margins, which its neighbours keep, by index.
    pub cropped: Vec<u64>,
    /// `model.json`; absent in reports of earlier versions.
    #[serde(default)]
    pub manifest: Option<BlobRef>,
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
    let plan_digest = view.job.plan.as_ref().map(|blob| blob.digest.clone()).unwrap_or_default();
    let config = config_of(&view.job)?;
    let cap = u64::from(config.train.max_gaussians);
    let mut results = Vec::with_capacity(plan.partitions.len());
    let mut handed_in = Vec::with_capacity(plan.partitions.len());
    for (task, _) in &view.tasks {
        if let (TaskId::Partition(index), TaskState::Done { result, .. }) = (task.task, &task.state) {
            handed_in.push((task.task, result));
            results.push(PartitionResult {
                partition: PartitionId(index),
                path: objects.local_path(result)?,
                digest: result.digest.clone(),
            });
        }
    }
    // The fence in the name: a merge of an earlier process can still be writing.
    let staged = format!("merge-{}-{}.ply", lease.job, lease.fence);
    let out = objects.staging_path(&staged);
    let made = blocking(move || {
        let merged = merge(&plan, &results, &config.merge, cap, &out)
            .map_err(|e| OwnTaskError::failed(e.to_string()))?;
        let manifest = ModelManifest::new(&plan, &plan_digest, &results, &merged);
        let manifest = serde_json::to_vec(&manifest).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        let water = ply::water_record(&out).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        Ok((merged, manifest, water))
    })
    .await;
    let (merged, manifest, water) = match made {
        Ok(made) => made,
        Err(error) => return Err(lost_results(objects, &handed_in, error).await?),
    };
    let duplicates: u64 = merged.partitions.iter().map(|partition| partition.duplicates).sum();
    if duplicates > 0 {
        tracing::info!(job = %lease.job, duplicates, "dropped Gaussians that a neighbour has too, across borders");
    }
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
        duplicates: merged.partitions.iter().map(|partition| partition.duplicates).collect(),
        cropped: merged.partitions.iter().map(|partition| partition.cropped).collect(),
        manifest: Some(objects.put(Bytes::from(manifest)).await?),
        water,
    };
    let report = serde_json::to_vec(&report).map_err(|e| OwnTaskError::failed(e.to_string()))?;
    Ok(TaskOutput::Merged {
        model: objects.adopt(&staged, BlobRef { digest: merged.digest, bytes: merged.bytes }).await?,
        report: objects.put(Bytes::from(report)).await?,
        stats: TaskStats {
            gaussians: u32::try_from(merged.gaussians).unwrap_or(u32::MAX),
            ..TaskStats::default()
        },
    })
}

/// Why a merge has failed: results that are not what was handed in, if there are such, else what it says itself.
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

/// Runs work that computes on a thread for it.
pub async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, OwnTaskError> + Send + 'static,
) -> Result<T, OwnTaskError> {
    // What it logs belongs to the task.
    let span = tracing::Span::current();
    match threads::blocking(move || span.in_scope(work)).await {
        Ok(result) => result,
        Err(error) => Err(OwnTaskError::failed(format!("panicked: {error}"))),
    }
}

#[cfg(test)]
mod tests {

    use fathom_core::scene::{PinholeCamera, Pose};
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::partition::{Connected, TurnRule};

    #[test]
    fn a_task_is_told_how_far_its_own_views_are_clear() {
        let camera = PinholeCamera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        let views: Vec<TrainView> = (0..20)
            .map(|i| {
                let eye = DVec3::new(f64::from(i), 0.0, 0.0);
                let pose = Pose::looking_at(eye, eye + DVec3::Z, DVec3::Y);
                TrainView { name: format!("{i:02}"), camera, pose, clear_range: 0.0 }
            })
            .collect();
        let config = JobConfig::default();
        let input = PlanInput { views: &views, points: &Points::default(), config: &config };
        let mut plan = plan_for(&input, Connected::default()).unwrap();
        assert_eq!(plan.clear_ranges, [0.0; 20], "there are no points");
        plan.clear_ranges = (0..20).map(|view| view as f32).collect();
        // Every task's specification begins with this, whatever it trains.
        assert_eq!(task_spec(&plan, 0, &[3, 11], 0).clear_ranges, [3.0, 11.0]);
        plan.clear_ranges.clear();
        assert!(task_spec(&plan, 0, &[3, 11], 0).clear_ranges.is_empty());
    }

    #[test]
    fn a_worker_is_given_the_box_in_the_axes_of_the_plan_with_the_turn() {
        let camera = PinholeCamera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        let turn = DQuat::from_rotation_y(0.5);
        let views: Vec<TrainView> = (0..90)
            .map(|i| {
                let eye = turn * DVec3::new(f64::from(i % 30), 0.0, f64::from(i / 30) * 2.0);
                let pose = Pose::looking_at(eye, eye + turn * DVec3::new(0.1, 0.4, 1.0), DVec3::Y);
                TrainView { name: format!("{i:02}"), camera, pose, clear_range: 0.0 }
            })
            .collect();
        let mut config = JobConfig::default();
        (config.partition.columns, config.partition.rows) = (3, 1);
        let input = PlanInput { views: &views, points: &Points::default(), config: &config };
        let plan = plan_for(&input, Connected::default()).unwrap();
        assert_eq!(plan.alignment.turn.rule, TurnRule::CompactCells);
        let neighbours =
            |of: usize| plan.neighbours_of(&plan.partitions[of]).map(|other| other.id.0).collect::<Vec<_>>();
        assert_eq!([0, 1, 2].map(neighbours), [vec![1], vec![0, 2], vec![1]]);
        for partition in &plan.partitions {
            let focus = box_on_plane(&plan, &partition.focus);
            let [w, x, y, z] = <[f64; 4]>::try_from(focus.align_quat_wxyz).unwrap();
            for i in 0..400_u16 {
                let point = [f32::from(i % 20) * 2.0 - 5.0, 0.0, f32::from(i / 20) * 2.0 - 25.0];
                // What a worker does with it: worker/src/execute/partition.rs.
                let aligned = DQuat::from_xyzw(x, y, z, w) * DVec3::from(point.map(f64::from));
                let inside = aligned.x > focus.min_x
                    && aligned.x <= focus.max_x
                    && aligned.z > focus.min_z
                    && aligned.z <= focus.max_z;
                assert_eq!(inside, plan.focuses(partition, point), "partition {}, {point:?}", partition.id);
                // Whose cell it lies in hands it in to all that train there.
                let owner = plan.partitions.iter().find(|other| plan.keeps(other, point)).unwrap().id;
                let is_known =
                    owner == partition.id || plan.neighbours_of(partition).any(|other| other.id == owner);
                assert!(!inside || is_known, "partition {} does not know {owner}", partition.id);
            }
        }
    }
}
