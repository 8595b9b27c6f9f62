//! The water that a run has, and what follows from it before a step is taken: how fast each number moves, how
//! wide Gaussians may be, and which terms say nothing in water that is no veil.

use crate::config::{Composition, DbdrMode, WaterConfig};
use crate::water::{ByDirection, RangeModulation, Water, WaterRecord};

/// Standard error of a number, as a share of it, from which it moves at the full rate; a surer one in
/// proportion to its variance, as weak evidence moves what is known.
const UNSURE: f64 = 0.25;
/// Deviation that any Gaussian may have, in [`Water::half_distance`]: its edges, two deviations off, are
/// hardly hidden. Against half the viewing distance alone, held-out views of reef-clip went from 26.83 to
/// 26.98 dB and those of fox, which has no water, from 31.24 to 31.60 dB.
const WIDEST_IN_HALVES: f64 = 0.15;
/// Share of the light of the clearest channel that a water takes at the usual viewing distance before it
/// counts as a veil: 0.44 for sesa-wreck and 0.001 for reef-clip, where the term that closes surfaces cost
/// 0.3 dB.
const LEAST_VEIL: f64 = 0.05;

/// The same from which sparse points know better than photographs where a surface is: 0.43 for sesa-wreck.
const THICK_VEIL: f64 = 0.25;

/// The water that a run has.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumRun {
    /// How it is stepped. Its keys `medium` and `blend` are what the user wrote: `composition` is what holds.
    pub config: WaterConfig,
    /// Where it acts, and how Gaussians are blended.
    pub composition: Composition,
    /// The nine numbers at the start.
    pub water: Water,
    /// How the coefficients follow from range at the start, where they do: only where the water acts on
    /// pixels.
    pub refinement: Option<RangeModulation>,
    /// How the colour of open water changes with direction, where it does: only where the water acts on
    /// pixels.
    pub by_direction: Option<ByDirection>,
    /// Channels whose numbers stay as they are: descent has nothing to say where the darkest pixels had to.
    pub stays: [bool; 3],
    /// Whether photographs show open water, and views have maps of where ([`crate::water::OpenWater`]);
    /// `None` where nobody looked.
    pub shows_open_water: Option<bool>,
    /// Scene units by which the unconstrained numbers are multiplied: the usual viewing distance.
    pub unit: f64,
    /// Whether the numbers move in their part of the run; else they stay as they are.
    pub is_free: bool,
    /// Of the nine numbers at the start, in the order of eq. 8, where something says how sure they are.
    /// Descent has none of its own, so they stay those of the start, or are those of what WaterParamPredict
    /// said of the views.
    pub standard_error: Option<[f64; 9]>,
    /// Where they come from: as [`WaterRecord::source`].
    pub source: &'static str,
    /// There where WaterParamPredict decides them in the first part of the run, near `water`; not where they
    /// are not free.
    pub network: Option<NetworkRun>,
}

/// A run that begins with WaterParamPredict.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NetworkRun {
    /// The nine numbers by the sparse points with their standard errors, in the order of eq. 8, where they
    /// tell something: what the network found is compared with them.
    pub sparse: Option<([f64; 9], [f64; 9])>,
}

impl MediumRun {
    /// A water that starts from the numbers of the configuration; `unit` is the usual viewing distance.
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

    /// What share of the rate each number has: its relative variance as a share of that of [`UNSURE`]; at
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
    /// The clearer the water the wider: what stands behind a scene and is seen has a colour of its own, and a
    /// water that hides nothing needs no limit.
    pub fn largest_deviation(&self) -> f32 {
        match self.config.largest_deviation {
            0.0 => f32::INFINITY,
            share => (f64::from(share) * self.unit).max(WIDEST_IN_HALVES * self.water.half_distance()) as f32,
        }
    }

    /// Whether the water is so clear that it is no veil before anything at the usual viewing distance. A
    /// model over black stays one, whatever its numbers become: what takes open water for what is behind
    /// would contradict it.
    fn is_clear(&self) -> bool {
        let no_veil = self.veil() < LEAST_VEIL;
        self.composition == Composition::PixelsOverBlack || (no_veil && self.shows_open_water != Some(true))
    }

    /// Share of the light of the clearest channel that the water takes at the usual viewing distance.
    fn veil(&self) -> f64 {
        1.0 - 0.5_f64.powf(self.unit / self.water.half_distance())
    }

    /// The same, blended over black in clear water where the configuration lets it
    /// (`water.clear_over_black`).
    #[must_use]
    pub(crate) fn over_what_is_behind(mut self) -> Self {
        let may_be = self.config.clear_over_black && !self.config.has_dark_channel();
        if may_be && self.composition == Composition::PixelsSrgb && self.is_clear() {
            self.composition = Composition::PixelsOverBlack;
        }
        self
    }

    /// `weight`, but nothing in clear water.
    fn where_veiled(&self, weight: f32) -> f32 {
        if self.is_clear() { 0.0 } else { weight }
    }

    /// How near to the colour of open water a pixel must be to count as that. Where photographs were searched
    /// for open water and show none, every ray ends on a surface, whatever its colour: the dark bluish floor
    /// of a sparse survey was else taken for open water, and nothing held it.
    pub(super) fn background_distance(&self) -> f32 {
        if self.shows_open_water == Some(false) { 0.0 } else { self.config.alpha_background_distance }
    }

    /// What `alpha_background` weighs. In clear water a ray that meets nothing ends on Gaussians behind the
    /// scene, and nobody knows the colour of open water: without the term held-out views of reef-clip went
    /// from 26.92 to 27.09 dB.
    pub(super) fn background_weight(&self) -> f32 {
        self.where_veiled(self.config.alpha_background)
    }

    /// What `surface_alpha_weight` weighs. In clear water open water has no other colour to be told from, and
    /// the term only stands in the way.
    pub(super) fn surface_weight(&self) -> f32 {
        self.where_veiled(self.config.surface_alpha_weight)
    }

    /// What ranges that are far from those of the sparse points weigh. In clear water the picture itself
    /// holds surfaces where they are.
    pub(super) fn range_weight(&self) -> f32 {
        self.where_veiled(self.config.sparse_ranges)
    }

    /// By how much the logarithm of a range may be off that of the sparse points. Through a veil the points
    /// know better than the photographs where a surface is; else the photographs do, and cells are coarse,
    /// with surfaces that run through them aslant. At 3 % held-out views of seathru-japan and seathru-curasao
    /// lost 0.2 dB; at a fifth those of a sparse survey lost 0.7 dB.
    pub fn range_slack(&self) -> f32 {
        if self.veil() < THICK_VEIL { 0.2 } else { 0.03 }
    }

    /// Optical depth that the Gaussians around a sparse point must have. In clear water the picture itself
    /// holds surfaces.
    pub(crate) fn least_cover(&self) -> f32 {
        self.where_veiled(self.config.least_cover)
    }

    /// What colours above white weigh. In clear water the photograph holds J itself, which is above white in
    /// a channel of which little arrives: the term took 2 % of the contrast of red on reef-clip, of which a
    /// seventh arrives. Nor where photographs show open water: that is kept empty by what they show, and
    /// bright sand under a lamp or the sun may be above white.
    pub(crate) fn saturation_weight(&self) -> f32 {
        if self.shows_open_water == Some(true) {
            0.0
        } else {
            self.where_veiled(self.config.overwhite_weight)
        }
    }

    /// By what the rate of the higher bands is multiplied. In clear water there is sunlight, which moves over
    /// the scene from one photograph to the next. Colours by direction take it up as well as veils before the
    /// cameras do, at rates that suffice, and leave the constant colour its mean. In murky water they would
    /// only take up noise. A scene that is looked at from one side has light of that kind too: on
    /// seathru-japan 0.2 dB and 0.0024 of SSIM.
    pub(crate) fn harmonics_lr_scale(&self) -> f32 {
        if self.is_clear() || self.shows_open_water == Some(true) { self.config.clear_harmonics } else { 1.0 }
    }

    /// The water of a model that was trained before, which stays as it is.
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

    /// The same, but it moves from there, each number in proportion to its variance.
    pub fn going_on(record: &WaterRecord, config: &WaterConfig, unit: f64) -> Self {
        Self { is_free: true, ..Self::of_record(record, config, unit) }
    }

    /// The same with every term of the loss that the water adds multiplied by `factor`
    /// (`partition.weights = loss_factor`).
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
    fn clear_water_is_blended_over_black_where_it_may_be() {
        use Composition::{GaussiansSrgb, PixelsLinear, PixelsOverBlack, PixelsSrgb};
        let of = |beta: f64, config: WaterConfig, composition: Composition| {
            let water = Water { beta_d: [9.0, beta, 0.1 * beta], ..Water::COASTAL };
            MediumRun { water, ..MediumRun::fixed(&config, composition, 7.0) }
                .over_what_is_behind()
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
    fn gaussians_may_be_wide_in_clear_water_and_in_murky_water_half_of_a_viewing_distance() {
        let widest = |clearest: f64, share: f32| {
            let config = WaterConfig { largest_deviation: share, ..WaterConfig::default() };
            let water = Water { beta_d: [0.9, clearest, 2.0 * clearest], ..Water::COASTAL };
            MediumRun { water, ..MediumRun::fixed(&config, Composition::PixelsSrgb, 3.0) }.largest_deviation()
        };
        assert_eq!(widest(0.5, 0.5), 1.5);
        // Half of the light of the clearest channel is gone after ln 2 / 0.01 = 69 units.
        assert!((widest(0.01, 0.5) - 0.15 * 69.3).abs() < 0.01);
        assert_eq!(widest(0.0, 0.5), f32::INFINITY);
        assert_eq!(widest(0.5, 0.0), f32::INFINITY);
    }

    #[test]
    fn terms_that_tell_scene_from_water_weigh_nothing_where_the_water_is_no_veil() {
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
    fn sparse_points_hold_ranges_closely_behind_a_veil_alone_and_clear_water_needs_no_cover() {
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
    fn a_model_over_black_keeps_what_clear_water_has_when_its_water_turns_out_not_to_be_clear() {
        let (config, over_black) = (WaterConfig::default(), Composition::PixelsOverBlack);
        let water = Water { beta_d: [0.9, 0.01, 0.02], ..Water::COASTAL };
        let run = MediumRun { water, ..MediumRun::fixed(&config, over_black, 7.0) };
        let weights = [run.background_weight(), run.surface_weight(), run.saturation_weight()];
        assert_eq!((weights, run.harmonics_lr_scale()), ([0.0; 3], config.clear_harmonics));
        assert_eq!(run.over_what_is_behind().composition, over_black);
    }

    #[test]
    fn clear_water_alone_raises_the_rate_of_harmonics() {
        let of = |clearest: f64| {
            let water = Water { beta_d: [0.9, clearest, 2.0 * clearest], ..Water::COASTAL };
            let config = WaterConfig { clear_harmonics: 3.0, ..WaterConfig::default() };
            MediumRun { water, ..MediumRun::fixed(&config, Composition::PixelsSrgb, 7.0) }
                .harmonics_lr_scale()
        };
        assert_eq!([of(1e-3), of(0.0), of(0.08)], [3.0, 3.0, 1.0]);
    }

    #[test]
    fn a_number_moves_in_proportion_to_its_relative_variance_and_freely_where_it_is_unknown() {
        let unit = 10.0;
        let run = MediumRun::fixed(&WaterConfig::default(), Composition::PixelsSrgb, unit);
        let water = Water { beta_d: [0.4, 0.04, 0.0], beta_b: [0.4, 0.04, 0.04], b_inf: [0.1, 0.1, 0.1] };
        let errors = [0.04, 0.004, 0.001, f64::INFINITY, 0.01, 0.02, 0.0, 0.0125, f64::NAN];
        let shares = run.shares_of_rate(&water, Some(errors));
        // A tenth is four tenths of a quarter, in murky water as in clear.
        for (share, expected) in shares.iter().zip([0.16, 0.16, 1.0, 1.0, 1.0, 1.0, 0.0, 0.25, 1.0]) {
            assert!((share - expected).abs() < 1e-6, "{shares:?}");
        }
        assert_eq!(run.shares_of_rate(&water, None), [1.0; 9]);
    }
}
