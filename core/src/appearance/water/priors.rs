//! Priors of an underwater run on the device (SMP-UWGS eq. 12 to 14): the dark channel of the direct signal,
//! and smooth depth except at edges of the photograph.
//!
//! They have no forward pass, since only their gradients are needed. The dark channel adds its gradient of
//! the picture before the backward pass of the water, whatever the water is. Direct gradients of alpha, range
//! and the water parameters are added after it. Minima are found along rows, then columns, with the first of
//! equal pixels. Each pixel collects its gradient in a fixed order, so every run gives the same bytes.

use super::WaterStep;
use crate::config::{DarkChannelOn, LossLight, PriorsConfig, WaterConfig};
use crate::gpu::{Frame, Gpu, PriorsUniform, Recorder, Size};
use crate::{CoreError, Result};

/// Number of pixels that a workgroup of `dark_channel_backscatter` sums, as in `water_backward`
/// (`shaders/shared/medium.wgsl`).
const CHUNK: u32 = 1024;
/// Number of windows per thread (`shaders/shared/slide.wgsl`).
const WINDOWS: u32 = 8;

/// The priors of a run on the device.
pub struct DevicePriors {
    config: PriorsConfig,
    light: LossLight,
    /// Scene scale, scene units.
    unit: f32,
    uniform: wgpu::Buffer,
    dark_channel: Option<DarkChannel>,
}

/// Buffers of the dark channel, each `[H*W]` vec2 of u32.
struct DarkChannel {
    pixels: u64,
    signal: wgpu::Buffer,
    rows: wgpu::Buffer,
    columns: wgpu::Buffer,
}

/// The inputs of the priors in an iteration, and the gradients that they add to.
#[derive(Clone, Copy)]
pub struct PriorMaps<'a> {
    /// The blended picture, its range image, and the water parameters.
    pub frame: &'a Frame,
    /// The picture under water in the light of the loss, `[H*W]` vec4: colour, alpha.
    pub seen: &'a wgpu::Buffer,
    /// The photograph, `[H*W]` packed.
    pub truth: &'a wgpu::Buffer,
    /// `[H*W]` vec4: before the backward pass of the water, the gradient of the underwater picture; after it,
    /// of the blended picture and its alpha.
    pub v_image: &'a wgpu::Buffer,
    /// Gradient of the blended range, `[H*W]`.
    pub v_range: &'a wgpu::Buffer,
    /// Sums by workgroup of the gradient of the water parameters; rows of pixels come first.
    pub partials: &'a wgpu::Buffer,
    /// The same for the four parameters of eq. 9.
    pub refinement_partials: &'a wgpu::Buffer,
}

impl DevicePriors {
    /// The priors of a water, with the scene scale `unit` in scene units; `None` if all weights are 0.
    pub fn new(gpu: &Gpu, config: &WaterConfig, unit: f64) -> Option<Self> {
        let priors = &config.priors;
        (priors.dark_channel > 0.0 || priors.depth_smoothness > 0.0).then(|| Self {
            config: priors.clone(),
            light: config.loss_light,
            unit: unit as f32,
            uniform: gpu.uniform("priors", &PriorsUniform::default()),
            dark_channel: None,
        })
    }

    /// Allocates buffers for pictures of `size`.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        let pixels = u64::from(size[0]) * u64::from(size[1]);
        let has_room = self.dark_channel.as_ref().is_some_and(|buffers| buffers.pixels >= pixels);
        if has_room || self.config.dark_channel <= 0.0 {
            return Ok(());
        }
        self.dark_channel = None;
        self.dark_channel = Some(DarkChannel {
            pixels,
            signal: gpu.buffer("dark channel signal", pixels * 8)?,
            rows: gpu.buffer("dark channel rows", pixels * 8)?,
            columns: gpu.buffer("dark channel columns", pixels * 8)?,
        });
        Ok(())
    }

    fn dark_channel(&self) -> Result<&DarkChannel> {
        self.dark_channel
            .as_ref()
            .ok_or_else(|| CoreError::Gpu("a dark channel was recorded before its buffers were made".into()))
    }

    /// Whether the priors have any effect in an iteration.
    fn is_on(step: &WaterStep) -> bool {
        step.terms > 0.0
    }

    /// Records the gradient of the underwater picture, between the loss and the backward pass of the water.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    pub fn record(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        maps: PriorMaps<'_>,
        step: &WaterStep,
    ) -> Result<()> {
        if !Self::is_on(step) {
            return Ok(());
        }
        let [width, height] = step.size;
        let on_photograph = self.config.dark_channel_on == DarkChannelOn::Photograph;
        let by_pixel = step.terms / (width as f32 * height as f32);
        let uniform = PriorsUniform {
            size: step.size,
            masked: u32::from(step.masked),
            on_photograph: u32::from(on_photograph),
            linear: u32::from(self.light == LossLight::Linear && !on_photograph),
            radius: self.config.radius(step.level),
            unit: self.unit,
            dark_weight: self.config.dark_channel * by_pixel,
            negative: self.config.dark_channel_negative,
            smooth_weight: self.config.depth_smoothness * by_pixel,
            ..PriorsUniform::default()
        };
        gpu.write(&self.uniform, 0, &[uniform]);
        if self.config.dark_channel <= 0.0 {
            return Ok(());
        }
        let buffers = self.dark_channel()?;
        let priors = ("priors", &self.uniform);
        let water = ("water", &maps.frame.water);
        let (seen, truth) = (("seen", maps.seen), ("truth", maps.truth));
        let (signal, rows, columns) =
            (("signal", &buffers.signal), ("rows", &buffers.rows), ("columns", &buffers.columns));
        let range_image = ("range_image", &maps.frame.targets()?.range_image);
        let by_rows = Size::Items(width.div_ceil(WINDOWS) * height, 32);
        let by_columns = Size::Items(height.div_ceil(WINDOWS) * width, 32);
        recorder.dispatch(
            "dark_channel_signal",
            Size::Items(width * height, 64),
            &[priors, water, range_image, seen, truth, signal],
        )?;
        recorder.dispatch("dark_channel_rows", by_rows, &[priors, signal, rows])?;
        recorder.dispatch("dark_channel_columns", by_columns, &[priors, truth, rows, columns])?;
        recorder.dispatch("dark_channel_columns_backward", by_columns, &[priors, columns, rows])?;
        recorder.dispatch(
            "dark_channel_rows_backward",
            by_rows,
            &[priors, water, rows, seen, signal, ("v_image", maps.v_image)],
        )
    }

    /// Records the direct gradients of alpha, range and the water parameters, after the backward pass of the
    /// water.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    pub fn record_after(
        &self,
        recorder: &mut Recorder<'_>,
        maps: PriorMaps<'_>,
        step: &WaterStep,
    ) -> Result<()> {
        if !Self::is_on(step) {
            return Ok(());
        }
        let pixels = step.size[0] * step.size[1];
        let targets = maps.frame.targets()?;
        let priors = ("priors", &self.uniform);
        let (image, range_image) = (("image", &targets.image), ("range_image", &targets.range_image));
        let (v_image, v_range) = (("v_image", maps.v_image), ("v_range_image", maps.v_range));
        if self.config.dark_channel > 0.0 {
            let signal = ("signal", &self.dark_channel()?.signal);
            let (water, partials) = (("water", &maps.frame.water), ("partials", maps.partials));
            let refinement = ("refinement_partials", maps.refinement_partials);
            recorder.dispatch(
                "dark_channel_backscatter",
                Size::Items(pixels, CHUNK),
                &[priors, water, image, range_image, signal, v_image, v_range, partials, refinement],
            )?;
        }
        if self.config.depth_smoothness > 0.0 {
            let truth = ("truth", maps.truth);
            recorder.dispatch(
                "depth_smoothness",
                Size::Items(pixels, 64),
                &[priors, image, range_image, truth, v_image, v_range],
            )?;
        }
        Ok(())
    }

    /// Buffers that are always written before they are read; tests fill them with garbage first.
    pub fn scratch(&self) -> impl Iterator<Item = &wgpu::Buffer> {
        self.dark_channel.iter().flat_map(|buffers| [&buffers.signal, &buffers.rows, &buffers.columns])
    }
}
