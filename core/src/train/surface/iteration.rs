//! One iteration of a run with a water surface.

use std::sync::Arc;

use super::device::{Frames, SetGradients, record_agreement};
use super::{SurfaceTrainer, share_of};
use crate::Result;
use crate::config::{SurfaceJoin, SurfaceRefine};
use crate::gpu::{FrameUniform, Gpu, MaskLossUniform, Recorder, StepUniform, SurfaceStepUniform};
use crate::memory::BATCH;
use crate::train::{
    BackwardBuffers, DiskMaps, Progress, TracedBuffers, Trainer, record_backward, record_backward_in_bands,
};

/// Adam of the surface: every iteration has a gradient, so these are the usual rates of decay.
const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;

impl SurfaceTrainer {
    /// Runs at most `iterations` more and waits for them.
    ///
    /// # Errors
    /// When a photograph cannot be read or the device fails.
    pub fn advance(&mut self, iterations: u32) -> Result<Progress> {
        let total = self.straight.config.iterations;
        let target = total.min(self.iteration.saturating_add(iterations));
        while self.iteration < target {
            self.decide()?;
            let end = target.min(self.iteration + BATCH).min(self.next_event());
            self.run_batch(end)?;
            if self.iteration < total {
                self.densify()?;
            }
        }
        Ok(self.progress())
    }

    /// The next iteration at whose start something other than a step happens.
    fn next_event(&self) -> u32 {
        let at = self.iteration;
        let side = at.saturating_sub(self.from);
        let of_sides = [&self.reflected, &self.refracted]
            .map(|set| self.from.saturating_add(set.schedule.next_refine(side)));
        let resets = self.next_reset(at);
        let masks = self.mask_times().find(|&time| time > at).unwrap_or(u32::MAX);
        let own = self.straight.schedule.next_refine(at);
        let begins = if at < self.from { self.from } else { u32::MAX };
        own.min(of_sides[0]).min(of_sides[1]).min(resets).min(masks).min(begins)
    }

    fn reset_every(&self) -> u32 {
        share_of(self.straight.config.iterations, self.config.reset_every)
    }

    /// The first reset of masks after an iteration.
    fn next_reset(&self, at: u32) -> u32 {
        let last = share_of(self.straight.config.iterations, self.config.reset_until);
        let next = at.max(self.from).checked_div(self.reset_every()).map(|n| (n + 1) * self.reset_every());
        next.filter(|&next| next <= last).unwrap_or(u32::MAX)
    }

    /// When pseudo-masks are made.
    fn mask_times(&self) -> impl Iterator<Item = u32> + use<> {
        let last = share_of(self.straight.config.iterations, self.config.reset_until).max(self.from);
        let (from, count) = (self.from, u64::from(self.config.pseudo_masks));
        (0..count).map(move |k| from + (u64::from(last - from) * k / count) as u32)
    }

    /// What is due at the start of this iteration, besides density control. Doing it twice changes nothing.
    fn decide(&mut self) -> Result<()> {
        let at = self.iteration;
        if at < self.from || self.config.join == SurfaceJoin::Over {
            return Ok(());
        }
        if self.masks.made_at() != Some(at) && self.mask_times().any(|time| time == at) {
            let surface = self.surface()?;
            self.masks.make(&self.straight, &surface, at)?;
        }
        let last = share_of(self.straight.config.iterations, self.config.reset_until);
        let every = self.reset_every();
        if every > 0 && at <= last && (at == self.from || at.is_multiple_of(every)) {
            let mut recorder = Recorder::new(&self.straight.gpu);
            self.device.record_reset(&mut recorder, &self.straight.blocks)?;
            recorder.submit();
        }
        Ok(())
    }

    /// Runs the density steps that are due after the iterations so far.
    fn densify(&mut self) -> Result<()> {
        let at = self.iteration;
        self.straight.iteration = at;
        if due(&self.straight, at) {
            self.straight.densify()?;
        }
        let side = at.saturating_sub(self.from);
        for set in [&mut self.reflected, &mut self.refracted] {
            set.iteration = side;
            if at > self.from && due(set, side) {
                set.densify()?;
            }
        }
        Ok(())
    }

    /// Runs up to iteration `end` and grows lists when needed.
    fn run_batch(&mut self, end: u32) -> Result<()> {
        let first = self.iteration;
        let gpu = Arc::clone(&self.straight.gpu);
        while self.iteration < end {
            for iteration in self.iteration..end {
                let mut recorder = Recorder::new(&gpu);
                if let Err(error) = self.record(&gpu, &mut recorder, iteration) {
                    self.settle(&gpu, iteration);
                    return Err(error);
                }
                recorder.submit();
            }
            match self.failed_at(&gpu)? {
                None => self.iteration = end,
                Some(failed_at) => self.grow(&gpu, failed_at)?,
            }
        }
        self.straight.last_loss = self.straight.loss.mean(&gpu, first..end)?;
        Ok(())
    }

    /// The first iteration in which a list of any set was too short.
    fn failed_at(&self, gpu: &Gpu) -> Result<Option<u32>> {
        let mut failed: Option<u32> = None;
        for set in [&self.straight, &self.reflected, &self.refracted] {
            if let Some(overflow) = set.frame.overflow(gpu)? {
                failed = Some(failed.map_or(overflow.failed_at, |at| at.min(overflow.failed_at)));
            }
        }
        Ok(failed)
    }

    /// As [`Trainer`] does when an iteration cannot be recorded: earlier ones must not run twice.
    fn settle(&mut self, gpu: &Gpu, next: u32) {
        // A device whose counters cannot be read has failed permanently.
        if let Ok(failed) = self.failed_at(gpu) {
            self.iteration = failed.unwrap_or(next);
        }
    }

    /// Returns to the iteration that failed, with room for its view in every set.
    fn grow(&mut self, gpu: &Gpu, failed_at: u32) -> Result<()> {
        self.iteration = failed_at;
        let key = self.straight.view_of(failed_at);
        for set in self.sets() {
            if let Some(overflow) = set.frame.overflow(gpu)? {
                set.make_room(key, overflow)?;
            }
        }
        Ok(())
    }

    /// Records one iteration: the pictures, the loss, and the steps of all sets and of the surface.
    fn record(&mut self, gpu: &Arc<Gpu>, recorder: &mut Recorder<'_>, iteration: u32) -> Result<()> {
        let total = self.straight.config.iterations;
        let key = self.straight.view_of(iteration);
        for next in (iteration + 1..total).take(self.straight.targets.ahead() as usize) {
            let key = self.straight.view_of(next);
            self.straight.targets.expect(key);
        }
        let photograph = self.straight.targets.load(gpu, key)?;
        let view = &self.straight.targets.views()[key.0];
        let camera = view.camera.resized(photograph.size[0], photograph.size[1]);
        let whole = FrameUniform { iteration, ..FrameUniform::of_camera(&camera, &view.pose, gpu.tile()) };
        let pixels = whole.size[0] * whole.size[1];
        let progress = self.straight.schedule.progress(iteration);
        let all = iteration >= self.from;
        self.straight.loss.prepare(gpu, whole.size)?;
        self.device.prepare(gpu, whole.size)?;
        if let Some(disks) = &mut self.straight.disks {
            disks.prepare(gpu, whole.size)?;
        }

        // Forward.
        let mask_lr = if self.config.join == SurfaceJoin::Over { 0.0 } else { self.config.mask_lr };
        let straight = begin(&mut self.straight, gpu, recorder, key, &whole, progress, mask_lr)?;
        let mut sides = Vec::new();
        if all {
            for set in [&mut self.reflected, &mut self.refracted] {
                set.frame.prepare_targets(gpu, whole.size)?;
            }
            self.device.record_rays(recorder, self.frames(), pixels)?;
            let of_run = self.reflected.schedule.progress(iteration - self.from);
            for set in [&mut self.reflected, &mut self.refracted] {
                sides.push(begin(set, gpu, recorder, key, &whole, of_run, 0.0)?);
            }
            record_agreement(recorder, self.frames())?;
            self.device.record_compose(recorder, self.frames(), pixels)?;
        }

        // Loss and its gradients.
        let loss = &self.straight.loss;
        recorder.clear(loss.v_image()?);
        recorder.clear(loss.v_range()?);
        let picture = if all { self.device.picture() } else { &self.straight.frame.targets()?.image };
        loss.record(gpu, recorder, &photograph, picture, self.straight.config.ssim_weight, iteration)?;
        let Some(maps) = self.straight.disks.as_ref() else { return Ok(()) };
        let v_mask = maps.buffers().v_mask;
        if all {
            let v = SetGradients { v_image: loss.v_image()?, v_mask };
            self.device.record_backward(recorder, self.frames(), pixels, v)?;
            if progress >= self.config.mask_from && self.masks.made_at().is_some() {
                let (cells, first) = self.masks.of_view(key.0);
                let weight = 2.0 * self.config.mask_weight / pixels as f32;
                let loss = MaskLossUniform { cells, first, weight };
                let bits = self.masks.bits();
                self.device.record_mask_loss(
                    gpu,
                    recorder,
                    &self.straight.frame,
                    pixels,
                    bits,
                    loss,
                    v_mask,
                )?;
            }
        } else {
            recorder.clear(v_mask);
        }
        let weight = self.straight.schedule.normal_consistency(progress) / pixels as f32;
        let gradients = [loss.v_image()?, loss.v_range()?];
        maps.record(gpu, recorder, &self.straight.frame, &whole, weight, gradients)?;

        // Backward.
        end(&self.straight, gpu, recorder, &whole, &straight, None)?;
        if all {
            let moves = self.moves_surface(iteration);
            let traced = self
                .device
                .traced()
                .map(|traced| TracedBuffers { v_rays: traced.v_rays.filter(|_| moves), ..traced });
            for ((set, bands), traced) in
                [&self.reflected, &self.refracted].into_iter().zip(&sides).zip(traced)
            {
                let v_image = loss.v_image()?;
                end(set, gpu, recorder, &whole, bands, Some((v_image, traced)))?;
            }
            if moves {
                self.record_surface_step(gpu, recorder, iteration, pixels)?;
            }
        }
        Ok(())
    }

    /// Whether an iteration takes a step of the surface.
    fn moves_surface(&self, iteration: u32) -> bool {
        let until = share_of(self.straight.config.iterations, self.config.refine_until);
        self.config.refine != SurfaceRefine::Fixed && iteration < until
    }

    fn record_surface_step(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        iteration: u32,
        pixels: u32,
    ) -> Result<()> {
        let steps = f64::from(iteration - self.from + 1);
        let tilts = self.config.refine == SurfaceRefine::Tilt;
        let step = SurfaceStepUniform {
            offset_rate: self.config.offset_lr * self.straight.extent,
            tilt_rate: if tilts { self.config.tilt_lr } else { 0.0 },
            unbias1: (1.0 / (1.0 - BETA1.powf(steps))) as f32,
            unbias2: (1.0 / (1.0 - BETA2.powf(steps))) as f32,
            ..SurfaceStepUniform::default()
        };
        self.device.record_step(gpu, recorder, self.frames(), pixels, step)
    }

    pub(super) fn frames(&self) -> Frames<'_> {
        Frames {
            straight: &self.straight.frame,
            reflected: &self.reflected.frame,
            refracted: &self.refracted.frame,
        }
    }
}

/// Whether density control is due at the start of an iteration.
fn due(set: &Trainer, iteration: u32) -> bool {
    set.schedule.densifies_at(iteration) || set.schedule.resets_at(iteration)
}

/// Records the picture of one set, and sets its rates. Returns its bands.
fn begin(
    set: &mut Trainer,
    gpu: &Gpu,
    recorder: &mut Recorder<'_>,
    key: (usize, u32),
    whole: &FrameUniform,
    progress: f32,
    mask_lr: f32,
) -> Result<Vec<FrameUniform>> {
    set.frame.prepare_targets(gpu, whole.size)?;
    let trainable = set.blocks.trainable_total();
    let step = StepUniform { trainable, mask_lr, ..set.schedule.rates(progress, set.extent) };
    gpu.write(&set.step, 0, &[step]);
    let view = FrameUniform { sh_degree: set.schedule.sh_degree(progress), ..*whole };
    let bands = view.bands(set.bands.get(&key).copied().unwrap_or(1), gpu.tile());
    for band in &bands {
        set.frame.record_forward(gpu, recorder, &set.blocks, band)?;
        if bands.len() > 1 {
            recorder.flush();
        }
    }
    Ok(bands)
}

/// Records the backward pass and the step of one set. Without `traced`, its gradients are those of its own
/// loss and maps.
fn end(
    set: &Trainer,
    gpu: &Gpu,
    recorder: &mut Recorder<'_>,
    whole: &FrameUniform,
    bands: &[FrameUniform],
    traced: Option<(&wgpu::Buffer, TracedBuffers<'_>)>,
) -> Result<()> {
    let (v_image, v_range) = match traced {
        // Not read.
        Some((v_image, _)) => (v_image, v_image),
        None => (set.loss.v_image()?, set.loss.v_range()?),
    };
    let buffers = BackwardBuffers {
        v_image,
        v_range,
        slot_gradients: &set.slot_gradients,
        disks: set.disks.as_ref().map(DiskMaps::buffers),
        traced: traced.map(|(_, traced)| traced),
        step: &set.step,
        appearances: &[],
    };
    let first = bands.first().unwrap_or(whole);
    if bands.len() == 1 {
        return record_backward(gpu, recorder, &set.frame, &set.blocks, first, buffers);
    }
    recorder.flush();
    let view = FrameUniform { sh_degree: first.sh_degree, ..*whole };
    record_backward_in_bands(gpu, recorder, &set.frame, &set.blocks, &view, bands, buffers)
}
