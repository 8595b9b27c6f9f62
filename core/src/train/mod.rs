//! Training: one run over one set of views on one GPU.

use std::sync::Arc;

use crate::config::TrainConfig;
use crate::gaussians::Gaussians;
use crate::gpu::Gpu;
use crate::scene::Points;
use crate::views::ViewSource;
use crate::{CoreError, Result};

/// One run: what to train, on what, for how long.
pub struct TrainRun {
    /// Resolved configuration; `iterations` and `max_gaussians` are those of this run.
    pub config: TrainConfig,
    /// Extent of the whole scene (1.1 x the largest distance of a camera centre from their mean), scene
    /// units; the same for every partition, so that learning rates are.
    pub extent: f32,
    /// Views to train on.
    pub views: Arc<dyn ViewSource>,
    /// Gaussians that are trained and densified.
    pub focus: Gaussians,
    /// Gaussians that are rendered but never change.
    pub context: Gaussians,
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

/// Trains one [`TrainRun`].
pub struct Trainer {}

impl Trainer {
    /// A run from its beginning.
    ///
    /// # Errors
    /// When there are no views, no Gaussians, or the device cannot hold them.
    pub fn new(_gpu: Arc<Gpu>, _run: TrainRun) -> Result<Self> {
        Err(CoreError::Gpu("being written".into()))
    }

    /// The same run from a checkpoint of it; gives the bytes that an uninterrupted run gives.
    ///
    /// # Errors
    /// [`CoreError::Checkpoint`] when the bytes are torn or belong to another run: start anew then.
    pub fn resume(_gpu: Arc<Gpu>, _run: TrainRun, _checkpoint: &[u8]) -> Result<Self> {
        Err(CoreError::Gpu("being written".into()))
    }

    /// Runs at most `iterations` more and waits for them.
    ///
    /// # Errors
    /// When a photograph cannot be read or the device fails.
    pub fn advance(&mut self, _iterations: u32) -> Result<Progress> {
        Err(CoreError::Gpu("being written".into()))
    }

    /// Where the run stands; `iteration == iterations` means done.
    pub fn progress(&self) -> Progress {
        Progress { iteration: 0, iterations: 0, gaussians: 0, loss: 0.0 }
    }

    /// Everything that a resumed run needs, with a digest at its end.
    ///
    /// # Errors
    /// When the device fails.
    pub fn checkpoint(&mut self) -> Result<Vec<u8>> {
        Err(CoreError::Gpu("being written".into()))
    }

    /// The Gaussians in focus as they are now.
    ///
    /// # Errors
    /// When the device fails.
    pub fn gaussians(&mut self) -> Result<Gaussians> {
        Err(CoreError::Gpu("being written".into()))
    }
}

/// Gaussians at sparse points: scale from the three nearest neighbours, opacity 0.1, colour as SH 0 (3DGS).
///
/// # Errors
/// When there are no points.
pub fn gaussians_from_points(_points: &Points, _sh_degree: u8) -> Result<Gaussians> {
    Err(CoreError::Gpu("being written".into()))
}
