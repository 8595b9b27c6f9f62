//! Scenes seen through a water surface (WSGS, "Through the Water: Refractive Gaussian Splatting").

use serde::{Deserialize, Serialize};

/// What of the water surface is trained.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceRefine {
    /// Nothing: the plane stays where the sparse points or the configuration put it.
    #[default]
    Fixed,
    /// The offset, as in the paper.
    Offset,
    /// The offset and the tilt of the normal.
    Tilt,
}

/// How much of the light the surface reflects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Reflectance {
    /// Fresnel's equations for unpolarised light.
    #[default]
    Fresnel,
    /// Schlick's approximation (WSGS eq. 10): 0.05 off at 80 degrees.
    Schlick,
}

/// In which encoding reflected and refracted light add.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceLight {
    /// In linear light.
    #[default]
    Linear,
    /// In sRGB, as the paper prints it.
    Srgb,
}

/// How the scene above water lies over what the water shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceJoin {
    /// As any disk lies over what is behind it: water shows through where the scene above is transparent.
    #[default]
    Over,
    /// By masks that are trained (WSGS eq. 12).
    Masked,
}

/// Where the water surface comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceStart {
    /// From the sparse points: straight against refracted triangulation.
    #[default]
    Tracks,
    /// Half-way between the worst points and the lowest camera (WSGS section 4.1).
    Paper,
}

/// A scene seen through a calm water surface; used by method `wsgs`. Shares are those of the run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SurfaceConfig {
    /// Normal of the surface towards the air, scene axes. Default: from the sparse points.
    pub normal: Option<[f64; 3]>,
    /// Offset of the surface along its normal, scene units. Default: from the sparse points.
    pub offset: Option<f64>,
    /// Refractive index of the water. Default 1.333.
    pub ior: f64,
    /// Where the surface comes from: `tracks` or `paper`. Default `tracks`.
    pub start: SurfaceStart,
    /// What of the surface is trained: `fixed`, `offset` or `tilt`. Default `fixed`: on
    /// pools the estimate from the sparse points is within 0.02 % of the viewing distance.
    pub refine: SurfaceRefine,
    /// How much light the surface reflects: `fresnel` or `schlick`. Default `fresnel`.
    pub reflectance: Reflectance,
    /// How reflected and refracted light add: `linear` or `srgb`. Default `linear`.
    pub light: SurfaceLight,
    /// How the scene above water lies over what the water shows: `over` or `masked`. Default `over`: water
    /// shows through where the scene above is transparent. `masked` is that of the paper (eq. 12); mask and
    /// reset settings count for it only.
    pub join: SurfaceJoin,
    /// Share of the run before which only the scene above water is trained. Default: 0, and 18/70 with
    /// `masked` (WSGS), which needs that scene to start from.
    pub from: Option<f32>,
    /// Shares of the cap: scene above water, refracted set, reflected set. Default 0.45, 0.48, 0.07.
    pub shares: [f32; 3],
    /// Weight of the loss between mask and pseudo-mask (WSGS eq. 15). Default 0.5; the paper has 0.05, in
    /// runs that are twenty times as long.
    pub mask_weight: f32,
    /// Share of the run from which that loss counts. Default 18/70; the paper has 30/70.
    pub mask_from: f32,
    /// Times that pseudo-masks are made, evenly spread from `from` to `reset_until`. Default 8.
    pub pseudo_masks: u32,
    /// Learning rate of the masks. Default 0.05; the paper has 0.01.
    pub mask_lr: f32,
    /// Share of the run between two resets of the masks of disks below the surface. Default 1/70 (WSGS). 0
    /// disables them.
    pub reset_every: f32,
    /// Share of the run after which masks are not reset. Default 0.79 (WSGS).
    pub reset_until: f32,
    /// Learning rate of the offset, times [`crate::scene::learning_scale`]. Default 1e-3 (WSGS).
    pub offset_lr: f32,
    /// Learning rate of the tilt, radians. Default 1e-4.
    pub tilt_lr: f32,
    /// Share of the run after which the surface stays. Default 30/70 (WSGS).
    pub refine_until: f32,
}

impl SurfaceConfig {
    /// The value of [`SurfaceConfig::from`] or its default.
    pub fn begins_at(&self) -> f32 {
        self.from.unwrap_or(match self.join {
            SurfaceJoin::Over => 0.0,
            SurfaceJoin::Masked => 18.0 / 70.0,
        })
    }

    /// The settings of a coarse model of `gaussians` in a job of `of_job`. Partitions train no part of the
    /// reflected set, so it has its whole share of the job, at the cost of the others.
    #[must_use]
    pub fn of_coarse_run(&self, gaussians: u32, of_job: u32) -> Self {
        let [straight, refracted, reflected] = self.shares;
        let reflected = reflected * (of_job as f32 / gaussians.max(1) as f32).max(1.0);
        Self { shares: [straight, refracted, reflected], ..self.clone() }
    }

    /// Reports every fault.
    pub(super) fn validate(&self, require: &mut impl FnMut(bool, &str)) {
        let share = |value: f32| (0.0..=1.0).contains(&value);
        require(
            self.ior.is_finite() && self.ior > crate::surface::AIR,
            "surface.ior must be above that of air, 1.000293; water has 1.333",
        );
        require(
            self.normal.is_none_or(|normal| glam::DVec3::from(normal).length() > 1e-6),
            "surface.normal must be a direction: three numbers that are not all 0",
        );
        require(self.offset.is_none_or(f64::is_finite), "surface.offset must be a number");
        require(
            self.offset.is_none() || self.normal.is_some(),
            "surface.offset needs surface.normal: it is the distance along it",
        );
        require(
            self.shares.iter().all(|share| *share > 0.0 && share.is_finite()),
            "surface.shares must be three numbers above 0",
        );
        require(
            self.begins_at() < 1.0
                && [self.begins_at(), self.mask_from, self.reset_every, self.reset_until, self.refine_until]
                    .into_iter()
                    .all(share),
            "surface.from, mask_from, reset_every, reset_until and refine_until must be shares of the run, and \
             surface.from below 1",
        );
        require(
            [self.mask_weight, self.mask_lr, self.offset_lr, self.tilt_lr]
                .into_iter()
                .all(|value| value.is_finite() && value >= 0.0),
            "surface.mask_weight, mask_lr, offset_lr and tilt_lr must not be negative",
        );
    }
}

impl Default for SurfaceConfig {
    fn default() -> Self {
        Self {
            normal: None,
            offset: None,
            ior: crate::surface::WATER,
            start: SurfaceStart::Tracks,
            refine: SurfaceRefine::Fixed,
            reflectance: Reflectance::Fresnel,
            light: SurfaceLight::Linear,
            join: SurfaceJoin::Over,
            from: None,
            shares: [0.45, 0.48, 0.07],
            mask_weight: 0.5,
            mask_from: 18.0 / 70.0,
            pseudo_masks: 8,
            mask_lr: 0.05,
            reset_every: 1.0 / 70.0,
            reset_until: 0.79,
            offset_lr: 1e-3,
            tilt_lr: 1e-4,
            refine_until: 30.0 / 70.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_coarse_model_has_the_whole_reflected_set_of_its_job() {
        let config = SurfaceConfig::default();
        let reflected =
            |config: &SurfaceConfig, cap: f32| cap * config.shares[2] / config.shares.iter().sum::<f32>();
        let coarse = config.of_coarse_run(4000, 16_000);
        assert_eq!(coarse.shares[..2], config.shares[..2]);
        // 1120 of 16,000 in the job; the other sets shrink in proportion.
        assert!((reflected(&config, 16_000.0) - 1120.0).abs() < 1.0);
        assert!((900.0..1120.0).contains(&reflected(&coarse, 4000.0)), "{:?}", coarse.shares);
        assert_eq!(config.of_coarse_run(16_000, 16_000), config);
        assert_eq!(config.of_coarse_run(16_000, 4000), config);
    }
}
