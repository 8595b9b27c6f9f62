//! Exposures of the training views on the device: an affine map of colour each, learnt beside the Gaussians.
//!
//! Photographs of one place differ in exposure and white balance. Without compensation the Gaussians learn
//! views that are bright from here and dark from there, and veils that make up for the rest. As in 3DGS since
//! October 2024 (Kerbl et al.), the render of a training view goes through a 3x4 map before the loss;
//! held-out views and exports take the identity.
//!
//! The loss does not tell a dark model under bright exposures from the opposite. 3DGS leaves that to chance;
//! here the mean of all exposures stays the identity, so the model has the mean exposure of its photographs,
//! which is what the identity stands for on views that were not trained on.

use crate::Result;
use crate::appearance::adam::{interpolate_log, unbiasing};
use crate::appearance::chain::{Appearance, Gradients, Iteration};
use crate::config::TrainConfig;
use crate::gpu::{ExposureUniform, Frame, Gpu, Recorder, Size};

/// Pixels that a workgroup of `expose_backward` sums (`shaders/shared/exposure.wgsl`).
const CHUNK: u32 = 1024;
/// Decay of the moments: those of the Gaussians' Adam (`shaders/shared/adam.wgsl`).
const BETAS: [f64; 2] = [0.8, 0.99];
/// Largest factor on the rate of one of many views (`project_backward.wgsl`).
const MAX_LR_SCALE: f32 = 8.0;
const IDENTITY: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// One iteration's step of an exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExposureStep {
    /// Index of the view.
    pub view: u32,
    /// Steps that the view will have had after this one, from 1.
    pub steps: u32,
    /// Learning rate of Adam.
    pub rate: f32,
    /// Width and height of the picture, pixels.
    pub size: [u32; 2],
}

/// The exposures of all training views of a run.
pub struct Exposures {
    views: u32,
    uniform: wgpu::Buffer,
    exposures: wgpu::Buffer,
    moments: wgpu::Buffer,
    /// Learning rate at the start of the run and at its end, of one view among many.
    rates: [f32; 2],
    sized: Option<Sized>,
}

struct Sized {
    pixels: u64,
    exposed: wgpu::Buffer,
    partials: wgpu::Buffer,
}

impl Exposures {
    /// The identity for each of `views` views.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn new(gpu: &Gpu, views: u32) -> Result<Self> {
        let rows = u64::from(views) * 3;
        let exposures = gpu.buffer("exposures", rows * 16)?;
        gpu.write(&exposures, 0, &vec![IDENTITY; views as usize]);
        Ok(Self {
            views,
            uniform: gpu.uniform("exposure", &ExposureUniform::default()),
            exposures,
            moments: gpu.buffer("exposure moments", rows * 32)?,
            rates: [0.0; 2],
            sized: None,
        })
    }

    /// The same with the learning rates of a run.
    #[must_use]
    pub fn with_rates(self, config: &TrainConfig) -> Self {
        Self { rates: [config.exposure_lr, config.exposure_lr_end], ..self }
    }

    /// The step of an iteration of a run.
    fn step_at(&self, now: &Iteration<'_>) -> ExposureStep {
        let [start, end] = self.rates;
        ExposureStep {
            view: now.view,
            // Every view is seen once an epoch; where views have weights, in the mean.
            steps: now.number / now.views + 1,
            rate: Self::lr_scale(now.views as usize) * interpolate_log(start, end, now.progress()),
            size: now.photograph.size,
        }
    }

    /// The factor on the learning rate with `views` views, of which one is seen an iteration: 1 / sqrt(p), p
    /// the share.
    ///
    /// Where Adam acts on all views in every iteration (3DGS), the second moment of one of them averages the
    /// zeros of the others too; the same as for Gaussians (`lr_scale` in `project_backward.wgsl`), at most by
    /// the same factor.
    pub fn lr_scale(views: usize) -> f32 {
        (views as f32).sqrt().min(MAX_LR_SCALE)
    }

    /// Makes room for pictures of `size`.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        let pixels = u64::from(size[0]) * u64::from(size[1]);
        if self.sized.as_ref().is_some_and(|sized| sized.pixels >= pixels) {
            return Ok(());
        }
        self.sized = Some(Sized {
            pixels,
            exposed: gpu.buffer("exposed", pixels * 16)?,
            partials: gpu.buffer("exposure partials", pixels.div_ceil(CHUNK.into()) * 48)?,
        });
        Ok(())
    }

    fn sized(&self) -> Result<&Sized> {
        self.sized.as_ref().ok_or_else(|| {
            crate::CoreError::Gpu("an exposure was recorded before its buffers were made".into())
        })
    }

    /// Records the exposure of the render `image`; gives what the loss is to compare, `[H*W]` vec4: rgb,
    /// alpha.
    ///
    /// # Errors
    /// When the kernel does not compile or no room was made.
    pub fn record(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        image: &wgpu::Buffer,
        step: ExposureStep,
    ) -> Result<&wgpu::Buffer> {
        let sized = self.sized()?;
        let pixels = step.size[0] * step.size[1];
        let [unbias1, unbias2] = unbiasing(BETAS, step.steps).map(|value| value as f32);
        let uniform = ExposureUniform {
            pixels,
            view: step.view,
            views: self.views,
            rate: step.rate,
            unbias1,
            unbias2,
            ..ExposureUniform::default()
        };
        gpu.write(&self.uniform, 0, &[uniform]);
        recorder.dispatch(
            "expose",
            Size::Items(pixels, 64),
            &[
                ("exposure", &self.uniform),
                ("exposures", &self.exposures),
                ("image", image),
                ("exposed", &sized.exposed),
            ],
        )?;
        Ok(&sized.exposed)
    }

    /// Records the way back of what [`Exposures::record`] recorded, and the step; nothing is stepped while
    /// `counters` say that a list was too short. `v_image` holds the gradient by the exposed picture before,
    /// by `image` after.
    ///
    /// # Errors
    /// When a kernel does not compile or no room was made.
    pub fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        image: &wgpu::Buffer,
        v_image: &wgpu::Buffer,
        counters: &wgpu::Buffer,
        size: [u32; 2],
    ) -> Result<()> {
        let sized = self.sized()?;
        let (exposure, exposures) = (("exposure", &self.uniform), ("exposures", &self.exposures));
        let partials = ("partials", &sized.partials);
        recorder.dispatch(
            "expose_backward",
            Size::Items(size[0] * size[1], CHUNK),
            &[exposure, exposures, ("image", image), ("v_image", v_image), partials],
        )?;
        recorder.dispatch(
            "expose_step",
            Size::Groups(1),
            &[exposure, ("counters", counters), partials, exposures, ("moments", &self.moments)],
        )
    }

    /// Buffers that must be written before they are read: tests fill them with rubbish first.
    ///
    /// # Errors
    /// When no room was made.
    pub fn scratch(&self) -> Result<[&wgpu::Buffer; 2]> {
        let sized = self.sized()?;
        Ok([&sized.exposed, &sized.partials])
    }

    /// The arrays whose content outlives an iteration, with their bytes: `[views*3]` vec4, rows of A and b,
    /// and `[views*6]` vec4, their first and second moments.
    pub fn arrays(&self) -> [(&wgpu::Buffer, usize); 2] {
        let rows = 3 * self.views as usize;
        [(&self.exposures, 16 * rows), (&self.moments, 32 * rows)]
    }

    /// Rows of A and b of each view.
    ///
    /// # Errors
    /// When the device fails.
    pub fn download(&self, gpu: &Gpu) -> Result<Vec<[[f32; 4]; 3]>> {
        gpu.read(&self.exposures, 0, self.views as usize)
    }
}

impl Appearance for Exposures {
    fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        self.prepare(gpu, size)
    }

    fn record<'a>(
        &'a self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        image: &'a wgpu::Buffer,
    ) -> Result<&'a wgpu::Buffer> {
        self.record(now.gpu, recorder, image, self.step_at(now))
    }

    fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        image: &wgpu::Buffer,
        gradients: Gradients<'_>,
    ) -> Result<()> {
        self.record_backward(recorder, image, gradients.v_image, &now.frame.counters, now.photograph.size)
    }

    fn arrays<'a>(&'a self, _frame: &'a Frame) -> Vec<(&'a wgpu::Buffer, usize)> {
        self.arrays().to_vec()
    }
}
