//! The water of a run: the common part of the appearances for water on pixels and on Gaussians.

use super::{DeviceMedium, WaterSchedule, WaterStep};
use crate::appearance::chain::{Gradients, Iteration, Start};
use crate::gpu::{Gpu, Recorder, StepUniform};
use crate::views::TrainView;
use crate::{CoreError, Result};

/// The water of a run with its schedule.
pub(in crate::appearance) struct StartedWater {
    pub(in crate::appearance) medium: DeviceMedium,
    schedule: WaterSchedule,
    /// Maximum number of trained Gaussians, and number of their blocks.
    gaussians: u32,
    blocks: u32,
}

impl StartedWater {
    /// The water of the run at its start.
    ///
    /// # Errors
    /// When the run has none, its parameters are not physical, or the device cannot hold it.
    pub(in crate::appearance) fn new(start: &Start<'_>) -> Result<Self> {
        let run = start.medium.ok_or_else(|| CoreError::Config("the run has no water".to_owned()))?;
        Ok(Self {
            schedule: WaterSchedule::new(run, start.settings.train.iterations),
            medium: DeviceMedium::new(start.gpu, run.clone())?,
            gaussians: start.settings.train.max_gaussians,
            blocks: start.blocks,
        })
    }

    pub(in crate::appearance) fn prepare(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<()> {
        self.medium.prepare(gpu, size, self.gaussians, self.blocks)
    }

    /// The step of an iteration.
    fn step_at(&self, now: &Iteration<'_>) -> WaterStep {
        let (run, map) = (self.medium.run(), now.photograph.map.as_ref());
        let step = self.schedule.step(now.number);
        let progress = now.progress();
        WaterStep {
            size: now.photograph.size,
            masked: now.photograph.masked,
            has_surfaces: progress >= run.config.start_at || !run.is_free,
            rate: step.map(|(rate, _)| rate),
            gathers: self.gathers(now),
            steps: step.map_or(0, |(_, steps)| steps),
            // A fixed water is past the stages in which the terms begin.
            terms: if run.is_free { run.config.priors.share(progress) } else { 1.0 },
            level: now.level,
            map: map.map_or([0; 2], |map| map.size),
            alike: map.map_or(0.0, |map| map.alike),
        }
    }

    /// Whether gradients are collected for WaterParamPredict.
    fn gathers(&self, now: &Iteration<'_>) -> bool {
        now.number < self.schedule.network_end()
    }

    /// Whether the water parameters are stepped, or their gradients collected, with the step of the
    /// Gaussians. If the network predicted the water from this view, it already took the gradients.
    pub(in crate::appearance) fn steps_with_gaussians(&self, now: &Iteration<'_>) -> bool {
        self.schedule.step(now.number).is_some() || (self.gathers(now) && !now.is_predicted)
    }

    pub(in crate::appearance) fn record(
        &self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
    ) -> Result<&wgpu::Buffer> {
        let (gaussians, blocks) = (now.blocks.trainable_total(), now.blocks.trainable().count() as u32);
        self.medium.record(now.gpu, recorder, now.frame, self.step_at(now), gaussians, blocks)
    }

    pub(in crate::appearance) fn record_backward(
        &self,
        recorder: &mut Recorder<'_>,
        now: &Iteration<'_>,
        gradients: Gradients<'_>,
    ) -> Result<()> {
        let map = now.photograph.map.as_ref().map(|map| &map.cells);
        let (step, by) = (self.step_at(now), [gradients.v_image, gradients.v_range]);
        self.medium.record_backward(now.gpu, recorder, now.frame, gradients.truth, map, step, by)
    }

    pub(in crate::appearance) fn weigh(&self, step: &mut StepUniform, view: &TrainView) {
        let run = self.medium.run();
        step.sh_rest_lr *= run.harmonics_lr_scale();
        step.overwhite_weight = run.saturation_weight();
        step.floater_weight = run.config.floater_weight;
        step.clear_range = view.clear_range;
    }
}
