//! Appearances on the device: the trait, and the chain of appearances in a run.
//!
//! ```text
//! Gaussians -> blended picture -> first -> ... -> last -> loss
//!                                              <- gradients, in the opposite order
//! ```

use std::any::Any;

use super::water::{DeviceMedium, MediumRun};
use super::{Settings, of_run};
use crate::gpu::{Blocks, DevicePhotograph, Frame, Gpu, Recorder, StepUniform};
use crate::views::TrainView;
use crate::{CoreError, Result};

/// The inputs for creating an appearance.
pub struct Start<'a> {
    /// The device.
    pub gpu: &'a Gpu,
    /// The settings that select appearances.
    pub settings: Settings<'a>,
    /// The water of the run, if it has one.
    pub medium: Option<&'a MediumRun>,
    /// Number of training views.
    pub views: u32,
    /// Number of trained blocks of Gaussians.
    pub blocks: u32,
}

/// The data of one iteration for an appearance.
#[derive(Clone, Copy)]
pub struct Iteration<'a> {
    /// The device.
    pub gpu: &'a Gpu,
    /// The view that was rendered.
    pub frame: &'a Frame,
    /// The Gaussians.
    pub blocks: &'a Blocks,
    /// The photograph of the view; the picture has the same size.
    pub photograph: &'a DevicePhotograph,
    /// Number of the iteration, from 0.
    pub number: u32,
    /// Number of iterations of the run.
    pub iterations: u32,
    /// Index of the view.
    pub view: u32,
    /// Number of training views.
    pub views: u32,
    /// How many times the picture is halved.
    pub level: u32,
    /// Whether WaterParamPredict predicted the water of this iteration from this view.
    pub is_predicted: bool,
}

impl Iteration<'_> {
    /// Share of the run before the iteration.
    pub fn progress(&self) -> f32 {
        self.number as f32 / self.iterations as f32
    }
}

/// Gradients passed back through the chain.
#[derive(Clone, Copy)]
pub struct Gradients<'a> {
    /// The photograph that the loss compared with the picture, `[H*W]` packed.
    pub truth: &'a wgpu::Buffer,
    /// `[H*W]` vec4: before a backward pass, the gradient of the appearance's output picture; after it, of
    /// its input picture.
    pub v_image: &'a wgpu::Buffer,
    /// `[H*W]`: gradient of the range image. An appearance that uses ranges adds to it.
    pub v_range: &'a wgpu::Buffer,
}

/// The gradients of a view's splats, before the step of the Gaussians.
#[derive(Clone, Copy)]
pub struct SplatGradients<'a> {
    /// The view.
    pub frame: &'a Frame,
    /// The Gaussians.
    pub blocks: &'a Blocks,
    /// `[intersections*3]` vec4: gradients of the splats by tile.
    pub slots: &'a wgpu::Buffer,
    /// Whether the view was rendered in bands. The gradients are then sums by Gaussian, in the blocks.
    pub in_bands: bool,
}

/// A differentiable step between Gaussians and loss, with its own parameters.
pub trait Appearance: Any + Send + Sync {
    /// Allocates buffers for pictures of `size`. Called before every iteration; sufficient buffers are kept.
    ///
    /// # Errors
    /// When the device cannot hold it.
    fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()>;

    /// Records the step on `image`, `[H*W]` vec4; returns the input of the next step, in the same form.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    fn record<'a>(
        &'a self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        image: &'a wgpu::Buffer,
    ) -> Result<&'a wgpu::Buffer>;

    /// Records the backward pass of [`Appearance::record`], which had the same `image`, and the parameter
    /// step. Some appearances step after the Gaussians instead ([`Appearance::record_step`]). Parameters stay
    /// unchanged if the frame's counters report an overflowing list.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        image: &wgpu::Buffer,
        gradients: Gradients<'_>,
    ) -> Result<()>;

    /// How `project_forward` computes colours (`Frame.medium` in the shaders); `None` if this appearance does
    /// not change them.
    fn colouring(&self) -> Option<u32> {
        None
    }

    /// Adjusts the rates and weights of the Gaussians' step for a view.
    fn weigh(&self, _step: &mut StepUniform, _view: &TrainView) {}

    /// Whether an iteration includes [`Appearance::record_gradients`] and [`Appearance::record_step`].
    fn steps_with_gaussians(&self, _now: &Iteration<'_>) -> bool {
        false
    }

    /// Records the gradients from the splats to the parameters, before the step of the Gaussians.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    fn record_gradients(
        &self,
        _gpu: &Gpu,
        _recorder: &mut Recorder<'_>,
        _splats: SplatGradients<'_>,
    ) -> Result<()> {
        Ok(())
    }

    /// Records the parameter step after the step of the Gaussians, for parameters that the gradients of the
    /// Gaussians depend on.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    fn record_step(&self, _recorder: &mut Recorder<'_>, _frame: &Frame) -> Result<()> {
        Ok(())
    }

    /// Buffers that persist across iterations, with their used bytes: the content of a checkpoint.
    fn arrays<'a>(&'a self, frame: &'a Frame) -> Vec<(&'a wgpu::Buffer, usize)>;

    /// The water, if this appearance is one.
    fn water(&self) -> Option<&DeviceMedium> {
        None
    }

    /// Mutable access to the water.
    fn water_mut(&mut self) -> Option<&mut DeviceMedium> {
        None
    }
}

/// The appearances of a run, in the order from the Gaussians to the loss.
pub struct Chain {
    appearances: Vec<Box<dyn Appearance>>,
}

impl Chain {
    /// The appearances selected by the settings, at the start of a run.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn new(start: &Start<'_>) -> Result<Self> {
        let appearances = of_run(start.settings).map(|appearance| (appearance.start)(start));
        Ok(Self { appearances: appearances.collect::<Result<_>>()? })
    }

    /// The appearance of this type, if the run has it.
    pub fn get<T: Appearance>(&self) -> Option<&T> {
        self.appearances.iter().find_map(|appearance| (appearance.as_ref() as &dyn Any).downcast_ref())
    }

    /// The water, if the run has one.
    pub fn water(&self) -> Option<&DeviceMedium> {
        self.appearances.iter().find_map(|appearance| appearance.water())
    }

    /// Mutable access to the water.
    pub fn water_mut(&mut self) -> Option<&mut DeviceMedium> {
        self.appearances.iter_mut().find_map(|appearance| appearance.water_mut())
    }

    /// Replaces the water of the run by that of `start`. The new water has no picture buffers yet.
    ///
    /// # Errors
    /// [`CoreError::Config`] when one of the two is missing; also when the device cannot hold the water.
    pub fn exchange_water(&mut self, start: &Start<'_>) -> Result<()> {
        let at_water = |chain: &Self| chain.appearances.iter().position(|one| one.water().is_some());
        let missing = || CoreError::Config("a run without a water has none to exchange".to_owned());
        let at = at_water(self).ok_or_else(missing)?;
        // Dropped first: together they would need more memory than the run ever has.
        drop(self.appearances.remove(at));
        let mut fresh = Self::new(start)?;
        let theirs = at_water(&fresh).ok_or_else(missing)?;
        self.appearances.insert(at, fresh.appearances.swap_remove(theirs));
        Ok(())
    }

    /// [`Appearance::prepare`] of all appearances.
    ///
    /// # Errors
    /// When the device cannot hold them.
    pub fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        self.appearances.iter_mut().try_for_each(|appearance| appearance.prepare(gpu, size))
    }

    /// [`Appearance::colouring`] of the appearance that has one; 0 blends colours unchanged.
    pub fn colouring(&self) -> u32 {
        self.appearances.iter().find_map(|appearance| appearance.colouring()).unwrap_or(0)
    }

    /// [`Appearance::weigh`] of all appearances.
    pub fn weigh(&self, step: &mut StepUniform, view: &TrainView) {
        self.appearances.iter().for_each(|appearance| appearance.weigh(step, view));
    }

    /// Records all appearances on the blended picture `image`; returns the input picture of each, and the
    /// picture for the loss.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    pub fn record<'a>(
        &'a self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        image: &'a wgpu::Buffer,
    ) -> Result<Pictures<'a>> {
        let mut pictures = Pictures { taken: Vec::new(), last: image };
        for appearance in &self.appearances {
            let next = appearance.record(recorder, now, pictures.last)?;
            pictures.taken.push(pictures.last);
            pictures.last = next;
        }
        Ok(pictures)
    }

    /// Records the backward pass of [`Chain::record`], from the loss to the blended picture.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    pub fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        pictures: &Pictures<'_>,
        gradients: Gradients<'_>,
    ) -> Result<()> {
        let steps = self.appearances.iter().zip(&pictures.taken).rev();
        for (appearance, image) in steps {
            appearance.record_backward(recorder, now, image, gradients)?;
        }
        Ok(())
    }

    /// The appearances whose parameters step with the Gaussians in this iteration.
    pub fn stepped_with_gaussians(&self, now: &Iteration<'_>) -> Vec<&dyn Appearance> {
        let all = self.appearances.iter().map(AsRef::as_ref);
        all.filter(|appearance| appearance.steps_with_gaussians(now)).collect()
    }

    /// The content of a checkpoint, from the loss back to the Gaussians: [`Appearance::arrays`].
    pub fn arrays<'a>(&'a self, frame: &'a Frame) -> impl Iterator<Item = (&'a wgpu::Buffer, usize)> {
        self.appearances.iter().rev().flat_map(move |appearance| appearance.arrays(frame))
    }
}

/// The pictures of an iteration.
pub struct Pictures<'a> {
    /// The input of each appearance.
    taken: Vec<&'a wgpu::Buffer>,
    /// The picture for the loss.
    pub last: &'a wgpu::Buffer,
}
