//! The files of a succeeded job; `docs/using/output.md` lists their names and contents.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use fathom_core::cover;
use fathom_core::metrics::protocol;
use fathom_core::paths::check_inside;
use fathom_core::scene::{BlobRef, PinholeCamera, Pose};
use fathom_core::seams;
use fathom_core::views::TrainView;
use fathom_core::water::Consensus;
use fathom_merge::ModelManifest;
use fathom_plan::Plan;
use fathom_proto::worker::v1::ViewMetrics;
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::evaluation::{self, Evaluated};
use super::input::{JobInput, blocking, config_of, made, read_plan};
use super::merge::MergeReport;
use super::{OwnTaskError, exchange, sets, viewing_copy};
use crate::objects::{BlobStore, ObjectError};
use crate::schedule::{Artifact, HeldOut, JobRecord, Stage, TaskId, TaskOutput, TaskState, TaskStats};
use crate::store::JobView;

/// The index of the files. It is a separate blob, because a job can have thousands of renders.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArtifactIndex {
    /// Path under the output folder and content, by ascending path.
    pub files: Vec<(String, BlobRef)>,
}

impl ArtifactIndex {
    /// Reads an index.
    ///
    /// # Errors
    /// When the bytes are not an index.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, ObjectError> {
        let refuse = |why: String| ObjectError::DigestMismatch {
            digest: String::new(),
            message: format!("the index of the artifacts cannot be read: {why}"),
        };
        let index: Self = serde_json::from_slice(bytes).map_err(|e| refuse(e.to_string()))?;
        for (path, _) in &index.files {
            check_inside(path).map_err(|fault| refuse(format!("the path of one of its files {fault}")))?;
        }
        Ok(index)
    }
}

/// The error of an artifact that another version may have written.
pub(super) fn unreadable(artifact: Artifact, blob: &BlobRef, error: &dyn std::error::Error) -> OwnTaskError {
    OwnTaskError::failed(format!(
        "the {} {} cannot be read: {error}; use one version of Fathom for the whole job",
        artifact.title(),
        blob.digest
    ))
}

/// Writes the files of a job whose model is merged and evaluated.
pub async fn assemble(objects: &Arc<BlobStore>, view: &JobView) -> Result<TaskOutput, OwnTaskError> {
    let job = &view.job;
    let model = made(job, Artifact::Model)?.clone();
    let plan_json = made(job, Artifact::Plan)?.clone();
    let plan_png = made(job, Artifact::PlanPicture)?.clone();
    let report = made(job, Artifact::MergeReport)?;
    let report: MergeReport = serde_json::from_slice(&objects.read(report).await?)
        .map_err(|e| unreadable(Artifact::MergeReport, report, &e))?;
    let input = JobInput::read(objects, job).await?;
    let plan = read_plan(objects, job).await?;
    let evaluation = evaluation::read(objects, view, plan.held_out.len()).await?;
    let views = input.views()?;
    let water = water_json(&report, exchange::read(objects, view).await?.as_ref());

    // What viewers show.
    let mut shown = model.clone();
    let mut files = vec![("plan.json".to_owned(), plan_json), ("plan.png".to_owned(), plan_png)];
    if config_of(job)?.method.through_surface() {
        // Its rows are not those of the merge, which the manifest describes.
        let sets = sets::make(objects, &model).await?;
        if let Some((_, dry)) = sets.iter().find(|(name, _)| name == "model.ply") {
            shown = dry.clone();
        }
        files.extend(sets);
    } else {
        files.push(("model.ply".to_owned(), model.clone()));
        files.push(("model.json".to_owned(), manifest_of(objects, &report.manifest, &model).await?));
    }
    if let Some(copy) = viewing_copy::make(objects, &shown).await? {
        files.push((viewing_copy::FILE.to_owned(), copy));
    }
    for (path, value) in [
        ("cameras.json", cameras_json(&views)),
        ("metrics.json", {
            let mut metrics = metrics_json(view, &input, &plan, &views, &report, evaluation.as_ref());
            seams::put_into(&mut metrics, evaluation.as_ref().and_then(|found| found.seams.as_ref()));
            cover::put_into(&mut metrics, evaluation.as_ref().and_then(|found| found.cover.as_ref()));
            if let Some(gains) = evaluation.as_ref().and_then(|found| found.clear_gains) {
                metrics["picture_gains"] = serde_json::json!(gains);
            }
            metrics
        }),
        ("run.json", run_json(view, &input)),
    ]
    .into_iter()
    .chain(water.map(|water| ("water.json", water)))
    {
        let text = serde_json::to_vec_pretty(&value).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        files.push((path.to_owned(), objects.put(Bytes::from(text)).await?));
    }
    for (index, metrics) in evaluation.iter().flat_map(|evaluation| &evaluation.views).enumerate() {
        for (kind, blob) in [("", &metrics.side_by_side), ("border_", &metrics.border)] {
            if let Some(blob) = blob {
                let blob = BlobRef { digest: blob.digest.clone(), bytes: blob.size_bytes };
                objects.require(&blob).await?;
                files.push((render_path(kind, index, &metrics.name), blob));
            }
        }
    }
    files.sort();
    let index =
        serde_json::to_vec(&ArtifactIndex { files }).map_err(|e| OwnTaskError::failed(e.to_string()))?;
    let blob = objects.put(Bytes::from(index)).await?;
    Ok(TaskOutput::of(Stage::Artifacts, blob, TaskStats::default()))
}

/// `model.json` of the final model: that of the merge, or with new bounds if borders were trained since.
async fn manifest_of(
    objects: &Arc<BlobStore>,
    merged: &BlobRef,
    model: &BlobRef,
) -> Result<BlobRef, OwnTaskError> {
    let failed = |why: String| OwnTaskError::failed(format!("model.json: {why}"));
    let manifest: ModelManifest =
        serde_json::from_slice(&objects.read(merged).await?).map_err(|e| failed(e.to_string()))?;
    if manifest.blake3 == model.digest {
        return Ok(merged.clone());
    }
    let (files, path, digest) = (objects.files(), objects.path_of(model)?, model.digest.clone());
    let json = blocking(move || {
        let manifest = manifest.of_changed_rows(&files, &path, &digest);
        let manifest = manifest.map_err(|error| OwnTaskError::of_merge(&error))?;
        serde_json::to_vec(&manifest).map_err(|e| failed(e.to_string()))
    });
    Ok(objects.put(json.await?.into()).await?)
}

/// Maximum length of a photograph's name in the name of its render: with number and extension it must be a
/// valid file name on any system.
const MAX_STEM_BYTES: usize = 200;

/// Numbered, because names of different folders can look the same once `/` is replaced.
pub fn render_path(kind: &str, index: usize, name: &str) -> String {
    let stem = match name.rsplit_once('.') {
        Some((stem, extension)) if !extension.contains('/') => stem,
        _ => name,
    };
    let plain = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let stem: String = stem.chars().map(plain).take(MAX_STEM_BYTES).collect();
    format!("renders/{kind}{index:04}_{stem}.png")
}

/// As 3DGS writes it beside a model: rotation is camera to world, row by row.
fn cameras_json(views: &[TrainView]) -> Value {
    let camera = |(id, view): (usize, &TrainView)| {
        let Pose { rotation, .. } = view.pose;
        let to_world = DMat3::from_quat(rotation.inverse());
        let rows: Vec<[f64; 3]> = (0..3).map(|row| to_world.row(row).to_array()).collect();
        let PinholeCamera { width, height, fx, fy, cx, cy } = view.camera;
        json!({
            "id": id,
            "img_name": view.name,
            "width": width,
            "height": height,
            "position": view.pose.centre().to_array(),
            "rotation": rows,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
        })
    };
    Value::Array(views.iter().enumerate().map(camera).collect())
}

/// The water of the model as a `WaterRecord`. If partitions trained it, it includes the result of each: a
/// list of `PartitionWater` as `partitions`. `None` where there is no medium.
fn water_json(report: &MergeReport, consensus: Option<&Consensus>) -> Option<Value> {
    let mut water = json!(report.water.as_ref()?);
    if let Some(Consensus { partitions, .. }) = consensus {
        water["partitions"] = json!(partitions);
    }
    Some(water)
}

fn metrics_json(
    view: &JobView,
    input: &JobInput,
    plan: &Plan,
    views: &[TrainView],
    report: &MergeReport,
    evaluation: Option<&Evaluated>,
) -> Value {
    let job = &view.job;
    let measured = evaluation.map_or(&[][..], |evaluation| &evaluation.views);
    let per_view: Vec<Value> = measured
        .iter()
        .map(|m| json!({ "name": m.name, "psnr": number(m.psnr_db), "ssim": number(m.ssim), "lpips": null }))
        .collect();
    // In double precision, as in the plan: a camera on a border belongs to one cell.
    let rotation = plan.alignment.rotation();
    let centres: HashMap<&str, DVec3> =
        views.iter().map(|view| (view.name.as_str(), rotation * view.pose.centre())).collect();
    let partitions: Vec<Value> = plan
        .partitions
        .iter()
        .map(|partition| {
            let id = partition.id.0;
            let seconds = |task: TaskId| done_stats(view, task).map(|(_, seconds)| seconds);
            let first = seconds(Stage::FirstPart.task_of(id)).unwrap_or(0.0);
            let stands_in_cell = |m: &&ViewMetrics| {
                centres.get(m.name.as_str()).is_some_and(|centre| partition.cell.contains(*centre))
            };
            json!({
                "id": partition.id.0,
                "cameras": partition.chosen_views.len(),
                "gaussians": report.kept.get(partition.id.0 as usize),
                "gaussians_duplicate": report.duplicates.get(partition.id.0 as usize),
                "gaussians_over_cap": report.thinned.get(partition.id.0 as usize),
                "iterations": partition.iterations,
                "seconds": seconds(Stage::Partition.task_of(id)).map(|rest| first + rest),
                "psnr": mean(measured.iter().filter(stands_in_cell).map(|m| m.psnr_db)),
            })
        })
        .collect();
    let mut adapters: Vec<&str> = view
        .tasks
        .iter()
        .filter_map(|(task, _)| match &task.state {
            TaskState::Done { stats, .. } if !stats.adapter.is_empty() => Some(stats.adapter.as_str()),
            _ => None,
        })
        .collect();
    adapters.sort_unstable();
    adapters.dedup();
    let mut metrics = json!({
        "psnr": mean(measured.iter().map(|m| m.psnr_db)),
        "ssim": mean(measured.iter().map(|m| m.ssim)),
        "lpips": null,
        "views": per_view,
        "gaussians": report.kept.iter().sum::<u64>(),
        "partitions": partitions,
        "seconds": seconds_json(job),
        "iterations": input.config.train.iterations,
        "adapter": adapters.join(", "),
        "colour_space": "sRGB",
        "medium": report.water.as_ref().map_or(json!("none"), |water| json!(water.composition.medium())),
        "protocol": protocol(),
    });
    let history = training_history(view);
    if !history.is_empty() {
        metrics["held_out_in_training"] = history.into();
    }
    metrics
}

/// Measurements on held-out views during training, in order of tasks and iterations.
fn training_history(view: &JobView) -> Vec<Value> {
    let done = view.tasks.iter().filter_map(|(task, _)| match &task.state {
        TaskState::Done { stats, .. } => Some((task.task, &stats.held_out)),
        _ => None,
    });
    let row = |task: TaskId, m: &HeldOut| {
        let (psnr, ssim) = (number(m.psnr_db), number(m.ssim));
        json!({ "task": task.to_string(), "iteration": m.iteration, "psnr": psnr, "ssim": ssim, "views": m.views })
    };
    done.flat_map(|(task, history)| history.iter().map(move |m| row(task, m))).collect()
}

/// Wall time of the submission and of each stage before this one; 0 for a stage that was skipped.
fn seconds_json(job: &JobRecord) -> Value {
    let stages = Stage::all().filter(|stage| *stage < Stage::Artifacts);
    let seconds = |stage: Stage| json!(job.stage_seconds.get(&stage).copied().unwrap_or(0.0));
    let of_stages = stages.map(|stage| (stage.name().to_owned(), seconds(stage)));
    Value::Object(
        std::iter::once(("ingest".to_owned(), json!(job.ingest_seconds))).chain(of_stages).collect(),
    )
}

/// Everything that determined the result: inputs by digest, configuration, seed, versions, and the worker of
/// each task.
fn run_json(view: &JobView, input: &JobInput) -> Value {
    let job = &view.job;
    let images: Vec<Value> = input
        .manifest
        .views
        .iter()
        .map(|v| json!({ "name": v.name, "image": v.image.digest, "mask": v.mask.as_ref().map(|m| &m.digest) }))
        .collect();
    let tasks: Vec<Value> = view
        .tasks
        .iter()
        .map(|(task, _)| {
            let done = done_stats(view, task.task);
            json!({
                "id": task.task.to_string(),
                "attempts": task.attempts,
                "errors": task.errors,
                "losses": task.losses,
                "worker": task.worker,
                "resumed_from_iteration": task.resumed_from,
                "seconds": done.map(|(_, seconds)| seconds),
                "spec": task.spec.as_ref().map(|blob| &blob.digest),
            })
        })
        .collect();
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "job": job.job_id,
        "name": job.name,
        "seed": input.config.train.seed,
        "config": input.config,
        "inputs": {
            "source": input.manifest.source,
            "manifest": job.manifest.digest,
            "points": input.manifest.points.digest,
            "images": images,
        },
        "plan": job.output(Artifact::Plan).map(|blob| &blob.digest),
        "model": job.output(Artifact::Model).map(|blob| &blob.digest),
        "tasks": tasks,
    })
}

fn done_stats(view: &JobView, id: TaskId) -> Option<(&TaskStats, f64)> {
    let (task, _) = view.tasks.iter().find(|(task, _)| task.task == id)?;
    match &task.state {
        TaskState::Done { stats, seconds, .. } => Some((stats, *seconds)),
        _ => None,
    }
}

/// JSON has no NaN and no infinity; equal pictures have an infinite PSNR.
fn number(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let finite: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    number(finite.iter().sum::<f64>() / finite.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_render_has_a_plain_name_under_its_folder() {
        assert_eq!(render_path("", 3, "left/IMG 01.JPG"), "renders/0003_left_IMG_01.png");
        assert_eq!(render_path("border_", 3, "left/IMG 01.JPG"), "renders/border_0003_left_IMG_01.png");
        let long = render_path("border_", 3, &format!("{}.png", "deep/".repeat(200)));
        assert!(long.len() <= 8 + 255 && check_inside(&long).is_ok(), "{long}");
        assert_eq!(render_path("", 0, "../../etc/passwd"), "renders/0000_.._.._etc_passwd.png");
    }

    #[test]
    fn an_index_that_names_a_file_outside_of_its_folder_is_refused() {
        let read = |path: &str| {
            let files = vec![(path.to_owned(), BlobRef::of(b"a"))];
            ArtifactIndex::from_bytes(&serde_json::to_vec(&ArtifactIndex { files }).unwrap_or_default())
        };
        assert!(read("renders/a.png").is_ok_and(|index| index.files[0].0 == "renders/a.png"));
        for path in ["../a", "/etc/passwd", "a\\b", "C:/a", ""] {
            let refused = read(path).map_err(|error| error.to_string());
            assert!(
                refused.as_ref().is_err_and(|error| error.contains("the path of one")),
                "{path}: {refused:?}"
            );
        }
    }

    #[test]
    fn a_mean_of_nothing_is_null_and_infinities_are_left_out() {
        assert_eq!(mean([].into_iter()), None);
        assert_eq!(mean([f64::INFINITY, 20.0, 30.0].into_iter()), Some(25.0));
    }
}
