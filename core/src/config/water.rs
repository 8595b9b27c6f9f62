//! The water of a job: where it acts, its initial parameters, and when they are trained.

use serde::{Deserialize, Serialize};

use super::{DbdrConfig, DbdrMode, FilmConfig, NetworkConfig, PriorsConfig, WaterPartitions};
use crate::CoreError;

/// Where the water acts (docs/decisions/0005).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Medium {
    /// No medium between camera and scene: training and blending in sRGB, as in 3DGS.
    None,
    /// On each Gaussian before blending, by its own range: exact between layers, without a division by alpha.
    #[default]
    PerGaussian,
    /// On each pixel, by the expected range (SMP-UWGS eq. 7).
    PerPixel,
}

/// The light in which Gaussians are blended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Blend {
    /// In sRGB, as every viewer blends, so viewers show J as it was trained. The water itself acts in linear
    /// light, on each Gaussian or on the blended picture.
    #[default]
    Srgb,
    /// In linear light: exact between half-transparent layers. Viewers, which blend in sRGB, show a different
    /// J (31 dB on sesa-wreck).
    Linear,
    /// As [`Blend::Srgb`], but rays that hit nothing are black, not open water. For clear water, where the
    /// open-water colour cannot be estimated. Only where the water acts on pixels.
    #[serde(rename = "over_black")]
    OverBlack,
}

/// The light in which the loss compares render and photograph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LossLight {
    /// As the photograph is encoded: differences count roughly as they are perceived.
    #[default]
    Srgb,
    /// Linear light (SMP-UWGS section 4, "Radiometric Linearization"): differences count in proportion to
    /// radiance, so those in dark areas count little.
    Linear,
}

/// The source of the initial water parameters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WaterPrior {
    /// Least squares over sparse points that are seen from several distances
    /// ([`crate::water::sparse_prior`]).
    #[default]
    Sparse,
    /// The predictions of WaterParamPredict, which learns together with the Gaussians ([`NetworkConfig`]).
    Network,
    /// `water.start_beta_d`, `water.start_beta_b` and `water.start_b_inf`.
    Fixed,
}

/// The medium between camera and scene (SMP-UWGS sections 3.2 and 3.3). The water parameters are attenuation,
/// backscatter and open-water colour, each for red, green and blue. The scene scale is the median depth of
/// what the training cameras see. Water is clear where it takes less than a twentieth of the light of its
/// clearest channel at the scene scale, unless photographs show open water. Shares are of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WaterConfig {
    /// Where the water acts: `per_pixel`, `per_gaussian` or `none`. Default `per_pixel` (BENCHMARKS.md);
    /// `none` in `3dgs`.
    pub medium: Medium,
    /// The light in which Gaussians are blended, and the background: `srgb`, `linear` or `over_black`.
    /// Default `srgb` (BENCHMARKS.md); `linear` in `paper`. In clear water, `clear_over_black` turns `srgb`
    /// into `over_black`.
    pub blend: Blend,
    /// Source of the initial water parameters: `sparse`, `network` or `fixed`. Default `sparse`; `network` in
    /// the preset `paper`.
    pub prior: WaterPrior,
    /// WaterParamPredict, for `network`.
    pub network: NetworkConfig,
    /// Initial attenuation of the direct signal, for red, green and blue, in 1 / scene scale. Default 0.75,
    /// 0.30, 0.50 (SMP-UWGS's code). Used where the prior or `network.start` is `fixed`, or where the prior
    /// has no estimate.
    pub start_beta_d: [f64; 3],
    /// Initial backscatter coefficient, for red, green and blue, in 1 / scene scale. Default 0.75, 0.40, 0.40
    /// (SMP-UWGS's code). Same use as `start_beta_d`.
    pub start_beta_b: [f64; 3],
    /// Initial colour of the water at infinity, red, green and blue, in linear light. Default 0.10, 0.25,
    /// 0.45 (SMP-UWGS's code). Same use as `start_beta_d`.
    pub start_b_inf: [f64; 3],
    /// Share of the run from which the water parameters are trained with the Gaussians. Default 0.1. Until
    /// then the Gaussians take shape.
    pub start_at: f32,
    /// Share of the run after which the water parameters are fixed. Default 0.667 (SMP-UWGS: 8000 of 12,000).
    /// Before it, J has no view dependence if `sh0_while_free = true`.
    pub freeze_at: f32,
    /// Learning rate of Adam on the unconstrained water parameters (eq. 8) at `start_at`. Default 0.01
    /// (SeaSplat). It applies in full to parameters without an estimate from the prior. Where the prior has
    /// standard errors, the rate of each parameter is proportional to its variance.
    pub lr: f32,
    /// Learning rate of the water parameters at `freeze_at`, with exponential decay from `lr`. Default 1e-3.
    pub lr_end: f32,
    /// Whether J has only spherical harmonics of degree 0 while the water is trained. Default false. Higher
    /// degrees can absorb the water, since range and direction are correlated. They do not where the sparse
    /// points determine the water (BENCHMARKS.md).
    pub sh0_while_free: bool,
    /// Weight of the squared excess of J's colours above white, averaged over the Gaussians of a view.
    /// Default 0.2 (SeaSplat has such a term with 2, from 0.7); 0 in `paper`. Distant or textureless areas
    /// can hide Gaussians with J far above white: through the water they look the same. Not used in clear
    /// water.
    pub overwhite_weight: f32,
    /// Weight of the squared water parameters, coefficients in 1 / scene scale (eq. 16). Default 0; 1e-4 in
    /// `paper`, which gives none.
    pub l2_weight: f32,
    /// Weight of the mean alpha over pixels whose photograph shows open water (eq. 15). Default 0.01
    /// (SeaSplat). Not used in clear water.
    pub alpha_background: f32,
    /// Weight of the mean alpha over pixels that the view's map marks as open water. Default 0.03
    /// (bench/history.jsonl). It replaces `alpha_background` where photographs certainly show open water.
    pub alpha_open: f32,
    /// Weight of the difference between the log range of a pixel and that of the view's sparse points near
    /// it. Default 1 (bench/history.jsonl); 0 in `paper`. Under water, a surface that few views see can
    /// otherwise float in front of its true position. Differences up to 3 % are ignored, or up to a fifth
    /// where the water takes less than a quarter of the light at the scene scale. Not used in clear water.
    pub sparse_ranges: f32,
    /// Minimum optical depth of the Gaussians around certain sparse points. Default 2 (bench/history.jsonl);
    /// 0 in `paper`. It applies to points that two training views saw, all from where the water takes more
    /// than half of the light of its clearest channel. Where the last density step finds less, it adds a
    /// Gaussian. Otherwise a surface seen only from afar and at grazing angles becomes a fog, transparent
    /// from above. Not used in clear water.
    pub least_cover: f32,
    /// Whether photographs are searched before the run for open water and for the darkest pixels at each
    /// range. Default true. They determine the veil where the sparse points do not. Only with `prior =
    /// "sparse"` and `medium = "per_pixel"`, and without a dark channel.
    pub open_water: bool,
    /// Weight of `1 - alpha`, averaged over pixels that are not open water. Default 0.05
    /// (bench/history.jsonl); 0 in `paper`. Open water has nearly the colour of an underwater scene. Without
    /// this term the scene stays half transparent, and J too dark by the same factor. Not used in clear
    /// water.
    pub surface_alpha_weight: f32,
    /// Weight of the mean opacity of Gaussians that float between the camera and the scene. Default 20; 0 in
    /// `paper`. These are nearer than half of the 2nd percentile of the ranges of the view's sparse points.
    /// Objects that move between photographs otherwise become veils there (bench/history.jsonl; as FreeNeRF,
    /// Yang et al. 2023, eq. 4, on density near the camera). Views with fewer than 20 points are skipped.
    pub floater_weight: f32,
    /// Largest standard deviation of a Gaussian, in scene scales. Default 0.5; 0 in `paper`. 0 sets no limit.
    /// Larger Gaussians are relocated; otherwise a few behind the scene close every hole in its surface
    /// (bench/history.jsonl). The limit is at least 0.15 of the range at which half of the light of the
    /// clearest channel is left, so clear water allows larger ones.
    pub largest_deviation: f32,
    /// Largest distance between the colours of a pixel and of open water at which the pixel counts as open
    /// water. Default 0.05; in `paper` 0.3464, 0.2 times the square root of 3 (SeaSplat). The distance is in
    /// sRGB over three channels.
    pub alpha_background_distance: f32,
    /// The light in which L1 and SSIM compare render and photograph: `srgb` or `linear`. Default `srgb`;
    /// `linear` in `paper`. Without a medium it is always sRGB. Exposures (`train.exposure`) act on the
    /// compared values. Metrics are in sRGB.
    pub loss_light: LossLight,
    /// Whether `over_black` replaces `srgb` in clear water that acts on pixels. Default true. An open-water
    /// background of unknown colour cost 0.3 dB on reef-clip (bench/history.jsonl). Not with a dark channel,
    /// whose backscatter assumes open water behind the scene.
    pub clear_over_black: bool,
    /// Factor on [`super::TrainConfig::sh_rest_lr`] in clear water. Default 4; 1 in `paper`. The higher bands
    /// then learn light that moves over the scene before it becomes a veil. The global stage uses at most 1.
    pub clear_harmonics: f32,
    /// Priors on direct signal and depth, and when the terms other than the image loss begin.
    pub priors: PriorsConfig,
    /// The water parameters that are trained between `start_at` and `freeze_at`.
    pub dbdr: DbdrConfig,
    /// View embeddings between the underwater picture and the loss.
    pub film: FilmConfig,
    /// Whether partitions refine the water of the global stage: `frozen` or `joint`. Default `frozen`. No
    /// effect in a job with one partition or without a medium.
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
    /// SMP-UWGS as printed: eq. 7 per pixel, eq. 8 to 17, the loss in linear light. The paper states no
    /// rates, weights or initial values. Rate and open-water threshold are from SeaSplat, the initial values
    /// from the released code, and `l2_weight` is ours.
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

    /// Whether pixels other than the sparse points inform the prior: open water and the darkest pixels at
    /// each range.
    pub fn looks_beyond_points(&self) -> bool {
        let sparse = self.prior == WaterPrior::Sparse && self.medium == Medium::PerPixel;
        self.open_water && sparse && !self.has_dark_channel()
    }

    /// Whether a run has a dark channel, and therefore its buffers.
    pub fn has_dark_channel(&self) -> bool {
        self.medium != Medium::None && self.priors.dark_channel > 0.0
    }

    /// Whether training views have embeddings ([`FilmConfig`]).
    pub fn has_film(&self) -> bool {
        self.film.on && self.medium != Medium::None
    }

    /// Whether any water parameter is trained with the Gaussians in some part of a run.
    pub fn descends(&self) -> bool {
        let moves = match self.dbdr.mode {
            DbdrMode::None => false,
            DbdrMode::Constants => self.lr.max(self.lr_end) > 0.0,
            DbdrMode::Maps => self.lr.max(self.lr_end) > 0.0 || self.dbdr.lr > 0.0,
        };
        moves && self.freeze_at > self.start_at
    }

    /// Reports every invalid value to `require`, by name.
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
            require(
                (0.0..=1.0).contains(&share),
                &format!("water.{name} must be a share of the run, from 0 to 1"),
            );
        }
        require(self.start_at <= self.freeze_at, "water.start_at must not be after water.freeze_at");
        if let Err(CoreError::Config(message)) = self.composition() {
            require(false, &message);
        }
        require(
            self.blend != Blend::OverBlack || !self.has_dark_channel(),
            "water.priors.dark_channel assumes open water behind the scene; set it to 0, or set water.blend to \"srgb\"",
        );
        self.dbdr.validate(self.medium, require);
        self.film.validate(require);
        self.priors.validate(require);
        self.network.validate(require);
        if self.prior == WaterPrior::Network && self.medium != Medium::None {
            require(
                self.network.until <= self.freeze_at,
                "water.network.until must not be after water.freeze_at, where the water is fixed",
            );
            require(
                self.network.every > 0 || self.medium == Medium::PerPixel,
                "water.network.every = 0 predicts between blending and water, which needs \
                 water.medium = \"per_pixel\"; with \"per_gaussian\" set every to 1 or more, and depth_gradient to false",
            );
        }
        self.partitions.validate(self, require);
    }
}
