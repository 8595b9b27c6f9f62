//! One iteration of a run: its recording, and the recovery when a list was too short.

use std::sync::Arc;

use super::target_images::Key;
use super::{BackwardBuffers, DiskMaps, Trainer, record_backward, record_backward_in_bands};
use crate::Result;
use crate::appearance::chain::{Gradients, Iteration};
use crate::gpu::{DevicePhotograph, FrameUniform, KernelTime, Recorder, StepUniform, Workload};

impl Trainer {
    /// Runs up to iteration `end` and grows lists when needed.
    pub(super) fn run_batch(&mut self, end: u32) -> Result<()> {
        let first = self.iteration;
        while self.iteration < end {
            for iteration in self.iteration..end {
                let gpu = Arc::clone(&self.gpu);
                let mut recorder = Recorder::new(&gpu);
                if let Err(error) = self.record(&mut recorder, iteration) {
                    self.settle(iteration);
                    return Err(error);
                }
                recorder.submit();
            }
            match self.frame.overflow(&self.gpu)? {
                None => self.iteration = end,
                Some(overflow) => self.grow(overflow)?,
            }
        }
        self.last_loss = self.loss.mean(&self.gpu, first..end)?;
        Ok(())
    }

    /// Sets the progress of the device when iteration `next` cannot be recorded. Earlier iterations are
    /// already submitted and must not run twice when training continues.
    fn settle(&mut self, next: u32) {
        // A device whose counters cannot be read has failed permanently.
        if let Ok(overflow) = self.frame.overflow(&self.gpu) {
            self.iteration = overflow.map_or(next, |overflow| overflow.failed_at);
        }
    }

    /// The view of an iteration: its index among the views and how often its image is halved.
    pub(super) fn view_of(&mut self, iteration: u32) -> Key {
        let index = self.targets.view_at(iteration);
        let progress = self.schedule.progress(iteration);
        (index, self.schedule.level(progress, &self.targets.views()[index].camera))
    }

    /// A uniform with the image size of a view from [`Trainer::view_of`].
    pub(super) fn picture_of(&self, (index, level): Key) -> FrameUniform {
        let camera = &self.targets.views()[index].camera;
        let size = [camera.width, camera.height].map(|side| (side >> level).max(1));
        FrameUniform::default().with_size(size, self.gpu.tile())
    }

    /// Records one iteration: forward, appearances, loss, backward, step.
    fn record(&mut self, recorder: &mut Recorder<'_>, iteration: u32) -> Result<()> {
        let progress = self.schedule.progress(iteration);
        let key = self.view_of(iteration);
        for next in (iteration + 1..self.config.iterations).take(self.targets.ahead() as usize) {
            let key = self.view_of(next);
            self.targets.expect(key);
        }
        let photograph = self.targets.load(&self.gpu, key)?;
        let view = &self.targets.views()[key.0];
        let camera = view.camera.resized(photograph.size[0], photograph.size[1]);
        let frame = FrameUniform {
            sh_degree: self.schedule.sh_degree(progress),
            background: self.schedule.background(iteration),
            iteration,
            mip_filter: u32::from(self.config.mip_filter),
            medium: self.appearances.colouring(),
            ..FrameUniform::of_camera(&camera, &view.pose, self.gpu.tile())
        };
        self.frame.prepare_targets(&self.gpu, frame.size)?;
        self.loss.prepare(&self.gpu, frame.size)?;
        self.appearances.prepare(&self.gpu, frame.size)?;
        if let Some(disks) = &mut self.disks {
            disks.prepare(&self.gpu, frame.size)?;
        }
        let trainable = self.blocks.trainable_total();
        let mut step = StepUniform { trainable, ..self.schedule.rates(progress, self.extent) };
        self.appearances.weigh(&mut step, view);
        let gpu = Arc::clone(&self.gpu);
        gpu.write(&self.step, 0, &[step]);
        let bands = frame.bands(self.bands.get(&key).copied().unwrap_or(1), gpu.tile());
        for band in &bands {
            self.frame.record_forward(&gpu, recorder, &self.blocks, band)?;
            if bands.len() > 1 {
                recorder.flush();
            }
        }
        let is_predicted = self.predictor.as_ref().is_some_and(|predictor| predictor.is_at_once(iteration));
        let mut at_once = None;
        if is_predicted {
            recorder.flush();
            if self.frame.overflow(&gpu)?.is_some() {
                // The view was not rendered, and the device does nothing until the lists are longer.
                return Ok(());
            }
            at_once = self.predict_at_once(&gpu, photograph.size)?;
        }
        self.record_loss(recorder, &self.seen_in(iteration, key, &photograph, is_predicted))?;
        if let Some(disks) = &self.disks {
            let weight = self.schedule.normal_consistency(progress) / (frame.size[0] * frame.size[1]) as f32;
            let gradients = [self.loss.v_image()?, self.loss.v_range()?];
            disks.record(&gpu, recorder, &self.frame, &frame, weight, gradients)?;
        }
        if let Some(at_once) = at_once {
            self.learn_at_once(&gpu, recorder, at_once)?;
        }
        let now = self.seen_in(iteration, key, &photograph, is_predicted);
        let buffers = BackwardBuffers {
            v_image: self.loss.v_image()?,
            v_range: self.loss.v_range()?,
            slot_gradients: &self.slot_gradients,
            disks: self.disks.as_ref().map(DiskMaps::buffers),
            traced: None,
            step: &self.step,
            appearances: &self.appearances.stepped_with_gaussians(&now),
        };
        if bands.len() == 1 {
            return record_backward(&gpu, recorder, &self.frame, &self.blocks, &frame, buffers);
        }
        recorder.flush();
        record_backward_in_bands(&gpu, recorder, &self.frame, &self.blocks, &frame, &bands, buffers)
    }

    /// The inputs of appearances in one iteration.
    fn seen_in<'a>(
        &'a self,
        number: u32,
        (view, level): Key,
        photograph: &'a DevicePhotograph,
        is_predicted: bool,
    ) -> Iteration<'a> {
        Iteration {
            gpu: &self.gpu,
            frame: &self.frame,
            blocks: &self.blocks,
            photograph,
            number,
            iterations: self.config.iterations,
            view: view as u32,
            views: self.targets.views().len() as u32,
            level,
            is_predicted,
        }
    }

    /// Records the stages between the blended image and its gradient: appearances, loss, appearances
    /// backward.
    fn record_loss(&self, recorder: &mut Recorder<'_>, now: &Iteration<'_>) -> Result<()> {
        if self.disks.is_some() {
            // Normals add to them. Without water nothing else writes the gradients of alpha and range.
            recorder.clear(self.loss.v_image()?);
            recorder.clear(self.loss.v_range()?);
        }
        let pictures = self.appearances.record(recorder, now, &self.frame.targets()?.image)?;
        let weight = self.config.ssim_weight;
        self.loss.record(now.gpu, recorder, now.photograph, pictures.last, weight, now.number)?;
        let gradients = Gradients {
            truth: self.loss.truth()?,
            v_image: self.loss.v_image()?,
            v_range: self.loss.v_range()?,
        };
        self.appearances.record_backward(recorder, now, &pictures, gradients)
    }

    /// Runs one iteration as [`Trainer::advance`] does, even after the last, and returns the device time of
    /// each kernel.
    ///
    /// # Errors
    /// When a photograph cannot be read or the device fails.
    pub fn time_iteration(&mut self) -> Result<Vec<KernelTime>> {
        let refine_at = self.schedule.next_refine(self.iteration);
        let predict_at = self.next_prediction();
        loop {
            let gpu = Arc::clone(&self.gpu);
            let mut recorder = Recorder::timed(&gpu);
            self.record(&mut recorder, self.iteration)?;
            let times = recorder.submit_timed()?;
            match self.frame.overflow(&gpu)? {
                None => {
                    self.iteration += 1;
                    if self.iteration == predict_at {
                        self.predict_water()?;
                    }
                    if self.iteration == refine_at && self.iteration < self.config.iterations {
                        self.densify()?;
                    }
                    return Ok(times);
                }
                Some(overflow) => self.grow(overflow)?,
            }
        }
    }

    /// Work of the forward pass of the previous iteration; for a view in bands, of its last band. Waits for
    /// the device; for benchmarks.
    ///
    /// # Errors
    /// When no iteration has run yet or the device fails.
    pub fn last_workload(&mut self) -> Result<Workload> {
        let key = self.view_of(self.iteration.saturating_sub(1));
        let whole = self.picture_of(key);
        let bands = whole.bands(self.bands.get(&key).copied().unwrap_or(1), self.gpu.tile());
        self.frame.workload(&self.gpu, bands.last().unwrap_or(&whole))
    }
}
