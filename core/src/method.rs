//! The interface between a worker and a training run of any method.
//!
//! A [`Method`] names what trains a scene; [`start`] begins a [`Run`] of it. A worker advances the run,
//! reports progress, keeps checkpoints and takes the result; it depends on nothing else.

use std::sync::Arc;
use std::time::Duration;

use crate::Result;
use crate::gaussians::Gaussians;
use crate::gpu::Gpu;
use crate::scene::{PinholeCamera, Pose};
use crate::surface::SurfaceModel;
use crate::train::surface::SurfaceTrainer;
use crate::train::{HeldOutMetrics, Preview, Progress, TrainRun, Trainer};
use crate::views::ViewSource;
use crate::water::{StandardErrors, Water, WaterRecord};

pub use crate::config::Method;

/// What a run has trained.
pub struct Trained {
    /// The model.
    pub gaussians: Gaussians,
    /// The whole scene if it has a water surface; `gaussians` is then the scene without it.
    pub surface: Option<SurfaceModel>,
    /// Its water, if the run has one.
    pub water: Option<WaterRecord>,
    /// Optimiser steps of the water that were skipped because a gradient was not finite.
    pub skipped_steps: u32,
}

/// A training run, from its start or a checkpoint to its end.
pub trait Run {
    /// Runs at most `iterations` more and waits for them.
    ///
    /// # Errors
    /// When a photograph cannot be read or the device fails.
    fn advance(&mut self, iterations: u32) -> Result<Progress>;

    /// Progress of the run; `iteration == iterations` means done.
    fn progress(&self) -> Progress;

    /// Everything that a resumed run needs, with a digest at its end.
    ///
    /// # Errors
    /// When the device fails.
    fn checkpoint(&mut self) -> Result<Vec<u8>>;

    /// Sets the run to the state of `checkpoint`.
    ///
    /// # Errors
    /// [`crate::CoreError::Checkpoint`] when it is damaged or belongs to another run; the run then keeps its
    /// state.
    fn go_to(&mut self, checkpoint: &[u8]) -> Result<()>;

    /// Measures the model on `held_out` views. `None` without such views, or when `go_on`, which is called
    /// before each view, returns false.
    ///
    /// # Errors
    /// When a photograph cannot be read, or the device cannot hold a second copy of the model.
    fn measure(
        &mut self,
        held_out: &dyn ViewSource,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Option<HeldOutMetrics>>;

    /// Small pictures of what the run sees now, with the first of these cameras, as long as `go_on`, which is
    /// called before each picture, returns true. They change nothing.
    ///
    /// # Errors
    /// When the device fails, or has no memory for them.
    fn preview(
        &mut self,
        cameras: &[(PinholeCamera, Pose)],
        go_on: &dyn Fn() -> bool,
    ) -> Result<Vec<Preview>>;

    /// The water as it is now; `None` if the run has none.
    ///
    /// # Errors
    /// When the device fails.
    fn water(&self) -> Result<Option<Water>>;

    /// One standard error of each parameter of that water, null where nothing determines it; `None` if the
    /// run has no water.
    fn water_errors(&self) -> Option<StandardErrors>;

    /// How long the run has waited for photographs that were not read yet.
    fn waited_for_photographs(&self) -> Duration;

    /// What the run has trained so far; a `metres_per_unit` of 0 means unknown.
    ///
    /// # Errors
    /// When the device fails.
    fn hand_in(&mut self, metres_per_unit: f64) -> Result<Trained>;
}

/// Begins a run of a method.
///
/// # Errors
/// When there are no views, nothing to train, or the device cannot hold the run.
pub fn start(method: Method, gpu: Arc<Gpu>, run: TrainRun) -> Result<Box<dyn Run>> {
    match method {
        // The configuration of the run says which of the two it is.
        Method::Splats | Method::Disks => Ok(Box::new(Trainer::new(gpu, run)?)),
        Method::Surface => Ok(Box::new(SurfaceTrainer::new(gpu, run)?)),
    }
}

impl Run for Trainer {
    fn advance(&mut self, iterations: u32) -> Result<Progress> {
        self.advance(iterations)
    }

    fn progress(&self) -> Progress {
        self.progress()
    }

    fn checkpoint(&mut self) -> Result<Vec<u8>> {
        self.checkpoint()
    }

    fn go_to(&mut self, checkpoint: &[u8]) -> Result<()> {
        self.go_to(checkpoint)
    }

    fn measure(
        &mut self,
        held_out: &dyn ViewSource,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Option<HeldOutMetrics>> {
        self.measure(held_out, go_on)
    }

    fn preview(
        &mut self,
        cameras: &[(PinholeCamera, Pose)],
        go_on: &dyn Fn() -> bool,
    ) -> Result<Vec<Preview>> {
        self.preview(cameras, go_on)
    }

    fn water(&self) -> Result<Option<Water>> {
        self.water()
    }

    fn water_errors(&self) -> Option<StandardErrors> {
        self.water_errors()
    }

    fn waited_for_photographs(&self) -> Duration {
        self.waited_for_photographs()
    }

    fn hand_in(&mut self, metres_per_unit: f64) -> Result<Trained> {
        Ok(Trained {
            gaussians: self.gaussians()?,
            surface: None,
            water: self.water_record(metres_per_unit)?,
            skipped_steps: self.water_steps_left_out()?,
        })
    }
}

impl Run for SurfaceTrainer {
    fn advance(&mut self, iterations: u32) -> Result<Progress> {
        self.advance(iterations)
    }

    fn progress(&self) -> Progress {
        self.progress()
    }

    fn checkpoint(&mut self) -> Result<Vec<u8>> {
        self.checkpoint()
    }

    fn go_to(&mut self, checkpoint: &[u8]) -> Result<()> {
        self.go_to(checkpoint)
    }

    fn measure(
        &mut self,
        held_out: &dyn ViewSource,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Option<HeldOutMetrics>> {
        self.measure(held_out, go_on)
    }

    fn preview(
        &mut self,
        cameras: &[(PinholeCamera, Pose)],
        go_on: &dyn Fn() -> bool,
    ) -> Result<Vec<Preview>> {
        self.preview(cameras, go_on)
    }

    fn water(&self) -> Result<Option<Water>> {
        Ok(None)
    }

    fn water_errors(&self) -> Option<StandardErrors> {
        None
    }

    fn waited_for_photographs(&self) -> Duration {
        self.waited_for_photographs()
    }

    fn hand_in(&mut self, _metres_per_unit: f64) -> Result<Trained> {
        let model = self.model()?;
        Ok(Trained {
            gaussians: model.dry(),
            surface: Some(model),
            water: None,
            skipped_steps: self.steps_left_out()?,
        })
    }
}
