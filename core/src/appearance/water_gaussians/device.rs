//! Water in the colours of the Gaussians: `project_forward` applies it to each one before blending. After
//! blending, the open-water colour is added where rays continue.

use crate::Result;
use crate::appearance::chain::{Appearance, Gradients, Iteration, SplatGradients};
use crate::appearance::water::{DeviceMedium, StartedWater};
use crate::gpu::{Frame, Gpu, Recorder, Size, StepUniform};
use crate::memory;
use crate::views::TrainView;

/// A water that acts on Gaussians.
pub struct WaterOnGaussians(StartedWater);

impl WaterOnGaussians {
    pub(in crate::appearance) fn new(water: StartedWater) -> Self {
        Self(water)
    }
}

impl DeviceMedium {
    /// Records the gradients from all splats to the water parameters, before the step of the Gaussians.
    ///
    /// # Errors
    /// When a kernel does not compile or `prepare` was not called.
    pub fn record_gradients(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        SplatGradients { frame, blocks, slots, in_bands }: SplatGradients<'_>,
    ) -> Result<()> {
        let (medium, partials) = (self.uniform(), self.partials()?);
        for (_, block, training) in blocks.trainable() {
            let common = [
                ("frame", &frame.uniform),
                ("block", &block.uniform),
                ("medium", medium),
                ("counters", &frame.counters),
                ("transforms", &block.transforms),
                ("sh_coeffs", &block.sh_coeffs),
                ("water", &frame.water),
                ("partials", partials),
            ];
            let size = Size::Items(block.count, 64);
            if in_bands {
                let sums =
                    ("band_gradients", training.band_gradients(gpu, block.capacity, memory::BAND_BYTES)?);
                recorder.dispatch("water_gradients_bands", size, &[&common[..], &[sums]].concat())?;
            } else {
                let slots =
                    [("flags", &frame.flags), ("segments", &frame.segments), ("slot_gradients", slots)];
                recorder.dispatch("water_gradients", size, &[&common[..], &slots].concat())?;
            }
        }
        Ok(())
    }
}

impl Appearance for WaterOnGaussians {
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

    fn record_gradients(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: SplatGradients<'_>,
    ) -> Result<()> {
        self.0.medium.record_gradients(gpu, recorder, splats)
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
