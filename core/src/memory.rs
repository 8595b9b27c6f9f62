//! Forecasts the GPU memory of a run before it begins: the lengths of its lists, and its peak.
//!
//! A coordinator uses it for forecasts, without a GPU. The trainer allocates its lists with the lengths from
//! [`RunSize::lists`], so that they seldom grow and the forecast holds. `core/tests/forecast.rs` compares the
//! sizes below with the buffers of real runs, and the forecast with their peak.
//!
//! Two quantities are estimated. The number of Gaussians in the fullest view follows from the positions of
//! the points ([`visible_in_fullest_view`]). The number of tiles that they touch follows from a formula
//! fitted to measured runs ([`RunSize::lists`]).

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::appearance::{self, Settings};
use crate::config::{Moments, TrainConfig};
use crate::scene::{PinholeCamera, Pose};

/// Bytes per Gaussian for mean, quaternion, log scale and opacity: three vec4.
pub const TRANSFORM_BYTES: u64 = 48;
/// Bytes per Gaussian in the lists of a view, visible or not: its flag.
pub const FLAG_BYTES: u64 = 4;
/// Bytes per trained Gaussian for the statistics of density control and its steps: a vec4.
pub const STATISTICS_BYTES: u64 = 16;
/// Bytes per visible Gaussian: its splat (three vec4), index, segment (two words) and offset; key and value
/// of the depth sort, twice.
pub const VISIBLE_BYTES: u64 = 80;
/// Bytes per intersection: its Gaussian; key and value of the tile sort, twice; its gradient (three vec4).
pub const INTERSECTION_BYTES: u64 = 68;
/// Bytes per intersection for its gradient, which rendering alone does not need.
pub const GRADIENT_BYTES: u64 = 48;
/// Bytes per trained Gaussian for its sums if views are rendered in bands: three vec4.
pub const BAND_BYTES: u64 = 48;
/// Bytes per visible disk, beside those of a Gaussian: its three vec4 in the camera's frame.
pub const DISK_BYTES: u64 = 48;
/// Bytes per intersection of a disk for its gradient: five vec4.
pub const DISK_GRADIENT_BYTES: u64 = 80;
/// Bytes per pixel of disks, beside those of Gaussians. The first is the blended normal (vec4). The second is
/// for training: its gradient, two vec4 for the backward pass, and the gradient of the mask.
pub const DISK_PIXEL_BYTES: [u64; 2] = [16, 52];
/// Bytes per pixel of the reflected and the refracted set of a scene with a water surface: render and rays
/// (two vec4) of each.
pub const SET_PIXEL_BYTES: u64 = 2 * (RENDER_BYTES + 32);
/// Bytes per pixel of the surface: the picture (vec4), gradients of the two pictures (vec4) and of their rays
/// (two vec4), and that of the reflectance.
pub const SURFACE_PIXEL_BYTES: u64 = 16 + 2 * 16 + 2 * 32 + 4;

/// Bytes of the gradient of an intersection, and of the sums of bands of a Gaussian.
pub fn slot_bytes(disks: bool) -> u64 {
    if disks { DISK_GRADIENT_BYTES } else { GRADIENT_BYTES }
}

/// Bytes per visible Gaussian or disk.
pub fn visible_bytes(disks: bool) -> u64 {
    VISIBLE_BYTES + if disks { DISK_BYTES } else { 0 }
}

/// Bytes per intersection of a Gaussian or a disk.
pub fn intersection_bytes(disks: bool) -> u64 {
    INTERSECTION_BYTES - GRADIENT_BYTES + slot_bytes(disks)
}

/// Bytes per pixel of the render: colour and alpha (vec4) and range.
pub const RENDER_BYTES: u64 = 20;
/// Bytes per pixel of the loss: photograph, three SSIM maps (vec4), gradients of colour (vec4) and of range.
pub const LOSS_BYTES: u64 = 72;
/// Bytes per pixel of a photograph.
pub const PHOTOGRAPH_BYTES: u64 = 4;

/// Maximum bytes of photographs kept on the device: 64 at 1080p.
pub const RESIDENT_BYTES: u64 = 512 << 20;
/// Maximum bytes of writes in staging buffers until the device has copied them; a larger write waits alone.
/// Without a limit, an upload takes the memory of a whole model twice, and photographs queue up if the device
/// is slower than the host. 128 MiB hold 15 photographs at 1080p, about one batch ([`BATCH`]).
pub const STAGED_BYTES: u64 = 128 << 20;
/// Iterations between two waits for the device, after which the staging buffers are empty.
pub const BATCH: u32 = 16;
/// Gaussians in a full block, the unit of reading back.
pub const BLOCK_CAPACITY: u32 = 512 * 1024;

/// Gaussians in a full block that is trained with these moments. In f32 the moments of the coefficients are
/// one array of twice the coefficients' size.
pub fn block_capacity(moments: Moments) -> u32 {
    match moments {
        Moments::Compact => BLOCK_CAPACITY,
        Moments::F32 => BLOCK_CAPACITY / 2,
    }
}

/// Maximum number of tiles processed at once, in a strip of a picture or a band of a view. With tiles of 16 x
/// 16, their colours take 128 MiB, the smallest maximum binding size of devices; a picture of 3840 x 2160 has
/// fewer tiles. With tiles of 8 x 8, on CPU adapters, it is the largest power of two that a splat can cover.
/// Lavapipe ends all loops of a thread after 65,535 iterations in total, and `intersect_emit` takes one per
/// tile.
pub const MAX_TILES: u32 = 32 * 1024;

/// Side of the smallest tiles, those of CPU adapters, pixels. Forecasts use it if the adapter is unknown.
/// Tiles of a GPU are 16 x 16, which makes lists by intersection about a third shorter, by the formula of
/// [`RunSize::lists`].
pub const SMALLEST_TILE: u32 = 8;
/// Maximum binding size of common GPUs, bytes (2 GiB and more). Forecasts use it if the adapter is unknown.
/// With a smaller limit (128 MiB on lavapipe), views of millions of Gaussians are divided into bands, and a
/// run takes less.
pub const COMMON_BINDING_BYTES: u64 = 2 << 30;

/// Factor on the estimated number of Gaussians in the fullest view. It covers Gaussians outside the picture
/// that reach into it, and Gaussians that move into the views. On sesa-wreck, a view has a quarter of the
/// points but a third of the Gaussians.
const ROOM: f64 = 1.4;
/// Layers of Gaussians over each tile: `(LAYERS_AT_LEAST + LAYERS_BY_DENSITY * sqrt(visible Gaussians per
/// tile))^2`.
///
/// A splat r tiles wide touches about (1 + r)^2 tiles. For splats that fill a picture, r is proportional to 1
/// / sqrt(density), which gives this form. It was fitted to the fullest views of fox, reef-clip and
/// sesa-wreck (bench/history.jsonl).
const LAYERS_AT_LEAST: f64 = 9.5;
const LAYERS_BY_DENSITY: f64 = 1.75;
/// Maximum intersections per visible Gaussian in preallocated lists: a run with few Gaussians in large
/// pictures grows its lists instead.
const MOST_TILES: u64 = 32;
/// Minimum lengths of lists.
const LEAST_VISIBLE: u64 = 256;
const LEAST_INTERSECTIONS: u64 = 4096;

/// Bytes of the longest row in the lists of a view: splats by visible Gaussian, gradients by intersection.
pub const LONGEST_ROW_BYTES: u64 = 48;

/// Maximum length of the lists of a view for bindings of up to `binding_bytes`, of 3D Gaussians or of disks.
pub fn most_rows(binding_bytes: u64, disks: bool) -> u32 {
    let longest = LONGEST_ROW_BYTES.max(slot_bytes(disks));
    u32::try_from(binding_bytes / longest).unwrap_or(u32::MAX)
}

/// Bytes per Gaussian for its coefficients: three channels of f32, in groups of four coefficients.
pub fn coefficient_bytes(sh_degree: u8) -> u64 {
    48 * (u64::from(sh_degree) + 1).pow(2).div_ceil(4)
}

/// Bytes per rendered but untrained Gaussian, without its flag.
pub fn frozen_bytes(sh_degree: u8) -> u64 {
    TRANSFORM_BYTES + coefficient_bytes(sh_degree)
}

/// Bytes per Gaussian for all moments except those of the coefficients.
fn transform_moment_bytes(moments: Moments) -> u64 {
    match moments {
        Moments::Compact => 64,
        Moments::F32 => 2 * TRANSFORM_BYTES,
    }
}

/// Bytes per trained Gaussian with its moments and statistics, without its flag.
pub fn trained_bytes(sh_degree: u8, moments: Moments) -> u64 {
    let colour = coefficient_bytes(sh_degree);
    let colour_moments = match moments {
        Moments::Compact => colour / 2,
        Moments::F32 => 2 * colour,
    };
    frozen_bytes(sh_degree) + transform_moment_bytes(moments) + colour_moments + STATISTICS_BYTES
}

/// Bytes per pixel of a training picture during training.
pub fn pixel_bytes(settings: Settings<'_>) -> u64 {
    let of_disks: u64 = if settings.train.disks { DISK_PIXEL_BYTES.iter().sum() } else { 0 };
    let of_sets = if settings.train.sets.is_some() { SET_PIXEL_BYTES + SURFACE_PIXEL_BYTES } else { 0 };
    RENDER_BYTES + LOSS_BYTES + appearance::pixel_bytes(settings) + of_disks + of_sets
}

/// Lengths of the lists of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lists {
    /// Visible Gaussians.
    pub visible: u32,
    /// Intersections of Gaussians with tiles.
    pub intersections: u32,
    /// Whether the fullest views exceed what the device can bind, so that they are rendered in bands.
    pub in_bands: bool,
}

/// The quantities that determine the memory of a run.
#[derive(Clone, Debug)]
pub struct RunSize<'a> {
    /// Resolved configuration, with the `iterations` of this run, and the water if there is one.
    pub settings: Settings<'a>,
    /// Cap on the trained Gaussians.
    pub trained: u64,
    /// Number of Gaussians that are rendered but not trained.
    pub frozen: u64,
    /// How many of both are in the fullest view at the cap: [`visible_in_fullest_view`].
    pub visible: u64,
    /// Width and height of every training picture.
    pub pictures: &'a [[u32; 2]],
    /// Side of a tile, pixels; [`SMALLEST_TILE`] if unknown.
    pub tile: u32,
    /// Maximum binding size of the device, bytes; [`COMMON_BINDING_BYTES`] if unknown.
    pub binding_bytes: u64,
    /// Whether held-out views are measured during the run (`train.eval_every`).
    pub measures: bool,
}

/// Peak GPU memory of a run by use, bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MemoryForecast {
    /// Gaussians with moments, statistics and flags.
    pub gaussians: u64,
    /// Lists by visible Gaussian.
    pub per_visible: u64,
    /// Lists by intersection, gradients included.
    pub per_intersection: u64,
    /// Buffers of picture size: render, loss and its gradients.
    pub pixels: u64,
    /// Photographs kept on the device.
    pub photographs: u64,
    /// Pending transfers to or from the device: photographs, or the largest array of a checkpoint.
    pub transfers: u64,
    /// A second copy of the model with its own lists, if held-out views are measured during the run.
    pub measuring: u64,
}

impl MemoryForecast {
    /// The sum of all parts.
    pub fn total(&self) -> u64 {
        let Self { gaussians, per_visible, per_intersection, pixels, photographs, transfers, measuring } =
            self;
        gaussians + per_visible + per_intersection + pixels + photographs + transfers + measuring
    }
}

impl RunSize<'_> {
    /// Initial lengths of the lists: enough for the fullest view at the cap, as far as it can be predicted
    /// and the device can bind them. They grow if a view needs more. Training results do not depend on them.
    pub fn lists(&self) -> Lists {
        let all = self.trained + self.frozen;
        let visible = ((self.visible as f64 * ROOM).ceil() as u64).min(all).max(LEAST_VISIBLE.min(all));
        let tiles = self.pictures.iter().map(|[w, h]| w.div_ceil(self.tile) * h.div_ceil(self.tile)).max();
        let tiles = f64::from(tiles.unwrap_or(1));
        let layers = (LAYERS_AT_LEAST + LAYERS_BY_DENSITY * (visible as f64 / tiles).sqrt()).powi(2);
        let intersections = ((tiles * layers) as u64).min(MOST_TILES * visible).max(LEAST_INTERSECTIONS);
        let most = u64::from(most_rows(self.binding_bytes, self.settings.train.disks));
        Lists {
            visible: visible.min(most) as u32,
            intersections: intersections.min(most) as u32,
            in_bands: visible > most || intersections > most || tiles > f64::from(MAX_TILES),
        }
    }

    /// Bytes per trained Gaussian without its flag: [`trained_bytes`], plus sums if views are rendered in
    /// bands.
    pub fn trained_bytes(&self) -> u64 {
        let config = self.settings.train;
        let bands = if self.lists().in_bands { slot_bytes(config.disks) } else { 0 };
        trained_bytes(config.sh_degree, config.moments) + bands
    }

    /// The sizes of the three sets of a scene with a water surface: straight, refracted, reflected.
    fn sets(&self, shares: [f32; 3]) -> [Self; 3] {
        let sum: f64 = shares.iter().map(|&share| f64::from(share)).sum();
        shares.map(|share| {
            let of = |all: u64| (all as f64 * f64::from(share) / sum.max(1e-9)) as u64;
            Self { trained: of(self.trained).max(1), visible: of(self.visible), frozen: 0, ..self.clone() }
        })
    }

    /// Bytes of the lists of a view: by visible Gaussian, and by intersection.
    fn list_bytes(&self) -> [u64; 2] {
        if let Some(shares) = self.settings.train.sets {
            let each = self.sets(shares).map(|set| set.own_list_bytes());
            return [0, 1].map(|kind| each.iter().map(|bytes| bytes[kind]).sum());
        }
        self.own_list_bytes()
    }

    fn own_list_bytes(&self) -> [u64; 2] {
        let (lists, disks) = (self.lists(), self.settings.train.disks);
        [
            u64::from(lists.visible) * visible_bytes(disks),
            u64::from(lists.intersections) * intersection_bytes(disks),
        ]
    }

    /// Peak memory of the run on the device, except half a MiB for wgpu and less than 1 % for tiles,
    /// histograms and uniforms.
    ///
    /// This is the peak of the allocator: all lists and photographs are present, and the largest transfer is
    /// in progress. If the device keeps up with the uploads, the transfer is smaller.
    pub fn forecast(&self) -> MemoryForecast {
        let config = self.settings.train;
        let all = self.trained + self.frozen;
        let lists = self.lists();
        let (visible, intersections) = (u64::from(lists.visible), u64::from(lists.intersections));
        let frozen_bytes = frozen_bytes(config.sh_degree);
        let pixels = self.pictures.iter().map(area).max().unwrap_or(0);
        let photograph = pixels * PHOTOGRAPH_BYTES;
        let views = self.pictures.len() as u64;
        let colour = coefficient_bytes(config.sh_degree);
        let of_colour = if config.moments == Moments::F32 { 2 * colour } else { colour };
        let read_back = self.trained.min(block_capacity(config.moments).into())
            * of_colour.max(transform_moment_bytes(config.moments));
        let uploaded = (photograph * views.min(BATCH.into())).min(STAGED_BYTES.max(photograph));
        let [per_visible, per_intersection] = self.list_bytes();
        let disks = config.disks;
        let of_disks = if disks { DISK_PIXEL_BYTES[0] } else { 0 };
        let copy = self.trained * (frozen_bytes + FLAG_BYTES)
            + visible * visible_bytes(disks)
            + intersections * (INTERSECTION_BYTES - GRADIENT_BYTES)
            + pixels * (RENDER_BYTES + of_disks)
            + if config.sets.is_some() { pixels * (SET_PIXEL_BYTES + SURFACE_PIXEL_BYTES) } else { 0 }
            + (self.trained * frozen_bytes).min(STAGED_BYTES);
        MemoryForecast {
            gaussians: self.trained * self.trained_bytes() + self.frozen * frozen_bytes + all * FLAG_BYTES,
            per_visible,
            per_intersection,
            pixels: pixels * pixel_bytes(self.settings),
            photographs: self.photographs(),
            transfers: read_back.max(uploaded),
            measuring: if self.measures { copy } else { 0 },
        }
    }

    /// Bytes of the photographs that the run keeps: each at every size used, up to [`RESIDENT_BYTES`].
    fn photographs(&self) -> u64 {
        let views = self.pictures.len().max(1) as f64;
        let iterations = f64::from(self.settings.train.iterations);
        let [quarter, half] = self.settings.train.resolution_at.map(|at| f64::from(at.clamp(0.0, 1.0)));
        let shares = [quarter, half - quarter, 1.0 - half];
        let bytes: f64 = self
            .pictures
            .iter()
            .map(|size| {
                // Iterations at full, half and quarter size.
                let mut at_level = [0.0; 3];
                for (share, wanted) in shares.iter().zip([2, 1, 0]) {
                    at_level[TrainConfig::halvings(wanted, size[0].max(size[1])) as usize] +=
                        share * iterations;
                }
                let levels = at_level.iter().zip(0..);
                levels
                    .map(|(n, level)| (n / views).min(1.0) * (area(size) >> (2 * level)) as f64)
                    .sum::<f64>()
            })
            .sum();
        ((bytes * PHOTOGRAPH_BYTES as f64) as u64).min(RESIDENT_BYTES)
    }
}

fn area([width, height]: &[u32; 2]) -> u64 {
    u64::from(*width) * u64::from(*height)
}

/// Maximum points per group, and maximum views, that [`visible_in_fullest_view`] samples.
const MOST_POINTS: usize = 8192;
const MOST_VIEWS: usize = 512;

/// Numbers of Gaussians in views.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Visible {
    /// In the view that has the most.
    pub fullest: u64,
    /// Mean over views.
    pub mean: f64,
}

/// [`Visible::fullest`] of [`visible_in_views`].
pub fn visible_in_fullest_view(
    views: impl ExactSizeIterator<Item = (PinholeCamera, Pose)>,
    groups: &[(&[DVec3], u64)],
) -> u64 {
    visible_in_views(views, groups).fullest
}

/// Counts the Gaussians in the pictures of views.
///
/// `groups` are Gaussians (or points that represent them), each with its eventual number of Gaussians. The
/// share of the points in a view is taken as the share of the Gaussians. Points and views are thinned evenly.
/// A group without points counts as visible in every view.
pub fn visible_in_views(
    views: impl ExactSizeIterator<Item = (PinholeCamera, Pose)>,
    groups: &[(&[DVec3], u64)],
) -> Visible {
    let step = |count: usize, most: usize| count.div_ceil(most).max(1);
    let sampled: Vec<(Vec<DVec3>, f64)> = groups
        .iter()
        .map(|(points, count)| {
            let sample: Vec<DVec3> =
                points.iter().copied().step_by(step(points.len(), MOST_POINTS)).collect();
            let each = *count as f64 / sample.len().max(1) as f64;
            (sample, each)
        })
        .collect();
    let blind: u64 = groups.iter().filter(|(points, _)| points.is_empty()).map(|(_, count)| count).sum();
    let every = step(views.len(), MOST_VIEWS);
    let seen = views.step_by(every).map(|(camera, pose)| {
        let inside = |point: &&DVec3| {
            let p = pose.transform(**point);
            let (x, y) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
            p.z > 0.0
                && (0.0..f64::from(camera.width)).contains(&x)
                && (0.0..f64::from(camera.height)).contains(&y)
        };
        sampled.iter().map(|(points, each)| points.iter().filter(inside).count() as f64 * each).sum::<f64>()
    });
    let (count, sum, most) =
        seen.fold((0u32, 0.0, 0.0_f64), |(count, sum, most), n| (count + 1, sum + n, most.max(n)));
    let mean = blind as f64 + sum / f64::from(count.max(1));
    Visible { fullest: blind + most.round() as u64, mean }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run<'a>(config: &'a TrainConfig, visible: u64, pictures: &'a [[u32; 2]]) -> RunSize<'a> {
        let (trained, binding_bytes) = (1_000_000, COMMON_BINDING_BYTES);
        RunSize {
            settings: Settings { train: config, water: None },
            trained,
            frozen: 0,
            visible,
            pictures,
            tile: 16,
            binding_bytes,
            measures: false,
        }
    }

    #[test]
    fn bytes_per_gaussian_match_the_layout() {
        assert_eq!(trained_bytes(3, Moments::Compact), 416);
        assert_eq!(trained_bytes(3, Moments::F32), 736);
        // 1, 4, 9 and 16 coefficients take 1, 1, 3 and 4 groups of four.
        assert_eq!([0, 1, 2, 3].map(frozen_bytes), [96, 96, 192, 240]);
    }

    #[test]
    fn fullest_view_counts_each_group_by_its_own_points() {
        let camera = PinholeCamera { width: 100, height: 100, fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0 };
        let looking = |at| (camera, Pose::looking_at(DVec3::ZERO, at, DVec3::Y));
        let ahead = DVec3::new(0.0, 0.0, 5.0);
        let (left, mixed) = ([ahead, ahead, -ahead, DVec3::X], [ahead, -ahead]);
        let views = [looking(DVec3::X), looking(DVec3::Z)];
        let visible = |groups: &[(&[DVec3], u64)]| visible_in_fullest_view(views.iter().copied(), groups);
        assert_eq!(visible(&[(&left, 1000)]), 500);
        assert_eq!(visible(&[(&left, 1000), (&mixed, 60)]), 530);
        assert_eq!(visible(&[(&left, 1000), (&[], 70)]), 570, "a group without points may be anywhere");
        // The other view sees one of the four and one of the two.
        let both = visible_in_views(views.iter().copied(), &[(&left, 1000), (&mixed, 60), (&[], 7)]);
        assert_eq!(both, Visible { fullest: 537, mean: 7.0 + (530.0 + 250.0) / 2.0 });
    }

    #[test]
    fn lists_beyond_a_binding_are_cut_and_bands_add_sums() {
        let config = TrainConfig::default();
        let pictures = [[1600, 1200]];
        let whole = run(&config, 800_000, &pictures);
        let cut = RunSize { binding_bytes: 48 << 20, ..whole.clone() };
        assert!(!whole.lists().in_bands && whole.lists().intersections > 1 << 20);
        assert_eq!(cut.lists(), Lists { visible: 1_000_000, intersections: 1 << 20, in_bands: true });
        assert_eq!(cut.forecast().gaussians - whole.forecast().gaussians, 48_000_000);
        // Pictures with more than the maximum number of tiles also need bands: 200 by 164 tiles of 8 pixels.
        let (most, more) = ([[1600, 1304]], [[1600, 1320]]);
        let bands = |pictures| RunSize { tile: 8, ..run(&config, 100_000, pictures) }.lists().in_bands;
        assert!(!bands(&most) && bands(&more));
    }

    #[test]
    fn photographs_count_at_every_size_used_up_to_the_limit() {
        let long = TrainConfig { iterations: 1000, ..TrainConfig::default() };
        let at =
            |config: &TrainConfig, pictures: &[[u32; 2]]| run(config, 1, pictures).forecast().photographs;
        let full = 4 * 400 * 400;
        assert_eq!(at(&long, &[[400, 400]; 10]), 10 * (full + full / 4 + full / 16));
        assert_eq!(at(&long.clone().continued(), &[[400, 400]; 10]), 10 * full);
        // Halved at most once, so that at least 96 pixels remain.
        assert_eq!(at(&long, &[[200, 200]; 10]), 10 * (full / 4 + full / 16));
        // 7 iterations at full size, 2 and 1 at the others.
        let short = TrainConfig { iterations: 10, ..TrainConfig::default() };
        assert!(at(&short, &[[400, 400]; 10]).abs_diff(7 * full + 2 * full / 4 + full / 16) < 10);
        assert_eq!(at(&long, &[[4000, 4000]; 50]), RESIDENT_BYTES);
    }
}
