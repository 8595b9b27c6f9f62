//! The water of a run and the settings that depend on it: parameter rates, the maximum width of Gaussians,
//! and the loss terms that are off in clear water.

use crate::config::{Composition, DbdrMode, WaterConfig};
use crate::water::{ByDirection, RangeModulation, Water, WaterRecord};

/// Relative standard error from which a parameter is optimised at the full rate. A smaller error reduces the
/// rate in proportion to the variance, since weak evidence should barely move a known value.
const UNSURE: f64 = 0.25;
/// Standard deviation allowed for any Gaussian, in units of [`Water::half_distance`]: its edges, two
/// deviations off, are hardly hidden. Compared with a limit of half the scene scale, held-out views improved
/// from 26.83 to 26.98 dB on reef-clip. On fox, which has no water, they improved from 31.24 to 31.60 dB.
const WIDEST_IN_HALVES: f64 = 0.15;
/// Minimum share of the clearest channel's light that the water takes at the scene scale to count as a veil.
/// It is 0.44 for sesa-wreck and 0.001 for reef-clip, where the term that closes surfaces cost 0.3 dB.
const LEAST_VEIL: f64 = 0.05;

/// The same share from which sparse points locate surfaces better than photographs: 0.43 for sesa-wreck.
const THICK_VEIL: f64 = 0.25;

/// The water of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumRun {
    /// Its settings. The keys `medium` and `blend` are those of the user; `composition` is what applies.
    pub config: WaterConfig,
    /// Where it acts, and how Gaussians are blended.
    pub composition: Composition,
    /// The water parameters at the start.
    pub water: Water,
    /// Range modulation at the start, if there is any; only for a water on pixels.
    pub refinement: Option<RangeModulation>,
    /// Change of the open-water colour with direction, if there is any; only for a water on pixels.
    pub by_direction: Option<ByDirection>,
    /// Channels whose parameters are fixed: for those from the darkest pixels, descent has no information.
    pub stays: [bool; 3],
    /// Whether photographs show open water, with ray maps of the views ([`crate::water::OpenWater`]); `None`
    /// if they were not searched.
    pub shows_open_water: Option<bool>,
    /// Factor on the unconstrained parameters: the scene scale, scene units.
    pub unit: f64,
    /// Whether the parameters are optimised in their part of the run.
    pub is_free: bool,
    /// Standard errors of the water parameters at the start, in the order of eq. 8, if known. Descent does
    /// not change them; WaterParamPredict replaces them by those of its predictions.
    pub standard_error: Option<[f64; 9]>,
    /// Source of the parameters, as in [`WaterRecord::source`].
    pub source: &'static str,
    /// Set if WaterParamPredict predicts the parameters in the first part of the run, near `water`. `None`
    /// for a fixed water.
    pub network: Option<NetworkRun>,
}

/// A run that begins with WaterParamPredict.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NetworkRun {
    /// The water parameters of the sparse estimate and their standard errors, in the order of eq. 8, if
    /// available. The predictions are compared with them.
    pub sparse: Option<([f64; 9], [f64; 9])>,
}

impl MediumRun {
    /// A water that starts from the configured parameters; `unit` is the scene scale.
    pub fn fixed(config: &WaterConfig, composition: Composition, unit: f64) -> Self {
        let in_scene_units = |beta: [f64; 3]| beta.map(|value| value / unit);
        let water = Water {
            beta_d: in_scene_units(config.start_beta_d),
            beta_b: in_scene_units(config.start_beta_b),
            b_inf: config.start_b_inf,
        };
        let maps = composition.acts_on_pixels() && config.dbdr.mode == DbdrMode::Maps;
        let refinement = maps.then(|| RangeModulation::identity(config.dbdr.scale.into(), unit));
        Self {
            config: config.clone(),
            composition,
            water,
            refinement,
            by_direction: None,
            stays: [false; 3],
            shows_open_water: None,
            unit,
            is_free: true,
            standard_error: None,
            source: "fixed",
            network: None,
        }
    }

    /// Share of the learning rate for each parameter: its relative variance divided by that of [`UNSURE`], at
    /// most 1.
    pub(super) fn shares_of_rate(&self, water: &Water, standard_error: Option<[f64; 9]>) -> [f32; 9] {
        let Some(errors) = standard_error else { return [1.0; 9] };
        let numbers = water.to_array();
        std::array::from_fn(|i| {
            let share = (errors[i] / numbers[i].max(1e-9) / UNSURE).powi(2);
            if self.stays[i % 3] {
                0.0
            } else if share.is_finite() {
                share.clamp(0.0, 1.0) as f32
            } else {
                1.0
            }
        })
    }

    /// Largest standard deviation that a Gaussian may have, scene units.
    ///
    /// The clearer the water, the larger the limit: whatever is visible behind the scene has its own colour,
    /// and water without a veil needs no limit.
    pub fn largest_deviation(&self) -> f32 {
        match self.config.largest_deviation {
            0.0 => f32::INFINITY,
            share => (f64::from(share) * self.unit).max(WIDEST_IN_HALVES * self.water.half_distance()) as f32,
        }
    }

    /// Whether the water is too clear to be a veil at the scene scale. A model blended over black stays clear
    /// whatever its parameters become: terms that treat the background as open water would contradict it.
    fn is_clear(&self) -> bool {
        let no_veil = self.veil() < LEAST_VEIL;
        self.composition == Composition::PixelsOverBlack || (no_veil && self.shows_open_water != Some(true))
    }

    /// Share of the clearest channel's light that the water takes at the scene scale.
    fn veil(&self) -> f64 {
        1.0 - 0.5_f64.powf(self.unit / self.water.half_distance())
    }

    /// Blends over black if the water is clear and the configuration allows it (`water.clear_over_black`).
    #[must_use]
    pub(crate) fn over_black_if_clear(mut self) -> Self {
        let may_be = self.config.clear_over_black && !self.config.has_dark_channel();
        if may_be && self.composition == Composition::PixelsSrgb && self.is_clear() {
            self.composition = Composition::PixelsOverBlack;
        }
        self
    }

    /// `weight`, but 0 in clear water.
    fn where_veiled(&self, weight: f32) -> f32 {
        if self.is_clear() { 0.0 } else { weight }
    }

    /// Maximum distance of a pixel from the colour of open water to count as such. If photographs were
    /// searched and show no open water, it is 0: every ray ends on a surface. Otherwise the dark bluish floor
    /// of a sparse survey was taken for open water, and nothing held it in place.
    pub(super) fn background_distance(&self) -> f32 {
        if self.shows_open_water == Some(false) { 0.0 } else { self.config.alpha_background_distance }
    }

    /// The effective weight of `alpha_background`. In clear water it is 0: a ray without a hit ends on
    /// Gaussians behind the scene, and the open-water colour is unknown. Without the term, held-out views of
    /// reef-clip improved from 26.92 to 27.09 dB.
    pub(super) fn background_weight(&self) -> f32 {
        self.where_veiled(self.config.alpha_background)
    }

    /// The effective weight of `surface_alpha_weight`. In clear water it is 0: the colour of open water is no
    /// different there, so the term only does harm.
    pub(super) fn surface_weight(&self) -> f32 {
        self.where_veiled(self.config.surface_alpha_weight)
    }

    /// The effective weight of ranges that differ from those of the sparse points. In clear water it is 0,
    /// since the picture itself locates surfaces.
    pub(super) fn range_weight(&self) -> f32 {
        self.where_veiled(self.config.sparse_ranges)
    }

    /// Tolerance of the logarithm of a range relative to the sparse points. Through a veil, points locate
    /// surfaces better than photographs. Otherwise photographs do, since cells are coarse and surfaces cross
    /// them at an angle. At 3 %, held-out views of seathru-japan and seathru-curasao lost 0.2 dB; at a fifth,
    /// those of a sparse survey lost 0.7 dB.
    pub fn range_slack(&self) -> f32 {
        if self.veil() < THICK_VEIL { 0.2 } else { 0.03 }
    }

    /// Minimum optical depth of the Gaussians around a sparse point. In clear water it is 0, since the
    /// picture itself locates surfaces.
    pub(crate) fn least_cover(&self) -> f32 {
        self.where_veiled(self.config.least_cover)
    }

    /// The effective weight of colours above white. In clear water it is 0: the photograph shows J itself,
    /// which exceeds white in a channel with little light. On reef-clip, where a seventh of the red light
    /// arrives, the term cost 2 % of the contrast of red. It is also 0 if photographs show open water. The
    /// water is then kept empty by these observations, and bright sand under a lamp or in sunlight may exceed
    /// white.
    pub(crate) fn saturation_weight(&self) -> f32 {
        if self.shows_open_water == Some(true) {
            0.0
        } else {
            self.where_veiled(self.config.overwhite_weight)
        }
    }

    /// Learning-rate scale of the higher SH bands. In clear water, sunlight moves over the scene between
    /// photographs. With a high enough rate, the higher bands absorb it instead of veils in front of the
    /// cameras, and the constant colour keeps its mean. In murky water they would only fit noise. A scene
    /// viewed from one side has such light too: on seathru-japan the gain was 0.2 dB and 0.0024 of SSIM.
    pub(crate) fn harmonics_lr_scale(&self) -> f32 {
        if self.is_clear() || self.shows_open_water == Some(true) { self.config.clear_harmonics } else { 1.0 }
    }

    /// The fixed water of a model that was trained before.
    pub fn of_record(record: &WaterRecord, config: &WaterConfig, unit: f64) -> Self {
        Self {
            config: config.clone(),
            composition: record.composition,
            water: record.water(),
            refinement: record.refinement,
            by_direction: record.by_direction,
            stays: [false; 3],
            shows_open_water: record.shows_open_water,
            unit,
            is_free: false,
            standard_error: Some(record.standard_error.to_array()),
            source: "",
            network: None,
        }
    }

    /// The same water, optimised further, each parameter in proportion to its variance.
    pub fn going_on(record: &WaterRecord, config: &WaterConfig, unit: f64) -> Self {
        Self { is_free: true, ..Self::of_record(record, config, unit) }
    }

    /// Multiplies all loss terms of the water by `factor` (`partition.weights = loss_factor`).
    #[must_use]
    pub(crate) fn times(mut self, factor: f32) -> Self {
        let WaterConfig {
            alpha_background,
            alpha_open,
            sparse_ranges,
            surface_alpha_weight,
            overwhite_weight,
            floater_weight,
            l2_weight,
            priors,
            ..
        } = &mut self.config;
        for weight in [
            alpha_background,
            alpha_open,
            sparse_ranges,
            surface_alpha_weight,
            overwhite_weight,
            floater_weight,
            l2_weight,
            &mut priors.dark_channel,
            &mut priors.depth_smoothness,
        ] {
            *weight *= factor;
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clear_water_is_blended_over_black_if_allowed() {
        use Composition::{GaussiansSrgb, PixelsLinear, PixelsOverBlack, PixelsSrgb};
        let of = |beta: f64, config: WaterConfig, composition: Composition| {
            let water = Water { beta_d: [9.0, beta, 0.1 * beta], ..Water::COASTAL };
            MediumRun { water, ..MediumRun::fixed(&config, composition, 7.0) }
                .over_black_if_clear()
                .composition
        };
        let default = WaterConfig::default;
        assert_eq!(of(1e-3, default(), PixelsSrgb), PixelsOverBlack);
        assert_eq!(of(1.0, default(), PixelsSrgb), PixelsSrgb);
        assert_eq!(of(1.0, default(), PixelsOverBlack), PixelsOverBlack);
        let mut with_prior = default();
        with_prior.priors.dark_channel = 1.0;
        for (config, composition) in [
            (WaterConfig { clear_over_black: false, ..default() }, PixelsSrgb),
            (default(), GaussiansSrgb),
            (default(), PixelsLinear),
            (with_prior, PixelsSrgb),
        ] {
            assert_eq!(of(1e-3, config, composition), composition);
        }
    }

    #[test]
    fn gaussians_may_be_wider_in_clear_water() {
        let widest = |clearest: f64, share: f32| {
            let config = WaterConfig { largest_deviation: share, ..WaterConfig::default() };
            let water = Water { beta_d: [0.9, clearest, 2.0 * clearest], ..Water::COASTAL };
            MediumRun { water, ..MediumRun::fixed(&config, Composition::PixelsSrgb, 3.0) }.largest_deviation()
        };
        assert_eq!(widest(0.5, 0.5), 1.5);
        // The clearest channel loses half of its light after ln 2 / 0.01 = 69 units.
        assert!((widest(0.01, 0.5) - 0.15 * 69.3).abs() < 0.01);
        assert_eq!(widest(0.0, 0.5), f32::INFINITY);
        assert_eq!(widest(0.5, 0.0), f32::INFINITY);
    }

    #[test]
    fn terms_against_veils_are_off_in_clear_water() {
        let of = |clearest: f64, unit: f64| {
            let water = Water { beta_d: [0.9, clearest, 2.0 * clearest], ..Water::COASTAL };
            let run = MediumRun {
                water,
                ..MediumRun::fixed(&WaterConfig::default(), Composition::PixelsSrgb, unit)
            };
            [run.background_weight(), run.surface_weight(), run.saturation_weight()]
        };
        let WaterConfig { alpha_background, surface_alpha_weight, overwhite_weight, .. } =
            WaterConfig::default();
        assert_eq!(
            [of(0.08, 7.0), of(0.08, 0.7)],
            [[alpha_background, surface_alpha_weight, overwhite_weight]; 2]
        );
        assert_eq!([of(0.08, 0.5), of(1e-4, 25.0), of(0.0, 25.0)], [[0.0; 3]; 3]);
    }

    #[test]
    fn range_slack_and_cover_depend_on_the_veil() {
        let of = |clearest: f64| {
            let water = Water { beta_d: [0.9, clearest, 2.0 * clearest], ..Water::COASTAL };
            let run = MediumRun {
                water,
                ..MediumRun::fixed(&WaterConfig::default(), Composition::PixelsSrgb, 7.0)
            };
            (run.range_slack(), run.least_cover())
        };
        let least_cover = WaterConfig::default().least_cover;
        assert_eq!([of(0.08), of(0.02), of(1e-4)], [(0.03, least_cover), (0.2, least_cover), (0.2, 0.0)]);
    }

    #[test]
    fn model_over_black_counts_as_clear_whatever_its_water() {
        let (config, over_black) = (WaterConfig::default(), Composition::PixelsOverBlack);
        let water = Water { beta_d: [0.9, 0.01, 0.02], ..Water::COASTAL };
        let run = MediumRun { water, ..MediumRun::fixed(&config, over_black, 7.0) };
        let weights = [run.background_weight(), run.surface_weight(), run.saturation_weight()];
        assert_eq!((weights, run.harmonics_lr_scale()), ([0.0; 3], config.clear_harmonics));
        assert_eq!(run.over_black_if_clear().composition, over_black);
    }

    #[test]
    fn only_clear_water_raises_the_rate_of_harmonics() {
        let of = |clearest: f64| {
            let water = Water { beta_d: [0.9, clearest, 2.0 * clearest], ..Water::COASTAL };
            let config = WaterConfig { clear_harmonics: 3.0, ..WaterConfig::default() };
            MediumRun { water, ..MediumRun::fixed(&config, Composition::PixelsSrgb, 7.0) }
                .harmonics_lr_scale()
        };
        assert_eq!([of(1e-3), of(0.0), of(0.08)], [3.0, 3.0, 1.0]);
    }

    #[test]
    fn rate_share_is_proportional_to_the_relative_variance() {
        let unit = 10.0;
        let run = MediumRun::fixed(&WaterConfig::default(), Composition::PixelsSrgb, unit);
        let water = Water { beta_d: [0.4, 0.04, 0.0], beta_b: [0.4, 0.04, 0.04], b_inf: [0.1, 0.1, 0.1] };
        let errors = [0.04, 0.004, 0.001, f64::INFINITY, 0.01, 0.02, 0.0, 0.0125, f64::NAN];
        let shares = run.shares_of_rate(&water, Some(errors));
        // A relative error of a tenth is four tenths of a quarter, in murky water and in clear.
        for (share, expected) in shares.iter().zip([0.16, 0.16, 1.0, 1.0, 1.0, 1.0, 0.0, 0.25, 1.0]) {
            assert!((share - expected).abs() < 1e-6, "{shares:?}");
        }
        assert_eq!(run.shares_of_rate(&water, None), [1.0; 9]);
    }
}
