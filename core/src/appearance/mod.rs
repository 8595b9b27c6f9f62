//! Appearances: trainable steps between Gaussians and picture, or between picture and loss.
//!
//! An appearance has parameters of its own, which are optimised with the Gaussians. Water is one, and so are
//! the exposures of the training views. Each has a file here that describes it without a GPU, and a file
//! `device.rs` that implements [`chain::Appearance`]. [`ALL`] lists them; `docs/internals/appearances.md`
//! says how to add one.
//!
//! Invariant: code outside this folder never enumerates appearances. Memory forecast, buffers, recording,
//! checkpoints and the handover of a run use the list.

#[cfg(feature = "gpu")]
pub(crate) mod adam;
#[cfg(feature = "gpu")]
pub mod chain;
pub mod exposure;
pub mod film;
#[cfg(feature = "gpu")]
pub mod water;
pub mod water_gaussians;
pub mod water_pixels;

#[cfg(feature = "gpu")]
use crate::Result;
use crate::config::{Composition, TrainConfig, WaterConfig};

/// Every appearance, in the order from the Gaussians to the loss.
pub const ALL: [Description; 4] =
    [water_gaussians::DESCRIPTION, water_pixels::DESCRIPTION, film::DESCRIPTION, exposure::DESCRIPTION];

/// An appearance, as far as it needs no GPU.
#[derive(Clone, Copy)]
pub struct Description {
    /// Its name, for messages.
    pub name: &'static str,
    /// Whether a run uses it.
    pub is_on: fn(Settings<'_>) -> bool,
    /// Its bytes per pixel of a training picture, if it is on.
    pub pixel_bytes: fn(Settings<'_>) -> u64,
    /// Creates it on the device, if it is on.
    #[cfg(feature = "gpu")]
    start: fn(&chain::Start<'_>) -> Result<Box<dyn chain::Appearance>>,
}

/// The settings that select the appearances of a run.
#[derive(Clone, Copy, Debug)]
pub struct Settings<'a> {
    /// Optimisation.
    pub train: &'a TrainConfig,
    /// The water between cameras and scene, if there is one.
    pub water: Option<(Composition, &'a WaterConfig)>,
}

impl<'a> Settings<'a> {
    /// The settings of a validated configuration.
    pub fn new(train: &'a TrainConfig, water: &'a WaterConfig) -> Self {
        let composition = water.composition().ok().flatten();
        Self { train, water: composition.map(|composition| (composition, water)) }
    }
}

/// The appearances of a run, in the order from the Gaussians to the loss.
pub fn of_run(settings: Settings<'_>) -> impl Iterator<Item = Description> {
    ALL.into_iter().filter(move |appearance| (appearance.is_on)(settings))
}

/// Bytes per pixel of a training picture, summed over all appearances of a run.
pub fn pixel_bytes(settings: Settings<'_>) -> u64 {
    of_run(settings).map(|appearance| (appearance.pixel_bytes)(settings)).sum()
}

/// Bytes per pixel of a water: the picture under water, and the dark channel if it is used.
fn water_bytes(settings: Settings<'_>) -> u64 {
    let has_dark_channel = settings.water.is_some_and(|(_, water)| water.has_dark_channel());
    PICTURE_BYTES + if has_dark_channel { DARK_CHANNEL_BYTES } else { 0 }
}

/// Bytes per pixel of the picture that an appearance passes on: a vec4.
const PICTURE_BYTES: u64 = 16;
/// Bytes per pixel of a dark channel: its signal, and minima along rows and columns (vec2 each).
const DARK_CHANNEL_BYTES: u64 = 24;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Blend, FilmConfig, JobConfig, Medium, Preset, PriorsConfig};

    fn named(train: &TrainConfig, water: &WaterConfig) -> (Vec<&'static str>, u64) {
        let settings = Settings::new(train, water);
        (of_run(settings).map(|appearance| appearance.name).collect(), pixel_bytes(settings))
    }

    #[test]
    fn configuration_selects_the_appearances() {
        let JobConfig { mut train, water, .. } = JobConfig::of_preset(Preset::Splatting);
        assert_eq!(named(&train, &water), (vec![], 0));
        train.exposure = true;
        assert_eq!(named(&train, &water), (vec!["exposure"], 16));
        assert_eq!(named(&train, &WaterConfig::default()), (vec!["water on pixels", "exposure"], 32));
        train.exposure = false;
        let film = FilmConfig { on: true, ..FilmConfig::default() };
        let priors = PriorsConfig { dark_channel: 1.0, ..PriorsConfig::default() };
        let water = WaterConfig { medium: Medium::PerGaussian, film, priors, ..WaterConfig::default() };
        assert_eq!(named(&train, &water), (vec!["water on Gaussians", "film"], 16 + 24 + 16));
        let none = WaterConfig { medium: Medium::None, ..water.clone() };
        assert_eq!(named(&train, &none), (vec![], 0), "view embeddings need a water");
        let impossible = WaterConfig { blend: Blend::OverBlack, ..water };
        assert_eq!(named(&train, &impossible).0, Vec::<&str>::new(), "validation refuses this one");
    }
}
