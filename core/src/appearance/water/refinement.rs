//! The Adam step of the range modulation of a water on pixels (DBDR, SMP-UWGS eq. 9), on the device.
//!
//! Its four parameters are stored with the water parameters in the water uniform, where all kernels that form
//! a picture find them. This file holds Adam's state, which persists across iterations.

use super::BETAS;
use crate::Result;
use crate::appearance::adam::unbiasing;
use crate::gpu::{DbdrState, DbdrUniform, Frame, Gpu, Recorder, Size};
use crate::water::RangeModulation;

/// Adam on the four parameters of a [`RangeModulation`].
pub(super) struct RefinementStep {
    uniform: wgpu::Buffer,
    state: wgpu::Buffer,
}

impl RefinementStep {
    /// The state at `refinement`, before any step.
    ///
    /// # Errors
    /// When the device cannot hold it.
    pub fn new(gpu: &Gpu, refinement: &RangeModulation) -> Result<Self> {
        let state = gpu.buffer("refinement state", size_of::<DbdrState>() as u64)?;
        let raw = refinement.to_array().map(|value| value as f32);
        gpu.write(&state, 0, &[DbdrState { raw, ..DbdrState::default() }]);
        Ok(Self { uniform: gpu.uniform("dbdr", &DbdrUniform::default()), state })
    }

    /// Sets the next step: over `rows` rows of sums, as step number `steps`, from 1.
    pub fn set(&self, gpu: &Gpu, rows: u32, rate: f32, steps: u32) {
        let [unbias1, unbias2] = unbiasing(BETAS, steps).map(|value| value as f32);
        gpu.write(&self.uniform, 0, &[DbdrUniform { rows, rate, unbias1, unbias2 }]);
    }

    /// Records the step on the sums in `partials`; nothing is stepped if the frame reports an overflowing
    /// list.
    ///
    /// # Errors
    /// When the kernel does not compile.
    pub fn record(&self, recorder: &mut Recorder<'_>, frame: &Frame, partials: &wgpu::Buffer) -> Result<()> {
        recorder.dispatch(
            "dbdr_step",
            Size::Groups(1),
            &[
                ("dbdr", &self.uniform),
                ("counters", &frame.counters),
                ("refinement_partials", partials),
                ("state", &self.state),
                ("water", &frame.water),
            ],
        )
    }

    /// The state with its bytes; it persists across iterations.
    pub fn array(&self) -> (&wgpu::Buffer, usize) {
        (&self.state, size_of::<DbdrState>())
    }

    /// Number of steps skipped because of a non-finite gradient.
    ///
    /// # Errors
    /// When the device fails.
    pub fn left_out(&self, gpu: &Gpu) -> Result<u32> {
        let state: Vec<DbdrState> = gpu.read(&self.state, 0, 1)?;
        Ok(state.first().map_or(0, |state| state.left_out as u32))
    }
}
