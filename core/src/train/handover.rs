//! A run whose water is exchanged on the way: up to a checkpoint it moves with the Gaussians, then the run goes on with
//! another one that stays (`water.partitions = refine`).
//!
//! Such a run is one of its own. It is decided by the run before, by the checkpoint at which the water is exchanged and
//! by the new water; the digest of its checkpoints is of these three. Everything but the water goes on as it was:
//! Gaussians, moments, iteration, and with the iteration every schedule.

use std::sync::Arc;

use super::{DeviceMedium, MediumRun, Schedule, TrainRun, Trainer, checkpoint};
use crate::gpu::Gpu;
use crate::{CoreError, Result};

impl Trainer {
    /// The run from `state`, a checkpoint of `run`, on with the water `medium`. Where that is the water that the run has by
    /// then, and it moves no more in either, the bytes are those of `run` without the exchange.
    ///
    /// # Errors
    /// [`CoreError::Checkpoint`] when `state` is torn or belongs to another run; [`CoreError::Config`] when `run` has no
    /// water.
    pub fn hand_over(gpu: Arc<Gpu>, run: TrainRun, state: &[u8], medium: MediumRun) -> Result<Self> {
        let mut trainer = Self::resume(gpu, run, state)?;
        let mut hasher = blake3::Hasher::new();
        hasher.update(&trainer.run_digest);
        hasher.update(blake3::hash(state).as_bytes());
        hasher.update(format!("{medium:?}").as_bytes());
        trainer.run_digest = *hasher.finalize().as_bytes();
        trainer.exchange(medium)?;
        Ok(trainer)
    }

    /// Puts the run where `checkpoint`, one of the same run, stands.
    ///
    /// # Errors
    /// [`CoreError::Checkpoint`] when it is torn or belongs to another run; the run is then where it was.
    pub fn go_to(&mut self, checkpoint: &[u8]) -> Result<()> {
        checkpoint::restore(self, checkpoint)
    }

    fn exchange(&mut self, medium: MediumRun) -> Result<()> {
        if self.medium.take().is_none() {
            return Err(CoreError::Config("a run without a water has none to exchange".into()));
        }
        self.schedule = Schedule::new(&self.config, Some(&medium));
        let mut medium = DeviceMedium::new(&self.gpu, medium.times(self.config.loss_factor))?;
        medium.give_to(&self.gpu, &self.frame);
        let blocks = self.blocks.trainable().count() as u32;
        for view in self.truth.views() {
            let size = [view.camera.width, view.camera.height];
            medium.prepare(&self.gpu, size, self.config.max_gaussians, blocks)?;
        }
        self.medium = Some(medium);
        self.gpu.wait()
    }

    /// What stands behind each of the nine numbers, in the order of eq. 8, after what they have moved so far: the sum of
    /// the squares of the gradients of its unconstrained number, as Adam's second moment has it. 0 for one that has not
    /// moved. `None` where the run has no water.
    ///
    /// Gradients are those of a mean over the pixels of a picture. So this compares runs with pictures of one size.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water_evidence(&self) -> Result<Option<[f64; 9]>> {
        let Some(medium) = &self.medium else { return Ok(None) };
        let free = medium.run().config.free_iterations(self.config.iterations).min(self.iteration);
        let last = free.checked_sub(1).and_then(|iteration| self.schedule.water_step(iteration));
        medium.evidence(&self.gpu, last.map_or(0, |(_, steps)| steps)).map(Some)
    }
}
