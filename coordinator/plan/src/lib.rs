//! The cut of a scene on its x-z plane (SMP-UWGS section 3.1, corrected).
//!
//! [`plan`] is a pure function: the same views, points and configuration give the same [`Plan`], with any
//! number of threads. It reads no file, no clock and no random number. The steps:
//!
//! 1. `up_axis` and `turn`: the direction of down and of the horizontal axes; all later steps use the aligned
//!    frame (y down, x-z horizontal).
//! 2. `cells`: cameras assigned by rank, and rectangles that tile the plane: a grid, or the choice of `auto`.
//! 3. `region`: the extended box of each cell and the points in it.
//! 4. `selection` and `visibility`: the cameras that see enough of that box.
//! 5. `weights`: the weight of each partition, and its effects.
//! 6. `budget`: iterations, Gaussians and memory of each run.
//! 7. `borders`: the borders between cells, and the training there after the merge.
//!
//! Held-out views are not used. [`picture`] draws the result, `neighbours` lists adjacent partitions, and
//! `seam_lines` gives the lines along which a model is measured for seams.

mod auto;
mod borders;
mod budget;
mod cells;
#[cfg(test)]
mod fuzz;
mod geometry;
mod neighbours;
pub mod picture;
mod plan;
mod region;
mod seam_lines;
mod selection;
mod turn;
mod up_axis;
mod visibility;
mod weights;

use fathom_core::config::{JobConfig, Medium, TrainConfig, WeightMode};
use fathom_core::floaters;
use fathom_core::scene::{PinholeCamera, Points, Pose, viewing_distance};
use fathom_core::views::TrainView;
use glam::DVec3;
use rayon::prelude::*;

pub use auto::Connected;
pub use geometry::*;
pub use plan::*;
pub use selection::MIN_CAMERAS;

use cells::{Cell, Centre};
use region::AlignedPoints;
use selection::Candidate;

/// A partition gets at least this part of an even share of the Gaussians. The global stage may have placed
/// Gaussians where the sparse cloud has no points, and the cap must hold them.
const LEAST_SHARE: f64 = 0.25;

/// Number of points that represent those outside of a partition in its forecast: twice as many as
/// [`fathom_core::memory::visible_in_views`] samples. All millions, for each partition, would take most of
/// the time and memory of a plan.
const OUTSIDE_POINTS: usize = 16_384;

/// The input of a plan.
pub struct PlanInput<'a> {
    /// All views of the scene, held-out ones too, strictly ascending by name, with their undistorted
    /// cameras at full size.
    pub views: &'a [TrainView],
    /// Sparse points; may be empty where nothing is trained (see [`Plan::require_points`]).
    pub points: &'a Points,
    /// Resolved configuration of the job.
    pub config: &'a JobConfig,
}

/// Errors of planning, with remedies.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// The configuration contradicts itself.
    #[error(transparent)]
    Config(#[from] fathom_core::CoreError),
    /// The caller broke the rule of [`PlanInput::views`].
    #[error("views must be sorted by name and have different names, but {second:?} follows {first:?}")]
    UnsortedViews {
        /// A name.
        first: String,
        /// The name after it.
        second: String,
    },
    /// A pose or camera that nothing can be projected with.
    #[error("view {view:?}: {fault}; remove it from the scene or export the scene again")]
    BadView {
        /// Its name.
        view: String,
        /// The fault.
        fault: &'static str,
    },
    /// Fewer training views than partitions.
    #[error(
        "{training} training views ({held_out} held out) cannot fill {columns}x{rows} partitions, \
         which need at least one each; use fewer partitions, such as --partitions 1x1 or auto, or hold out fewer \
         views with --test-every"
    )]
    TooFewViews {
        /// Views that are trained on.
        training: usize,
        /// Views that are held out.
        held_out: usize,
        /// Columns asked for.
        columns: u32,
        /// Rows asked for.
        rows: u32,
    },
    /// Training starts from sparse points and there are none.
    #[error(
        "the scene has no sparse points to start from; export it with its point cloud (COLMAP: points3D, \
         nerfstudio: ply_file_path)"
    )]
    NoPoints,
}

/// Plans the scene without any connected worker.
///
/// # Errors
/// When the input cannot be cut as configured; the message names a remedy.
pub fn plan(input: &PlanInput<'_>) -> Result<Plan, PlanError> {
    plan_for(input, Connected::default())
}

/// Cuts the scene, with `partition.auto` for these workers.
///
/// # Errors
/// As [`plan`].
pub fn plan_for(input: &PlanInput<'_>, connected: Connected) -> Result<Plan, PlanError> {
    let config = input.config;
    config.validate()?;
    check_views(input.views)?;
    let (columns, rows) = (config.partition.columns, config.partition.rows);
    let held_out = held_out(input.views.len(), config.data.test_every);
    let training: Vec<usize> =
        (0..input.views.len()).filter(|&i| held_out.binary_search(&(i as u32)).is_err()).collect();
    if training.len() < (columns as usize * rows as usize) {
        let (training, held_out) = (training.len(), held_out.len());
        return Err(PlanError::TooFewViews { training, held_out, columns, rows });
    }

    let poses: Vec<Pose> = training.iter().map(|&i| input.views[i].pose).collect();
    let alignment = up_axis::align(&poses, config.partition.rotate);
    tracing::info!(rule = ?alignment.rule, down = ?alignment.down, "found the vertical");
    tracing::info!(rule = ?alignment.turn.rule, degrees = alignment.turn.degrees, "found the turn about the vertical");
    let candidates = candidates(input.views, &training, &alignment);
    let points = AlignedPoints::in_frame(input.points, &alignment);
    let seen_by: Vec<_> = training.iter().map(|&i| (input.views[i].camera, input.views[i].pose)).collect();
    let extent = extent(&candidates, &points, viewing_distance(&seen_by, input.points));
    let centres = candidates
        .iter()
        .map(|c| Centre { view: c.view, name: &input.views[c.view as usize].name, at: c.centre })
        .collect();

    let scene = SceneSize::new(&extent, &candidates, config);
    let global_stage = || {
        let max_resolution = scene.longest_side.div_ceil(2).max(1);
        let views = fitted(&candidates, max_resolution, |_| true);
        budget::global_stage(config, max_resolution, &views, points.all())
    };
    let (cells, cut, global) = if config.partition.auto {
        let planned_for = connected.planned_for(&config.partition);
        let global = global_stage();
        let load = |cell: &Cell, count: usize| {
            let coarse = (count > 1).then_some(&global);
            let one = partition(0, cell, count, &candidates, &points, &scene, config);
            forecast(&one, &candidates, &points, coarse, config)
        };
        let (cells, cut) = auto::choose(centres, planned_for, &global.forecast, &load);
        let global = (cells.len() > 1).then_some(global);
        (cells, cut, global)
    } else {
        let cells = cells::cut(centres, columns, rows);
        let reason = format!("{columns} x {rows} was asked for");
        let global = (cells.len() > 1).then(global_stage);
        (cells, Cut { shape: CutShape::Grid, reason, planned_for: None }, global)
    };
    let mut partitions: Vec<Partition> = cells
        .par_iter()
        .zip(0..cells.len() as u32)
        .map(|(cell, id)| partition(id, cell, cells.len(), &candidates, &points, &scene, config))
        .collect();
    weights::weigh(&mut partitions, &config.partition.weight_terms);
    finish(&mut partitions, &candidates, &points, global.as_ref(), config);
    let rects: Vec<Rect> = cells.iter().map(|cell| cell.rect).collect();
    let borders = borders::stage(config, &rects, &candidates, &points, &extent);
    let places = cells.iter().map(|cell| cell.place);
    let grid = places.reduce(Option::max).flatten().filter(|_| cut.shape == CutShape::Grid);
    let clear_ranges = clear_ranges(input, &training);
    Ok(Plan {
        format: PLAN_FORMAT,
        cut,
        columns: grid.map(|(column, _)| column + 1),
        rows: grid.map(|(_, row)| row + 1),
        alignment,
        extent,
        views: input.views.len() as u32,
        held_out,
        points: points.all().len() as u64,
        global,
        balance: Balance::of(&partitions),
        weights: config.partition.weights,
        partitions,
        borders,
        clear_ranges,
    })
}

impl Plan {
    /// Refuses a plan that cannot be trained because Gaussians start from sparse points.
    ///
    /// A partition without points is allowed if the scene has some: cameras around an object may leave its
    /// points to other cells. Such a partition keeps the Gaussians of the global stage in its cell, possibly
    /// none.
    ///
    /// # Errors
    /// [`PlanError::NoPoints`].
    pub fn require_points(&self) -> Result<(), PlanError> {
        if self.points == 0 { Err(PlanError::NoPoints) } else { Ok(()) }
    }

    /// Warnings about plans that train but will probably disappoint: a sentence each, with a remedy.
    pub fn warnings(&self, train: &TrainConfig) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.held_out.is_empty() {
            warnings.push(
                "no view is held out, so the result has no metrics; --test-every 8 holds out an eighth"
                    .into(),
            );
        }
        if train.eval_every > 0 && !self.held_out.is_empty() {
            warnings.extend(self.warning_of_measurements(train));
        }
        warnings.extend(self.warning_of_memory());
        warnings.extend(self.warning_of_weights());
        for partition in &self.partitions {
            let (id, cameras) = (partition.id, partition.chosen_views.len());
            if cameras < MIN_CAMERAS {
                let advice =
                    if self.partitions.len() > 1 { "use fewer partitions" } else { "add photographs" };
                warnings.push(format!(
                    "partition {id} trains on {cameras} cameras, and fewer than {MIN_CAMERAS} tend to overfit; {advice}"
                ));
            }
            // A scene without points is refused for training, and only inspected otherwise.
            if self.points > 0 && partition.cell_points == 0 && self.partitions.len() > 1 {
                warnings.push(format!(
                    "partition {id} has no sparse points in its cell, so it contributes only the global stage's Gaussians there; \
                     use fewer partitions if there should be more"
                ));
            }
        }
        warnings
    }

    /// Where `partition.auto` found no cut that fits, or additions (weights, borders) exceed the memory.
    fn warning_of_memory(&self) -> Option<String> {
        let has = self.cut.planned_for?.memory_bytes;
        let coarse = self.global.iter().map(|global| ("the coarse model".to_owned(), &global.forecast));
        let own = self.partitions.iter().map(|p| (format!("partition {}", p.id), &p.forecast));
        let borders =
            self.borders.iter().map(|stage| ("the training at borders".to_owned(), &stage.forecast));
        let (run, forecast) = coarse.chain(own).chain(borders).max_by_key(|(_, forecast)| forecast.bytes)?;
        (!auto::fits(forecast.bytes, has)).then(|| {
            format!(
                "{run} is forecast to need {} of the {} that a worker has, of which a tenth is kept free; lower --max-gaussians or \
                 --max-resolution, or raise partition.memory_gib",
                auto::gib(forecast.bytes),
                auto::gib(has)
            )
        })
    }

    fn warning_of_weights(&self) -> Option<String> {
        let first = self.partitions.first()?.weight;
        let alike = self.partitions.iter().all(|partition| partition.weight == first);
        (alike && self.partitions.len() > 1 && self.weights != WeightMode::None).then(|| {
            format!(
                "all partitions have the weight {first:.3}, so partition.weights moves nothing between them; weights end at \
                 partition.weight_terms.clamp, which may be raised"
            )
        })
    }

    fn warning_of_measurements(&self, train: &TrainConfig) -> Option<String> {
        let iterations = self.global.as_ref().map_or(train.iterations, |global| global.iterations);
        if train.eval_every > iterations {
            return Some(format!(
                "train.eval_every is {}, but the evaluated run has only {iterations} iterations, so nothing is measured during \
                 training; choose a smaller value",
                train.eval_every
            ));
        }
        self.global.as_ref().map(|global| {
            format!(
                "train.eval_every measures the coarse model only, at its {} pixels: no partition alone renders the whole \
                 scene; the merged model is measured at the end",
                global.max_resolution
            )
        })
    }
}

/// Every n-th view by sorted name, the first among them; none for 0.
fn held_out(views: usize, test_every: u32) -> Vec<u32> {
    match test_every {
        0 => Vec::new(),
        every => (0..views as u32).step_by(every as usize).collect(),
    }
}

fn check_views(views: &[TrainView]) -> Result<(), PlanError> {
    for pair in views.windows(2) {
        if pair[0].name >= pair[1].name {
            let (first, second) = (pair[0].name.clone(), pair[1].name.clone());
            return Err(PlanError::UnsortedViews { first, second });
        }
    }
    for view in views {
        let (camera, pose) = (&view.camera, &view.pose);
        let fault = if !(pose.rotation.is_finite() && pose.translation.is_finite()) {
            "its pose is not finite"
        } else if (pose.rotation.length() - 1.0).abs() > 1e-6 {
            "its rotation is not a unit quaternion"
        } else if camera.width == 0 || camera.height == 0 {
            "its picture has no pixels"
        } else if !(camera.fx > 0.0 && camera.fy > 0.0 && camera.fx.is_finite() && camera.fy.is_finite()) {
            "its focal length is not a positive number"
        } else if !(camera.cx.is_finite() && camera.cy.is_finite()) {
            "its principal point is not finite"
        } else {
            continue;
        };
        return Err(PlanError::BadView { view: view.name.clone(), fault });
    }
    Ok(())
}

fn candidates(views: &[TrainView], training: &[usize], alignment: &Alignment) -> Vec<Candidate> {
    let rotation = alignment.rotation();
    training
        .iter()
        .map(|&i| {
            let pose = visibility::aligned_pose(&views[i].pose, rotation);
            Candidate { view: i as u32, camera: views[i].camera, pose, centre: pose.centre() }
        })
        .collect()
}

/// Training views of the given numbers with their pictures at most `max_side` pixels on a side, aligned
/// frame.
fn fitted(
    candidates: &[Candidate],
    max_side: u32,
    chosen: impl Fn(u32) -> bool,
) -> Vec<(PinholeCamera, Pose)> {
    let chosen = candidates.iter().filter(|candidate| chosen(candidate.view));
    chosen.map(|candidate| (candidate.camera.fitted(max_side), candidate.pose)).collect()
}

/// [`Plan::clear_ranges`].
fn clear_ranges(input: &PlanInput<'_>, training: &[usize]) -> Vec<f32> {
    let water = &input.config.water;
    if water.medium == Medium::None || water.floater_weight == 0.0 {
        return Vec::new();
    }
    let view = |&i: &usize| (i as u32, input.views[i].camera, input.views[i].pose);
    let found = floaters::clear_ranges(&training.iter().map(view).collect::<Vec<_>>(), input.points);
    let mut ranges = vec![0.0; input.views.len()];
    for (&i, range) in training.iter().zip(found) {
        ranges[i] = range;
    }
    ranges
}

fn extent(candidates: &[Candidate], points: &AlignedPoints, viewing_distance: Option<f64>) -> Extent {
    let mean = candidates.iter().map(|c| c.centre).sum::<DVec3>() / candidates.len().max(1) as f64;
    let farthest = candidates.iter().map(|c| c.centre.distance(mean)).fold(0.0, f64::max);
    let axis = |axis: usize| region::range(candidates.iter().map(|c| c.centre[axis]));
    let [x, y, z] = [axis(0), axis(1), axis(2)];
    Extent {
        radius: 1.1 * farthest,
        viewing_distance,
        cameras: Box3 { min: [x.0, y.0, z.0], max: [x.1, y.1, z.1] },
        points: points.robust_box(),
    }
}

/// Sizes that the budgets of all partitions relate to.
struct SceneSize {
    /// Longest horizontal side, scene units; 1 where everything is in one place.
    side: f64,
    /// Longest side of a training picture, pixels.
    longest_side: u32,
}

impl SceneSize {
    fn new(extent: &Extent, candidates: &[Candidate], config: &JobConfig) -> Self {
        let boxes = [Some(extent.cameras), extent.points];
        let side = boxes.iter().flatten().flat_map(|b| [b.side(0), b.side(2)]).fold(0.0, f64::max);
        let fitted = candidates.iter().map(|c| c.camera.fitted(config.data.max_resolution));
        let longest_side = fitted.map(|camera| camera.width.max(camera.height)).max().unwrap_or(1);
        Self { side: if side > 0.0 { side } else { 1.0 }, longest_side }
    }
}

/// One of `count` partitions, without its weight and its effects: its forecast is empty.
fn partition(
    id: u32,
    cell: &Cell,
    count: usize,
    candidates: &[Candidate],
    points: &AlignedPoints,
    scene: &SceneSize,
    config: &JobConfig,
) -> Partition {
    let layer = cell.layer();
    let own: Vec<Candidate> =
        candidates.iter().filter(|c| cell.views.binary_search(&c.view).is_ok()).copied().collect();
    let own_centres: Vec<DVec3> = own.iter().map(|c| c.centre).collect();
    let region = region::region(cell, &own_centres, points, &config.partition, scene.side);
    let chosen = selection::select(candidates, &cell.views, layer, &region.extended, &config.partition);
    let focus: Vec<DVec3> = points.within(&region.focus).collect();
    let cell_points = focus.iter().filter(|&&p| cell.rect.contains(p)).count() as u64;
    let r_focus = focus.len() as f64 / points.all().len().max(1) as f64;
    let chosen_share = chosen.views.len() as f64 / candidates.len() as f64;
    let share = if points.all().is_empty() { chosen_share } else { r_focus.max(LEAST_SHARE / count as f64) };
    let max_gaussians = budget::max_gaussians(config, share);
    let iterations = budget::iterations(config, chosen.views.len(), candidates.len());
    Partition {
        id: PartitionId(id),
        column: cell.place.map(|(column, _)| column),
        row: cell.place.map(|(_, row)| row),
        path: cell.path.clone(),
        layer,
        cell: cell.rect,
        focus: region.focus,
        extended_box: region.extended,
        base_views: cell.views.clone(),
        iterations,
        filled_views: chosen.filled,
        mean_visibility: chosen.mean_visibility,
        chosen_views: chosen.views,
        focus_points: focus.len() as u64,
        cell_points,
        r_focus,
        depth: selection::mean_depth(&own, &focus),
        weight: 0.0,
        weighed: Weighed::default(),
        max_gaussians,
        forecast: Forecast::default(),
    }
}

/// Weights and forecasts, once the views of all partitions stand.
fn finish(
    partitions: &mut [Partition],
    candidates: &[Candidate],
    points: &AlignedPoints,
    global: Option<&GlobalStage>,
    config: &JobConfig,
) {
    weights::apply(partitions, config);
    partitions.par_iter_mut().for_each(|partition| {
        partition.forecast = forecast(partition, candidates, points, global, config);
    });
}

/// The forecast of a partition's run, once its views, iterations and cap are known.
fn forecast(
    partition: &Partition,
    candidates: &[Candidate],
    points: &AlignedPoints,
    global: Option<&GlobalStage>,
    config: &JobConfig,
) -> Forecast {
    // A run with a coarse model starts from it.
    let started = if global.is_some() { config.train.clone().continued() } else { config.train.clone() };
    let run = TrainConfig { iterations: partition.iterations, ..started };
    let focus: Vec<DVec3> = points.within(&partition.focus).collect();
    let outside: Vec<DVec3> = if global.is_some() {
        let step = (points.all().len() / OUTSIDE_POINTS).max(1);
        points.all().iter().copied().step_by(step).filter(|&p| !partition.focus.contains(p)).collect()
    } else {
        Vec::new()
    };
    let share = f64::from(partition.max_gaussians) / f64::from(config.train.max_gaussians);
    let frozen =
        global.map_or(0.0, |stage| f64::from(stage.max_gaussians) * (1.0 - share).max(0.0)).round() as u64;
    let is_chosen = |view| partition.chosen_views.binary_search(&view).is_ok();
    let content = budget::Content {
        views: &fitted(candidates, config.data.max_resolution, is_chosen),
        trained: (&focus, partition.max_gaussians.into()),
        frozen: (&outside, frozen),
    };
    budget::forecast(&run, &config.water, &content, global.is_none() && config.train.eval_every > 0)
}

#[cfg(test)]
mod tests;
