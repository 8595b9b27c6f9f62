//! The water of a run on the device: its effect between blending and loss, and the step of the water
//! parameters.
//!
//! Colours of Gaussians are J in sRGB, so any viewer shows the restored model directly. For a water on
//! Gaussians, `project_forward` decodes each colour, applies the water and encodes it again for blending in
//! sRGB. For a water on pixels, colours are decoded and blended in linear light, or blended unchanged, and
//! the kernel `water` applies the water to the picture. `water` also adds the open-water colour where rays
//! continue.

mod priors;
mod refinement;
mod run;
mod schedule;
mod started;

use std::mem::offset_of;

use super::adam::unbiasing;
use crate::config::{Composition, LossLight};
use crate::gpu::{
    Frame, Gpu, MediumUniform, Output, Recorder, Size, WaterState, WaterUniform, medium, water_rows,
};
use crate::water::{RangeModulation, StandardErrors, Water, WaterRecord};
use crate::{CoreError, Result};

pub use priors::{DevicePriors, PriorMaps};
use refinement::RefinementStep;
pub use run::{MediumRun, NetworkRun};
pub use schedule::WaterSchedule;
pub(super) use started::StartedWater;

/// Number of pixels that a workgroup of `water_backward` sums (`shaders/shared/medium.wgsl`).
const CHUNK: u32 = 1024;
/// Decay of Adam's moments (`water_step.wgsl`).
const BETAS: [f64; 2] = [0.9, 0.999];
/// Byte offsets of parts of the state.
const SHARES_AT: u64 = offset_of!(WaterState, shares) as u64;
const MOMENTS_AT: u64 = offset_of!(WaterState, moment1) as u64;
const GATHERED_AT: u64 = offset_of!(WaterState, gathered) as u64;

/// Gradients collected by `water_step`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gathered {
    /// Sums of the gradients of the unconstrained parameters.
    pub v_raw: [f32; 9],
    /// Number of iterations with finite gradients.
    pub iterations: u32,
}

/// One iteration's part of the schedule.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WaterStep {
    /// Width and height of the picture, pixels.
    pub size: [u32; 2],
    /// Whether the photograph has masked pixels.
    pub masked: bool,
    /// Whether alpha is pulled to 1 where the photograph does not show open water.
    pub has_surfaces: bool,
    /// Learning rate of Adam; `None` if the water parameters are not stepped.
    pub rate: Option<f32>,
    /// Whether gradients of the water parameters are collected for WaterParamPredict; then there is no rate.
    pub gathers: bool,
    /// Number of steps of the water including this one, from 1.
    pub steps: u32,
    /// Factor on the weights of eq. 12 to 16, 0 to 1; not on `surface_alpha_weight` and `overwhite_weight`.
    pub terms: f32,
    /// How many times the picture is halved.
    pub level: u32,
    /// Columns and rows of the view's ray map; 0 without one.
    pub map: [u32; 2],
    /// Distance in sRGB from the colour of open water beyond which a pixel at its edge shows a surface.
    pub alike: f32,
}

/// The water on the device. The frame holds the water parameters that the kernels read.
pub struct DeviceMedium {
    run: MediumRun,
    uniform: wgpu::Buffer,
    state: wgpu::Buffer,
    /// Set if a prior has a weight.
    priors: Option<DevicePriors>,
    /// Set if the coefficients depend on range.
    refinement: Option<RefinementStep>,
    sized: Option<Sized>,
    /// Bound for views without a map.
    no_map: wgpu::Buffer,
}

struct Sized {
    pixels: u64,
    rows: u64,
    seen: wgpu::Buffer,
    partials: wgpu::Buffer,
    refinement_partials: wgpu::Buffer,
}

impl DeviceMedium {
    /// The water at the start of a run; [`DeviceMedium::give_to`] copies it to a frame.
    ///
    /// # Errors
    /// When the parameters are not physical, or the device cannot hold them.
    pub fn new(gpu: &Gpu, run: MediumRun) -> Result<Self> {
        if !(run.water.is_physical() && run.unit > 0.0 && run.unit.is_finite()) {
            return Err(CoreError::Config(format!(
                "the initial water must be finite, not below 0 and at most 1 at infinity, and its unit above 0; \
                 it is {:?} in units of {}",
                run.water, run.unit
            )));
        }
        if let Some(refinement) = &run.refinement
            && !(refinement.is_sound() && run.composition.acts_on_pixels())
        {
            return Err(CoreError::Config(format!(
                "range-dependent coefficients need finite numbers and a water on pixels \
                 (water.medium = \"per_pixel\"); they are {refinement:?}, and the water acts on {:?}",
                run.composition.medium()
            )));
        }
        let state = gpu.buffer("water state", size_of::<WaterState>() as u64)?;
        let raw = run.water.to_raw(run.unit).map(|value| value as f32);
        let shares = run.shares_of_rate(&run.water, run.standard_error);
        gpu.write(&state, 0, &[WaterState { raw, shares, ..WaterState::default() }]);
        let refinement = run.refinement.as_ref().map(|start| RefinementStep::new(gpu, start)).transpose()?;
        Ok(Self {
            priors: DevicePriors::new(gpu, &run.config, run.unit),
            uniform: gpu.uniform("medium", &MediumUniform::default()),
            run,
            state,
            refinement,
            sized: None,
            no_map: gpu.buffer("no map", 4)?,
        })
    }

    /// The water settings of the run.
    pub fn run(&self) -> &MediumRun {
        &self.run
    }

    /// `Frame.medium` of a training view.
    pub fn frame_medium(&self) -> u32 {
        medium::of(self.run.composition, Output::Underwater)
    }

    /// Copies the water at the start of the run to `frame`.
    pub fn give_to(&self, gpu: &Gpu, frame: &Frame) {
        let mut water = WaterUniform::from(&self.run.water);
        if let Some(refinement) = &self.run.refinement {
            water = water.with_refinement(refinement);
        }
        if let Some(by_direction) = &self.run.by_direction {
            water = water.with_direction(by_direction);
        }
        frame.set_water_uniform(gpu, water);
    }

    /// The current water parameters.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water(&self, gpu: &Gpu, frame: &Frame) -> Result<Water> {
        let rows: Vec<[f32; 4]> = gpu.read(&frame.water, 0, 3)?;
        Ok(Water::from_array(std::array::from_fn(|i| f64::from(rows[i / 3][i % 3]))))
    }

    /// The current range modulation; `None` without one.
    ///
    /// # Errors
    /// When the device fails.
    pub fn refinement(&self, gpu: &Gpu, frame: &Frame) -> Result<Option<RangeModulation>> {
        let Some(start) = self.run.refinement else { return Ok(None) };
        let at = offset_of!(WaterUniform, refinement) as u64;
        let values: Vec<f32> = gpu.read(&frame.water, at, 4)?;
        Ok(Some(start.with_array(std::array::from_fn(|i| f64::from(values[i])))))
    }

    /// The record of the current water.
    ///
    /// # Errors
    /// When the device fails.
    pub fn record_of(&self, gpu: &Gpu, frame: &Frame, metres_per_unit: f64) -> Result<WaterRecord> {
        let run = &self.run;
        // Predicted parameters stay unchanged if descent ends before the network does.
        let ends = run.network.is_some() && run.config.network.until >= run.config.freeze_at;
        let descends = run.is_free && run.config.descends() && !ends;
        let source = if descends { "descended" } else { run.source };
        let (water, errors) = (self.water(gpu, frame)?, self.standard_errors());
        let record = WaterRecord::new(&water, run.composition, errors, source, metres_per_unit);
        let record = WaterRecord { shows_open_water: run.shows_open_water, ..record };
        Ok(record.with_refinement(self.refinement(gpu, frame)?).with_direction(run.by_direction))
    }

    fn state(&self, gpu: &Gpu) -> Result<WaterState> {
        let state: Vec<WaterState> = gpu.read(&self.state, 0, 1)?;
        Ok(state.first().copied().unwrap_or_default())
    }

    /// Number of steps skipped because of a non-finite gradient.
    ///
    /// # Errors
    /// When the device fails.
    pub fn steps_left_out(&self, gpu: &Gpu) -> Result<u32> {
        let refinement = self.refinement.as_ref().map_or(Ok(0), |refinement| refinement.left_out(gpu))?;
        Ok((self.state(gpu)?.left_out as u32).max(refinement))
    }

    /// Evidence for each parameter after `steps` steps of the water: see
    /// [`crate::train::Trainer::water_evidence`].
    pub(crate) fn evidence(&self, gpu: &Gpu, steps: u32) -> Result<[f64; 9]> {
        let state = self.state(gpu)?;
        let start = self.run.water.to_raw(self.run.unit).map(|value| value as f32);
        let [_, unbias] = unbiasing(BETAS, steps);
        let of = |i: usize| f64::from(steps) * unbias * f64::from(state.moment2[i]);
        Ok(std::array::from_fn(|i| if state.raw[i] == start[i] { 0.0 } else { of(i) }))
    }

    /// The gradients collected since the last call; resets the sums. Waits for the device.
    ///
    /// # Errors
    /// When the device fails.
    pub fn take_gathered(&self, gpu: &Gpu) -> Result<Gathered> {
        let state = self.state(gpu)?;
        // The sums and their number of iterations.
        gpu.write(&self.state, GATHERED_AT, &[0.0_f32; 10]);
        Ok(Gathered { v_raw: state.gathered, iterations: state.gathered_iterations as u32 })
    }

    /// Sets the water from finite unconstrained parameters in the order of eq. 8.
    pub fn set_raw(&self, gpu: &Gpu, frame: &Frame, raw: [f32; 9]) {
        gpu.write(&self.state, 0, &raw);
        frame.set_water_parameters(gpu, &Water::from_raw(raw.map(f64::from), self.run.unit));
    }

    /// Restarts descent at the unconstrained parameters `raw`. `standard_error` holds the standard errors of
    /// the water parameters from now on.
    pub fn begin_at(&mut self, gpu: &Gpu, frame: &Frame, raw: [f32; 9], standard_error: [f64; 9]) {
        self.set_raw(gpu, frame, raw);
        gpu.write(&self.state, MOMENTS_AT, &[[0.0_f32; 9]; 2]);
        let water = Water::from_raw(raw.map(f64::from), self.run.unit);
        gpu.write(&self.state, SHARES_AT, &self.run.shares_of_rate(&water, Some(standard_error)));
        self.set_standard_error(standard_error);
    }

    /// The standard errors of the water parameters, null where nothing determines them.
    pub fn standard_errors(&self) -> StandardErrors {
        StandardErrors::from_array(self.run.standard_error.unwrap_or([f64::INFINITY; 9]))
    }

    /// Sets the standard errors of the water parameters.
    pub fn set_standard_error(&mut self, standard_error: [f64; 9]) {
        self.run.standard_error = Some(standard_error);
    }

    /// The buffers that persist across iterations, with their bytes: Adam's state, and the water in `frame`
    /// that the device derives from it.
    pub fn arrays<'a>(&'a self, frame: &'a Frame) -> Vec<(&'a wgpu::Buffer, usize)> {
        let own = [(&self.state, size_of::<WaterState>()), (&frame.water, size_of::<WaterUniform>())];
        own.into_iter().chain(self.refinement.as_ref().map(RefinementStep::array)).collect()
    }

    /// Allocates buffers for pictures of `size` and for up to `gaussians` Gaussians in `blocks` blocks.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn prepare(&mut self, gpu: &Gpu, size: [u32; 2], gaussians: u32, blocks: u32) -> Result<()> {
        if let Some(priors) = &mut self.priors {
            priors.prepare(gpu, size)?;
        }
        let pixels = u64::from(size[0]) * u64::from(size[1]);
        let rows = pixels.div_ceil(CHUNK.into()) + u64::from(water_rows(gaussians, blocks));
        if self.sized.as_ref().is_some_and(|sized| sized.pixels >= pixels && sized.rows >= rows) {
            return Ok(());
        }
        self.sized = None;
        let refinement_rows = if self.refinement.is_some() { pixels.div_ceil(CHUNK.into()) } else { 1 };
        self.sized = Some(Sized {
            pixels,
            rows,
            refinement_partials: gpu.buffer("refinement partials", refinement_rows * 16)?,
            seen: gpu.buffer("seen", pixels * 16)?,
            partials: gpu.buffer("water partials", rows * 48)?,
        });
        Ok(())
    }

    /// The `Medium` uniform of an iteration, for the kernels of a water on Gaussians.
    pub(super) fn uniform(&self) -> &wgpu::Buffer {
        &self.uniform
    }

    /// Sums by workgroup of the gradient of the water parameters, for the same kernels.
    pub(super) fn partials(&self) -> Result<&wgpu::Buffer> {
        Ok(&self.sized()?.partials)
    }

    fn sized(&self) -> Result<&Sized> {
        self.sized
            .as_ref()
            .ok_or_else(|| CoreError::Gpu("a water was recorded before its buffers were made".into()))
    }

    /// Whether the underwater picture is formed in sRGB.
    fn is_formed_in_srgb(&self) -> bool {
        self.run.composition == Composition::GaussiansSrgb
    }

    /// Whether the underwater picture is formed in sRGB and must be decoded for the loss.
    fn is_decoded(&self) -> bool {
        self.run.config.loss_light == LossLight::Linear && self.is_formed_in_srgb()
    }

    /// Records the underwater picture; returns the picture for the loss, `[H*W]` vec4: colour in the light of
    /// the loss, alpha.
    ///
    /// # Errors
    /// When the kernel does not compile or `prepare` was not called.
    pub fn record(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        frame: &Frame,
        step: WaterStep,
        gaussians: u32,
        blocks: u32,
    ) -> Result<&wgpu::Buffer> {
        let sized = self.sized()?;
        let config = &self.run.config;
        let pixels = step.size[0] * step.size[1];
        let gaussian_rows = pixels.div_ceil(CHUNK);
        let counts_gaussians =
            (step.rate.is_some() || step.gathers) && !self.run.composition.acts_on_pixels();
        let [unbias1, unbias2] = unbiasing(BETAS, step.steps).map(|value| value as f32);
        let uniform = MediumUniform {
            pixels,
            compose: self.frame_medium(),
            encode: u32::from(!self.is_formed_in_srgb() && config.loss_light == LossLight::Srgb),
            rows: gaussian_rows + if counts_gaussians { water_rows(gaussians, blocks) } else { 0 },
            gaussian_rows,
            masked: u32::from(step.masked),
            unit: self.run.unit as f32,
            rate: step.rate.unwrap_or(0.0),
            unbias1,
            unbias2,
            decay: step.terms * config.l2_weight,
            background_weight: step.terms * self.run.background_weight() / pixels as f32,
            background_distance: self.run.background_distance(),
            surface_weight: if step.has_surfaces { self.run.surface_weight() / pixels as f32 } else { 0.0 },
            gathers: u32::from(step.gathers),
            map_columns: step.map[0],
            map_rows: step.map[1],
            range_weight: if step.has_surfaces { self.run.range_weight() / pixels as f32 } else { 0.0 },
            range_slack: self.run.range_slack(),
            edge_distance: step.alike,
            open_weight: step.terms * config.alpha_open / pixels as f32,
        };
        gpu.write(&self.uniform, 0, &[uniform]);
        if let Some(refinement) = &self.refinement {
            // Not stepped while the water parameters are fixed or predicted.
            let rate = step.rate.map_or(0.0, |_| config.dbdr.lr);
            refinement.set(gpu, gaussian_rows, rate, step.steps);
        }
        let targets = frame.targets()?;
        recorder.dispatch(
            "water",
            Size::Items(pixels, 64),
            &[
                ("medium", &self.uniform),
                ("water", &frame.water),
                ("image", &targets.image),
                ("range_image", &targets.range_image),
                ("seen", &sized.seen),
                ("frame", &frame.uniform),
            ],
        )?;
        if self.is_decoded() {
            let buffers = [("medium", &self.uniform), ("seen", &sized.seen)];
            recorder.dispatch("loss_light", Size::Items(pixels, 64), &buffers)?;
        }
        Ok(&sized.seen)
    }

    /// Records the backward pass of [`DeviceMedium::record`], and the priors.
    ///
    /// `v_image` holds the gradient of the picture before, and of the blended colour and its alpha after.
    /// `truth` is the photograph, and `map` its ray map, if known. `step` is that of `record`.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    pub fn record_backward(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        frame: &Frame,
        truth: &wgpu::Buffer,
        map: Option<&wgpu::Buffer>,
        step: WaterStep,
        [v_image, v_range]: [&wgpu::Buffer; 2],
    ) -> Result<()> {
        let sized = self.sized()?;
        let targets = frame.targets()?;
        let pixels = step.size[0] * step.size[1];
        let maps = PriorMaps {
            frame,
            seen: &sized.seen,
            truth,
            v_image,
            v_range,
            partials: &sized.partials,
            refinement_partials: &sized.refinement_partials,
        };
        if let Some(priors) = &self.priors {
            priors.record(gpu, recorder, maps, &step)?;
        }
        if self.is_decoded() {
            let buffers = [("medium", &self.uniform), ("seen", &sized.seen), ("v_image", v_image)];
            recorder.dispatch("loss_light_backward", Size::Items(pixels, 64), &buffers)?;
        }
        recorder.clear(&sized.partials);
        recorder.dispatch(
            "water_backward",
            Size::Items(pixels, CHUNK),
            &[
                ("medium", &self.uniform),
                ("water", &frame.water),
                ("image", &targets.image),
                ("range_image", &targets.range_image),
                ("truth", truth),
                ("v_image", v_image),
                ("v_range_image", v_range),
                ("partials", &sized.partials),
                ("refinement_partials", &sized.refinement_partials),
                ("frame", &frame.uniform),
                ("map", map.unwrap_or(&self.no_map)),
            ],
        )?;
        self.priors.as_ref().map_or(Ok(()), |priors| priors.record_after(recorder, maps, &step))
    }

    /// Records the step of the water parameters and of the range modulation, after the step of the Gaussians,
    /// whose gradients belong to the rendered water. Nothing is stepped if the frame reports an overflowing
    /// list.
    ///
    /// # Errors
    /// When the kernel does not compile or no room was made.
    pub fn record_step(&self, recorder: &mut Recorder<'_>, frame: &Frame) -> Result<()> {
        let sized = self.sized()?;
        recorder.dispatch(
            "water_step",
            Size::Groups(1),
            &[
                ("medium", &self.uniform),
                ("counters", &frame.counters),
                ("partials", &sized.partials),
                ("state", &self.state),
                ("water", &frame.water),
            ],
        )?;
        match &self.refinement {
            None => Ok(()),
            Some(refinement) => refinement.record(recorder, frame, &sized.refinement_partials),
        }
    }

    /// Buffers that are always written before they are read; tests fill them with garbage first.
    ///
    /// # Errors
    /// When `prepare` was not called.
    pub fn scratch(&self) -> Result<Vec<&wgpu::Buffer>> {
        let sized = self.sized()?;
        let priors = self.priors.iter().flat_map(DevicePriors::scratch);
        let own = [&sized.seen, &sized.partials, &sized.refinement_partials];
        Ok(own.into_iter().chain(priors).collect())
    }
}
