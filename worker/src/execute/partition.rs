//! PARTITION: trains the Gaussians in this partition's box; the rest of the coarse model is context.
//!
//! A job of one partition has no coarse model and trains everything from the sparse points. If partitions
//! have two parts (`first_part.rs`), this is the second part.

use std::path::Path;
use std::sync::Arc;

use fathom_core::config::TrainConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, Renderer};
use fathom_core::ply;
use fathom_core::surface::{Surface, SurfaceModel};
use fathom_core::train::surface::{disks_at_points, surface_part};
use fathom_core::train::{MediumRun, clear_points, surface_points};
use fathom_core::views::ViewSource;
use fathom_proto::worker::v1::{Artifact, FailClass, FocusBox, PartitionSpec};
use glam::{DQuat, DVec3};

use super::first_part::{read_exchange, run_rest};
use super::loss_mask::LossMask;
use super::training::{
    Parts, Span, Unchanged, output_of_shared, parts_of_points, read_points, train, under_water,
};
use super::{Control, TaskError, TaskInput, TaskOutput};

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &PartitionSpec,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let exchange = read_exchange(task)?;
    let Some(own) = own_part(gpu, task, spec, Arc::clone(&views), control)? else {
        let (parts, views) = parts_of_points(task, views)?;
        return train(gpu, task, task.train_config(), views, parts, Span::of(&task.common), control);
    };
    if own.parts.focus.is_empty() {
        let agreed = exchange.and_then(|exchange| exchange.water);
        let water = agreed.map(|agreed| agreed.water).or(own.parts.water);
        return output_of_shared(&own.parts.shared, &task.config.train, water.as_ref());
    }
    match exchange {
        Some(exchange) => run_rest(gpu, task, spec, own, exchange, control),
        None => train(gpu, task, own.config, own.views, own.parts, Span::of(&task.common), control),
    }
}

/// The Gaussians that a partition trains, and its views.
pub struct OwnPart {
    /// The Gaussians in its box, then those outside, with the water of the coarse model unchanged. In open
    /// water or pure haze nothing is in focus: then there is nothing to train, and the neighbours cover the
    /// rest.
    pub parts: Parts,
    /// Its views; masked to its own pixels if there is something to train.
    pub views: Arc<dyn ViewSource>,
    /// Schedule of a run that continues from a model.
    pub config: TrainConfig,
}

/// The part of the coarse model in the task's box; `None` for a job of one partition, which has neither.
pub fn own_part(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &PartitionSpec,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<Option<OwnPart>, TaskError> {
    let (model, bounds) = match (task.input(Artifact::CoarseModel), &spec.focus) {
        (Some(model), Some(bounds)) => (model, bounds),
        (None, None) => return Ok(None),
        _ => {
            let message = "a partition needs both the coarse model and its box, or neither".to_owned();
            return Err(TaskError::Failed { class: FailClass::Input, message });
        }
    };
    let inside = Inside::new(bounds)?;
    if task.config.method.through_surface() {
        return own_sets(gpu, task, model, &inside, views, control).map(Some);
    }
    let water = ply::water_record(model)?;
    let model = ply::read_model(model)?;
    let (own, mut context) = model.split_by(|mean| inside.contains(DVec3::from(mean.map(f64::from))));
    let solid = model.surfaces(task.common.viewing_distance);
    let (shared, focus) = split_shared(&own, task.common.viewing_distance);
    (0..shared.len()).for_each(|index| context.push_from(&shared, index));
    let config = task.train_config().continued();
    let medium = water.as_ref().map(|water| MediumRun::of_record(water, &task.config.water, task.unit()));
    let surfaces = match medium.as_ref() {
        None => Gaussians::empty(config.sh_degree),
        Some(medium) => {
            let points = clear_points(medium, &read_points(task)?, views.views(), &task.common.views);
            let is_own = |at: [f32; 3]| inside.contains(DVec3::from(at.map(f64::from)));
            surface_points(&points, views.views(), &task.common.views, &config, Some(medium), is_own)?
        }
    };
    let views = under_water(task, medium.as_ref(), views)?;
    if focus.is_empty() {
        tracing::warn!(shared = shared.len(), "this partition has nothing to train");
    }
    let shared = Unchanged::Gaussians(shared);
    let parts = Parts { focus, context, surfaces, shared, medium, water, surface: None };
    if parts.focus.is_empty() {
        return Ok(Some(OwnPart { parts, views, config }));
    }
    let views = own_pixels(gpu, task, &solid, None, &inside, views, control)?;
    Ok(Some(OwnPart { parts, views, config }))
}

/// How much wider Gaussians that no partition trains are in air: there is no haze, and what is wide is what a
/// hall or a far bank consists of. A pool of 4 m in 2x2 reached 29.03 dB with this, and 28.86 dB with 1 (one
/// seed).
const IN_AIR: f32 = 4.0;

/// As [`own_part`], of a scene with a water surface: every set has its part in the box.
fn own_sets(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    path: &Path,
    inside: &Inside<'_>,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<OwnPart, TaskError> {
    let Some(model) = ply::read_surface_model(path)? else {
        let message = "the coarse model has no water surface".to_owned();
        return Err(TaskError::Failed { class: FailClass::Input, message });
    };
    let surface = model.record.surface();
    let distance = task.common.viewing_distance.map(|distance| IN_AIR * distance);
    let solid = model.dry().surfaces(distance);
    let (own, mut rest) = model.split_by(|mean| inside.contains(DVec3::from(mean.map(f64::from))));
    let sets = own.sets();
    // Pixels of all partitions see the whole reflected set. If each trained its part, every refracted set
    // would fit reflections that the merged model does not show.
    let is_shared = |set: usize, index| set == SurfaceModel::REFLECTED || sets[set].is_wide(index, distance);
    let (shared, focus) = own.split_where(is_shared);
    rest.append(&shared);
    let config = task.train_config().continued();
    let shared_count = shared.len();
    // What is submitted unchanged counts too; of the reflected set it is a whole share.
    let room = config.max_gaussians.saturating_sub(shared_count as u32).max(focus.len() as u32);
    let config = TrainConfig { max_gaussians: room, ..config };
    let shared = Unchanged::Sets(Box::new(shared));
    if focus.is_empty() {
        tracing::warn!(shared = shared_count, "this partition has nothing to train");
        let nothing = Parts::only(Gaussians::empty(config.sh_degree));
        return Ok(OwnPart { parts: Parts { shared, ..nothing }, views, config });
    }
    let points =
        disks_at_points(&read_points(task)?, views.views(), &task.common.views, &config, &focus.record)?;
    let points =
        points.map(|disks| disks.split_by(|mean| inside.contains(DVec3::from(mean.map(f64::from)))).0);
    let ([focus, context], run) = surface_part(focus, rest, points, &config, &task.config.surface);
    let parts = Parts { context, shared, surface: Some(run), ..Parts::only(focus) };
    let views = own_pixels(gpu, task, &solid, Some(&surface), inside, views, control)?;
    Ok(OwnPart { parts, views, config })
}

/// The views, with only those pixels that show the box. `solid` is the model without Gaussians that are no
/// surface: haze would move surfaces towards the camera, and background Gaussians would end rays that meet
/// none. `water` is the water surface that cameras look through.
fn own_pixels(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    solid: &Gaussians,
    water: Option<&Surface>,
    inside: &Inside<'_>,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<Arc<dyn ViewSource>, TaskError> {
    let go_on = || control.stop_reason().is_none();
    let renderer = Renderer::new(Arc::clone(gpu), solid)?.drawn(task.config.train.drawing())?;
    let views = LossMask::new(renderer, water, views, |point| inside.contains(point), go_on)?;
    let Some(views) = views else { return Err(TaskError::Stopped { checkpoint: None }) };
    Ok(Arc::new(views))
}

/// Splits a model into shared Gaussians, so large that many partitions see them (haze and background), and
/// the others.
///
/// Every partition renders the shared ones unchanged, and the partition whose cell holds one submits it
/// unchanged. If they were trained, each partition would fit its own copy to its own views. The merge would
/// then keep a copy that only one partition has seen. If the scene scale is unknown, nothing is shared.
pub(super) fn split_shared(model: &Gaussians, viewing_distance: Option<f32>) -> (Gaussians, Gaussians) {
    model.split_where(|index| model.is_wide(index, viewing_distance))
}

/// Tests a partition's box with the same operations in the same order as `Plan::focuses`, so that both agree
/// to the last bit.
pub(super) struct Inside<'a> {
    rotation: DQuat,
    bounds: &'a FocusBox,
}

impl<'a> Inside<'a> {
    pub(super) fn new(bounds: &'a FocusBox) -> Result<Self, TaskError> {
        let Ok([w, x, y, z]) = <[f64; 4]>::try_from(bounds.align_quat_wxyz.as_slice()) else {
            let message = format!("a quaternion has 4 numbers, not {}", bounds.align_quat_wxyz.len());
            return Err(TaskError::Failed { class: FailClass::Input, message });
        };
        Ok(Self { rotation: DQuat::from_xyzw(x, y, z, w), bounds })
    }

    pub(super) fn contains(&self, point: DVec3) -> bool {
        let aligned = self.rotation * point;
        let FocusBox { min_x, max_x, min_z, max_z, .. } = self.bounds;
        aligned.is_finite()
            && aligned.x > *min_x
            && aligned.x <= *max_x
            && aligned.z > *min_z
            && aligned.z <= *max_z
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bounds(align_quat_wxyz: Vec<f64>) -> FocusBox {
        FocusBox { align_quat_wxyz, min_x: 0.0, max_x: 1.0, min_z: f64::NEG_INFINITY, max_z: 2.0 }
    }

    #[test]
    fn a_box_excludes_its_lower_bounds_and_includes_its_upper_ones() {
        let bounds = bounds(vec![1.0, 0.0, 0.0, 0.0]);
        let inside = Inside::new(&bounds).unwrap();
        assert!(!inside.contains(DVec3::new(0.0, 5.0, 0.0)));
        assert!(inside.contains(DVec3::new(1.0, -5.0, 2.0)));
        assert!(inside.contains(DVec3::new(0.5, 0.0, -1e30)));
        assert!(!inside.contains(DVec3::new(0.5, 0.0, 2.1)));
        assert!(!inside.contains(DVec3::new(0.5, f64::NAN, 0.0)));
    }

    #[test]
    fn a_continued_run_starts_at_full_size_with_all_harmonics() {
        let config = TrainConfig { seed: 7, ..TrainConfig::default() };
        let continued = config.clone().continued();
        assert_eq!((continued.sh_degree_at, continued.resolution_at), ([0.0; 3], [0.0; 2]));
        let restored = TrainConfig {
            sh_degree_at: config.sh_degree_at,
            resolution_at: config.resolution_at,
            ..continued
        };
        assert_eq!(restored, config, "something else changed too");
    }

    #[test]
    fn the_box_stands_in_the_aligned_frame() {
        // A quarter turn about y takes world z to aligned x, and world x to aligned -z.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let bounds = bounds(vec![half, 0.0, half, 0.0]);
        let inside = Inside::new(&bounds).unwrap();
        assert!(inside.contains(DVec3::new(0.0, 0.0, 0.5)));
        assert!(!inside.contains(DVec3::new(0.0, 0.0, -0.5)));
        assert!(inside.contains(DVec3::new(9.0, 0.0, 0.5)), "aligned z = -9 is above no lower bound");
        assert!(!inside.contains(DVec3::new(-9.0, 0.0, 0.5)), "aligned z = 9 is beyond the upper bound");
        assert!(Inside::new(&FocusBox::default()).is_err());
    }
}
