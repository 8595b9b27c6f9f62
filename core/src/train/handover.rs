//! Hands a run over to another run at a checkpoint. Up to the checkpoint it trains with its own water and
//! next to the coarse model. Then the water is fixed to the one that all partitions agreed on
//! (`water.partitions = joint`), or the context becomes what the neighbours have trained
//! (`partition.neighbours_from`), or both.
//!
//! The result is a run of its own. It is determined by the first run, the checkpoint and what it continues
//! with, and the digest of its checkpoints covers all of these. Everything else continues: the kept
//! Gaussians, moments, the iteration and all schedules.

use std::sync::Arc;

use super::{MediumRun, Schedule, TrainRun, Trainer, checkpoint, settings};
use crate::Result;
use crate::appearance::chain::Start;
use crate::config::TrainConfig;
use crate::gaussians::Gaussians;
use crate::gpu::{Block, Gpu, sh_stride};

/// The surroundings that a run continues with: which Gaussians it still trains, and what replaces its
/// context.
pub struct Surroundings<'a> {
    /// Whether a Gaussian with this mean (world axes) is still trained; the others are dropped.
    pub keeps: &'a dyn Fn([f32; 3]) -> bool,
    /// Frozen Gaussians: rendered, but not changed from here on.
    pub context: Gaussians,
}

impl Trainer {
    /// Continues the run from `state`, a checkpoint of `run`, with the water `medium` and the surroundings
    /// `surroundings`, if given. `None` if nothing would be left to train.
    /// If nothing changes, the bytes equal those of the uninterrupted `run`. Nothing changes if `medium` is
    /// the water that the run has by then, fixed in both, and the context is the same.
    ///
    /// # Errors
    /// [`crate::CoreError::Checkpoint`] when `state` is torn or belongs to another run;
    /// [`crate::CoreError::Config`] when a `medium` is given but `run` has no water.
    pub fn hand_over(
        gpu: Arc<Gpu>,
        run: TrainRun,
        state: &[u8],
        medium: Option<MediumRun>,
        surroundings: Option<Surroundings<'_>>,
    ) -> Result<Option<Self>> {
        let mut trainer = match surroundings {
            None => Self::resume(gpu, run, state)?,
            Some(surroundings) => match Self::go_on_beside(gpu, run, state, surroundings)? {
                Some(trainer) => trainer,
                None => return Ok(None),
            },
        };
        let mut hasher = blake3::Hasher::new();
        hasher.update(&trainer.run_digest);
        hasher.update(blake3::hash(state).as_bytes());
        if let Some(medium) = &medium {
            hasher.update(format!("{medium:?}").as_bytes());
        }
        trainer.run_digest = *hasher.finalize().as_bytes();
        if let Some(medium) = medium {
            trainer.exchange(medium)?;
        }
        Ok(Some(trainer))
    }

    /// A run with the kept Gaussians of `state` and another context, at the iteration of `state`. Its cap
    /// shrinks in proportion to the kept Gaussians, so that it does not grow more than it would have
    /// otherwise.
    fn go_on_beside(
        gpu: Arc<Gpu>,
        run: TrainRun,
        state: &[u8],
        Surroundings { keeps, context }: Surroundings<'_>,
    ) -> Result<Option<Self>> {
        let TrainRun { config, extent, views, surfaces, medium, .. } = &run;
        let (config, extent, views) = (config.clone(), *extent, Arc::clone(views));
        // This run does not cover bare surfaces elsewhere.
        let (surfaces, medium) = (surfaces.split_by(keeps).0, medium.clone());
        let mut before = Self::resume(Arc::clone(&gpu), run, state)?;
        let model = before.blocks.download(&gpu)?;
        let kept: Vec<usize> = (0..model.len()).filter(|index| keeps(model.means[*index])).collect();
        let share =
            |count: u32| (u64::from(count) * kept.len() as u64).div_ceil(model.len().max(1) as u64) as u32;
        if kept.is_empty() {
            return Ok(None);
        }
        let rows = before.rows(&kept)?;
        let extras = before.extras()?;
        let network = before.predictor.as_mut().map(|predictor| predictor.save()).transpose()?;
        let (iteration, initial, most) = (before.iteration, before.initial, before.config.max_gaussians);
        // Two runs may not fit in memory at once.
        drop(before);
        let mut chosen = kept.iter().peekable();
        let (focus, _) = model.split_where(|index| chosen.next_if(|row| **row == index).is_some());
        let config = TrainConfig { max_gaussians: share(most).max(focus.len() as u32), ..config };
        let run = TrainRun { config, extent, views, focus, context, surfaces, medium, surface: None };
        let mut trainer = Self::new(gpu, run)?;
        trainer.take_rows(&rows);
        trainer.take_extras(&extras, network.as_deref())?;
        (trainer.iteration, trainer.initial) = (iteration, share(initial).max(1));
        trainer.gpu.wait()?;
        Ok(Some(trainer))
    }

    /// The state of the Gaussians at the given places (ascending), one byte vector per array.
    fn rows(&self, places: &[usize]) -> Result<Vec<Vec<u8>>> {
        let mut all: Vec<Vec<u8>> = Vec::new();
        let (mut first, mut left) = (0, places);
        for (_, block, _) in self.blocks.trainable() {
            let count = block.count as usize;
            let (here, after) = left.split_at(left.partition_point(|place| *place < first + count));
            let arrays = self.arrays(block);
            all.resize(arrays.len(), Vec::new());
            for ((buffer, row), kept) in arrays.into_iter().zip(&mut all) {
                let bytes = self.gpu.read::<u8>(buffer, 0, row * count)?;
                here.iter()
                    .for_each(|place| kept.extend(&bytes[row * (place - first)..row * (place - first + 1)]));
            }
            (first, left) = (first + count, after);
        }
        Ok(all)
    }

    /// Writes the state from [`Trainer::rows`] into all trainable Gaussians.
    fn take_rows(&self, rows: &[Vec<u8>]) {
        let mut first = 0;
        for (_, block, _) in self.blocks.trainable() {
            let count = block.count as usize;
            for ((buffer, row), bytes) in self.arrays(block).into_iter().zip(rows) {
                self.gpu.write(buffer, 0, &bytes[row * first..row * (first + count)]);
            }
            first += count;
        }
    }

    fn arrays<'a>(&self, block: &'a Block) -> Vec<(&'a wgpu::Buffer, usize)> {
        block.arrays(sh_stride(self.config.sh_degree))
    }

    /// Moves the run to `checkpoint`, which must be one of the same run.
    ///
    /// # Errors
    /// [`crate::CoreError::Checkpoint`] when it is torn or belongs to another run; the run then stays where
    /// it was.
    pub fn go_to(&mut self, checkpoint: &[u8]) -> Result<()> {
        checkpoint::restore(self, checkpoint)
    }

    fn exchange(&mut self, medium: MediumRun) -> Result<()> {
        let medium = medium.times(self.config.loss_factor);
        self.appearances.exchange_water(&Start {
            gpu: &self.gpu,
            settings: settings(&self.config, Some(&medium)),
            medium: Some(&medium),
            views: self.targets.views().len() as u32,
            blocks: self.blocks.trainable().count() as u32,
        })?;
        self.schedule = Schedule::new(&self.config, Some(&medium));
        if let Some(water) = self.appearances.water() {
            water.give_to(&self.gpu, &self.frame);
        }
        for view in self.targets.views() {
            self.appearances.prepare(&self.gpu, [view.camera.width, view.camera.height])?;
        }
        self.gpu.wait()
    }

    /// The evidence for each of the water parameters, in the order of eq. 8: the sum of the squared gradients
    /// of its unconstrained value so far, from Adam's second moment. 0 for a parameter that has not moved.
    /// `None` if the run has no water.
    ///
    /// Gradients are those of a mean over the pixels of an image, so only runs with equal image sizes can be
    /// compared.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water_evidence(&self) -> Result<Option<[f64; 9]>> {
        let Some(medium) = self.appearances.water() else { return Ok(None) };
        let free = medium.run().config.free_iterations(self.config.iterations).min(self.iteration);
        let last = free.checked_sub(1).and_then(|iteration| self.schedule.water()?.step(iteration));
        medium.evidence(&self.gpu, last.map_or(0, |(_, steps)| steps)).map(Some)
    }
}
