//! BORDERS: trains the Gaussians of the merged model near partition borders; all others are context.
//!
//! Two partitions meet at a border without having seen each other: each was trained beside the coarse model.
//! This stage sees both sides. It trains the band around the borders again, on the views that show it, at
//! lower learning rates and with the model's water frozen. Pixels whose surface lies beyond the band and a
//! margin do not count, as in a partition. The result is the merged model with new rows for the band; no
//! other byte changes.

use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use fathom_core::config::TrainConfig;
use fathom_core::gaussians::{Gaussians, is_shared};
use fathom_core::gpu::{Drawing, Gpu, Renderer};
use fathom_core::method;
use fathom_core::surface::Surface;
use fathom_core::train::surface::surface_part;
use fathom_core::train::{MediumRun, TrainRun};
use fathom_core::views::ViewSource;
use fathom_core::{CoreError, ply};
use fathom_proto::worker::v1::{Artifact, BordersSpec, FailClass, FocusBox};
use glam::DVec3;

use super::loss_mask::LossMask;
use super::partition::Inside;
use super::training::{Span, advance, go_on, open, under_water};
use super::{Control, TaskError, TaskInput, TaskOutput};

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &BordersSpec,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let Some(path) = task.input(Artifact::Model) else {
        let message = "border training needs the merged model".to_owned();
        return Err(TaskError::Failed { class: FailClass::Input, message });
    };
    if task.config.method.through_surface() {
        return run_sets(gpu, task, spec, path, views, control);
    }
    let model = ply::read_model(path)?;
    let gaussians = model.len() as u32;
    let band = band_of(&model, task, spec)?;
    let water = ply::water_record(path)?;
    let medium = water.as_ref().map(|water| MediumRun::of_record(water, &task.config.water, task.unit()));
    let views = under_water(task, medium.as_ref(), views)?;
    let views = if band.is_empty() { None } else { views_of(gpu, task, spec, &model, None, views, control)? };
    let Some(views) = views else {
        tracing::warn!(gaussians = band.len(), "no view shows a surface to train at the borders");
        return output_of(read(path)?, gaussians, 0);
    };
    let (focus, context) = split_at(model, &band);
    let config = TrainConfig { max_gaussians: focus.len() as u32, ..task.train_config() };
    let config = task.config.borders.of_run(config);
    tracing::info!(gaussians = band.len(), views = views.views().len(), "training the borders");
    let (extent, surfaces) = (task.common.scene_extent, Gaussians::empty(config.sh_degree));
    let run =
        TrainRun { config: config.clone(), extent, views, focus, context, surfaces, medium, surface: None };
    let mut trainer = open(gpu, task, run)?;
    let span = Span::of(&task.common);
    let resumed_from = span.done(trainer.progress().iteration);
    advance(task, &mut trainer, &config, span, control)?;
    let trained = trainer.gaussians()?;
    // Free the device while the model is written and uploaded.
    drop(trainer);
    let mut bytes = read(path)?;
    ply::replace_rows(&mut bytes, &path.display().to_string(), &band, &trained)?;
    output_of(bytes, gaussians, resumed_from)
}

/// The same of a scene with a water surface: the band of every set is trained.
fn run_sets(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &BordersSpec,
    path: &Path,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let Some(model) = ply::read_surface_model(path)? else {
        let message = "the merged model has no water surface".to_owned();
        return Err(TaskError::Failed { class: FailClass::Input, message });
    };
    let disks = model.len() as u32;
    let [straight, reflected, refracted] = model.sets().map(|set| band_of(set, task, spec));
    let bands = [straight?, reflected?, refracted?];
    let water = model.record.surface();
    let views = if bands.iter().all(Vec::is_empty) {
        None
    } else {
        views_of(gpu, task, spec, &model.dry(), Some(&water), views, control)?
    };
    let Some(views) = views else {
        tracing::warn!("no view shows a surface to train at the borders");
        return output_of(read(path)?, disks, 0);
    };
    let (part, rest) = model.split_where(|set, index| bands[set].binary_search(&index).is_ok());
    let none = || Gaussians::empty(part.straight.sh_degree);
    let no_more = [none(), none()];
    let ([focus, context], surface) =
        surface_part(part, rest, no_more, &task.train_config(), &task.config.surface);
    let most = focus.len() + surface.reflected.len() + surface.refracted.len();
    let config = TrainConfig { max_gaussians: most as u32, ..task.train_config() };
    let config = task.config.borders.of_run(config);
    tracing::info!(disks = most, views = views.views().len(), "training the borders");
    let (extent, surfaces) = (task.common.scene_extent, Gaussians::empty(config.sh_degree));
    let run = TrainRun {
        config: config.clone(),
        extent,
        views,
        focus,
        context,
        surfaces,
        medium: None,
        surface: Some(surface),
    };
    let mut run = method::start(task.config.method, Arc::clone(gpu), run)?;
    go_on(task, run.as_mut())?;
    let span = Span::of(&task.common);
    let resumed_from = span.done(run.progress().iteration);
    advance(task, run.as_mut(), &config, span, control)?;
    let trained = run.hand_in(task.config.data.metres_per_unit)?.surface;
    // Free the device while the model is written and uploaded.
    drop(run);
    let mut bytes = read(path)?;
    if let Some(trained) = trained {
        // A disk that only stands for an empty band stays as it was.
        let none = Gaussians::empty(trained.straight.sh_degree);
        let with = [0, 1, 2].map(|set| if bands[set].is_empty() { &none } else { trained.sets()[set] });
        let bands = [&bands[0][..], &bands[1][..], &bands[2][..]];
        ply::replace_surface_rows(&mut bytes, &path.display().to_string(), bands, with)?;
    }
    output_of(bytes, disks, resumed_from)
}

/// Rows of the model to train, ascending: those of the band, except Gaussians that are visible far beyond it
/// (`is_shared`).
fn band_of(model: &Gaussians, task: &TaskInput, spec: &BordersSpec) -> Result<Vec<usize>, TaskError> {
    let band = Boxes::new(&spec.band)?;
    let is_trained = |index: &usize| {
        band.contain(DVec3::from(model.means[*index].map(f64::from)))
            && !is_shared(model.log_scales[*index], task.common.viewing_distance)
    };
    Ok((0..model.len()).filter(is_trained).collect())
}

/// The views that show the band, with their loss masks, through a water surface if there is one; `None` if no
/// view does.
fn views_of(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &BordersSpec,
    model: &Gaussians,
    water: Option<&Surface>,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<Option<Arc<dyn ViewSource>>, TaskError> {
    let (band, surroundings) = (Boxes::new(&spec.band)?, Boxes::new(&spec.surroundings)?);
    // Without Gaussians that would move the surfaces, as for a partition.
    let surfaces = model.surfaces(task.common.viewing_distance);
    let renderer = Renderer::new(Arc::clone(gpu), &surfaces)?
        .drawn(Drawing { mip_filter: false, ..task.config.train.drawing() })?;
    drop(surfaces);
    let go_on = || control.stop_reason().is_none();
    let shows = |point| band.contain(point);
    let chosen =
        LossMask::showing(shows, renderer, water, views, |point| surroundings.contain(point), go_on)?;
    let Some(chosen) = chosen else { return Err(TaskError::Stopped { checkpoint: None }) };
    Ok((!chosen.views().is_empty()).then(|| Arc::new(chosen) as Arc<dyn ViewSource>))
}

/// Splits off the Gaussians of the given rows, which ascend, from all others.
fn split_at(model: Gaussians, rows: &[usize]) -> (Gaussians, Gaussians) {
    let mut rows = rows.iter().peekable();
    model.split_where(|index| rows.next_if(|row| **row == index).is_some())
}

fn read(path: &Path) -> Result<Vec<u8>, TaskError> {
    Ok(std::fs::read(path).map_err(CoreError::io("read", path))?)
}

fn output_of(model: Vec<u8>, gaussians: u32, resumed_from: u32) -> Result<TaskOutput, TaskError> {
    Ok(TaskOutput { result: Bytes::from(model), gaussians, resumed_from, ..TaskOutput::default() })
}

/// Several boxes as one region.
struct Boxes<'a>(Vec<Inside<'a>>);

impl<'a> Boxes<'a> {
    fn new(boxes: &'a [FocusBox]) -> Result<Self, TaskError> {
        boxes.iter().map(Inside::new).collect::<Result<_, _>>().map(Self)
    }

    fn contain(&self, point: DVec3) -> bool {
        self.0.iter().any(|one| one.contains(point))
    }
}
