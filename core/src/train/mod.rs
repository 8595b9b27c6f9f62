//! Training: one run over one set of views on one GPU.
//!
//! An iteration renders one view, compares it with its photograph and takes one Adam step on the Gaussians
//! that the view sees, all on the device. The host only queues iterations, periodically checks for list
//! overflows, and decides on density from statistics read back at fixed iterations. After an overflow it
//! grows the list and returns to the first iteration that failed; the device did nothing since. So the result
//! depends only on the run, the seed and the device, and not on timing, capacities, batches or interruptions.

mod background;
mod backward;
mod checkpoint;
mod density;
mod disks;
mod handover;
mod held_out;
mod init;
mod iteration;
mod lists;
mod loss;
mod predictor;
mod results;
mod schedule;
mod smoothing;
mod start;
pub mod surface;
mod surfaces;
mod target_images;

use std::collections::HashMap;
use std::sync::Arc;

use crate::appearance::Settings;
use crate::appearance::chain::{Chain, Start};
use crate::config::{LossLight, TrainConfig};
use crate::gaussians::Gaussians;
use crate::gpu::{Blocks, Frame, Gpu, StepUniform, SurfaceRays, spatial_order};
use crate::memory::BATCH;
use crate::views::ViewSource;
use crate::{CoreError, Result};

pub use crate::appearance::exposure::{ExposureStep, Exposures};
pub use crate::appearance::film::{FILM_UNITS, Film, FilmEmbedding, FilmStep};
pub use crate::appearance::water::{
    DeviceMedium, DevicePriors, Gathered, MediumRun, NetworkRun, PriorMaps, WaterStep,
};
pub use crate::gpu::DevicePhotograph;
pub use backward::{BackwardBuffers, DiskBuffers, TracedBuffers, record_backward, record_backward_in_bands};
pub use disks::{DiskMaps, LEAST_ALPHA};
pub use handover::Surroundings;
pub use held_out::{HeldOutMetrics, Preview};
pub use init::initial_gaussians;
use lists::{lists, slot_gradients};
pub use loss::Loss;
use predictor::Predictor;
use schedule::Schedule;
pub use smoothing::smoothed;
pub use start::{StartingWater, clear_points, starting_water, with_ray_maps};
use surfaces::Surfaces;
pub use surfaces::surface_points;
use target_images::TargetImages;

/// One run: its Gaussians, views, water and configuration.
pub struct TrainRun {
    /// Resolved configuration; `iterations` and `max_gaussians` are those of this run.
    pub config: TrainConfig,
    /// [`crate::scene::learning_scale`] of the whole scene, scene units. It is the same for every partition,
    /// so that learning rates are equal.
    pub extent: f32,
    /// Views to train on.
    pub views: Arc<dyn ViewSource>,
    /// Gaussians that are trained and densified.
    pub focus: Gaussians,
    /// Frozen Gaussians: rendered, but never changed.
    pub context: Gaussians,
    /// One covering Gaussian for each place that must stay covered ([`surface_points`]).
    pub surfaces: Gaussians,
    /// The water between cameras and scene; `None` trains in sRGB without water.
    pub medium: Option<MediumRun>,
    /// The water surface that cameras look at; for method `wsgs` only.
    pub surface: Option<surface::SurfaceRun>,
}

/// Progress of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Iterations done.
    pub iteration: u32,
    /// Total iterations.
    pub iterations: u32,
    /// Gaussians in focus.
    pub gaussians: u32,
    /// Mean loss of the last batch of iterations.
    pub loss: f32,
}

/// Device memory of a run, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryUse {
    /// Gaussians with their moments.
    pub gaussians: u64,
    /// Lists of visible Gaussians.
    pub per_visible: u64,
    /// Lists of intersections, including gradients.
    pub per_intersection: u64,
    /// Gradient sums of views that are rendered in several bands.
    pub bands: u64,
}

/// Trains one [`TrainRun`].
pub struct Trainer {
    gpu: Arc<Gpu>,
    config: TrainConfig,
    schedule: Schedule,
    extent: f32,
    /// Digest of everything that determines the result; a checkpoint carries it.
    run_digest: [u8; 32],
    targets: TargetImages,
    blocks: Blocks,
    frame: Frame,
    loss: Loss,
    /// The appearances between Gaussians and loss.
    appearances: Chain,
    /// Set if WaterParamPredict determines the water at first.
    predictor: Option<Predictor>,
    /// Set if the Gaussians are disks.
    disks: Option<DiskMaps>,
    /// Whether the third number of a disk is the logit of its mask, not a scale (a scene with a water
    /// surface).
    masked: bool,
    /// Set if there are surfaces that must stay covered.
    surfaces: Option<Surfaces>,
    slot_gradients: wgpu::Buffer,
    step: wgpu::Buffer,
    /// Number of bands of the views (index and level) whose lists would be too long for the device.
    bands: HashMap<(usize, u32), u32>,
    iteration: u32,
    /// Gaussians in focus at the start of the run: growth is geometric from here.
    initial: u32,
    last_loss: f32,
}

/// What a trainer trains.
#[derive(Clone, Copy, PartialEq)]
enum Part<'a> {
    /// A scene.
    Whole,
    /// Of a scene with a water surface, the disks that cameras see straight. Their third numbers are the
    /// logits of their masks.
    Straight,
    /// Of such a scene, the disks that they see by these rays at the surface.
    AtSurface(SurfaceRays, &'a wgpu::Buffer),
}

impl TrainRun {
    /// The settings that determine the appearances of the run.
    pub fn settings(&self) -> Settings<'_> {
        settings(&self.config, self.medium.as_ref())
    }
}

fn settings<'a>(train: &'a TrainConfig, medium: Option<&'a MediumRun>) -> Settings<'a> {
    Settings { train, water: medium.map(|medium| (medium.composition, &medium.config)) }
}

impl Trainer {
    /// Starts a run.
    ///
    /// # Errors
    /// When there are no views, no Gaussians, or the device cannot hold them.
    pub fn new(gpu: Arc<Gpu>, run: TrainRun) -> Result<Self> {
        Self::of_part(gpu, run, Part::Whole)
    }

    fn of_part(gpu: Arc<Gpu>, run: TrainRun, part: Part<'_>) -> Result<Self> {
        if run.views.views().is_empty() {
            return Err(CoreError::Scene("there are no views to train on".into()));
        }
        if run.focus.is_empty() {
            return Err(CoreError::Scene(
                "there are no Gaussians to train: the scene has no points in this partition".into(),
            ));
        }
        let run_digest = checkpoint::run_digest(&run);
        let TrainRun { config, extent, views, focus, context, surfaces, medium, surface: _ } = run;
        let medium = medium.map(|medium| medium.times(config.loss_factor));
        let mut focus = init::limit(focus, config.max_gaussians, config.seed);
        if config.disks && part != Part::Straight {
            focus.flatten();
        }
        let surfaces = Surfaces::new(surfaces, &context)?;
        let mut blocks = Blocks::new(&gpu, config.sh_degree)?;
        blocks.push_trainable(&gpu, &focus, config.max_gaussians, config.moments)?;
        blocks.push_frozen(&gpu, &context, &spatial_order(&context))?;
        // Otherwise the uploads stay in staging buffers while the next buffers are made.
        gpu.wait()?;
        let gaussians = config.max_gaussians.max(focus.len() as u32) + context.len() as u32;
        let lists = lists(&gpu, &config, views.views(), &focus, &context, medium.as_ref());
        let mut frame = Frame::new(&gpu, gaussians, lists.visible, lists.intersections)?;
        let mut disks = None;
        if config.disks {
            frame = frame.of_disks(&gpu)?;
            if let Part::AtSurface(rays, plane) = part {
                frame = frame.at_surface(&gpu, rays, plane)?;
            }
            disks = Some(DiskMaps::new(&gpu)?);
        }
        let slot_gradients = slot_gradients(&gpu, &frame)?;
        // Sized for the largest image, so that a run that cannot hold it fails here and not at full
        // resolution.
        let light = medium.as_ref().map_or(LossLight::Srgb, |medium| medium.config.loss_light);
        let mut loss = Loss::new(&gpu)?.in_light(light).times(config.loss_factor);
        let schedule = Schedule::new(&config, medium.as_ref());
        let predictor = match (&medium, schedule.water()) {
            (Some(medium), Some(water)) => Predictor::new(medium, water.network_end(), config.seed)?,
            _ => None,
        };
        let mut appearances = Chain::new(&Start {
            gpu: &gpu,
            settings: settings(&config, medium.as_ref()),
            medium: medium.as_ref(),
            views: views.views().len() as u32,
            blocks: blocks.trainable().count() as u32,
        })?;
        if let Some(water) = appearances.water() {
            water.give_to(&gpu, &frame);
        }
        for view in views.views() {
            let size = [view.camera.width, view.camera.height];
            frame.prepare_targets(&gpu, size)?;
            if matches!(part, Part::AtSurface(..)) {
                // Its pictures are parts of another.
                continue;
            }
            loss.prepare(&gpu, size)?;
            appearances.prepare(&gpu, size)?;
            if let Some(disks) = &mut disks {
                disks.prepare(&gpu, size)?;
            }
        }
        let trainer = Self {
            schedule,
            step: gpu.uniform("step", &StepUniform::default()),
            loss,
            appearances,
            predictor,
            disks,
            masked: part == Part::Straight,
            surfaces,
            targets: TargetImages::new(views, config.seed, config.prefetch_threads).evictable_on(&gpu),
            initial: focus.len() as u32,
            gpu,
            config,
            extent,
            run_digest,
            blocks,
            frame,
            slot_gradients,
            bands: HashMap::new(),
            iteration: 0,
            last_loss: f32::NAN,
        };
        trainer.update_smoothing()?;
        Ok(trainer)
    }

    /// Resumes the same run from one of its checkpoints. The result has the same bytes as an uninterrupted
    /// run.
    ///
    /// # Errors
    /// [`CoreError::Checkpoint`] when the bytes are torn or belong to another run; start a new run then.
    pub fn resume(gpu: Arc<Gpu>, run: TrainRun, checkpoint: &[u8]) -> Result<Self> {
        let mut trainer = Self::new(gpu, run)?;
        checkpoint::restore(&mut trainer, checkpoint)?;
        Ok(trainer)
    }

    /// Runs at most `iterations` more and waits for them.
    ///
    /// # Errors
    /// When a photograph cannot be read or the device fails.
    pub fn advance(&mut self, iterations: u32) -> Result<Progress> {
        let target = self.config.iterations.min(self.iteration.saturating_add(iterations));
        while self.iteration < target {
            let refine_at = self.schedule.next_refine(self.iteration);
            let predict_at = self.next_prediction();
            let end = target.min(self.iteration + BATCH).min(refine_at).min(predict_at);
            self.run_batch(end)?;
            if self.iteration == predict_at {
                self.predict_water()?;
            }
            if self.iteration == refine_at && self.iteration < self.config.iterations {
                self.densify()?;
            }
        }
        Ok(self.progress())
    }

    /// Progress of the run; `iteration == iterations` means done.
    pub fn progress(&self) -> Progress {
        Progress {
            iteration: self.iteration,
            iterations: self.config.iterations,
            gaussians: self.blocks.trainable_total(),
            loss: self.last_loss,
        }
    }

    /// Everything that a resumed run needs, followed by a digest.
    ///
    /// # Errors
    /// When the device fails.
    pub fn checkpoint(&mut self) -> Result<Vec<u8>> {
        checkpoint::save(self)
    }

    /// The current Gaussians in focus as they are rendered: with the 3D filter of Mip-Splatting if it is on.
    /// The third scale of disks is a hundredth of the smaller one.
    ///
    /// # Errors
    /// When the device fails.
    pub fn gaussians(&mut self) -> Result<Gaussians> {
        let mut model = self.blocks.download(&self.gpu)?;
        if self.config.disks {
            model.flatten();
        }
        if self.config.mip_filter { Ok(smoothed(model, &self.smoothing()?)) } else { Ok(model) }
    }
}
