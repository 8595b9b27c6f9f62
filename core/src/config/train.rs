//! Optimisation: iterations, caps, learning rates, density control.

use serde::{Deserialize, Serialize};

use crate::gpu::Drawing;

/// Storage of Adam's moments on the device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Moments {
    /// 16 bits per value, and one second moment per channel for all coefficients. With SH 3, a Gaussian takes
    /// 416 bytes in total.
    #[default]
    Compact,
    /// Two f32 per parameter: 736 bytes.
    F32,
}

/// How Gaussians are added and removed during training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Strategy {
    /// Relocation and growth on a schedule up to the cap, in the spirit of 3DGS-MCMC (Kheradmand et al.
    /// 2024).
    #[default]
    Mcmc,
    /// Adaptive density control of 3DGS (Kerbl et al. 2023, section 5): clone, split, prune, and reset
    /// opacities.
    Classic,
}

/// Adaptive density control of 3DGS (Kerbl et al. 2023, section 5 and their code), for [`Strategy::Classic`].
///
/// 3DGS updates every Gaussian in every iteration; here a view updates only those that contribute to it.
/// Three differences follow. A mean gradient counts only views to which the Gaussian contributed. 3DGS also
/// counts views in which it was hidden, so here the same threshold selects slightly more Gaussians. A
/// Gaussian that no view sees does not move, whereas momentum keeps moving it in 3DGS. The first steps of a
/// new Gaussian have their full rate, since Adam counts its own steps. In 3DGS they are 3.2 times as large.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClassicConfig {
    /// Mean gradient from which Gaussians are cloned or split. Default 2e-4 (3DGS). It is the length of the
    /// gradient of the loss by the projected centre, averaged over views. Its unit is half a picture (NDC).
    pub gradient: f32,
    /// Largest deviation at which such a Gaussian is cloned, as a share of the scene's extent. Default 0.01
    /// (3DGS). Larger ones are split in two. The extent is [`crate::scene::learning_scale`].
    pub clone_scale: f32,
    /// Opacity below which Gaussians are removed. Default 0.005 (3DGS).
    pub prune_opacity: f32,
    /// Largest deviation beyond which Gaussians are removed after a reset of opacities, as a share of the
    /// extent. Default 0.1 (3DGS). 0 keeps them. This includes the far field. The limit on pixels that 3DGS
    /// states has no effect in its code.
    pub prune_scale: f32,
    /// Share of the run between two resets that lower each opacity to at most 0.01. Default 0.1 (3DGS: 3000
    /// of 30,000). 0 disables resets. They happen while Gaussians are added.
    pub reset_every: f32,
    /// Share of the run before which no Gaussian is added or removed. Default 1/60 (3DGS: 500 of 30,000).
    pub from: f32,
    /// Share of the run after which no Gaussian is added or removed. Default 0.5 (3DGS: 15,000 of 30,000).
    pub until: f32,
}

impl Default for ClassicConfig {
    fn default() -> Self {
        Self {
            gradient: 2e-4,
            clone_scale: 0.01,
            prune_opacity: 0.005,
            prune_scale: 0.1,
            reset_every: 0.1,
            from: 1.0 / 60.0,
            until: 0.5,
        }
    }
}

/// Optimisation of Gaussians. Learning rates are Adam's, per iteration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// Seed of all random numbers. Default 1.
    pub seed: u32,
    /// Iterations of the job as one 1x1 partition; one iteration renders one view. Default 12 000 (SMP-UWGS).
    pub iterations: u32,
    /// Cap on the Gaussians of the job, in all partitions together. Default 3 million.
    pub max_gaussians: u32,
    /// Final degree of the spherical harmonics, 0 to 3. Default 3.
    pub sh_degree: u8,
    /// Weight of 1 - SSIM relative to L1. Default 0.2 (3DGS).
    pub ssim_weight: f32,
    /// Learning rate of the means at the start, times [`crate::scene::learning_scale`]. Default 1.6e-4
    /// (3DGS).
    pub means_lr: f32,
    /// Learning rate of the means at the end of the run, with exponential decay. Default 1.6e-6 (3DGS).
    pub means_lr_end: f32,
    /// Learning rate of the constant colour. Default 2.5e-3 (3DGS).
    pub sh_dc_lr: f32,
    /// Learning rate of all higher bands, the same for views that see little. Default 1.25e-3 (half of
    /// `sh_dc_lr`). With a twentieth (3DGS), short runs do not learn these bands (bench/history.jsonl). In
    /// clear water it is multiplied by `water.clear_harmonics`.
    pub sh_rest_lr: f32,
    /// Learning rate of the opacity logits. Default 0.05 (3DGS 2023).
    pub opacity_lr: f32,
    /// Learning rate of the log scales, the same for views that see little. Default 4e-2; 3DGS has 5e-3. At
    /// that rate, the scales limit the quality of a short run (bench/history.jsonl).
    pub scales_lr: f32,
    /// Learning rate of the quaternions. Default 3e-3; 3DGS has 1e-3 (bench/history.jsonl).
    pub quats_lr: f32,
    /// Share of the run from which all rates except that of the means decay exponentially to the end. Default
    /// 0.85, where relocation ends (bench/history.jsonl).
    pub anneal_from: f32,
    /// Factor on those rates at the end of the run. Default 0.1. 1 keeps them constant (3DGS).
    pub anneal_to: f32,
    /// Weight of the mean opacity in the loss, until `relocate_until`. Default 0.01 (3DGS-MCMC, to the end).
    /// Gaussians that fade later are no longer relocated. Only with `mcmc`.
    pub opacity_reg: f32,
    /// Weight of the mean scale in the loss, until `relocate_until`. Default 0.01 (3DGS-MCMC, to the end).
    /// Only with `mcmc`.
    pub scale_reg: f32,
    /// Noise on the means of nearly transparent Gaussians, in deviations of the Gaussian at a learning rate
    /// of 1. Default 5000. 0 disables it. Only with `mcmc`. In the spirit of 3DGS-MCMC, whose factor of 5e5
    /// belongs to squared scene units.
    pub mean_noise: f32,
    /// Gaussians in a shell around the scene that represent open water and sky. Default 1024
    /// (bench/history.jsonl). 0 omits the shell (3DGS). Runs without a coarse model begin with it. It uses at
    /// most a 50th of the run's cap. Under water it exists only where more than half of the light of the
    /// shell comes through. Elsewhere the open-water colour ends every ray.
    pub background_gaussians: u32,
    /// How Gaussians are added and removed: `mcmc` or `classic`. Default mcmc. 3DGS-MCMC samples by opacity,
    /// and applies noise and weights to every Gaussian in every iteration. Here sampling is by gradient
    /// (AbsGS), averaged over the views that see a Gaussian. Only those Gaussians get noise and weights.
    pub strategy: Strategy,
    /// Number of density steps in a run: Gaussians are added, and relocated or removed. Default 40. 0
    /// disables them. 3DGS has 145 steps in 30,000 iterations, one every 100. Shorter runs have too few views
    /// between two steps for that.
    pub refine_steps: u32,
    /// Share of the run after which no Gaussian is added. Default 0.5. The cap is reached here. Only with
    /// `mcmc`.
    pub grow_until: f32,
    /// Share of the run after which no Gaussian is relocated. Default 0.85. Only with `mcmc`.
    pub relocate_until: f32,
    /// Shares of the run at which the SH degree rises to 1, 2 and 3. Default .1, .2, .3.
    pub sh_degree_at: [f32; 3],
    /// Shares of the run at which training goes from a quarter to half and from half to full size. Default
    /// .1, .3.
    pub resolution_at: [f32; 2],
    /// Whether every iteration renders over a new random colour instead of black (`random_bkgd` of gsplat and
    /// nerfstudio). Default false. Photographs are opaque, so with this option no Gaussian can leave dark
    /// parts to the background. Evaluation renders over black in both cases.
    pub random_background: bool,
    /// Whether each training view has an exposure, trained with the Gaussians. Default false. An exposure is
    /// a 3x4 affine map of the rendered colours (3DGS since October 2024). The mean of all exposures is the
    /// identity, which held-out views and exports use. Each partition trains its own exposures.
    pub exposure: bool,
    /// Learning rate of the exposures at the start, for each time that a view is seen. Default 0.01 (3DGS).
    /// It is multiplied by the square root of the number of views, at most by 8. This is as if Adam updated
    /// all of them in every iteration.
    pub exposure_lr: f32,
    /// Learning rate of the exposures at the end of the run, with exponential decay. Default 1e-3 (3DGS).
    pub exposure_lr_end: f32,
    /// Whether Gaussians have the filters of Mip-Splatting (Yu et al. 2024). Default false (3DGS). Pictures
    /// at other sizes than the training size then keep the brightness of thin structures. They show no detail
    /// finer than the photographs have. 3D filter: each Gaussian is smoothed with a variance of 0.2 /
    /// (samples of the closest view per scene unit)^2, as in the paper. The model has this filter in its
    /// scales and opacities. 2D filter: opacity compensates for the low-pass of the projection. Its 0.3 px^2
    /// is that of the antialiased modes of gsplat and of viewers; the paper has 0.1. A comment in the PLY
    /// records this filter. Other viewers show the model as trained when antialiasing is on.
    pub mip_filter: bool,
    /// Weight of the normal consistency of disks: the blended normal of a pixel against the normal of its
    /// expected range (2DGS, Huang et al. 2024, eq. 14). Default 0.05 (2DGS). Only with `method = 2dgs`.
    pub normal_consistency: f32,
    /// Share of the run from which it counts. Default 0.25 (2DGS: 7000 of 30,000).
    pub normal_consistency_from: f32,
    /// Storage of Adam's moments: `compact` or `f32`. Default compact. BENCHMARKS.md has its cost in quality.
    pub moments: Moments,
    /// Threads that read photographs ahead of use. Default 1. 0 reads each when it is needed. Results are the
    /// same.
    pub prefetch_threads: u32,
    /// Iterations between two measurements of PSNR and SSIM on the held-out views. Default 0. 0 disables
    /// them. The progress of the job and metrics.json include them. Training does not depend on them. Only
    /// runs that train the whole scene measure: a job with one partition, and otherwise the coarse model.
    pub eval_every: u32,
    /// Seconds between checkpoints. Default 30.
    pub checkpoint_seconds: u32,
    /// Seconds between previews: small pictures of `preview_views` held-out views, which show how far a run
    /// is. Default 30. 0 makes none. The pauses grow to an eighth of the time that a run has taken. Training
    /// does not depend on previews.
    pub preview_seconds: u32,
    /// Held-out views of each run in previews, at most 8. Default 2. A partition takes those whose cameras
    /// are closest to the middle of its own cameras.
    pub preview_views: u32,
    /// Thresholds and times of `classic`.
    pub classic: ClassicConfig,
    /// Factor on the whole loss. Default 1. Set by a task, never by a user (`partition.weights =
    /// loss_factor`).
    #[serde(skip)]
    pub loss_factor: f32,
    /// Whether Gaussians are disks. Set by `method`, never by itself.
    #[serde(skip)]
    pub disks: bool,
    /// Shares of the cap of the three sets of a scene with a water surface (`surface.shares`). Set by
    /// `method`, never by itself.
    #[serde(skip)]
    pub sets: Option<[f32; 3]>,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            iterations: 12_000,
            max_gaussians: 3_000_000,
            sh_degree: 3,
            ssim_weight: 0.2,
            means_lr: 1.6e-4,
            means_lr_end: 1.6e-6,
            sh_dc_lr: 2.5e-3,
            sh_rest_lr: 1.25e-3,
            opacity_lr: 0.05,
            scales_lr: 4e-2,
            quats_lr: 3e-3,
            anneal_from: 0.85,
            anneal_to: 0.1,
            opacity_reg: 0.01,
            scale_reg: 0.01,
            mean_noise: 5e3,
            background_gaussians: 1024,
            strategy: Strategy::Mcmc,
            refine_steps: 40,
            grow_until: 0.5,
            relocate_until: 0.85,
            sh_degree_at: [0.1, 0.2, 0.3],
            resolution_at: [0.1, 0.3],
            random_background: false,
            exposure: false,
            exposure_lr: 0.01,
            exposure_lr_end: 1e-3,
            mip_filter: false,
            normal_consistency: 0.05,
            normal_consistency_from: 0.25,
            moments: Moments::Compact,
            prefetch_threads: 1,
            eval_every: 0,
            checkpoint_seconds: 30,
            preview_seconds: 30,
            preview_views: 2,
            classic: ClassicConfig::default(),
            loss_factor: 1.0,
            disks: false,
            sets: None,
        }
    }
}

impl TrainConfig {
    /// How its Gaussians are rendered.
    pub fn drawing(&self) -> Drawing {
        Drawing { mip_filter: self.mip_filter, disks: self.disks }
    }

    /// How often a picture with a longest side of `side` pixels is halved when the schedule asks for `wanted`
    /// halvings. The result keeps at least 96 pixels.
    pub fn halvings(wanted: u32, side: u32) -> u32 {
        const LEAST_SIDE: u32 = 96;
        (0..=wanted).rev().find(|level| side >> level >= LEAST_SIDE).unwrap_or(0)
    }

    /// The schedule of a run that begins with a trained model: full size and all harmonics from the start.
    /// Otherwise the run would undo what the model has learnt.
    #[must_use]
    pub fn continued(self) -> Self {
        Self { sh_degree_at: [0.0; 3], resolution_at: [0.0; 2], ..self }
    }
}
