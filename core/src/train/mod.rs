//! Training: one run over one set of views on one GPU.
//!
//! An iteration renders one view, compares it with its photograph and takes one step of Adam on the Gaussians that
//! the view sees, all on the device. The host only queues iterations, looks now and then whether a list
//! overflowed (then it grows the list and goes back to the first iteration that failed: the device did nothing since),
//! and decides on density from numbers read back at fixed iterations. So the result depends on the run, the seed and
//! the device alone: not on timing, capacities, batches or interruptions.

mod adam;
mod backward;
mod checkpoint;
mod dbdr;
mod density;
mod exposure;
mod far_field;
mod film;
mod handover;
mod held_out;
mod init;
mod lists;
mod loss;
mod medium;
mod predictor;
mod priors;
mod schedule;
mod smoothing;
mod start;
mod surfaces;
mod truth;

use std::collections::HashMap;
use std::sync::Arc;

use crate::config::{LossLight, TrainConfig};
use crate::gaussians::Gaussians;
use crate::gpu::{
    Blocks, Frame, FrameUniform, Gpu, Recorder, Show, StageTime, StepUniform, WaterView, Workload,
    spatial_order,
};
use crate::memory::BATCH;
use crate::views::ViewSource;
use crate::water::{Water, WaterRecord};
use crate::{CoreError, Result};

pub use backward::{BackwardBuffers, record_backward, record_backward_in_bands};
pub use exposure::{ExposureStep, Exposures};
pub use film::{FILM_UNITS, Film, FilmEmbedding, FilmStep};
pub use handover::Beside;
pub use held_out::HeldOutMetrics;
pub use init::initial_gaussians;
use lists::{lists, slot_gradients};
pub use loss::Loss;
pub use medium::{DeviceMedium, Gathered, MediumRun, NetworkRun, WaterStep};
use predictor::Predictor;
pub use priors::{DevicePriors, PriorMaps};
use schedule::Schedule;
pub use smoothing::smoothed;
pub use start::{StartingWater, clear_points, starting_water, with_ray_maps};
use surfaces::Surfaces;
pub use surfaces::surface_points;
pub use truth::DevicePhotograph;
use truth::Truth;

/// One run: what to train, on what, for how long.
pub struct TrainRun {
    /// Resolved configuration; `iterations` and `max_gaussians` are those of this run.
    pub config: TrainConfig,
    /// [`crate::scene::learning_scale`] of the whole scene, scene units; the same for every partition, so that
    /// learning rates are.
    pub extent: f32,
    /// Views to train on.
    pub views: Arc<dyn ViewSource>,
    /// Gaussians that are trained and densified.
    pub focus: Gaussians,
    /// Gaussians that are rendered but never change.
    pub context: Gaussians,
    /// For each place that must stay covered a Gaussian that covers it ([`surface_points`]).
    pub surfaces: Gaussians,
    /// The water between cameras and scene; `None` trains in sRGB without one.
    pub medium: Option<MediumRun>,
}

/// Where a run stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Iterations done.
    pub iteration: u32,
    /// Iterations in all.
    pub iterations: u32,
    /// Gaussians in focus.
    pub gaussians: u32,
    /// Mean loss of the last batch of iterations.
    pub loss: f32,
}

/// Memory that a run takes on the device, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryUse {
    /// Gaussians with their moments.
    pub gaussians: u64,
    /// Lists by visible Gaussian.
    pub per_visible: u64,
    /// Lists by intersection, gradients included.
    pub per_intersection: u64,
    /// Sums of the bands of views that are rendered in several.
    pub bands: u64,
}

/// Trains one [`TrainRun`].
pub struct Trainer {
    gpu: Arc<Gpu>,
    config: TrainConfig,
    schedule: Schedule,
    extent: f32,
    /// Digest of everything that decides the result; a checkpoint belongs to it.
    run_digest: [u8; 32],
    truth: Truth,
    blocks: Blocks,
    frame: Frame,
    loss: Loss,
    /// Where `train.exposure` is on.
    exposures: Option<Exposures>,
    /// Where `water.film` is on.
    film: Option<Film>,
    /// Where the run has a water.
    medium: Option<DeviceMedium>,
    /// Where WaterParamPredict decides it at first.
    predictor: Option<Predictor>,
    /// Where surfaces must stay covered.
    surfaces: Option<Surfaces>,
    slot_gradients: wgpu::Buffer,
    step: wgpu::Buffer,
    /// Bands of the views (index and level) whose lists would be too long for the device.
    bands: HashMap<(usize, u32), u32>,
    iteration: u32,
    /// Gaussians in focus at the start of the run: growth is geometric from here.
    initial: u32,
    last_loss: f32,
}

impl Trainer {
    /// A run from its beginning.
    ///
    /// # Errors
    /// When there are no views, no Gaussians, or the device cannot hold them.
    pub fn new(gpu: Arc<Gpu>, run: TrainRun) -> Result<Self> {
        if run.views.views().is_empty() {
            return Err(CoreError::Scene("there are no views to train on".into()));
        }
        if run.focus.is_empty() {
            return Err(CoreError::Scene(
                "there are no Gaussians to train: the scene has no points where this partition is".into(),
            ));
        }
        let run_digest = checkpoint::run_digest(&run);
        let TrainRun { config, extent, views, focus, context, surfaces, medium } = run;
        let medium = medium.map(|medium| medium.times(config.loss_factor));
        let focus = init::limit(focus, config.max_gaussians, config.seed);
        let surfaces = Surfaces::new(surfaces, &context)?;
        let mut blocks = Blocks::new(&gpu, config.sh_degree)?;
        blocks.push_trainable(&gpu, &focus, config.max_gaussians, config.moments)?;
        blocks.push_frozen(&gpu, &context, &spatial_order(&context))?;
        // Else what was uploaded stays in staging buffers beside what is made now.
        gpu.wait()?;
        let gaussians = config.max_gaussians.max(focus.len() as u32) + context.len() as u32;
        let lists = lists(&gpu, &config, views.views(), &focus, &context, medium.as_ref());
        let mut frame = Frame::new(&gpu, gaussians, lists.visible, lists.intersections)?;
        let slot_gradients = slot_gradients(&gpu, &frame)?;
        // For the largest picture: a run that cannot hold it fails here, not when it comes to full size.
        let light = medium.as_ref().map_or(LossLight::Srgb, |medium| medium.config.loss_light);
        let mut loss = Loss::new(&gpu)?.in_light(light).times(config.loss_factor);
        let count = views.views().len() as u32;
        let mut exposures = config.exposure.then(|| Exposures::new(&gpu, count)).transpose()?;
        let schedule = Schedule::new(&config, medium.as_ref());
        let predictor = match &medium {
            Some(medium) => Predictor::new(medium, schedule.network_end(), config.seed)?,
            None => None,
        };
        let film = medium.as_ref().map(|run| &run.config).filter(|water| water.has_film());
        let mut film = film.map(|water| Film::new(&gpu, &water.film, count, config.seed)).transpose()?;
        let mut medium = medium.map(|run| DeviceMedium::new(&gpu, run)).transpose()?;
        if let Some(medium) = &medium {
            medium.give_to(&gpu, &frame);
        }
        for view in views.views() {
            let size = [view.camera.width, view.camera.height];
            frame.prepare_targets(&gpu, size)?;
            loss.prepare(&gpu, size)?;
            if let Some(medium) = &mut medium {
                medium.prepare(&gpu, size, config.max_gaussians, blocks.trainable().count() as u32)?;
            }
            if let Some(exposures) = &mut exposures {
                exposures.prepare(&gpu, size)?;
            }
            if let Some(film) = &mut film {
                film.prepare(&gpu, size)?;
            }
        }
        let trainer = Self {
            schedule,
            step: gpu.uniform("step", &StepUniform::default()),
            loss,
            exposures,
            film,
            medium,
            predictor,
            surfaces,
            truth: Truth::new(views, config.seed, config.prefetch_threads).gives_way(&gpu),
            initial: focus.len() as u32,
            gpu,
            config,
            extent,
            run_digest,
            blocks,
            frame,
            slot_gradients,
            bands: HashMap::new(),
            iteration: 0,
            last_loss: f32::NAN,
        };
        trainer.update_smoothing()?;
        Ok(trainer)
    }

    /// The same run from a checkpoint of it; gives the bytes that an uninterrupted run gives.
    ///
    /// # Errors
    /// [`CoreError::Checkpoint`] when the bytes are torn or belong to another run: start anew then.
    pub fn resume(gpu: Arc<Gpu>, run: TrainRun, checkpoint: &[u8]) -> Result<Self> {
        let mut trainer = Self::new(gpu, run)?;
        checkpoint::restore(&mut trainer, checkpoint)?;
        Ok(trainer)
    }

    /// Runs at most `iterations` more and waits for them.
    ///
    /// # Errors
    /// When a photograph cannot be read or the device fails.
    pub fn advance(&mut self, iterations: u32) -> Result<Progress> {
        let target = self.config.iterations.min(self.iteration.saturating_add(iterations));
        while self.iteration < target {
            let refine_at = self.schedule.next_refine(self.iteration);
            let predict_at = self.next_prediction();
            let end = target.min(self.iteration + BATCH).min(refine_at).min(predict_at);
            self.run_batch(end)?;
            if self.iteration == predict_at {
                self.predict_water()?;
            }
            if self.iteration == refine_at && self.iteration < self.config.iterations {
                self.refine()?;
            }
        }
        Ok(self.progress())
    }

    /// Runs to iteration `end`, growing lists on the way.
    fn run_batch(&mut self, end: u32) -> Result<()> {
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

    /// Says how far the device is where iteration `next` cannot be recorded: those before it are with the device already,
    /// and must not be done twice by who goes on.
    fn settle(&mut self, next: u32) {
        // A device that cannot say what it did has failed for good.
        if let Ok(overflow) = self.frame.overflow(&self.gpu) {
            self.iteration = overflow.map_or(next, |overflow| overflow.failed_at);
        }
    }

    /// The view of an iteration: its index among the views and how often its picture is halved.
    fn view_of(&mut self, iteration: u32) -> (usize, u32) {
        let index = self.truth.view_at(iteration);
        let progress = self.schedule.progress(iteration);
        (index, self.schedule.level(progress, &self.truth.views()[index].camera))
    }

    /// A uniform of the size of what [`Trainer::view_of`] gives.
    fn picture_of(&self, (index, level): (usize, u32)) -> FrameUniform {
        let camera = &self.truth.views()[index].camera;
        let size = [camera.width, camera.height].map(|side| (side >> level).max(1));
        FrameUniform::default().with_size(size, self.gpu.tile())
    }

    /// Records one iteration: forward, loss, backward, step.
    fn record(&mut self, recorder: &mut Recorder<'_>, iteration: u32) -> Result<()> {
        let progress = self.schedule.progress(iteration);
        let (index, level) = self.view_of(iteration);
        for next in (iteration + 1..self.config.iterations).take(self.truth.ahead() as usize) {
            let key = self.view_of(next);
            self.truth.expect(key);
        }
        let image = self.truth.load(&self.gpu, (index, level))?;
        let view = &self.truth.views()[index];
        let camera = view.camera.resized(image.size[0], image.size[1]);
        let frame = FrameUniform {
            sh_degree: self.schedule.sh_degree(progress),
            background: self.schedule.background(iteration),
            iteration,
            mip_filter: u32::from(self.config.mip_filter),
            medium: self.medium.as_ref().map_or(0, DeviceMedium::frame_medium),
            ..FrameUniform::of_camera(&camera, &view.pose, self.gpu.tile())
        };
        self.frame.prepare_targets(&self.gpu, frame.size)?;
        self.loss.prepare(&self.gpu, frame.size)?;
        if let Some(exposures) = &mut self.exposures {
            exposures.prepare(&self.gpu, frame.size)?;
        }
        if let Some(film) = &mut self.film {
            film.prepare(&self.gpu, frame.size)?;
        }
        let trainable = self.blocks.trainable_total();
        let mut rates = StepUniform { trainable, ..self.schedule.rates(progress, self.extent) };
        if let Some(medium) = &self.medium {
            let run = medium.run();
            rates.more[1] *= run.harmonics_haste();
            rates.noise[1] = run.saturation_weight();
            rates.noise[2] = run.config.floaters;
            rates.clear_range = view.clear_range;
        }
        let gpu = Arc::clone(&self.gpu);
        gpu.write(&self.step, 0, &[rates]);
        let bands = frame.bands(self.bands.get(&(index, level)).copied().unwrap_or(1), gpu.tile());
        for band in &bands {
            self.frame.record_forward(&gpu, recorder, &self.blocks, band)?;
            if bands.len() > 1 {
                recorder.flush();
            }
        }
        let water_step = self.schedule.water_step(iteration);
        let gathers = iteration < self.schedule.network_end();
        let is_at_once = self.predictor.as_ref().is_some_and(|predictor| predictor.is_at_once(iteration));
        let mut at_once = None;
        if is_at_once {
            recorder.flush();
            if self.frame.overflow(&gpu)?.is_some() {
                // There is no view, and the device does nothing more until the lists are longer.
                return Ok(());
            }
            at_once = self.predict_at_once(&gpu, image.size)?;
        }
        let targets = self.frame.targets()?;
        match &self.medium {
            None => self.record_loss(&gpu, recorder, index, &image, &targets.image, iteration)?,
            Some(medium) => {
                let step = WaterStep {
                    size: image.size,
                    masked: image.masked,
                    has_surfaces: progress >= medium.run().config.from || !medium.run().is_free,
                    rate: water_step.map(|(rate, _)| rate),
                    gathers,
                    steps: water_step.map_or(0, |(_, steps)| steps),
                    // A water that stays is past the stages in which they begin.
                    terms: if medium.run().is_free {
                        medium.run().config.priors.share(progress)
                    } else {
                        1.0
                    },
                    level,
                    map: image.map.as_ref().map_or([0; 2], |map| map.size),
                    alike: image.map.as_ref().map_or(0.0, |map| map.alike),
                };
                let count = self.blocks.trainable().count() as u32;
                let seen = medium.record(&gpu, recorder, &self.frame, step, trainable, count)?;
                self.record_filmed_loss(&gpu, recorder, index, &image, seen, iteration)?;
                let gradients = [self.loss.v_image()?, self.loss.v_range()?];
                let map = image.map.as_ref().map(|map| &map.cells);
                medium.record_backward(
                    &gpu,
                    recorder,
                    &self.frame,
                    self.loss.truth()?,
                    map,
                    step,
                    gradients,
                )?;
            }
        }
        if let Some(at_once) = at_once {
            self.learn_at_once(&gpu, recorder, at_once)?;
        }
        let buffers = BackwardBuffers {
            v_image: self.loss.v_image()?,
            v_range: self.loss.v_range()?,
            slot_gradients: &self.slot_gradients,
            step: &self.step,
            water: self.medium.as_ref().filter(|_| water_step.is_some() || (gathers && !is_at_once)),
        };
        if bands.len() == 1 {
            return record_backward(&gpu, recorder, &self.frame, &self.blocks, &frame, buffers);
        }
        recorder.flush();
        record_backward_in_bands(&gpu, recorder, &self.frame, &self.blocks, &frame, &bands, buffers)
    }

    /// The same as [`Trainer::record_loss`], through the view's embedding where there are embeddings.
    fn record_filmed_loss(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        view: usize,
        truth: &DevicePhotograph,
        seen: &wgpu::Buffer,
        iteration: u32,
    ) -> Result<()> {
        let Some(film) = &self.film else {
            return self.record_loss(gpu, recorder, view, truth, seen, iteration);
        };
        let scheduled = self.schedule.film_step(iteration, self.truth.views().len() as u32);
        let (steps, view_steps) = scheduled.map_or((0, 0), |(_, steps, view_steps)| (steps, view_steps));
        let rate = scheduled.map(|(rate, ..)| rate);
        let step = FilmStep { view: view as u32, size: truth.size, rate, steps, view_steps };
        let filmed = film.record(gpu, recorder, seen, step)?;
        self.record_loss(gpu, recorder, view, truth, filmed, iteration)?;
        film.record_backward(recorder, seen, self.loss.v_image()?, &self.frame.counters, step)
    }

    /// Records the loss of a render against its photograph, down to its gradient by the render, through the view's
    /// exposure where there are exposures.
    fn record_loss(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        view: usize,
        truth: &DevicePhotograph,
        render: &wgpu::Buffer,
        iteration: u32,
    ) -> Result<()> {
        let weight = self.config.ssim_weight;
        let Some(exposures) = &self.exposures else {
            return self.loss.record(gpu, recorder, truth, render, weight, iteration);
        };
        let views = self.truth.views().len();
        let step = ExposureStep {
            view: view as u32,
            // Every view is seen once an epoch; where views have weights, in the mean.
            steps: iteration / views as u32 + 1,
            rate: self.schedule.exposure_rate(self.schedule.progress(iteration), views),
            size: truth.size,
        };
        let exposed = exposures.record(gpu, recorder, render, step)?;
        self.loss.record(gpu, recorder, truth, exposed, weight, iteration)?;
        exposures.record_backward(recorder, render, self.loss.v_image()?, &self.frame.counters, step.size)
    }

    /// Does one iteration as [`Trainer::advance`] does, also after the last, and gives the device time of each stage.
    ///
    /// # Errors
    /// When a photograph cannot be read or the device fails.
    pub fn time_iteration(&mut self) -> Result<Vec<StageTime>> {
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
                        self.refine()?;
                    }
                    return Ok(times);
                }
                Some(overflow) => self.grow(overflow)?,
            }
        }
    }

    /// What the forward pass of the iteration before this one had to do; of a view in bands, its last band. Waits for the
    /// device: for benchmarks.
    ///
    /// # Errors
    /// When no iteration was done yet or the device fails.
    pub fn last_workload(&mut self) -> Result<Workload> {
        let key = self.view_of(self.iteration.saturating_sub(1));
        let whole = self.picture_of(key);
        let bands = whole.bands(self.bands.get(&key).copied().unwrap_or(1), self.gpu.tile());
        self.frame.workload(&self.gpu, bands.last().unwrap_or(&whole))
    }

    /// Where the run stands; `iteration == iterations` means done.
    pub fn progress(&self) -> Progress {
        Progress {
            iteration: self.iteration,
            iterations: self.config.iterations,
            gaussians: self.blocks.trainable_total(),
            loss: self.last_loss,
        }
    }

    /// The Gaussians on the device, trained and frozen.
    pub fn blocks(&self) -> &Blocks {
        &self.blocks
    }

    /// Exposure of each training view, rows r, g, b of a 3x4 affine map of the rendered colours; empty where
    /// `train.exposure` is off.
    ///
    /// # Errors
    /// When the device fails.
    pub fn exposures(&self) -> Result<Vec<[[f32; 4]; 3]>> {
        self.exposures.as_ref().map_or(Ok(Vec::new()), |exposures| exposures.download(&self.gpu))
    }

    /// Embedding of each training view, two numbers a hidden unit; empty where `water.film` is off.
    ///
    /// # Errors
    /// When the device fails.
    pub fn film_embeddings(&self) -> Result<Vec<FilmEmbedding>> {
        self.film.as_ref().map_or(Ok(Vec::new()), |film| film.embeddings(&self.gpu))
    }

    /// The water as it is now; `None` where the run has none.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water(&self) -> Result<Option<Water>> {
        self.medium.as_ref().map(|medium| medium.water(&self.gpu, &self.frame)).transpose()
    }

    /// What is to be said of the water as it is now; `None` where the run has none.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water_record(&self, metres_per_unit: f64) -> Result<Option<WaterRecord>> {
        let record = |medium: &DeviceMedium| medium.record_of(&self.gpu, &self.frame, metres_per_unit);
        self.medium.as_ref().map(record).transpose()
    }

    /// How to render what is trained as its photographs show it; `None` where the run has no water.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water_view(&self) -> Result<Option<WaterView>> {
        let Some(medium) = &self.medium else { return Ok(None) };
        let water = medium.water(&self.gpu, &self.frame)?;
        let refinement = medium.refinement(&self.gpu, &self.frame)?;
        let config = &medium.run().config;
        let (acts, blend) = (config.medium, config.blend);
        let by_direction = medium.run().by_direction;
        Ok(Some(WaterView { water, refinement, by_direction, medium: acts, blend, show: Show::Seen }))
    }

    /// Steps of the water, and of the network that predicts it, that were left out since a gradient was not finite.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water_steps_left_out(&self) -> Result<u32> {
        let of_water = self.medium.as_ref().map_or(Ok(0), |medium| medium.steps_left_out(&self.gpu))?;
        Ok(of_water + self.predictor.as_ref().map_or(0, Predictor::steps_left_out))
    }

    /// Memory on the device.
    pub fn memory(&self) -> MemoryUse {
        let (per_visible, per_intersection) = self.frame.bytes();
        MemoryUse {
            gaussians: self.blocks.bytes(),
            per_visible,
            per_intersection: per_intersection + self.slot_gradients.size(),
            bands: self.blocks.band_bytes(),
        }
    }

    /// Everything that a resumed run needs, with a digest at its end.
    ///
    /// # Errors
    /// When the device fails.
    pub fn checkpoint(&mut self) -> Result<Vec<u8>> {
        checkpoint::save(self)
    }

    /// The Gaussians in focus as they are now and as they are rendered: with the 3D filter of Mip-Splatting where it is
    /// on.
    ///
    /// # Errors
    /// When the device fails.
    pub fn gaussians(&mut self) -> Result<Gaussians> {
        let model = self.blocks.download(&self.gpu)?;
        if self.config.mip_filter { Ok(smoothed(model, &self.smoothing()?)) } else { Ok(model) }
    }
}
