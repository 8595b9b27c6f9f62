//! Exposures of the training views on the device: an affine colour map each, learnt with the Gaussians.
//!
//! Photographs of one place differ in exposure and white balance. Without compensation, the Gaussians learn
//! colours that are bright from one side and dark from another, and veils for the rest. As in 3DGS since
//! October 2024 (Kerbl et al.), the render of a training view goes through a 3x4 map before the loss.
//! Held-out views and exports use the identity.
//!
//! The loss cannot distinguish a dark model with bright exposures from the opposite. 3DGS leaves this to
//! chance. Here the mean of all exposures stays the identity, so the model has the mean exposure of its
//! photographs. Views without training thus use the mean exposure.

use crate::Result;
use crate::appearance::adam::{interpolate_log, unbiasing};
use crate::appearance::chain::{Appearance, Gradients, Iteration};
use crate::config::TrainConfig;
use crate::gpu::{ExposureUniform, Frame, Gpu, Recorder, Size};

/// Number of pixels that a workgroup of `expose_backward` sums (`shaders/shared/exposure.wgsl`).
const CHUNK: u32 = 1024;
/// Decay of the Adam moments, as for the Gaussians (`shaders/shared/adam.wgsl`).
const BETAS: [f64; 2] = [0.8, 0.99];
/// Largest learning-rate scale of a view (`project_backward.wgsl`).
const MAX_LR_SCALE: f32 = 8.0;
const IDENTITY: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// One iteration's step of an exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExposureStep {
    /// Index of the view.
    pub view: u32,
    /// Number of steps of the view including this one, from 1.
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
    /// Learning rates at the start and at the end of the run, before [`Exposures::lr_scale`].
    rates: [f32; 2],
    sized: Option<Sized>,
}

struct Sized {
    pixels: u64,
    exposed: wgpu::Buffer,
    partials: wgpu::Buffer,
}

impl Exposures {
    /// Identity exposures for `views` views.
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

    /// Sets the learning rates of a run.
    #[must_use]
    pub fn with_rates(self, config: &TrainConfig) -> Self {
        Self { rates: [config.exposure_lr, config.exposure_lr_end], ..self }
    }

    /// The step of an iteration of a run.
    fn step_at(&self, now: &Iteration<'_>) -> ExposureStep {
        let [start, end] = self.rates;
        ExposureStep {
            view: now.view,
            // Every view is used once per epoch; with weighted views, on average.
            steps: now.number / now.views + 1,
            rate: Self::lr_scale(now.views as usize) * interpolate_log(start, end, now.progress()),
            size: now.photograph.size,
        }
    }

    /// Learning-rate scale with `views` views, one of which is used per iteration: 1 / sqrt(p), with p the
    /// share.
    ///
    /// If Adam updates all views in every iteration (3DGS), the second moment of a view also averages the
    /// zeros of the other iterations. The scale reproduces this. It is the same as for Gaussians (`lr_scale`
    /// in `project_backward.wgsl`) and has the same limit.
    pub fn lr_scale(views: usize) -> f32 {
        (views as f32).sqrt().min(MAX_LR_SCALE)
    }

    /// Allocates buffers for pictures of `size`.
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

    /// Records the exposure of the render `image`; returns the picture for the loss, `[H*W]` vec4: rgb,
    /// alpha.
    ///
    /// # Errors
    /// When the kernel does not compile or `prepare` was not called.
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

    /// Records the backward pass of [`Exposures::record`], and the step. Nothing is stepped if `counters`
    /// report an overflowing list. `v_image` holds the gradient of the exposed picture before, and of `image`
    /// after.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
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

    /// Buffers that are always written before they are read; tests fill them with garbage first.
    ///
    /// # Errors
    /// When `prepare` was not called.
    pub fn scratch(&self) -> Result<[&wgpu::Buffer; 2]> {
        let sized = self.sized()?;
        Ok([&sized.exposed, &sized.partials])
    }

    /// The arrays that persist across iterations, with their bytes: `[views*3]` vec4, rows of A and b, and
    /// `[views*6]` vec4, their first and second moments.
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
