//! Training of a scene that is seen through a water surface (WSGS).
//!
//! Three sets of disks make a picture. The straight set is the scene above water, the reflected set is what
//! the surface mirrors, and the refracted set is what lies in the water. Each set is a [`Trainer`] of its
//! own, with its lists, its optimiser and its density control. This module only forms the picture from
//! theirs, and hands gradients back.
//!
//! The straight picture lies over that of the water. With [`SurfaceJoin::Masked`], as in the paper, each
//! straight disk has a mask that says whether it belongs above water. At first the straight set is then
//! trained alone, from all points. From [`SurfaceConfig::from`] on all sets are. Where refracted light
//! explains a pixel, the mask of the straight disks below the surface fades.

mod device;
mod iteration;
mod masks;
mod start;
mod state;

use std::sync::Arc;

use glam::DVec3;

pub use device::{DeviceSurface, Frames, SetGradients, record_agreement};
pub use start::{disks_at_points, surface_part, surface_run};

use super::{HeldOutMetrics, Part, Preview, Progress, TrainRun, Trainer};
use crate::config::{
    Reflectance, Strategy, SurfaceConfig, SurfaceJoin, SurfaceLight, SurfaceRefine, TrainConfig,
};
use crate::gaussians::Gaussians;
use crate::gpu::{Gpu, ListLimits, SurfaceRays, SurfaceRenderer, SurfaceUniform};
use crate::scene::{PinholeCamera, Pose};
use crate::surface::{AIR, Surface, SurfaceModel, SurfaceRecord};
use crate::views::ViewSource;
use crate::{CoreError, Result};
use masks::PseudoMasks;

/// The water surface of a run and the starts of the two sets that it shows.
#[derive(Clone, Debug)]
pub struct SurfaceRun {
    /// The surface at the start.
    pub record: SurfaceRecord,
    /// A point of it about which it turns, scene axes.
    pub pivot: DVec3,
    /// Disks above it that it reflects.
    pub reflected: Gaussians,
    /// Disks below it.
    pub refracted: Gaussians,
    /// Disks of both that are seen but not trained: reflected, refracted. Those above water are in
    /// [`TrainRun::context`].
    pub context: [Gaussians; 2],
    /// How it is trained.
    pub config: SurfaceConfig,
}

/// Trains one [`TrainRun`] with a water surface.
pub struct SurfaceTrainer {
    straight: Trainer,
    reflected: Trainer,
    refracted: Trainer,
    device: DeviceSurface,
    config: SurfaceConfig,
    record: SurfaceRecord,
    /// What is seen but not trained.
    context: SurfaceModel,
    /// First iteration of all three sets.
    from: u32,
    masks: PseudoMasks,
    iteration: u32,
    digest: [u8; 32],
}

/// The surface as kernels read it.
pub fn uniform_of(record: &SurfaceRecord) -> SurfaceUniform {
    let surface = record.surface();
    SurfaceUniform {
        normal: surface.normal.normalize().as_vec3().to_array(),
        offset: surface.offset as f32,
        eta: (AIR / surface.ior) as f32,
        schlick: u32::from(record.reflectance == Reflectance::Schlick),
        as_shown: u32::from(record.light == SurfaceLight::Srgb),
        over: u32::from(record.join == SurfaceJoin::Over),
    }
}

impl SurfaceTrainer {
    /// Starts a run.
    ///
    /// # Errors
    /// When the run has no surface, no views or no Gaussians, when its settings exclude each other, or when
    /// the device cannot hold it.
    pub fn new(gpu: Arc<Gpu>, mut run: TrainRun) -> Result<Self> {
        let Some(surface) = run.surface.take() else {
            return Err(CoreError::Scene("a run of method wsgs needs a water surface".into()));
        };
        if run.config.strategy != Strategy::Mcmc || !run.config.disks || run.medium.is_some() {
            return Err(CoreError::Scene(
                "method wsgs needs train.strategy = \"mcmc\", disks, and no water.medium".into(),
            ));
        }
        let SurfaceRun { record, pivot, reflected, refracted, context, config } = surface;
        let context = SurfaceModel {
            masks: vec![SHOWN; run.context.len()],
            straight: run.context.clone(),
            reflected: context[0].clone(),
            refracted: context[1].clone(),
            record: record.clone(),
        };
        let iterations = run.config.iterations;
        let from = share_of(iterations, config.begins_at()).min(iterations);
        let device = DeviceSurface::new(&gpu, uniform_of(&record), pivot.as_vec3().to_array())?;
        let caps = caps(run.config.max_gaussians, config.shares);
        let side = |[focus, context]: [Gaussians; 2], cap: u32, seed: u32, own: TrainConfig| TrainRun {
            config: TrainConfig {
                max_gaussians: cap,
                iterations: (iterations - from).max(1),
                seed: run.config.seed.wrapping_add(seed),
                prefetch_threads: 0,
                normal_consistency: 0.0,
                ..own
            },
            extent: run.extent,
            views: Arc::clone(&run.views),
            focus,
            context,
            surfaces: Gaussians::empty(run.config.sh_degree),
            medium: None,
            surface: None,
        };
        let part = |rays| Part::AtSurface(rays, device.plane());
        let [reflected, refracted] = [
            side([reflected, context.reflected.clone()], caps[2], 1, of_reflections(&run.config)),
            side([refracted, context.refracted.clone()], caps[1], 2, run.config.clone()),
        ];
        let reflected = Trainer::of_part(Arc::clone(&gpu), reflected, part(SurfaceRays::Reflected))?;
        let refracted = Trainer::of_part(Arc::clone(&gpu), refracted, part(SurfaceRays::Refracted))?;
        run.config.max_gaussians = caps[0];
        // The logit of a mask: of one that hides nothing, or of a half.
        let mask = if config.join == SurfaceJoin::Over { SHOWN } else { 0.0 };
        run.focus.log_scales.iter_mut().for_each(|scales| scales[2] = mask);
        let straight = Trainer::of_part(Arc::clone(&gpu), run, Part::Straight)?;
        let digest = state::digest(&config, &record, pivot, [&straight, &reflected, &refracted]);
        let masks = PseudoMasks::new(&gpu, straight.targets.views())?;
        let mut trainer = Self {
            straight,
            reflected,
            refracted,
            device,
            config,
            record,
            context,
            from,
            masks,
            iteration: 0,
            digest,
        };
        trainer.prepare_all()?;
        Ok(trainer)
    }

    fn prepare_all(&mut self) -> Result<()> {
        let gpu = Arc::clone(&self.straight.gpu);
        let sizes: Vec<[u32; 2]> = self
            .straight
            .targets
            .views()
            .iter()
            .map(|view| [view.camera.width, view.camera.height])
            .collect();
        sizes.into_iter().try_for_each(|size| self.device.prepare(&gpu, size))
    }

    /// Resumes a run from one of its checkpoints, to the same bytes as an uninterrupted one.
    ///
    /// # Errors
    /// [`CoreError::Checkpoint`] when the bytes are torn or belong to another run.
    pub fn resume(gpu: Arc<Gpu>, run: TrainRun, checkpoint: &[u8]) -> Result<Self> {
        let mut trainer = Self::new(gpu, run)?;
        trainer.go_to(checkpoint)?;
        Ok(trainer)
    }

    /// Progress of the run; `iteration == iterations` means done.
    pub fn progress(&self) -> Progress {
        let straight = self.straight.progress();
        let others = [&self.reflected, &self.refracted].map(|set| set.progress().gaussians);
        Progress {
            iteration: self.iteration,
            gaussians: straight.gaussians + others[0] + others[1],
            ..straight
        }
    }

    /// The surface as it is now.
    ///
    /// # Errors
    /// When the device fails.
    pub fn surface(&self) -> Result<Surface> {
        let plane = self.device.read(&self.straight.gpu)?;
        Ok(Surface {
            normal: DVec3::from(plane.normal.map(f64::from)).normalize(),
            offset: plane.offset.into(),
            ior: AIR / f64::from(plane.eta),
        })
    }

    /// Skipped steps of the surface because a gradient was not finite.
    ///
    /// # Errors
    /// When the device fails.
    pub fn steps_left_out(&self) -> Result<u32> {
        self.device.steps_left_out(&self.straight.gpu)
    }

    /// What the run has trained so far, without the context.
    ///
    /// # Errors
    /// When the device fails.
    pub fn model(&mut self) -> Result<SurfaceModel> {
        let surface = self.surface()?;
        let gpu = Arc::clone(&self.straight.gpu);
        let mut straight = self.straight.blocks.download(&gpu)?;
        let masks = straight.log_scales.iter().map(|scales| scales[2]).collect();
        straight.flatten();
        Ok(SurfaceModel {
            straight,
            masks,
            reflected: self.reflected.gaussians()?,
            refracted: self.refracted.gaussians()?,
            record: if self.config.refine == SurfaceRefine::Fixed {
                // The same to the bit in every partition.
                self.record.clone()
            } else {
                self.record.clone().at(&surface)
            },
        })
    }

    /// What the run shows: what it has trained, and what it trains beside.
    fn shown(&mut self) -> Result<SurfaceModel> {
        let mut shown = self.model()?;
        shown.append(&self.context);
        Ok(shown)
    }

    /// As [`Trainer::measure`], of the picture with the surface.
    ///
    /// # Errors
    /// When a photograph cannot be read, or the device cannot hold a second copy of the model.
    pub fn measure(
        &mut self,
        held_out: &dyn ViewSource,
        go_on: impl Fn() -> bool,
    ) -> Result<Option<HeldOutMetrics>> {
        let model = self.shown()?;
        let mut renderer = SurfaceRenderer::new(Arc::clone(&self.straight.gpu), &model)?;
        let iteration = self.iteration;
        let measured = super::held_out::measured(iteration, held_out, go_on, |camera, pose| {
            renderer.render(camera, pose)
        });
        drop(renderer);
        self.straight.gpu.release_unused()?;
        measured
    }

    /// As [`Trainer::preview`]; without the water it is the scene seen straight.
    ///
    /// # Errors
    /// When the device fails, or has no memory for the lists of a picture.
    pub fn preview(
        &mut self,
        cameras: &[(PinholeCamera, Pose)],
        go_on: impl Fn() -> bool,
    ) -> Result<Vec<Preview>> {
        let model = self.shown()?;
        let gpu = Arc::clone(&self.straight.gpu);
        let mut renderer = SurfaceRenderer::new(Arc::clone(&gpu), &model)?;
        let mut dry = SurfaceRenderer::dry(Arc::clone(&gpu), &model)?;
        let mut previews = Vec::with_capacity(cameras.len());
        for (camera, pose) in cameras {
            if !go_on() {
                break;
            }
            let bytes = |rendered: &crate::gpu::Rendered| {
                crate::metrics::quantised(rendered.width, rendered.height, &rendered.rgb).to_rgb8()
            };
            let render = bytes(&renderer.render(camera, pose)?);
            let clear = Some(bytes(&dry.render(camera, pose, [0.0; 3])?));
            previews.push(Preview { width: camera.width, height: camera.height, render, clear });
        }
        drop((renderer, dry));
        gpu.release_unused()?;
        Ok(previews)
    }

    /// As [`Trainer::set_list_capacities`], of every set.
    ///
    /// # Errors
    /// When the device cannot bind them.
    pub fn set_list_capacities(&mut self, visible: u32, intersections: u32) -> Result<()> {
        self.sets().into_iter().try_for_each(|set| set.set_list_capacities(visible, intersections))
    }

    /// As [`Trainer::set_list_limits`], of every set.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn set_list_limits(&mut self, limits: ListLimits) -> Result<()> {
        self.sets().into_iter().try_for_each(|set| set.set_list_limits(limits))
    }

    /// Largest number of bands of any view of any set so far.
    pub fn most_bands(&self) -> u32 {
        let sets = [&self.straight, &self.reflected, &self.refracted];
        sets.into_iter().map(Trainer::most_bands).max().unwrap_or(1)
    }

    fn sets(&mut self) -> [&mut Trainer; 3] {
        [&mut self.straight, &mut self.reflected, &mut self.refracted]
    }

    /// How long the run has waited for photographs that were not read yet.
    pub fn waited_for_photographs(&self) -> std::time::Duration {
        self.straight.waited_for_photographs()
    }
}

/// Logit of the mask of a disk that shows in full.
const SHOWN: f32 = 10.0;
/// Factor on the rates of shapes and opacities of the reflected set.
const SLOW: f32 = 0.1;

/// The settings of the reflected set.
///
/// The surface reflects a few percent of the light. The weights on opacity and scale assume gradients as
/// large as those of the picture: with them, nothing of the set was left on a pool. Adam scales small
/// gradients to full size, with their noise, so the set has no harmonics, and its shapes move slowly. A pool
/// with masks came out the same without (29.9 dB in the water, one seed). The set is not what limits a pool:
/// with the true refracted picture, the water would have 41 dB.
fn of_reflections(config: &TrainConfig) -> TrainConfig {
    TrainConfig {
        sh_degree_at: [2.0; 3],
        opacity_reg: 0.0,
        scale_reg: 0.0,
        scales_lr: SLOW * config.scales_lr,
        quats_lr: SLOW * config.quats_lr,
        opacity_lr: SLOW * config.opacity_lr,
        ..config.clone()
    }
}

/// An iteration at a share of the run.
fn share_of(iterations: u32, share: f32) -> u32 {
    (f64::from(iterations) * f64::from(share)).round() as u32
}

/// Caps of the straight, the refracted and the reflected set, at least one each.
fn caps(total: u32, shares: [f32; 3]) -> [u32; 3] {
    let sum: f64 = shares.iter().map(|&share| f64::from(share)).sum();
    // Rounded, so that shares which are numbers of disks give these numbers.
    let of = |share: f32| (f64::from(total) * f64::from(share) / sum.max(1e-9)).round() as u32;
    let [_, refracted, reflected] = shares.map(of).map(|cap| cap.max(1));
    [total.saturating_sub(refracted + reflected).max(1), refracted, reflected]
}
