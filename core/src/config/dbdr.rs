//! DBDR: refines the coefficients of the water while the Gaussians are trained (SMP-UWGS section 3.2, eq. 9).

use serde::{Deserialize, Serialize};

use super::Medium;

/// The part of the water that is refined.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DbdrMode {
    /// Nothing: the water parameters keep the values of the prior.
    None,
    /// The water parameters, one value per channel, as a residual to the prior (SMP-UWGS's code, SeaSplat).
    #[default]
    Constants,
    /// The water parameters, and a factor on each coefficient that depends on the range of the pixel (eq. 9).
    /// Only where the water acts on pixels.
    Maps,
}

/// Training of the water parameters between `water.start_at` and `water.freeze_at`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DbdrConfig {
    /// Part of the water that is refined: `none`, `constants` or `maps`. Default `constants`; `maps` in the
    /// preset `paper`.
    pub mode: DbdrMode,
    /// Largest factor of a map, `Scale` of eq. 9; above 1. Default 2, so that factors start at 1 with weights
    /// and biases of 0. The paper gives none; SeaSplat has an unused 5.
    pub scale: f32,
    /// Learning rate of Adam on the two weights and two biases of the maps. Default 0.01 (SeaSplat's rate for
    /// the water).
    pub lr: f32,
}

impl Default for DbdrConfig {
    fn default() -> Self {
        Self { mode: DbdrMode::Constants, scale: 2.0, lr: 0.01 }
    }
}

impl DbdrConfig {
    /// With maps of coefficients per pixel, as printed.
    pub fn paper() -> Self {
        Self { mode: DbdrMode::Maps, ..Self::default() }
    }

    /// Reports every invalid value to `require`, by name; `medium` is where the water acts.
    pub(super) fn validate(&self, medium: Medium, require: &mut impl FnMut(bool, &str)) {
        require(
            self.mode != DbdrMode::Maps || medium != Medium::PerGaussian,
            "water.dbdr.mode = \"maps\" needs water.medium = \"per_pixel\": a map has one coefficient per pixel, \
             not per Gaussian; use water.dbdr.mode = \"constants\" where the water acts on Gaussians",
        );
        require(
            self.scale > 1.0 && self.scale.is_finite(),
            "water.dbdr.scale must be a finite number above 1: factors range from 0 to this value and start at 1",
        );
        require(self.lr >= 0.0 && self.lr.is_finite(), "water.dbdr.lr must be a finite number, 0 or more");
    }
}

#[cfg(test)]
mod tests {
    use super::super::{JobConfig, Preset};
    use super::*;

    fn with(medium: Medium, mode: DbdrMode) -> JobConfig {
        let mut config = JobConfig::default();
        (config.water.medium, config.water.dbdr.mode) = (medium, mode);
        config
    }

    #[test]
    fn maps_need_water_on_pixels_and_presets_are_valid() {
        let fault = |config: JobConfig| config.validate().err().map(|error| error.to_string());
        let refused = fault(with(Medium::PerGaussian, DbdrMode::Maps)).unwrap_or_default();
        assert!(refused.contains("water.dbdr.mode") && refused.contains("per_pixel"), "{refused}");
        for medium in [Medium::PerPixel, Medium::None] {
            assert_eq!(fault(with(medium, DbdrMode::Maps)), None, "{medium:?}");
        }
        assert_eq!(fault(with(Medium::PerGaussian, DbdrMode::None)), None);
        for preset in [Preset::Fathom, Preset::Paper, Preset::Splatting] {
            assert_eq!(fault(JobConfig::of_preset(preset)), None, "{preset:?}");
        }
        assert_eq!(JobConfig::of_preset(Preset::Paper).water.dbdr.mode, DbdrMode::Maps);
        let mut flat = with(Medium::PerPixel, DbdrMode::Maps);
        flat.water.dbdr = DbdrConfig { scale: 1.0, lr: -1.0, ..flat.water.dbdr };
        let refused = fault(flat).unwrap_or_default();
        assert!(refused.contains("water.dbdr.scale") && refused.contains("water.dbdr.lr"), "{refused}");
    }

    #[test]
    fn water_descends_if_any_part_of_it_has_a_rate() {
        let mut water = JobConfig::default().water;
        assert!(water.descends());
        water.lr = 0.0;
        assert!(water.descends(), "the rate rises from 0");
        water.lr_end = 0.0;
        assert!(!water.descends());
        water.dbdr.mode = DbdrMode::Maps;
        assert!(water.descends(), "maps alone");
        water.freeze_at = water.start_at;
        assert!(!water.descends());
        water.freeze_at = 1.0;
        water.dbdr.mode = DbdrMode::None;
        assert!(!water.descends());
    }
}
