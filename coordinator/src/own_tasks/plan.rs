//! Plans a job: partitions the scene, draws the plan, and writes the specification of every task.
//! `fathom_plan` does the geometry.

use std::collections::BTreeMap;

use fathom_core::config::{DEFAULT_MEMORY_GIB, JobConfig, Method, PartitionConfig, WaterPartitions};
use fathom_core::scene::{Manifest, Points};
use fathom_core::seams::{self, Axis};
use fathom_core::views::TrainView;
use fathom_plan::{Connected, MemoryFrom, Plan, PlanInput, Rect, picture, plan_for};
use fathom_proto::worker::v1::task_spec::Work;
use fathom_proto::worker::v1::{
    BordersSpec, CommonSpec, EvaluateSpec, FocusBox, GlobalSpec, PartitionSpec, SeamLine, SeamLines, TaskSpec,
};
use glam::{DVec2, DVec3, Vec3Swizzles as _};
use prost::Message;

use super::OwnTaskError;
use super::evaluation::views_of_part;
use super::input::{JobInput, blocking};
use crate::objects::BlobStore;
use crate::schedule::{JobRecord, Planned, PlannedTask, Stage, TaskId, TaskOutput};

/// Version of [`TaskSpec`]'s layout.
const SPEC_FORMAT: u32 = 2;

/// Partitions the scene of a job and stores the plan, its picture and the specification of every task.
/// `partition.auto` plans for the connected workers.
pub async fn plan_job(
    objects: &BlobStore,
    job: &JobRecord,
    connected: Connected,
) -> Result<TaskOutput, OwnTaskError> {
    let input = JobInput::read(objects, job).await?;
    require_uploads(objects, &input.manifest).await?;
    let config = input.config.clone();
    let Drawn { plan, plan_json, plan_png, centres } = draw(objects, job, input, connected).await?;
    tracing::info!(job = %job.job_id, partitions = plan.partitions.len(), reason = plan.cut.reason, "partitioned the scene");
    let warnings = warnings_of(&plan, &config, connected);
    let mut tasks = put_partitions(objects, &plan, &config, &centres).await?;
    let own = |stage: Stage| (stage.task(), PlannedTask::default());
    if let Some(stage) = &plan.global {
        let common = CommonSpec {
            iterations: stage.iterations,
            max_gaussians: stage.max_gaussians,
            held_out: measured(&plan, &config),
            previews: previewed(&plan, &config, &centres, &[]),
            ..common_spec(&plan, &plan.training_views(), stage.max_resolution)
        };
        let work = Work::Global(GlobalSpec { view_weights: plan.view_weights() });
        tasks.insert(
            Stage::Global.task(),
            put_spec(objects, config.method, common, work, stage.forecast.bytes).await?,
        );
    }
    if tasks.keys().any(|task| task.stage == Stage::FirstPart) {
        tasks.extend([own(Stage::Exchange)]);
    }
    if let Some(stage) = &plan.borders {
        let boxes = |rects: Vec<Rect>| rects.iter().map(|rect| box_on_plane(&plan, rect)).collect();
        let work = Work::Borders(BordersSpec {
            band: boxes(stage.band()),
            surroundings: boxes(stage.surroundings()),
        });
        let common = common_spec(&plan, &stage.views, config.data.max_resolution);
        let common = CommonSpec { iterations: stage.iterations, ..common };
        // It holds the whole model, whose memory has no forecast.
        tasks.insert(Stage::Borders.task(), put_spec(objects, config.method, common, work, 0).await?);
    }
    tasks.extend(put_evaluations(objects, &plan, &config).await?);
    tasks.extend([own(Stage::Merge), own(Stage::Artifacts)]);
    let (plan_blob, picture) = (objects.put(plan_json.into()).await?, objects.put(plan_png.into()).await?);
    Ok(TaskOutput::planned(plan_blob, picture, Planned { tasks, warnings }))
}

/// What is unusual about a plan; a sentence each.
pub fn warnings_of(plan: &Plan, config: &JobConfig, connected: Connected) -> Vec<String> {
    let mut warnings = plan.warnings(&config.train);
    if config.water.partitions == WaterPartitions::Joint
        && !config.water.is_joint_for(plan.partitions.len() as u32)
    {
        warnings.push(
            "water.partitions = \"joint\" has no effect here: it needs more than one partition and a medium"
                .into(),
        );
    }
    if config.borders.enabled && plan.borders.is_none() {
        warnings.push("borders.enabled has no effect here: it needs more than one partition".into());
    }
    warnings.extend(warning_of_defaults(plan, connected, &config.partition));
    warnings
}

/// What `partition.auto` assumed because no worker was connected and the configuration does not say it.
fn warning_of_defaults(plan: &Plan, connected: Connected, config: &PartitionConfig) -> Option<String> {
    let planned_for = plan.cut.planned_for.filter(|_| connected.workers == 0)?;
    let mut assumed = Vec::new();
    if config.workers == 0 {
        assumed.push(("one worker".to_owned(), "partition.workers"));
    }
    if planned_for.memory_from == MemoryFrom::Default {
        assumed.push((format!("{DEFAULT_MEMORY_GIB} GiB of GPU memory"), "partition.memory_gib"));
    }
    let (what, settings): (Vec<String>, Vec<&str>) = assumed.into_iter().unzip();
    (!what.is_empty()).then(|| {
        format!(
            "no worker was connected when the scene was partitioned, so the plan assumes {}; start workers first, or set {}",
            what.join(" with "),
            settings.join(" and ")
        )
    })
}

/// The plan of a scene, and its views.
pub fn planned(
    input: &JobInput,
    points: &Points,
    connected: Connected,
) -> Result<(Plan, Vec<TrainView>), OwnTaskError> {
    let views = input.views()?;
    let plan_input = PlanInput { views: &views, points, config: &input.config };
    let plan = plan_for(&plan_input, connected).map_err(|e| OwnTaskError::input(e.to_string()))?;
    plan.require_points().map_err(|e| OwnTaskError::input(e.to_string()))?;
    Ok((plan, views))
}

/// A plan, as JSON and as a picture.
struct Drawn {
    plan: Plan,
    plan_json: Vec<u8>,
    plan_png: Vec<u8>,
    /// The centre of each view's camera, aligned axes, scene units.
    centres: Vec<DVec3>,
}

/// Plans the scene of a job, on a thread for blocking work.
async fn draw(
    objects: &BlobStore,
    job: &JobRecord,
    input: JobInput,
    connected: Connected,
) -> Result<Drawn, OwnTaskError> {
    let points = objects.read(&input.manifest.points).await?;
    let title = job.name.clone();
    blocking(move || {
        let points = Points::from_bytes(&points).map_err(|e| OwnTaskError::input(e.to_string()))?;
        let (plan, views) = planned(&input, &points, connected)?;
        let plan_json = serde_json::to_vec_pretty(&plan).map_err(|e| OwnTaskError::failed(e.to_string()))?;
        let plan_png = picture::draw(&plan, &views, &points, &title).map_err(OwnTaskError::failed)?;
        let centre = |view: &TrainView| plan.alignment.to_aligned(view.pose.centre().as_vec3().to_array());
        let centres = views.iter().map(centre).collect();
        Ok(Drawn { plan, plan_json, plan_png, centres })
    })
    .await
}

/// The common part of the specifications of all tasks on these photographs.
fn common_spec(plan: &Plan, views: &[u32], max_resolution_px: u32) -> CommonSpec {
    CommonSpec {
        views: views.to_vec(),
        max_resolution_px,
        scene_extent: plan.extent.learning_scale() as f32,
        viewing_distance: plan.extent.viewing_distance.map(|distance| distance as f32),
        clear_ranges: clear_ranges(plan, views),
        ..CommonSpec::default()
    }
}

/// The clear range of each of `views`; empty where it is not needed.
fn clear_ranges(plan: &Plan, views: &[u32]) -> Vec<f32> {
    views.iter().filter_map(|view| plan.clear_ranges.get(*view as usize).copied()).collect()
}

/// Held-out views of a run: only a run that trains the whole scene can be measured on views of all of it.
fn measured(plan: &Plan, config: &JobConfig) -> Vec<u32> {
    if config.train.eval_every > 0 { plan.held_out.clone() } else { Vec::new() }
}

/// Held-out views for the previews of a run, ascending: those whose cameras are closest to the middle of the
/// cameras of `near`. If `near` is empty, they are spread over the whole scene.
fn previewed(plan: &Plan, config: &JobConfig, centres: &[DVec3], near: &[u32]) -> Vec<u32> {
    let count = if config.train.preview_seconds > 0 { config.train.preview_views as usize } else { 0 };
    let held_out = &plan.held_out;
    if near.is_empty() || held_out.len() <= count {
        let count = count.min(held_out.len());
        return (0..count).map(|part| held_out[(2 * part + 1) * held_out.len() / (2 * count)]).collect();
    }
    let at = |view: u32| centres.get(view as usize).map_or(DVec2::ZERO, |centre| centre.xz());
    let middle = near.iter().map(|&view| at(view)).sum::<DVec2>() / near.len() as f64;
    let mut closest = held_out.clone();
    closest.sort_by(|&a, &b| at(a).distance_squared(middle).total_cmp(&at(b).distance_squared(middle)));
    closest.truncate(count);
    closest.sort_unstable();
    closest
}

/// The tasks of all partitions: the first part before the exchange, if there is one, and the rest.
async fn put_partitions(
    objects: &BlobStore,
    plan: &Plan,
    config: &JobConfig,
    centres: &[DVec3],
) -> Result<BTreeMap<TaskId, PlannedTask>, OwnTaskError> {
    let count = plan.partitions.len() as u32;
    let mut tasks = BTreeMap::new();
    for partition in &plan.partitions {
        let (index, memory_bytes) = (partition.id.0, partition.forecast.bytes);
        let loss_factor = partition.weighed.loss_factor;
        let mut common = CommonSpec {
            iterations: partition.iterations,
            max_gaussians: partition.max_gaussians,
            held_out: if plan.global.is_none() { measured(plan, config) } else { Vec::new() },
            previews: match plan.global {
                None => previewed(plan, config, centres, &[]),
                Some(_) => previewed(plan, config, centres, &partition.chosen_views),
            },
            ..common_spec(plan, &partition.chosen_views, config.data.max_resolution)
        };
        let mut work = PartitionSpec {
            index,
            focus: plan.global.is_some().then(|| box_on_plane(plan, &partition.focus)),
            loss_factor: (loss_factor != 1.0).then_some(loss_factor as f32),
            cell: None,
            neighbours: Vec::new(),
        };
        if let Some(exchange) = config.exchange_at(partition.iterations, count) {
            if config.partition.has_neighbours(count) {
                work.cell = Some(box_on_plane(plan, &partition.cell));
            }
            let first = CommonSpec { until_iteration: exchange, ..common.clone() };
            let first =
                put_spec(objects, config.method, first, Work::FirstPart(work.clone()), memory_bytes).await?;
            tasks.insert(Stage::FirstPart.task_of(index), first);
            common.from_iteration = exchange;
            if work.cell.is_some() {
                work.neighbours = plan.neighbours_of(partition).map(|neighbour| neighbour.id.0).collect();
            }
        }
        let rest = put_spec(objects, config.method, common, Work::Partition(work), memory_bytes).await?;
        tasks.insert(Stage::Partition.task_of(index), rest);
    }
    Ok(tasks)
}

/// The tasks that evaluate: one for all held-out views, or several for a part of them each. Their number
/// follows from the scene alone, so that the same job has the same tasks with any workers.
async fn put_evaluations(
    objects: &BlobStore,
    plan: &Plan,
    config: &JobConfig,
) -> Result<BTreeMap<TaskId, PlannedTask>, OwnTaskError> {
    let (held_out, mut tasks) = (&plan.held_out, BTreeMap::new());
    let seams = plan.seam_lines(&config.seams).as_ref().map(seam_lines);
    // Each task fetches the merged model. A job with few partitions has few workers.
    let of_task = config.partition.evaluation_views.max(1) as usize;
    let parts = held_out.len().div_ceil(of_task).min(plan.partitions.len());
    for part in 0..parts {
        let views = &held_out[views_of_part(part, parts, held_out.len())];
        let common = common_spec(plan, views, config.data.max_resolution);
        let (task, all) = match parts {
            1 => (Stage::Evaluate.task(), Vec::new()),
            _ => (Stage::Evaluate.task_of(part as u32 + 1), held_out.clone()),
        };
        let work = Work::Evaluate(EvaluateSpec { seams: seams.clone(), held_out: all });
        tasks.insert(task, put_spec(objects, config.method, common, work, 0).await?);
    }
    Ok(tasks)
}

/// Every photograph must be present before a worker trains for hours on the others.
async fn require_uploads(objects: &BlobStore, manifest: &Manifest) -> Result<(), OwnTaskError> {
    objects.require(&manifest.points).await?;
    let of_views = manifest.views.iter();
    let named = of_views
        .flat_map(|view| std::iter::once(&view.image).chain(&view.mask).map(move |blob| (view, blob)));
    let (views, blobs): (Vec<_>, Vec<_>) = named.map(|(view, blob)| (view, blob.clone())).unzip();
    match objects.missing(&blobs).await?.first() {
        None => Ok(()),
        Some(&first) => Err(OwnTaskError::input(format!(
            "{}: blob {} has not been uploaded; upload all files of the manifest and submit again",
            views[first].name, blobs[first].digest
        ))),
    }
}

/// `memory_bytes` is the forecast of its memory, 0 where there is none.
async fn put_spec(
    objects: &BlobStore,
    method: Method,
    common: CommonSpec,
    work: Work,
    memory_bytes: u64,
) -> Result<PlannedTask, OwnTaskError> {
    let iterations = common.own_iterations();
    let spec = TaskSpec { format: SPEC_FORMAT, common: Some(common), work: Some(work) };
    let spec = Some(objects.put(spec.encode_to_vec().into()).await?);
    Ok(PlannedTask { spec, iterations, method, memory_bytes })
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

#[cfg(test)]
mod tests {
    use fathom_core::scene::{PinholeCamera, Pose};
    use fathom_plan::TurnRule;
    use glam::DQuat;

    use super::*;

    /// Views with the place and the direction that `look` gives to each.
    fn views(count: u32, look: impl Fn(u32) -> (DVec3, DVec3)) -> Vec<TrainView> {
        let camera = PinholeCamera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        let view = |i| {
            let (eye, direction) = look(i);
            let pose = Pose::looking_at(eye, eye + direction, DVec3::Y);
            TrainView { name: format!("{i:02}"), camera, pose, clear_range: 0.0 }
        };
        (0..count).map(view).collect()
    }

    #[test]
    fn a_task_gets_the_clear_ranges_of_its_own_views() {
        let views = views(20, |i| (DVec3::new(f64::from(i), 0.0, 0.0), DVec3::Z));
        let config = JobConfig::default();
        let input = PlanInput { views: &views, points: &Points::default(), config: &config };
        let mut plan = plan_for(&input, Connected::default()).unwrap();
        assert_eq!(plan.clear_ranges, [0.0; 20], "there are no points");
        plan.clear_ranges = (0..20).map(|view| view as f32).collect();
        // The common settings of all tasks.
        assert_eq!(common_spec(&plan, &[3, 11], 0).clear_ranges, [3.0, 11.0]);
        plan.clear_ranges.clear();
        assert!(common_spec(&plan, &[3, 11], 0).clear_ranges.is_empty());
    }

    #[test]
    fn previews_show_held_out_views_near_a_partition_or_all_over() {
        let views = views(64, |i| (DVec3::new(f64::from(i), 0.0, 0.0), DVec3::Z));
        let mut config = JobConfig::default();
        let input = PlanInput { views: &views, points: &Points::default(), config: &config };
        let plan = plan_for(&input, Connected::default()).unwrap();
        assert_eq!(plan.held_out, [0, 8, 16, 24, 32, 40, 48, 56]);
        let centres: Vec<DVec3> = views.iter().map(|view| view.pose.centre()).collect();
        assert_eq!(previewed(&plan, &config, &centres, &[]), [16, 48]);
        assert_eq!(previewed(&plan, &config, &centres, &[33, 34, 35, 36, 37, 38]), [32, 40]);
        config.train.preview_views = 8;
        assert_eq!(previewed(&plan, &config, &centres, &[33]), plan.held_out);
        for count in 0..=8 {
            config.train.preview_views = count;
            let chosen = previewed(&plan, &config, &centres, &[]);
            assert_eq!(chosen.len(), count as usize);
            assert!(chosen.is_sorted() && chosen.iter().all(|view| plan.held_out.contains(view)));
        }
        config.train.preview_seconds = 0;
        assert!(previewed(&plan, &config, &centres, &[]).is_empty());
        assert!(previewed(&plan, &config, &centres, &[33]).is_empty());
    }

    #[test]
    fn a_plan_without_workers_names_what_it_assumes() {
        let views = views(40, |i| (DVec3::new(f64::from(i), 0.0, 0.0), DVec3::Z));
        let warned = |connected: Connected, change: fn(&mut PartitionConfig)| {
            let mut config = JobConfig::default();
            config.partition.auto = true;
            change(&mut config.partition);
            let input = PlanInput { views: &views, points: &Points::default(), config: &config };
            warning_of_defaults(&plan_for(&input, connected).unwrap(), connected, &config.partition)
                .unwrap_or_default()
        };
        let none = Connected::default();
        let said = warned(none, |_| ());
        assert!(
            said.contains("assumes one worker with 8 GiB of GPU memory; start workers first, or set"),
            "{said}"
        );
        assert!(said.ends_with("partition.workers and partition.memory_gib"), "{said}");
        let said = warned(none, |p| p.workers = 3);
        assert!(said.contains("assumes 8 GiB") && !said.contains("partition.workers"), "{said}");
        let said = warned(none, |p| p.memory_gib = 24.0);
        assert!(said.contains("assumes one worker;") && !said.contains("GiB"), "{said}");
        assert_eq!(warned(none, |p| (p.workers, p.memory_gib) = (3, 24.0)), "");
        assert_eq!(warned(Connected { workers: 2, memory_bytes: None }, |_| ()), "");
        assert_eq!(warned(none, |p| p.auto = false), "");
    }

    #[test]
    fn a_worker_gets_the_box_in_the_turned_axes_of_the_plan() {
        let turn = DQuat::from_rotation_y(0.5);
        let views = views(90, |i| {
            let eye = turn * DVec3::new(f64::from(i % 30), 0.0, f64::from(i / 30) * 2.0);
            (eye, turn * DVec3::new(0.1, 0.4, 1.0))
        });
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
                // The worker's side: worker/src/execute/partition.rs.
                let aligned = DQuat::from_xyzw(x, y, z, w) * DVec3::from(point.map(f64::from));
                let inside = aligned.x > focus.min_x
                    && aligned.x <= focus.max_x
                    && aligned.z > focus.min_z
                    && aligned.z <= focus.max_z;
                assert_eq!(inside, plan.focuses(partition, point), "partition {}, {point:?}", partition.id);
                // The partition whose cell contains it submits it to all that train there.
                let owner = plan.partitions.iter().find(|other| plan.keeps(other, point)).unwrap().id;
                let is_known =
                    owner == partition.id || plan.neighbours_of(partition).any(|other| other.id == owner);
                assert!(!inside || is_known, "partition {} does not know {owner}", partition.id);
            }
        }
    }
}
