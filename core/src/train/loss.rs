//! The loss on the device: (1-w) L1 + w (1 - SSIM), its gradient with respect to the render, and a log of its
//! values.

use std::ops::Range;

use crate::Result;
use crate::config::LossLight;
use crate::gpu::{DevicePhotograph, Gpu, LossUniform, Recorder, Size};

/// Entries of the log; more than the iterations between two reads.
const LOG: u32 = 64;

/// Buffers of the loss, for images up to a size.
pub struct Loss {
    uniforms: [wgpu::Buffer; 3],
    losses: wgpu::Buffer,
    light: LossLight,
    factor: f32,
    sized: Option<Sized>,
}

struct Sized {
    pixels: u64,
    truth: wgpu::Buffer,
    moments: wgpu::Buffer,
    partials: wgpu::Buffer,
    smoothed: wgpu::Buffer,
    sums: wgpu::Buffer,
    v_image: wgpu::Buffer,
    v_range: wgpu::Buffer,
}

impl Loss {
    /// A loss without buffers for images yet.
    ///
    /// # Errors
    /// When the device fails.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        let uniform = |channel| gpu.uniform("loss", &LossUniform::new([1, 1], channel, false, 0.0, 0));
        Ok(Self {
            uniforms: [uniform(0), uniform(1), uniform(2)],
            losses: gpu.buffer("losses", u64::from(LOG) * 4)?,
            light: LossLight::Srgb,
            factor: 1.0,
            sized: None,
        })
    }

    /// The same, compared in this light. In linear light, photographs are decoded and renders are taken as
    /// linear.
    #[must_use]
    pub fn in_light(self, light: LossLight) -> Self {
        Self { light, ..self }
    }

    /// The same, multiplied by a factor.
    #[must_use]
    pub fn times(self, factor: f32) -> Self {
        Self { factor, ..self }
    }

    /// Makes buffers for images of `size`.
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
            truth: gpu.buffer("truth", pixels * 4)?,
            moments: gpu.buffer("SSIM moments", pixels * 16)?,
            partials: gpu.buffer("SSIM partials", pixels * 16)?,
            smoothed: gpu.buffer("SSIM smoothed", pixels * 16)?,
            // A group sums 32 runs of one to eight pixels of a column, so this is enough for any shape.
            sums: gpu.buffer("loss sums", pixels.div_ceil(32) * 4)?,
            v_image: gpu.buffer("v_image", pixels * 16)?,
            v_range: gpu.buffer("v_range", pixels * 4)?,
        });
        Ok(())
    }

    /// Buffers that must be written before they are read. Tests fill them with garbage first.
    ///
    /// # Errors
    /// When [`Loss::prepare`] was not called.
    pub fn scratch(&self) -> Result<[&wgpu::Buffer; 4]> {
        let sized = self.sized()?;
        Ok([&sized.moments, &sized.partials, &sized.smoothed, &sized.sums])
    }

    fn sized(&self) -> Result<&Sized> {
        self.sized
            .as_ref()
            .ok_or_else(|| crate::CoreError::Gpu("a loss was recorded before its buffers were made".into()))
    }

    /// Gradient with respect to the image, `[H*W]` vec4; the alpha entry is 0.
    ///
    /// # Errors
    /// When [`Loss::prepare`] was not called.
    pub fn v_image(&self) -> Result<&wgpu::Buffer> {
        Ok(&self.sized()?.v_image)
    }

    /// The photograph of the last comparison, `[H*W]` packed; one buffer for all views.
    ///
    /// # Errors
    /// When [`Loss::prepare`] was not called.
    pub fn truth(&self) -> Result<&wgpu::Buffer> {
        Ok(&self.sized()?.truth)
    }

    /// Gradient with respect to the range image: 0, because no term of this loss depends on it.
    ///
    /// # Errors
    /// When [`Loss::prepare`] was not called.
    pub fn v_range(&self) -> Result<&wgpu::Buffer> {
        Ok(&self.sized()?.v_range)
    }

    /// Records the loss between `image` (the render) and `truth`.
    ///
    /// # Errors
    /// When a kernel does not compile or [`Loss::prepare`] was not called.
    pub fn record(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        truth: &DevicePhotograph,
        image: &wgpu::Buffer,
        ssim_weight: f32,
        iteration: u32,
    ) -> Result<()> {
        let sized = self.sized()?;
        let size = truth.size;
        // A copy, so that the kernels are bound to one buffer for all views.
        recorder.copy(&truth.pixels, &sized.truth);
        let [rows, columns, columns_backward] = match self.light {
            LossLight::Srgb => ["ssim_rows", "ssim_columns", "ssim_columns_backward"],
            LossLight::Linear => ["ssim_rows_linear", "ssim_columns_linear", "ssim_columns_backward_linear"],
        };
        let by_rows = Size::Items(size[0].div_ceil(8) * size[1], 32);
        let by_columns = Size::Items(size[1].div_ceil(8) * size[0], 32);
        for (channel, uniform) in self.uniforms.iter().enumerate() {
            let mut values =
                LossUniform::new(size, channel as u32, truth.masked, ssim_weight, iteration % LOG);
            values.scale *= self.factor;
            gpu.write(uniform, 0, &[values]);
            let (loss, image, truth) = (("loss", uniform), ("image", image), ("truth", &sized.truth));
            let moments = ("moments", &sized.moments);
            let partials = ("partials", &sized.partials);
            let smoothed = ("smoothed", &sized.smoothed);
            let sums = ("sums", &sized.sums);
            recorder.dispatch(rows, by_rows, &[loss, image, truth, moments])?;
            recorder.dispatch(
                columns,
                by_columns,
                &[loss, image, truth, moments, partials, ("sums_out", &sized.sums)],
            )?;
            recorder.dispatch("ssim_rows_backward", by_rows, &[loss, partials, smoothed])?;
            let v_image = ("v_image", &sized.v_image);
            recorder.dispatch(columns_backward, by_columns, &[loss, image, truth, smoothed, v_image])?;
            recorder.dispatch("loss_sum", Size::Groups(1), &[loss, sums, ("losses", &self.losses)])?;
        }
        Ok(())
    }

    /// Mean of the log over the last iterations of a range.
    ///
    /// # Errors
    /// When the device fails.
    pub fn mean(&self, gpu: &Gpu, iterations: Range<u32>) -> Result<f32> {
        let log: Vec<f32> = gpu.read(&self.losses, 0, LOG as usize)?;
        let first = iterations.start.max(iterations.end.saturating_sub(LOG));
        let values: Vec<f32> = (first..iterations.end).map(|i| log[(i % LOG) as usize]).collect();
        Ok(values.iter().sum::<f32>() / values.len().max(1) as f32)
    }
}
