//! Mirrors of the uniform structs and counters of `shaders/shared/`. A test compares every offset with naga's
//! reflection.

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use super::Output;
use crate::memory::MAX_TILES;
use crate::scene::{PinholeCamera, Pose};
use crate::water::{ByDirection, RangeModulation, Water};

/// Counts per workgroup of a scan.
pub(crate) const SCAN_CHUNK: u32 = 1024;
/// Keys per workgroup of a sort.
pub(crate) const SORT_CHUNK: u32 = 2048;
/// Digit values per pass of a sort.
pub(crate) const SORT_BINS: u32 = 64;
/// Bits per pass of a sort.
pub(crate) const SORT_BITS: u32 = 6;
/// Bits of a depth key: z from NEAR to beyond 1e36.
pub(crate) const DEPTH_BITS: u32 = 30;

/// Slots of the counters and of the indirect arguments (`shaders/shared/counters.wgsl`).
#[expect(missing_docs, reason = "named and explained in the shader")]
pub mod counter {
    pub const GAUSSIANS: u32 = 0;
    pub const VISIBLE: u32 = 1;
    pub const INTERSECTIONS: u32 = 2;
    pub const DEPTH_HISTOGRAM: u32 = 3;
    pub const TILE_HISTOGRAM: u32 = 4;
    pub const OVERFLOW: u32 = 5;
    pub const FAILED_AT: u32 = 6;
    pub const NEEDED_VISIBLE: u32 = 7;
    pub const NEEDED_INTERSECTIONS: u32 = 8;
    pub const COUNT: u32 = 16;

    pub const ARGS_VISIBLE: u32 = 0;
    pub const ARGS_VISIBLE_SCAN: u32 = 1;
    pub const ARGS_DEPTH_SORT: u32 = 2;
    pub const ARGS_DEPTH_SCAN: u32 = 3;
    pub const ARGS_TILE_SORT: u32 = 4;
    pub const ARGS_TILE_SCAN: u32 = 5;
    pub const ARGS_INTERSECT: u32 = 6;
    pub const ARGS_BLOCK: u32 = 8;
}

/// `Frame` of `shared/frame.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct FrameUniform {
    pub view_x: [f32; 4],
    pub view_y: [f32; 4],
    pub view_z: [f32; 4],
    pub eye: [f32; 3],
    pub sh_degree: u32,
    pub focal: [f32; 2],
    pub principal: [f32; 2],
    pub ratio_min: [f32; 2],
    pub ratio_max: [f32; 2],
    pub background: [f32; 3],
    pub iteration: u32,
    pub size: [u32; 2],
    pub tiles: [u32; 2],
    pub visible_capacity: u32,
    pub intersect_capacity: u32,
    pub gaussians: u32,
    pub blocks: u32,
    pub rect_min: [f32; 2],
    pub rect_max: [f32; 2],
    pub first_tile: u32,
    pub end_tile: u32,
    pub mip_filter: u32,
    pub medium: u32,
}

impl FrameUniform {
    /// The part that depends on the camera; the frame fills in counts and capacities. `tile` as given by
    /// [`super::Gpu::tile`].
    pub fn of_camera(camera: &PinholeCamera, pose: &Pose, tile: u32) -> Self {
        let rotation = glam::DMat3::from_quat(pose.rotation);
        let t = pose.translation;
        let row = |i: usize| {
            let r = rotation.row(i);
            [r.x as f32, r.y as f32, r.z as f32, t[i] as f32]
        };
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        // 15 % of the image size outside each edge (gsplat): 0.3 * tan(half the field of view).
        let margin = [0.15 * w / camera.fx, 0.15 * h / camera.fy];
        Self {
            view_x: row(0),
            view_y: row(1),
            view_z: row(2),
            eye: pose.centre().as_vec3().to_array(),
            focal: [camera.fx as f32, camera.fy as f32],
            principal: [camera.cx as f32, camera.cy as f32],
            ratio_min: [
                (-camera.cx / camera.fx - margin[0]) as f32,
                (-camera.cy / camera.fy - margin[1]) as f32,
            ],
            ratio_max: [
                ((w - camera.cx) / camera.fx + margin[0]) as f32,
                ((h - camera.cy) / camera.fy + margin[1]) as f32,
            ],
            ..Self::default()
        }
        .with_size([camera.width, camera.height], tile)
    }

    /// The same for an image of another size, all of which is processed.
    pub fn with_size(self, [width, height]: [u32; 2], tile: u32) -> Self {
        let tiles = [width.div_ceil(tile), height.div_ceil(tile)];
        Self {
            size: [width, height],
            tiles,
            rect_min: [0.0; 2],
            rect_max: [width as f32, height as f32],
            first_tile: 0,
            end_tile: tiles[0] * tiles[1],
            ..self
        }
    }

    /// The same view limited to tiles `first..end`, in reading order; `tile` as given by
    /// [`super::Gpu::tile`].
    pub fn with_band(&self, tiles: std::ops::Range<u32>, tile: u32) -> Self {
        let columns = self.tiles[0].max(1);
        let (top, bottom) = (tiles.start / columns, (tiles.end.max(1) - 1) / columns);
        // A band inside one row of tiles is as narrow as its tiles; any other is as wide as the image.
        let (left, right) =
            if top == bottom { (tiles.start % columns, (tiles.end - 1) % columns) } else { (0, columns - 1) };
        let edge = |index: u32, size: u32| ((index + 1) * tile).min(size) as f32;
        Self {
            rect_min: [(left * tile) as f32, (top * tile) as f32],
            rect_max: [edge(right, self.size[0]), edge(bottom, self.size[1])],
            first_tile: tiles.start,
            end_tile: tiles.end,
            ..*self
        }
    }

    /// Number of bands for a view whose lists need `count` bands: more if it has too many tiles, at most one
    /// per tile.
    pub fn band_count(&self, count: u32) -> u32 {
        let tiles = self.tile_count();
        count.max(tiles.div_ceil(MAX_TILES)).clamp(1, tiles.max(1))
    }

    /// The view cut into [`FrameUniform::band_count`] bands of equally many tiles. One band is the view
    /// itself.
    pub fn bands(&self, count: u32, tile: u32) -> Vec<Self> {
        let (tiles, count) = (self.tile_count(), self.band_count(count));
        let border = |index: u32| (u64::from(tiles) * u64::from(index) / u64::from(count)) as u32;
        (0..count).map(|index| self.with_band(border(index)..border(index + 1), tile)).collect()
    }

    /// Number of tiles.
    pub fn tile_count(&self) -> u32 {
        self.tiles[0] * self.tiles[1]
    }
}

/// `Block` of `shared/gaussian.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct BlockUniform {
    pub base: u32,
    pub count: u32,
    pub index: u32,
    pub sh_stride: u32,
}

/// `Step` of `project_backward.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct StepUniform {
    pub means_lr: f32,
    pub quats_lr: f32,
    pub scales_lr: f32,
    pub opacity_lr: f32,
    pub sh_dc_lr: f32,
    pub sh_rest_lr: f32,
    pub opacity_reg: f32,
    pub scale_reg: f32,
    pub mean_noise: f32,
    pub overwhite_weight: f32,
    pub floater_weight: f32,
    pub mask_lr: f32,
    pub seed: u32,
    pub gradients_only: u32,
    pub trainable: u32,
    pub clear_range: f32,
}

/// `LossParams` of `shared/ssim.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct LossUniform {
    pub size: [u32; 2],
    pub channel: u32,
    pub masked: u32,
    pub ssim_weight: f32,
    pub scale: f32,
    pub log_at: u32,
    pub pad: u32,
    pub weights_a: [[f32; 4]; 18],
    pub weights_b: [[f32; 4]; 18],
}

impl LossUniform {
    /// For one channel of an image.
    pub fn new(size: [u32; 2], channel: u32, masked: bool, ssim_weight: f32, log_at: u32) -> Self {
        let window = window();
        let weight =
            |offset: i32| usize::try_from(offset).ok().and_then(|i| window.get(i)).copied().unwrap_or(0.0);
        let row = |k: usize, first: i32| std::array::from_fn(|j| weight(k as i32 - first - j as i32));
        Self {
            size,
            channel,
            masked: u32::from(masked),
            ssim_weight,
            scale: 1.0 / (3.0 * size[0] as f32 * size[1] as f32),
            log_at,
            pad: 0,
            weights_a: std::array::from_fn(|k| row(k, 0)),
            weights_b: std::array::from_fn(|k| row(k, 4)),
        }
    }
}

/// `Exposure` of `shared/exposure.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct ExposureUniform {
    pub pixels: u32,
    pub view: u32,
    pub views: u32,
    pub pad0: u32,
    pub rate: f32,
    pub unbias1: f32,
    pub unbias2: f32,
    pub pad1: f32,
}

/// `Film` of `shared/film.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct FilmUniform {
    pub size: [u32; 2],
    pub cells: [u32; 2],
    pub view: u32,
    pub views: u32,
    pub rate: f32,
    pub unbias1: f32,
    pub unbias2: f32,
    pub view_rate: f32,
    pub view_unbias1: f32,
    pub view_unbias2: f32,
}

/// Values of [`FrameUniform::medium`] (`shaders/shared/water.wgsl`).
#[expect(missing_docs, reason = "named and explained in the shader")]
pub mod medium {
    pub const NONE: u32 = 0;
    pub const PER_GAUSSIAN: u32 = 1;
    pub const DECODED: u32 = 2;
    pub const VEIL: u32 = 3;
    pub const PER_GAUSSIAN_SRGB: u32 = 4;
    pub const VEIL_SRGB: u32 = 5;
    pub const AS_SHOWN: u32 = 6;
    pub const OVER_BLACK: u32 = 7;

    use super::Output;
    use crate::config::Composition;

    /// The value that renders `output` of a scene under water.
    pub(crate) fn of(composition: Composition, output: Output) -> u32 {
        match (composition, output) {
            (Composition::GaussiansSrgb, Output::Underwater) => PER_GAUSSIAN_SRGB,
            (Composition::GaussiansSrgb, Output::Backscatter) => VEIL_SRGB,
            (Composition::GaussiansLinear, Output::Underwater) => PER_GAUSSIAN,
            (Composition::GaussiansLinear, Output::Backscatter) => VEIL,
            (Composition::GaussiansLinear, Output::Restored) | (Composition::PixelsLinear, _) => DECODED,
            (_, Output::Restored) => NONE,
            (Composition::PixelsSrgb, _) => AS_SHOWN,
            (Composition::PixelsOverBlack, _) => OVER_BLACK,
        }
    }
}

/// `Water` of `shared/water.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct WaterUniform {
    pub beta_d: [f32; 3],
    pub scale: f32,
    pub beta_b: [f32; 3],
    pub per_unit: f32,
    pub b_inf: [f32; 3],
    pub most: f32,
    pub refinement: [f32; 4],
    pub red: [f32; 4],
    pub green: [f32; 4],
    pub blue: [f32; 4],
}

impl From<&Water> for WaterUniform {
    fn from(water: &Water) -> Self {
        let [beta_d, beta_b, b_inf] =
            [water.beta_d, water.beta_b, water.b_inf].map(|three| three.map(|value| value as f32));
        Self { beta_d, beta_b, b_inf, ..Self::default() }
    }
}

impl WaterUniform {
    /// The same with coefficients that depend on range.
    #[must_use]
    pub fn with_refinement(self, refinement: &RangeModulation) -> Self {
        Self {
            scale: refinement.scale as f32,
            per_unit: (1.0 / refinement.unit) as f32,
            refinement: refinement.to_array().map(|value| value as f32),
            ..self
        }
    }

    /// The same with a colour of open water that changes with direction.
    #[must_use]
    pub fn with_direction(self, by_direction: &ByDirection) -> Self {
        let middle = DVec3::from(by_direction.middle);
        let [red, green, blue] = by_direction.slopes.map(|slope| {
            let [x, y, z] = slope.map(|value| value as f32);
            [x, y, z, -DVec3::from(slope).dot(middle) as f32]
        });
        Self { most: by_direction.most as f32, red, green, blue, ..self }
    }
}

/// `WaterState` of `water_step.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct WaterState {
    pub raw: [f32; 9],
    pub moment1: [f32; 9],
    pub moment2: [f32; 9],
    pub left_out: f32,
    pub shares: [f32; 9],
    pub gathered: [f32; 9],
    pub gathered_iterations: f32,
}

/// `DbdrState` of `dbdr_step.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct DbdrState {
    pub raw: [f32; 4],
    pub moment1: [f32; 4],
    pub moment2: [f32; 4],
    pub left_out: f32,
    pub pad: [f32; 3],
}

/// `Dbdr` of `dbdr_step.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct DbdrUniform {
    pub rows: u32,
    pub rate: f32,
    pub unbias1: f32,
    pub unbias2: f32,
}

/// `Medium` of `shared/medium.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct MediumUniform {
    pub pixels: u32,
    pub compose: u32,
    pub encode: u32,
    pub rows: u32,
    pub gaussian_rows: u32,
    pub masked: u32,
    pub unit: f32,
    pub rate: f32,
    pub unbias1: f32,
    pub unbias2: f32,
    pub decay: f32,
    pub background_weight: f32,
    pub background_distance: f32,
    pub surface_weight: f32,
    pub gathers: u32,
    pub map_columns: u32,
    pub map_rows: u32,
    pub open_weight: f32,
    pub range_weight: f32,
    pub range_slack: f32,
    pub edge_distance: f32,
}

/// `Priors` of `shared/priors.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct PriorsUniform {
    pub size: [u32; 2],
    pub masked: u32,
    pub on_photograph: u32,
    pub linear: u32,
    pub radius: u32,
    pub unit: f32,
    pub dark_weight: f32,
    pub negative: f32,
    pub smooth_weight: f32,
    pub pad0: f32,
    pub pad1: f32,
}

/// `Normals` of `shared/normals.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct NormalsUniform {
    pub weight: f32,
    pub least_alpha: f32,
    pub pad_a: f32,
    pub pad_b: f32,
}

/// `Surface` of `shared/surface.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct SurfaceUniform {
    pub normal: [f32; 3],
    pub offset: f32,
    pub eta: f32,
    pub schlick: u32,
    pub as_shown: u32,
    pub over: u32,
}

/// `SurfaceStep` of `surface_step.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct SurfaceStepUniform {
    pub rows: u32,
    pub offset_rate: f32,
    pub tilt_rate: f32,
    pub unbias1: f32,
    pub unbias2: f32,
    pub pad: u32,
    pub pad1: u32,
    pub pad2: u32,
    pub pivot: [f32; 3],
    pub pad3: f32,
}

/// `SurfaceState` of `surface_step.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct SurfaceState {
    pub moment1: [f32; 4],
    pub moment2: [f32; 4],
    pub left_out: f32,
    pub pad0: f32,
    pub pad1: f32,
    pub pad2: f32,
}

/// `MaskLoss` of `surface_mask.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[expect(missing_docs, reason = "explained in the shader")]
pub struct MaskLossUniform {
    pub cells: [u32; 2],
    pub first: u32,
    pub weight: f32,
}

/// Rows of partial sums of `water_gradients` for this many Gaussians in this many blocks. The last block
/// counts as full.
pub(crate) fn water_rows(gaussians: u32, blocks: u32) -> u32 {
    gaussians.div_ceil(64) + blocks + 1
}

/// The Gaussian window of SSIM: 11 taps, sigma 1.5, sum 1 (Wang et al. 2004; 3DGS).
fn window() -> [f32; 11] {
    let raw: [f64; 11] = std::array::from_fn(|i| (-(i as f64 - 5.0).powi(2) / (2.0 * 1.5 * 1.5)).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|value| (value / sum) as f32)
}
