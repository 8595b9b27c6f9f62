//! The factors by range of a water that acts on pixels (DBDR, SMP-UWGS eq. 9): their step on the device.
//!
//! The four numbers lie beside the nine in the uniform of the water, so that whatever forms a picture has
//! them; here is Adam's state, which outlives an iteration with them.

use super::BETAS;
use crate::Result;
use crate::appearance::adam::unbiasing;
use crate::gpu::{DbdrState, DbdrUniform, Frame, Gpu, Recorder, Size};
use crate::water::RangeModulation;

/// Adam on the four numbers of a [`RangeModulation`].
pub(super) struct RefinementStep {
    uniform: wgpu::Buffer,
    state: wgpu::Buffer,
}

impl RefinementStep {
    /// At `refinement`, with no step behind it.
    ///
    /// # Errors
    /// When the device cannot hold it.
    pub fn new(gpu: &Gpu, refinement: &RangeModulation) -> Result<Self> {
        let state = gpu.buffer("refinement state", size_of::<DbdrState>() as u64)?;
        let raw = refinement.to_array().map(|value| value as f32);
        gpu.write(&state, 0, &[DbdrState { raw, ..DbdrState::default() }]);
        Ok(Self { uniform: gpu.uniform("dbdr", &DbdrUniform::default()), state })
    }

    /// Says how the next step is done: over `rows` rows of sums, as step number `steps`, from 1.
    pub fn set(&self, gpu: &Gpu, rows: u32, rate: f32, steps: u32) {
        let [unbias1, unbias2] = unbiasing(BETAS, steps).map(|value| value as f32);
        gpu.write(&self.uniform, 0, &[DbdrUniform { rows, rate, unbias1, unbias2 }]);
    }

    /// Records the step on the sums in `partials`; none is taken while the frame says that a list was too
    /// short.
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

    /// The state with its bytes: it outlives an iteration.
    pub fn array(&self) -> (&wgpu::Buffer, usize) {
        (&self.state, size_of::<DbdrState>())
    }

    /// Steps that were left out since a gradient was not finite.
    ///
    /// # Errors
    /// When the device fails.
    pub fn left_out(&self, gpu: &Gpu) -> Result<u32> {
        let state: Vec<DbdrState> = gpu.read(&self.state, 0, 1)?;
        Ok(state.first().map_or(0, |state| state.left_out as u32))
    }
}
