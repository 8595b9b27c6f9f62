//! Water between blending and loss, applied to the blended picture pixel by pixel.

use crate::Result;
use crate::appearance::chain::{Appearance, Gradients, Iteration};
use crate::appearance::water::{DeviceMedium, StartedWater};
use crate::gpu::{Frame, Gpu, Recorder, StepUniform};
use crate::views::TrainView;

/// A water that acts on pixels.
pub struct WaterOnPixels(StartedWater);

impl WaterOnPixels {
    pub(in crate::appearance) fn new(water: StartedWater) -> Self {
        Self(water)
    }
}

impl Appearance for WaterOnPixels {
    fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        self.0.prepare(gpu, size)
    }

    /// Uses the blended picture of the frame, since the water also needs its ranges.
    fn record<'a>(
        &'a self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        _image: &'a wgpu::Buffer,
    ) -> Result<&'a wgpu::Buffer> {
        self.0.record(recorder, now)
    }

    fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        _image: &wgpu::Buffer,
        gradients: Gradients<'_>,
    ) -> Result<()> {
        self.0.record_backward(recorder, now, gradients)
    }

    fn colouring(&self) -> Option<u32> {
        Some(self.0.medium.frame_medium())
    }

    fn weigh(&self, step: &mut StepUniform, view: &TrainView) {
        self.0.weigh(step, view);
    }

    fn steps_with_gaussians(&self, now: &Iteration<'_>) -> bool {
        self.0.steps_with_gaussians(now)
    }

    fn record_step(&self, recorder: &mut Recorder<'_>, frame: &Frame) -> Result<()> {
        self.0.medium.record_step(recorder, frame)
    }

    fn arrays<'a>(&'a self, frame: &'a Frame) -> Vec<(&'a wgpu::Buffer, usize)> {
        self.0.medium.arrays(frame)
    }

    fn water(&self) -> Option<&DeviceMedium> {
        Some(&self.0.medium)
    }

    fn water_mut(&mut self) -> Option<&mut DeviceMedium> {
        Some(&mut self.0.medium)
    }
}
