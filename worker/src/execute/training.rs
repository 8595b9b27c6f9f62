//! Trains under a lease: reports, checkpoints, resumes, and stops on request.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fathom_core::CoreError;
use fathom_core::config::TrainConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, spatial_order};
use fathom_core::method::{self, Run};
use fathom_core::ply;
use fathom_core::scene::Points;
use fathom_core::surface::SurfaceModel;
use fathom_core::train::surface::{SurfaceRun, surface_run};
use fathom_core::train::{
    HeldOutMetrics, MediumRun, StartingWater, TrainRun, Trainer, initial_gaussians, starting_water,
    surface_points, with_ray_maps,
};
use fathom_core::views::ViewSource;
use fathom_core::water::{StandardErrors, Water, WaterRecord};
use fathom_proto::v1::{self, Progress};
use fathom_proto::worker::v1::CommonSpec;

use super::previews::Previews;
use super::{Control, Stop, TaskError, TaskInput, TaskOutput, Work};
use crate::views::DiskWait;

/// Device time between two checks of the control.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// Iterations of the first span, before the speed is known.
const FIRST_STRETCH: u32 = 8;
/// Longest span, iterations.
const LONGEST_STRETCH: u32 = 1000;
/// Share of a task after which the first checkpoint is taken, unless it is due earlier by time.
const FIRST_CHECKPOINT_AT: f64 = 0.1;

/// The sparse points of the scene.
pub fn read_points(task: &TaskInput) -> Result<Points, TaskError> {
    let path = task.file(&task.manifest.points)?;
    let bytes = std::fs::read(path).map_err(CoreError::io("read", path))?;
    Ok(Points::from_bytes(&bytes)?)
}

/// The views of a run under the job's water, with maps of open water if the task searched for it.
pub fn under_water(
    task: &TaskInput,
    medium: Option<&MediumRun>,
    views: Arc<dyn ViewSource>,
) -> Result<Arc<dyn ViewSource>, TaskError> {
    match medium.filter(|medium| medium.shows_open_water.is_some()) {
        Some(medium) => Ok(with_ray_maps(medium, &read_points(task)?, &views, &task.common.views)?),
        None => Ok(views),
    }
}

/// The start of a run without a coarse model: Gaussians at the sparse points, the job's water if it has one,
/// and the views. The water is estimated from full-size photographs, so that it equals that of a job of one
/// partition.
pub fn parts_of_points(
    task: &TaskInput,
    views: Arc<dyn ViewSource>,
) -> Result<(Parts, Arc<dyn ViewSource>), TaskError> {
    let views = &views;
    let (points, config) = (read_points(task)?, task.train_config());
    if task.config.method.through_surface() {
        let mut settings = task.config.surface.clone();
        if matches!(task.work, Work::Global(_)) {
            settings = settings.of_coarse_run(config.max_gaussians, task.config.train.max_gaussians);
        }
        let (focus, surface) = surface_run(&points, views.views(), &task.common.views, &config, &settings)?;
        return Ok((Parts { surface: Some(surface), ..Parts::only(focus) }, Arc::clone(views)));
    }
    let full = task.full_views(views)?;
    let start = starting_water(&task.config.water, task.unit(), &points, full.as_ref(), &task.common.views)?;
    let Some(StartingWater { medium, points }) = start else {
        let parts = Parts::only(initial_gaussians(&points, views.views(), &config, None)?);
        return Ok((parts, Arc::clone(views)));
    };
    let focus = initial_gaussians(&points, views.views(), &config, Some(&medium))?;
    let surfaces =
        surface_points(&points, views.views(), &task.common.views, &config, Some(&medium), |_| true)?;
    let views = under_water(task, Some(&medium), Arc::clone(views))?;
    Ok((Parts { surfaces, medium: Some(medium), ..Parts::only(focus) }, views))
}

/// The inputs of a run.
pub struct Parts {
    /// The trained Gaussians.
    pub focus: Gaussians,
    /// Gaussians that are rendered but not trained.
    pub context: Gaussians,
    /// For each place that must stay covered, a Gaussian that covers it.
    pub surfaces: Gaussians,
    /// The part of the context that is submitted with the result.
    pub shared: Unchanged,
    /// The medium between cameras and scene.
    pub medium: Option<MediumRun>,
    /// The shared water as recorded in the coarse model.
    pub water: Option<WaterRecord>,
    /// The water surface that cameras look through.
    pub surface: Option<SurfaceRun>,
}

/// What a partition submits as the coarse model has it.
pub enum Unchanged {
    /// Of a scene without a water surface.
    Gaussians(Gaussians),
    /// Of one with it.
    Sets(Box<SurfaceModel>),
}

impl Parts {
    /// A run that trains everything.
    pub fn only(focus: Gaussians) -> Self {
        let none = Gaussians::empty(focus.sh_degree);
        Self {
            focus,
            context: none.clone(),
            surfaces: none.clone(),
            shared: Unchanged::Gaussians(none),
            medium: None,
            water: None,
            surface: None,
        }
    }
}

/// The iterations of a run that belong to a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Span {
    from: u32,
    until: u32,
    /// Number of iterations that the task reports: its progress counts from 0 to this.
    counted: u32,
}

impl Span {
    /// The iterations in the spec.
    pub fn of(spec: &CommonSpec) -> Self {
        Self { from: spec.from_iteration, until: spec.end_iteration(), counted: spec.own_iterations() }
    }

    /// The whole run, by a task that reports the iterations of one part.
    pub fn whole(spec: &CommonSpec) -> Self {
        Self { from: 0, until: spec.iterations, counted: spec.own_iterations() }
    }

    fn length(self) -> u32 {
        self.until.saturating_sub(self.from)
    }

    /// Progress of the task when the run is at `iteration`.
    pub fn done(self, iteration: u32) -> u32 {
        let done = u64::from(iteration.saturating_sub(self.from)) * u64::from(self.counted);
        (done / u64::from(self.length().max(1))) as u32
    }
}

/// Trains the focus before the context up to the end of `span`.
pub fn train(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    config: TrainConfig,
    views: Arc<dyn ViewSource>,
    Parts { focus, context, surfaces, shared, medium, water, surface }: Parts,
    span: Span,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let extent = task.common.scene_extent;
    let run = TrainRun { config: config.clone(), extent, views, focus, context, surfaces, medium, surface };
    let mut run = method::start(task.config.method, Arc::clone(gpu), run)?;
    go_on(task, run.as_mut())?;
    let resumed_from = span.done(run.progress().iteration);
    let history = advance(task, run.as_mut(), &config, span, control)?;
    finish(task, run.as_mut(), &config, &shared, water, resumed_from, history)
}

/// Returns the trained Gaussians with the included part of the coarse model. `water` is the job's water if
/// another task has decided it.
pub fn finish(
    task: &TaskInput,
    run: &mut dyn Run,
    config: &TrainConfig,
    shared: &Unchanged,
    water: Option<WaterRecord>,
    resumed_from: u32,
    history: Vec<v1::HeldOutMetrics>,
) -> Result<TaskOutput, TaskError> {
    let mut trained = run.hand_in(task.config.data.metres_per_unit)?;
    if trained.skipped_steps > 0 {
        tracing::warn!(
            skipped = trained.skipped_steps,
            "steps of the water, or of its surface, were skipped: their gradients were not finite"
        );
    }
    if let Some(mut model) = trained.surface {
        if let Unchanged::Sets(sets) = shared {
            // Of the reflected set the run trains one disk that stands for it, and which may be among these.
            model.reflected = Gaussians::empty(model.reflected.sh_degree);
            model.append(sets);
        }
        return output_of_sets(&model, resumed_from, history);
    }
    if let Unchanged::Gaussians(shared) = shared {
        (0..shared.len()).for_each(|index| trained.gaussians.push_from(shared, index));
    }
    let water = water.or(trained.water);
    output_of(&trained.gaussians, config, water.as_ref(), resumed_from, history)
}

/// What a partition with nothing to train submits.
pub fn output_of_shared(
    shared: &Unchanged,
    config: &TrainConfig,
    water: Option<&WaterRecord>,
) -> Result<TaskOutput, TaskError> {
    match shared {
        Unchanged::Gaussians(shared) => output_of(shared, config, water, 0, Vec::new()),
        Unchanged::Sets(shared) => output_of_sets(shared, 0, Vec::new()),
    }
}

/// As `output_of`, of a scene with a water surface.
fn output_of_sets(
    model: &SurfaceModel,
    resumed_from: u32,
    held_out: Vec<v1::HeldOutMetrics>,
) -> Result<TaskOutput, TaskError> {
    let model = in_order(model);
    let result = Bytes::from(ply::surface_to_bytes(&model, &[])?);
    Ok(TaskOutput { result, gaussians: model.len() as u32, resumed_from, held_out, further: Vec::new() })
}

/// A scene with a water surface whose sets are sorted as `output_of` sorts.
fn in_order(model: &SurfaceModel) -> SurfaceModel {
    let sorted = |set: &Gaussians| set.in_order(&spatial_order(set));
    let order = spatial_order(&model.straight);
    SurfaceModel {
        straight: model.straight.in_order(&order),
        masks: order.iter().map(|&index| model.masks[index as usize]).collect(),
        reflected: sorted(&model.reflected),
        refracted: sorted(&model.refracted),
        record: model.record.clone(),
    }
}

/// The checkpoint of an earlier attempt; `None` if none can be read.
fn read_checkpoint(task: &TaskInput) -> Option<Vec<u8>> {
    let read = std::fs::read(task.checkpoint.as_ref()?);
    read.inspect_err(|error| tracing::warn!(%error, "the checkpoint cannot be read; starting over")).ok()
}

/// The run restored from its checkpoint, or at its start if no checkpoint fits.
pub fn open(gpu: &Arc<Gpu>, task: &TaskInput, run: TrainRun) -> Result<Trainer, TaskError> {
    let mut trainer = Trainer::new(Arc::clone(gpu), run)?;
    go_on(task, &mut trainer)?;
    Ok(trainer)
}

/// Restores the run from the checkpoint of an earlier attempt; leaves it unchanged if no checkpoint fits.
pub fn go_on(task: &TaskInput, run: &mut dyn Run) -> Result<(), TaskError> {
    let Some(checkpoint) = read_checkpoint(task) else { return Ok(()) };
    match run.go_to(&checkpoint) {
        Ok(()) => tracing::info!(iteration = run.progress().iteration, "resuming from a checkpoint"),
        Err(CoreError::Checkpoint(message)) => {
            let iteration = run.progress().iteration;
            tracing::warn!(reason = %message, iteration, "the checkpoint does not fit; restarting the task");
        }
        Err(error) => return Err(error.into()),
    }
    Ok(())
}

/// Trains to the end of `span`; returns the measurements on the task's held-out views.
pub fn advance(
    task: &TaskInput,
    run: &mut dyn Run,
    config: &TrainConfig,
    span: Span,
    control: &dyn Control,
) -> Result<Vec<v1::HeldOutMetrics>, TaskError> {
    let held_out = task.held_out()?;
    let held_out = held_out.as_ref();
    let mut previews = Previews::of(task, config);
    let mut cadence =
        Cadence::new(run.progress().iteration.saturating_sub(span.from), config.checkpoint_seconds);
    let eval_every = if held_out.views().is_empty() { 0 } else { config.eval_every };
    let mut history: Vec<v1::HeldOutMetrics> = Vec::new();
    let mut stretch = FIRST_STRETCH;
    let (mut training, mut watching) = (Duration::ZERO, Duration::ZERO);
    let waited_before = run.waited_for_photographs();
    let mut disk_wait = DiskWait::new(Arc::clone(&task.reading));
    while run.progress().iteration < span.until {
        match control.stop_reason() {
            None => {}
            Some(Stop::Abandon) => return Err(TaskError::Stopped { checkpoint: None }),
            Some(Stop::Leave | Stop::GiveBack) => {
                let done = span.done(run.progress().iteration);
                let checkpoint = Some((Bytes::from(run.checkpoint()?), done));
                return Err(TaskError::Stopped { checkpoint });
            }
        }
        let (before, started) = (run.progress().iteration, Instant::now());
        let until_first = cadence.until_first(before.saturating_sub(span.from), span.length());
        let next = stretch.min(until_measured(before, eval_every)).min(until_first).min(span.until - before);
        let progress = run.advance(next)?;
        let took = started.elapsed();
        training += took;
        let iterations_per_second = (progress.iteration - before) as f32 / took.as_secs_f32().max(1e-6);
        let photographs = run.waited_for_photographs().saturating_sub(waited_before);
        let watched = Instant::now();
        let mut report = Progress {
            iteration: span.done(progress.iteration),
            iterations: span.counted,
            gaussians: progress.gaussians,
            loss: progress.loss,
            iterations_per_second,
            held_out: history.last().copied(),
            water: run.water()?.map(|water| water_now(water, run.water_errors())),
            time_spent: Some(v1::TimeSpent {
                training_seconds: training.saturating_sub(photographs).as_secs_f32(),
                photographs_seconds: photographs.as_secs_f32(),
                disk_seconds: Some(disk_wait.after(photographs).as_secs_f32()),
                watching_seconds: watching.as_secs_f32(),
                ..v1::TimeSpent::default()
            }),
            ..Progress::default()
        };
        control.report(report);
        if eval_every > 0
            && progress.iteration.is_multiple_of(eval_every)
            && let Some(metrics) = run.measure(held_out, &|| control.stop_reason().is_none())?
        {
            let HeldOutMetrics { iteration, psnr_db, ssim, views } = metrics;
            tracing::info!(iteration, psnr_db, ssim, views, "held-out views measured");
            history.push(v1::HeldOutMetrics { iteration, psnr_db, ssim, views });
            report.held_out = history.last().copied();
            control.report(report);
        }
        if let Some(pictures) = previews.make(run, &|| control.stop_reason().is_none()) {
            control.preview(report.iteration, pictures);
        }
        stretch = ((iterations_per_second * LOOK_EVERY.as_secs_f32()) as u32).clamp(1, LONGEST_STRETCH);
        if cadence.is_due(progress.iteration.saturating_sub(span.from), span.length()) {
            control.checkpoint(Bytes::from(run.checkpoint()?), span.done(progress.iteration));
            cadence.taken();
        }
        watching += watched.elapsed();
    }
    Ok(history)
}

fn water_now(water: Water, errors: Option<StandardErrors>) -> v1::WaterNow {
    let rgb = |of: [f64; 3]| {
        let [red, green, blue] = of.map(|value| value as f32);
        Some(v1::Rgb { red, green, blue })
    };
    let each = |of: [Option<f64>; 3]| {
        let [red, green, blue] = of.map(|error| error.map(|error| error as f32));
        Some(v1::RgbErrors { red, green, blue })
    };
    v1::WaterNow {
        beta_d: rgb(water.beta_d),
        beta_b: rgb(water.beta_b),
        b_inf: rgb(water.b_inf),
        standard_error: errors.map(|errors| v1::WaterErrors {
            beta_d: each(errors.beta_d),
            beta_b: each(errors.beta_b),
            b_inf: each(errors.b_inf),
        }),
    }
}

/// Iterations from `iteration` to the next measurement, one every `every`; 0: never.
fn until_measured(iteration: u32, every: u32) -> u32 {
    if every == 0 { u32::MAX } else { every - iteration % every }
}

/// Schedule of checkpoints: the first after a tenth of the task or by time, whichever is sooner; the others
/// by time. None at the end, where the result follows.
struct Cadence {
    started_at: u32,
    every: Duration,
    last: Instant,
    taken: bool,
}

impl Cadence {
    fn new(started_at: u32, seconds: u32) -> Self {
        Self { started_at, every: Duration::from_secs(seconds.into()), last: Instant::now(), taken: false }
    }

    fn is_due(&self, iteration: u32, iterations: u32) -> bool {
        let is_first = iteration >= self.first_at(iterations);
        iteration < iterations && (is_first || self.last.elapsed() >= self.every)
    }

    /// Iterations from `iteration` to the first checkpoint; many after it. A fast GPU would otherwise end a
    /// short task before anybody looks.
    fn until_first(&self, iteration: u32, iterations: u32) -> u32 {
        self.first_at(iterations).saturating_sub(iteration).max(1)
    }

    fn first_at(&self, iterations: u32) -> u32 {
        if self.taken {
            return u32::MAX;
        }
        self.started_at.saturating_add((f64::from(iterations) * FIRST_CHECKPOINT_AT).ceil() as u32)
    }

    fn taken(&mut self) {
        (self.last, self.taken) = (Instant::now(), true);
    }
}

/// The result of a task: rows sorted along a space-filling curve, so that runs of rows are compact. The merge
/// copies or skips runs that no border cuts, and viewers can load a model piece by piece.
pub fn output_of(
    gaussians: &Gaussians,
    config: &TrainConfig,
    water: Option<&WaterRecord>,
    resumed_from: u32,
    held_out: Vec<v1::HeldOutMetrics>,
) -> Result<TaskOutput, TaskError> {
    let mut comments: Vec<String> =
        config.mip_filter.then(|| ply::ANTIALIASED.to_owned()).into_iter().collect();
    comments.extend(config.disks.then(|| ply::DISKS.to_owned()));
    comments.extend(water.map(WaterRecord::to_comment).transpose()?);
    let ordered = gaussians.in_order(&spatial_order(gaussians));
    let result = Bytes::from(ply::to_bytes(&ordered, &comments)?);
    let gaussians = gaussians.len() as u32;
    Ok(TaskOutput { result, gaussians, resumed_from, held_out, further: Vec::new() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_span_ends_where_a_measurement_is_due() {
        assert_eq!([0, 1, 39, 40, 41].map(|iteration| until_measured(iteration, 40)), [40, 39, 1, 40, 39]);
        assert_eq!(until_measured(7, 0), u32::MAX, "never");
    }

    #[test]
    fn progress_counts_the_iterations_of_the_task_from_0() {
        let whole = CommonSpec { iterations: 900, ..CommonSpec::default() };
        assert_eq!([0, 7, 900].map(|at| Span::of(&whole).done(at)), [0, 7, 900]);
        let first = Span::of(&CommonSpec { until_iteration: 600, ..whole.clone() });
        assert_eq!((first.until, first.counted, first.done(600)), (600, 600, 600));
        let rest = CommonSpec { from_iteration: 600, ..whole };
        let span = Span::of(&rest);
        assert_eq!((span.until, span.counted), (900, 300));
        assert_eq!([600, 601, 900].map(|at| span.done(at)), [0, 1, 300]);
        // The whole run instead of a third of it: progress never exceeds the reported total and never
        // decreases.
        let anew = Span::whole(&rest);
        assert_eq!((anew.until, anew.counted), (900, 300));
        assert_eq!([0, 2, 3, 450, 900].map(|at| anew.done(at)), [0, 0, 1, 150, 300]);
    }

    #[test]
    fn the_first_checkpoint_comes_after_a_tenth_and_none_at_the_end() {
        let mut cadence = Cadence::new(0, 3600);
        assert!(!cadence.is_due(99, 1000));
        assert!(cadence.is_due(100, 1000));
        assert_eq!([0, 60, 99].map(|iteration| cadence.until_first(iteration, 1000)), [100, 40, 1]);
        assert_eq!(Cadence::new(500, 3600).until_first(500, 1000), 100, "from a checkpoint on");
        cadence.taken();
        assert!(!cadence.is_due(900, 1000), "the second one is due by time");
        assert!(cadence.until_first(900, 1000) > 1000);
        assert!(!Cadence::new(0, 0).is_due(1000, 1000), "at the end the result follows");
        assert!(Cadence::new(0, 0).is_due(1, 1000), "it is due by time");
    }
}
