//! The twins: every stage of the renderer and the trainer as plain f64 loops, forward and backward.
//!
//! This is a separate package for tests and examples; the program does not contain it.
//!
//! The twins compute the same as the kernels in `shaders/`, in the same order, and the kernels are tested
//! against them. `shaders/README.md` lists the twin of each kernel. Twins are slow and never run in a
//! training job. Their backward passes are tested against central differences, and the tile-based rasteriser
//! against a renderer without tiles. A render and the loss, forward and backward, are also tested against
//! other projects (`core/tests/peers`).
//!
//! Conventions: camera x right, y down, z forward; pixels from the top left with centres at +0.5; arrays are
//! row-major. `v_x` is the gradient of the loss with respect to `x`. Each Gaussian has one splat at its own
//! index, so the output of a kernel can be the input of the next twin.

mod adam;
#[cfg(test)]
mod brute_force;
mod chain;
mod dbdr;
mod disks;
mod exposure;
mod film;
#[cfg(test)]
mod finite_differences;
mod gaussians64;
mod intersect;
mod loss;
mod normals;
mod priors;
mod project_backward;
mod project_forward;
mod rasterize_backward;
mod rasterize_forward;
pub mod samples;
mod spherical_harmonics;
mod surface;
mod water;

pub use adam::{
    AdamState, BETA_1, BETA_2, EPSILON, LearningRates, MAX_LR_SCALE, adam, adam_compact, adam_update,
    adam_update_with, lr_scale,
};
pub use chain::{ViewGradients, ViewInput, render, view_gradients};
pub use dbdr::{RefinementState, form_refined, form_refined_backward};
pub use disks::{
    Disk, DiskGradient, DiskRaster, DiskRasterGradients, DiskRay, RayGradient, bounds_of, pinhole_rays,
    project_disks, project_disks_backward, project_seen, project_seen_backward, trace_backward,
    trace_backward_along, trace_forward,
};
pub use exposure::{Exposure, ExposureState, IDENTITY, expose, expose_backward};
pub use film::{Embedding, FilmGradients, FilmPicture, FilmState, FilmWeights, UNITS, film, film_backward};
pub use gaussians64::Gaussians64;
pub use intersect::{TileLists, depth_order, intersect, min_sigma_in_rect};
pub use loss::{Loss, SSIM_TAPS, loss, ssim_map, unpack};
pub use normals::{NormalConsistency, normal_consistency};
pub use priors::{
    DarkChannel, LEAST_ATTENUATION, PriorLoss, PriorView, channel_weights, dark_channel, depth_smoothness,
    patch_minima,
};
pub use project_backward::project_backward;
pub use project_forward::{Splat, project_forward};
pub use rasterize_backward::{RasterGradients, SplatGradient, rasterize_backward};
pub use rasterize_forward::{Raster, rasterize_forward};
pub use spherical_harmonics::{sh_basis_gradient, sh_colour, sh_colour_backward};
pub use surface::{
    PictureGradients, Pictures, PlaneState, RayGradients, Sight, SurfaceRays, WaterSurface, compose,
    compose_backward, mask_loss, plane_gradients, refracted_outline, surface_rays, trace_per_hit,
};
pub use water::{
    Blended, MAX_COLOUR_LR_SCALE, WaterState, decode, encode, form, form_backward, in_water,
    in_water_backward, lr_scale_under_water,
};

/// Gaussians nearer than this along z are not drawn, scene units.
pub const NEAR: f64 = 0.01;
/// Variance of the low-pass filter on every projected Gaussian, px^2 (3DGS).
pub const BLUR: f64 = 0.3;
/// Variance of the low-pass of disks, px^2. 2DGS has 0.5, which blurs disks of about a pixel.
pub const DISK_BLUR: f64 = 0.2;
/// Side of a tile, pixels.
pub const TILE: u32 = 16;

/// The hard edges of blending, and the effect of the low-pass on opacity. Central differences need the edges
/// switched off ([`RasterRules::SMOOTH`]).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterRules {
    /// A contribution below this is skipped; it also bounds the ellipse. 1/255: a smaller one changes an
    /// 8-bit value by less than one step.
    pub min_alpha: f64,
    /// A pixel stops before a contribution that would leave less than this: (1 - `max_alpha`)^2.
    pub min_transmittance: f64,
    /// Cap of one contribution, so that dividing by 1 - alpha is safe.
    pub max_alpha: f64,
    /// Whether opacity compensates for the low-pass: the 2D filter of Mip-Splatting (Yu et al. 2024, eq. 9).
    pub mip_filter: bool,
}

impl RasterRules {
    /// The rules of the kernels.
    pub const HARD: Self =
        Self { min_alpha: 1.0 / 255.0, min_transmittance: 1e-4, max_alpha: 0.99, mip_filter: false };
    /// No edge: every Gaussian reaches every pixel, and the image is a smooth function of the model
    /// wherever no two depths swap.
    pub const SMOOTH: Self =
        Self { min_alpha: 0.0, min_transmittance: 0.0, max_alpha: 1.0, mip_filter: false };
}

impl Default for RasterRules {
    fn default() -> Self {
        Self::HARD
    }
}
