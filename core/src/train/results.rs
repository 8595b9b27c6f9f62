//! Results of a run so far: Gaussians, water, exposures, embeddings; and its memory use.

use std::time::Duration;

use super::{DeviceMedium, Exposures, Film, FilmEmbedding, MediumRun, MemoryUse, Predictor, Trainer};
use crate::Result;
use crate::gpu::{Blocks, Output, WaterView};
use crate::water::{StandardErrors, Water, WaterRecord};

impl Trainer {
    /// The Gaussians on the device, trained and frozen.
    pub fn blocks(&self) -> &Blocks {
        &self.blocks
    }

    /// Exposure of each training view, rows r, g, b of a 3x4 affine map of the rendered colours; empty if
    /// `train.exposure` is off.
    ///
    /// # Errors
    /// When the device fails.
    pub fn exposures(&self) -> Result<Vec<[[f32; 4]; 3]>> {
        let exposures = self.appearances.get::<Exposures>();
        exposures.map_or(Ok(Vec::new()), |exposures| exposures.download(&self.gpu))
    }

    /// Embedding of each training view, two numbers per hidden unit; empty if `water.film` is off.
    ///
    /// # Errors
    /// When the device fails.
    pub fn film_embeddings(&self) -> Result<Vec<FilmEmbedding>> {
        let film = self.appearances.get::<Film>();
        film.map_or(Ok(Vec::new()), |film| film.embeddings(&self.gpu))
    }

    /// The current water; `None` if the run has none.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water(&self) -> Result<Option<Water>> {
        self.appearances.water().map(|medium| medium.water(&self.gpu, &self.frame)).transpose()
    }

    /// One standard error of each parameter of the current water, null where nothing determines it; `None` if
    /// the run has no water.
    pub fn water_errors(&self) -> Option<StandardErrors> {
        self.appearances.water().map(DeviceMedium::standard_errors)
    }

    /// The record of the current water; `None` if the run has none.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water_record(&self, metres_per_unit: f64) -> Result<Option<WaterRecord>> {
        let record = |medium: &DeviceMedium| medium.record_of(&self.gpu, &self.frame, metres_per_unit);
        self.appearances.water().map(record).transpose()
    }

    /// How to render the trained model as its photographs show it; `None` if the run has no water.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water_view(&self) -> Result<Option<WaterView>> {
        let Some(medium) = self.appearances.water() else { return Ok(None) };
        let water = medium.water(&self.gpu, &self.frame)?;
        let refinement = medium.refinement(&self.gpu, &self.frame)?;
        let MediumRun { by_direction, composition, .. } = *medium.run();
        Ok(Some(WaterView { water, refinement, by_direction, composition, output: Output::Underwater }))
    }

    /// Skipped steps of the water, and of the network that predicts it, because a gradient was not finite.
    ///
    /// # Errors
    /// When the device fails.
    pub fn water_steps_left_out(&self) -> Result<u32> {
        let of_water = self.appearances.water().map_or(Ok(0), |medium| medium.steps_left_out(&self.gpu))?;
        Ok(of_water + self.predictor.as_ref().map_or(0, Predictor::steps_left_out))
    }

    /// How long the run has waited for photographs that were not read yet.
    pub fn waited_for_photographs(&self) -> Duration {
        self.targets.waited()
    }

    /// Device memory in use.
    pub fn memory(&self) -> MemoryUse {
        let (per_visible, per_intersection) = self.frame.bytes();
        MemoryUse {
            gaussians: self.blocks.bytes(),
            per_visible,
            per_intersection: per_intersection + self.slot_gradients.size(),
            bands: self.blocks.band_bytes(),
        }
    }
}
