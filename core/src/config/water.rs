//! The water of a job: how it is composed, what it starts from and when it moves.

use serde::{Deserialize, Serialize};

use super::{DbdrConfig, DbdrMode, FilmConfig, NetworkConfig, PriorsConfig, WaterPartitions};
use crate::CoreError;

/// Where the water acts (docs/decisions/0005).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Medium {
    /// Nothing between camera and scene: training and blending in sRGB, as in 3DGS.
    None,
    /// On each Gaussian before blending, by its own range: exact for layers, no division by alpha.
    #[default]
    PerGaussian,
    /// On each pixel, by the expected range (SMP-UWGS eq. 7).
    PerPixel,
}

/// In which light Gaussians are blended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Blend {
    /// In sRGB, as every viewer blends: J is what any of them shows. The water itself acts in linear light,
    /// on each Gaussian or on the picture that comes of it.
    #[default]
    Srgb,
    /// In linear light: exact between layers that are half transparent; viewers show another J (31 dB on
    /// sesa-wreck).
    Linear,
    /// As [`Blend::Srgb`], and what nothing hides is black, not open water: for clear water, where nobody
    /// knows the colour of that. Only where the water acts on the picture.
    #[serde(rename = "over_black")]
    OverBlack,
}

/// In which light render and photograph are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LossLight {
    /// As the photograph is: differences count about as they are seen.
    #[default]
    Srgb,
    /// Linear light (SMP-UWGS section 4, "Radiometric Linearization"): differences count as the water makes
    /// them, so those in the dark count little.
    Linear,
}

/// What the nine numbers start from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WaterPrior {
    /// Least squares over sparse points that are seen from several distances
    /// ([`crate::water::sparse_prior`]).
    #[default]
    Sparse,
    /// What WaterParamPredict says of the views while it learns with the Gaussians ([`NetworkConfig`]).
    Network,
    /// `water.start_beta_d`, `water.start_beta_b` and `water.start_b_inf`.
    Fixed,
}

/// The medium between camera and scene (SMP-UWGS sections 3.2 and 3.3). Shares are of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WaterConfig {
    /// Where the water acts: `per_pixel`, `per_gaussian` or `none`. Default `per_pixel` (BENCHMARKS.md);
    /// `none` in `3dgs`.
    pub medium: Medium,
    /// In which light Gaussians are blended, and what is behind: `srgb`, `linear` or `over_black`. Default
    /// `srgb` (BENCHMARKS.md), which clear water makes `over_black` (`clear_over_black`); `linear` in
    /// `paper`.
    pub blend: Blend,
    /// What the nine numbers start from: `sparse`, `network` or `fixed`. Default `sparse`; `network` in the
    /// preset `paper`.
    pub prior: WaterPrior,
    /// WaterParamPredict, for `network`.
    pub network: NetworkConfig,
    /// Attenuation of the direct signal to start from where the prior, or `network.start`, is `fixed` or
    /// cannot say; red, green and blue, in units of 1 / the usual viewing distance. Default 0.75, 0.30, 0.50
    /// (SMP-UWGS's code).
    pub start_beta_d: [f64; 3],
    /// Growth of the backscatter, the same. Default 0.75, 0.40, 0.40 (SMP-UWGS's code).
    pub start_beta_b: [f64; 3],
    /// Colour of the water at infinity, the same, linear light. Default 0.10, 0.25, 0.45 (SMP-UWGS's code).
    pub start_b_inf: [f64; 3],
    /// Share of the run from which the nine numbers move with the Gaussians. Default 0.1: first the Gaussians
    /// must show something.
    pub start_at: f32,
    /// Share of the run after which they stay as they are; J has no view dependence before. Default 0.667
    /// (SMP-UWGS: 8000 of 12,000).
    pub freeze_at: f32,
    /// Learning rate of Adam on the unconstrained numbers (eq. 8) at `start_at`, of a number that the prior
    /// does not know. Where it has standard errors, each number moves in proportion to its variance. Default
    /// 0.01 (SeaSplat).
    pub lr: f32,
    /// The same at `freeze_at`, exponentially between. Default 1e-3.
    pub lr_end: f32,
    /// Whether J has spherical harmonics of degree 0 while the water moves: higher ones may absorb it, since
    /// range and direction go together. Default false: they do not where the sparse points know the water
    /// (BENCHMARKS.md).
    pub sh0_while_free: bool,
    /// Weight of what the colours of J pass white by, squared, as a mean over the Gaussians of a view. Where
    /// the scene is far or has no texture, Gaussians behind it with a J far above white look the same through
    /// the water. Not in water so clear that it is no veil. Default 0.2 (SeaSplat has such a term with 2,
    /// from 0.7); 0 in `paper`.
    pub overwhite_weight: f32,
    /// Weight of the squares of the nine numbers, coefficients in 1 / the usual viewing distance (eq. 16).
    /// Default 0; 1e-4 in `paper`, which gives none.
    pub l2_weight: f32,
    /// Weight of the mean alpha over pixels whose photograph shows open water (eq. 15). Left out in clear
    /// water, as `surface_alpha_weight` is. Default 0.01 (SeaSplat).
    pub alpha_background: f32,
    /// Weight of the mean alpha over pixels that the map of a view has as open water, in place of
    /// `alpha_background`: where photographs show open water for certain. Default 0.03 (bench/history.jsonl).
    pub alpha_open: f32,
    /// Weight of how far the logarithm of a pixel's range is from that of the sparse points that the view saw
    /// near it: through water a surface that few views see may hang before its place. Up to 3 % counts as no
    /// difference; up to a fifth where the water takes less than a quarter of the light at the usual viewing
    /// distance. Default 1 (bench/history.jsonl); 0 in `paper`, and nothing in clear water.
    pub sparse_ranges: f32,
    /// Optical depth that the Gaussians around certain sparse points must have: those that two training views
    /// saw, all from where the water takes more than half of the light of its clearest channel. Where they
    /// have less when density is decided for the last time, a Gaussian is put there. What is only seen from
    /// far and along its surface is else a fog that a view from above looks through. Nothing in clear water.
    /// Default 2 (bench/history.jsonl); 0 in `paper`.
    pub least_cover: f32,
    /// Whether photographs are searched for open water and for the darkest pixels at each range, before the
    /// run: where the sparse points do not know the veil, these do. Only with `prior = "sparse"` and
    /// `medium = "per_pixel"`, and not beside a dark channel. Default true.
    pub open_water: bool,
    /// Weight of what the mean alpha lacks to 1 over all other pixels: open water has nearly the colour of a
    /// scene under water, so without it the scene stays half transparent, and J is too dark by as much. Left
    /// out where the water takes less than a twentieth of the light at the usual viewing distance. Default
    /// 0.05 (bench/history.jsonl); 0 in `paper`.
    pub surface_alpha_weight: f32,
    /// Weight of the mean opacity of Gaussians that hang before the scene of the view: nearer than half of
    /// the 2nd percentile of the ranges of its sparse points. What moves between photographs is learnt as
    /// veils there (bench/history.jsonl; as FreeNeRF, Yang et al. 2023, eq. 4, on density near the camera).
    /// Where a view has fewer than 20 points, nothing is said of it. Default 20; 0 in `paper`.
    pub floater_weight: f32,
    /// Largest standard deviation of a Gaussian, in scene scales; what grows beyond is relocated,
    /// else a few behind the scene close every hole in its surface (bench/history.jsonl). In clear water at
    /// least 0.15 of the range at which half of the light of its clearest channel is left. 0: no limit.
    /// Default 0.5; 0 in `paper`.
    pub largest_deviation: f32,
    /// Greatest distance of a photograph's pixel from the colour of open water that counts as open water,
    /// sRGB, over three channels. Default 0.05; in `paper` 0.3464, 0.2 times the square root of 3 (SeaSplat).
    pub alpha_background_distance: f32,
    /// In which light L1 and SSIM compare render and photograph: `srgb` or `linear`. Default `srgb`; `linear`
    /// in `paper`; without a medium always sRGB. Exposures (`train.exposure`) act on what is compared;
    /// metrics are in sRGB.
    pub loss_light: LossLight,
    /// Whether `over_black` takes the place of `srgb` where the water acts on the picture and takes less than
    /// a twentieth of the light of its clearest channel at the usual viewing distance. Open water of an
    /// unknown colour behind everything cost 0.3 dB on reef-clip (bench/history.jsonl). Not beside a dark
    /// channel, whose backscatter is that of open water. Default true.
    pub clear_over_black: bool,
    /// How many times [`super::TrainConfig::sh_rest_lr`] the higher bands have in water that clear, so that
    /// they take up the light that moves over a scene, and no veil before it does. The global stage takes at
    /// most 1. Default 4; 1 in `paper`.
    pub clear_harmonics: f32,
    /// Priors on direct signal and depth, and when the terms beside the picture's begin.
    pub priors: PriorsConfig,
    /// What moves between `start_at` and `freeze_at`.
    pub dbdr: DbdrConfig,
    /// View embeddings between the picture under water and the loss.
    pub film: FilmConfig,
    /// What partitions do with the water of the global stage: `frozen` or `joint`. Default `frozen`. A job of
    /// one partition or without a medium has nothing to refine: there it changes nothing.
    pub partitions: WaterPartitions,
}

impl Default for WaterConfig {
    fn default() -> Self {
        Self {
            medium: Medium::PerPixel,
            blend: Blend::Srgb,
            prior: WaterPrior::Sparse,
            network: NetworkConfig::default(),
            start_beta_d: [0.75, 0.30, 0.50],
            start_beta_b: [0.75, 0.40, 0.40],
            start_b_inf: [0.10, 0.25, 0.45],
            start_at: 0.1,
            freeze_at: 0.667,
            lr: 0.01,
            lr_end: 1e-3,
            sh0_while_free: false,
            overwhite_weight: 0.2,
            l2_weight: 0.0,
            alpha_background: 0.01,
            alpha_open: 0.03,
            sparse_ranges: 1.0,
            least_cover: 2.0,
            open_water: true,
            surface_alpha_weight: 0.05,
            floater_weight: 20.0,
            largest_deviation: 0.5,
            alpha_background_distance: 0.05,
            loss_light: LossLight::Srgb,
            clear_over_black: true,
            clear_harmonics: 4.0,
            priors: PriorsConfig::default(),
            dbdr: DbdrConfig::default(),
            film: FilmConfig::default(),
            partitions: WaterPartitions::Frozen,
        }
    }
}

impl WaterConfig {
    /// SMP-UWGS as printed: eq. 7 by pixel, 8 to 17, the loss in linear light. The paper states no rates,
    /// weights or start: rate and threshold of open water are SeaSplat's, the start is that of the released
    /// code, `l2_weight` is ours.
    pub fn paper() -> Self {
        Self {
            blend: Blend::Linear,
            prior: WaterPrior::Network,
            network: NetworkConfig::paper(),
            start_at: 0.0,
            lr: 0.01,
            lr_end: 0.01,
            sh0_while_free: false,
            overwhite_weight: 0.0,
            l2_weight: 1e-4,
            surface_alpha_weight: 0.0,
            floater_weight: 0.0,
            sparse_ranges: 0.0,
            least_cover: 0.0,
            largest_deviation: 0.0,
            alpha_background_distance: 0.3464,
            loss_light: LossLight::Linear,
            clear_harmonics: 1.0,
            priors: PriorsConfig::paper(),
            dbdr: DbdrConfig::paper(),
            film: FilmConfig::paper(),
            ..Self::default()
        }
    }

    /// Without a medium: the control.
    pub fn none() -> Self {
        Self { medium: Medium::None, ..Self::default() }
    }

    /// Whether pixels beside the sparse points tell of the water: open water and the darkest at each range.
    pub fn looks_beyond_points(&self) -> bool {
        let sparse = self.prior == WaterPrior::Sparse && self.medium == Medium::PerPixel;
        self.open_water && sparse && !self.has_dark_channel()
    }

    /// Whether a run has a dark channel, and so its buffers.
    pub fn has_dark_channel(&self) -> bool {
        self.medium != Medium::None && self.priors.dark_channel > 0.0
    }

    /// Whether training views have embeddings ([`FilmConfig`]).
    pub fn has_film(&self) -> bool {
        self.film.on && self.medium != Medium::None
    }

    /// Whether numbers of the water move with the Gaussians in some part of a run.
    pub fn descends(&self) -> bool {
        let moves = match self.dbdr.mode {
            DbdrMode::None => false,
            DbdrMode::Constants => self.lr.max(self.lr_end) > 0.0,
            DbdrMode::Maps => self.lr.max(self.lr_end) > 0.0 || self.dbdr.lr > 0.0,
        };
        moves && self.freeze_at > self.start_at
    }

    /// Tells `require` of every value that cannot be, by name.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        for (name, values) in
            [("beta_d", self.start_beta_d), ("beta_b", self.start_beta_b), ("b_inf", self.start_b_inf)]
        {
            require(
                values.iter().all(|value| value.is_finite() && *value >= 0.0),
                &format!("water.start_{name} must be three finite numbers, 0 or more"),
            );
        }
        require(self.start_b_inf.iter().all(|value| *value <= 1.0), "water.start_b_inf must be at most 1");
        for (name, value) in [
            ("lr", self.lr),
            ("lr_end", self.lr_end),
            ("overwhite_weight", self.overwhite_weight),
            ("l2_weight", self.l2_weight),
            ("alpha_background", self.alpha_background),
            ("alpha_open", self.alpha_open),
            ("sparse_ranges", self.sparse_ranges),
            ("least_cover", self.least_cover),
            ("surface_alpha_weight", self.surface_alpha_weight),
            ("floater_weight", self.floater_weight),
            ("largest_deviation", self.largest_deviation),
            ("clear_harmonics", self.clear_harmonics),
            ("alpha_background_distance", self.alpha_background_distance),
        ] {
            require(
                value >= 0.0 && value.is_finite(),
                &format!("water.{name} must be a finite number, 0 or more"),
            );
        }
        for (name, share) in [("start_at", self.start_at), ("freeze_at", self.freeze_at)] {
            require((0.0..=1.0).contains(&share), &format!("water.{name} is a share of the run: 0 to 1"));
        }
        require(self.start_at <= self.freeze_at, "water.start_at must not be after water.freeze_at");
        if let Err(CoreError::Config(message)) = self.composition() {
            require(false, &message);
        }
        require(
            self.blend != Blend::OverBlack || !self.has_dark_channel(),
            "water.priors.dark_channel takes open water for what is behind; set it to 0, or water.blend to \"srgb\"",
        );
        self.dbdr.validate(self.medium, require);
        self.film.validate(require);
        self.priors.validate(require);
        self.network.validate(require);
        if self.prior == WaterPrior::Network && self.medium != Medium::None {
            require(
                self.network.until <= self.freeze_at,
                "water.network.until must not be after water.freeze_at, from where the water stays",
            );
            require(
                self.network.every > 0 || self.medium == Medium::PerPixel,
                "water.network.every = 0 predicts between the blending and the water, and needs \
                 water.medium = \"per_pixel\"; with \"per_gaussian\" set every to 1 or more, and depth_gradient to false",
            );
        }
        self.partitions.validate(self, require);
    }
}
