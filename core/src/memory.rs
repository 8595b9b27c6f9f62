//! GPU memory of a run, told before it begins: how long its lists should be, and what it will take at its
//! largest.
//!
//! A coordinator forecasts with it, without a GPU; the trainer makes its lists as long as [`RunSize::lists`]
//! says, so that they seldom grow and the forecast holds. `core/tests/forecast.rs` compares the sizes below
//! with the buffers of real runs, and the forecast with their peak.
//!
//! What cannot be known before is estimated: how many Gaussians the fullest view sees, from where the points
//! are ([`visible_in_fullest_view`]), and how many tiles they touch, by a formula fitted to measured runs
//! ([`RunSize::lists`]).

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::appearance::{self, Settings};
use crate::config::{Moments, TrainConfig};
use crate::scene::{PinholeCamera, Pose};

/// Bytes of a Gaussian's mean, quaternion, log scale and opacity: three vec4.
pub const TRANSFORM_BYTES: u64 = 48;
/// Bytes of what every Gaussian has in the lists of a view, seen or not: its flag.
pub const FLAG_BYTES: u64 = 4;
/// Bytes a trained Gaussian takes for the statistics of density control and its steps: a vec4.
pub const STATISTICS_BYTES: u64 = 16;
/// Bytes a visible Gaussian takes: its splat (three vec4), index, segment (two words) and offset; key and
/// value of the depth sort, twice.
pub const VISIBLE_BYTES: u64 = 80;
/// Bytes an intersection takes: its Gaussian; key and value of the tile sort, twice; its gradient (three
/// vec4).
pub const INTERSECTION_BYTES: u64 = 68;
/// Bytes of an intersection's gradient, which rendering alone does not need.
pub const GRADIENT_BYTES: u64 = 48;
/// Bytes a trained Gaussian takes for its sums where views are rendered in bands: three vec4.
pub const BAND_BYTES: u64 = 48;
/// Bytes a pixel of the render takes: colour and alpha (vec4) and range.
pub const RENDER_BYTES: u64 = 20;
/// Bytes a pixel of the loss takes: photograph, three maps of SSIM (vec4), gradients by colour (vec4) and by
/// range.
pub const LOSS_BYTES: u64 = 72;
/// Bytes a pixel of a photograph takes.
pub const PHOTOGRAPH_BYTES: u64 = 4;

/// Bytes of photographs that stay on the device: 64 at 1080p.
pub const RESIDENT_BYTES: u64 = 512 << 20;
/// Content of writes that may wait in staging buffers until the device has copied it, bytes; a larger write
/// waits alone. Without a bound an upload takes the memory of a whole model twice, and photographs queue up
/// behind a device that is slower than the host. 128 MiB are 15 photographs at 1080p, about one look at the
/// device.
pub const STAGED_BYTES: u64 = 128 << 20;
/// Iterations between two looks at the device, after which nothing waits in staging buffers.
pub const BATCH: u32 = 16;
/// Gaussians in a full block: what is read back at once.
pub const BLOCK_CAPACITY: u32 = 512 * 1024;
/// Most tiles that are worked on at once, in a strip of a picture or a band of a view. With tiles of 16 x 16
/// their colours take 128 MiB, the smallest binding that devices have; a picture of 3840 x 2160 has fewer.
/// With tiles of 8 x 8, on CPU adapters, it is the largest power of two that a splat can cover: lavapipe ends
/// all loops of a thread after 65,535 rounds together, and `intersect_emit` takes one for each tile.
pub const MAX_TILES: u32 = 32 * 1024;

/// Side of the smallest tiles, those of CPU adapters, pixels: what a forecast takes that does not know the
/// adapter. Tiles of a GPU are 16 x 16, so its lists by intersection are about a third shorter, by the
/// formula of [`RunSize::lists`].
pub const SMALLEST_TILE: u32 = 8;
/// Longest binding of common GPUs, bytes (2 GiB and more): what a forecast takes that does not know the
/// adapter. Where it is shorter (128 MiB on lavapipe), views of millions of Gaussians are cut into bands, and
/// a run takes less.
pub const COMMON_BINDING_BYTES: u64 = 2 << 30;

/// Room that lists have beyond the estimate of the fullest view, as a factor: what lies outside the picture
/// and reaches into it, and Gaussians that move to where views are (sesa-wreck: a third of them, where a
/// quarter of the points are).
const ROOM: f64 = 1.4;
/// Layers of Gaussians over each tile: `(LAYERS_AT_LEAST + LAYERS_BY_DENSITY * sqrt(visible Gaussians a
/// tile))^2`.
///
/// A splat of r tiles touches about (1 + r)^2 of them, and splats that fill a picture have r in proportion to
/// 1 / sqrt(density), whence the form. Fitted to the fullest views of fox, reef-clip and sesa-wreck
/// (bench/history.jsonl).
const LAYERS_AT_LEAST: f64 = 9.5;
const LAYERS_BY_DENSITY: f64 = 1.75;
/// Most intersections of a visible Gaussian in lists that are made before they are needed: a run with few
/// Gaussians in large pictures grows its lists instead.
const MOST_TILES: u64 = 32;
/// Shortest lists.
const LEAST_VISIBLE: u64 = 256;
const LEAST_INTERSECTIONS: u64 = 4096;

/// Bytes of the longest rows of the lists of a view: splats by visible Gaussian, gradients by intersection.
pub const LONGEST_ROW_BYTES: u64 = 48;

/// How long the lists of a view may be where no binding may exceed `binding_bytes`.
pub fn most_rows(binding_bytes: u64) -> u32 {
    u32::try_from(binding_bytes / LONGEST_ROW_BYTES).unwrap_or(u32::MAX)
}

/// Bytes of the coefficients of a Gaussian: three channels of f32, four coefficients at a time.
pub fn coefficient_bytes(sh_degree: u8) -> u64 {
    48 * (u64::from(sh_degree) + 1).pow(2).div_ceil(4)
}

/// Bytes of a Gaussian that is rendered and never changes, without its flag.
pub fn frozen_bytes(sh_degree: u8) -> u64 {
    TRANSFORM_BYTES + coefficient_bytes(sh_degree)
}

/// Bytes of the moments of all but the coefficients.
fn transform_moment_bytes(moments: Moments) -> u64 {
    match moments {
        Moments::Compact => 64,
        Moments::F32 => 2 * TRANSFORM_BYTES,
    }
}

/// Bytes of a trained Gaussian with its moments and statistics, without its flag.
pub fn trained_bytes(sh_degree: u8, moments: Moments) -> u64 {
    let colour = coefficient_bytes(sh_degree);
    let colour_moments = match moments {
        Moments::Compact => colour / 2,
        Moments::F32 => 2 * colour,
    };
    frozen_bytes(sh_degree) + transform_moment_bytes(moments) + colour_moments + STATISTICS_BYTES
}

/// Bytes a pixel of a training picture takes while it is trained on.
pub fn pixel_bytes(settings: Settings<'_>) -> u64 {
    RENDER_BYTES + LOSS_BYTES + appearance::pixel_bytes(settings)
}

/// Lengths of the lists of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lists {
    /// Visible Gaussians.
    pub visible: u32,
    /// Intersections of Gaussians with tiles.
    pub intersections: u32,
    /// Whether the fullest views need longer ones than the device can bind, so that they are rendered in
    /// bands.
    pub in_bands: bool,
}

/// What the memory of a run follows from.
#[derive(Clone, Debug)]
pub struct RunSize<'a> {
    /// Resolved configuration, whose `iterations` is that of this run, and the water where there is one.
    pub settings: Settings<'a>,
    /// Cap on the trained Gaussians.
    pub trained: u64,
    /// Gaussians that are rendered and do not change.
    pub frozen: u64,
    /// How many of both the fullest view sees at the cap: [`visible_in_fullest_view`].
    pub visible: u64,
    /// Width and height of every training picture.
    pub pictures: &'a [[u32; 2]],
    /// Side of a tile, pixels; [`SMALLEST_TILE`] where it is not known.
    pub tile: u32,
    /// Longest binding of the device; [`COMMON_BINDING_BYTES`] where it is not known.
    pub binding_bytes: u64,
    /// Whether held-out views are measured on the way (`train.eval_every`).
    pub measures: bool,
}

/// GPU memory of a run at its largest, by what takes it. Bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MemoryForecast {
    /// Gaussians with moments, statistics and flags.
    pub gaussians: u64,
    /// Lists by visible Gaussian.
    pub per_visible: u64,
    /// Lists by intersection, gradients included.
    pub per_intersection: u64,
    /// Buffers of a picture's size: render, loss and its gradients.
    pub pixels: u64,
    /// Photographs that stay on the device.
    pub photographs: u64,
    /// What waits on its way to the device or back: photographs, or the largest array of a checkpoint.
    pub transfers: u64,
    /// The model once more with lists of its own, where held-out views are measured on the way.
    pub measuring: u64,
}

impl MemoryForecast {
    /// All parts together.
    pub fn total(&self) -> u64 {
        let Self { gaussians, per_visible, per_intersection, pixels, photographs, transfers, measuring } =
            self;
        gaussians + per_visible + per_intersection + pixels + photographs + transfers + measuring
    }
}

impl RunSize<'_> {
    /// How long lists the run should begin with: enough for its fullest view at the cap, as far as that can
    /// be foreseen and the device can bind them. They grow where a view needs more; nothing that is trained
    /// depends on them.
    pub fn lists(&self) -> Lists {
        let all = self.trained + self.frozen;
        let visible = ((self.visible as f64 * ROOM).ceil() as u64).min(all).max(LEAST_VISIBLE.min(all));
        let tiles = self.pictures.iter().map(|[w, h]| w.div_ceil(self.tile) * h.div_ceil(self.tile)).max();
        let tiles = f64::from(tiles.unwrap_or(1));
        let layers = (LAYERS_AT_LEAST + LAYERS_BY_DENSITY * (visible as f64 / tiles).sqrt()).powi(2);
        let intersections = ((tiles * layers) as u64).min(MOST_TILES * visible).max(LEAST_INTERSECTIONS);
        let most = u64::from(most_rows(self.binding_bytes));
        Lists {
            visible: visible.min(most) as u32,
            intersections: intersections.min(most) as u32,
            in_bands: visible > most || intersections > most || tiles > f64::from(MAX_TILES),
        }
    }

    /// Bytes of a trained Gaussian without its flag: [`trained_bytes`], and sums where views are rendered in
    /// bands.
    pub fn trained_bytes(&self) -> u64 {
        let bands = if self.lists().in_bands { BAND_BYTES } else { 0 };
        let config = self.settings.train;
        trained_bytes(config.sh_degree, config.moments) + bands
    }

    /// What the run takes on the device at its largest, besides half a MiB of wgpu's own and less than 1 %
    /// for tiles, histograms and uniforms.
    ///
    /// That is the peak of the allocator: all lists and photographs there, and the largest transfer under
    /// way. Where the device keeps up with the uploads the transfer is smaller.
    pub fn forecast(&self) -> MemoryForecast {
        let config = self.settings.train;
        let all = self.trained + self.frozen;
        let lists = self.lists();
        let (visible, intersections) = (u64::from(lists.visible), u64::from(lists.intersections));
        let frozen_bytes = frozen_bytes(config.sh_degree);
        let pixels = self.pictures.iter().map(area).max().unwrap_or(0);
        let photograph = pixels * PHOTOGRAPH_BYTES;
        let views = self.pictures.len() as u64;
        let read_back = self.trained.min(BLOCK_CAPACITY.into())
            * coefficient_bytes(config.sh_degree).max(transform_moment_bytes(config.moments));
        let uploaded = (photograph * views.min(BATCH.into())).min(STAGED_BYTES.max(photograph));
        let copy = self.trained * (frozen_bytes + FLAG_BYTES)
            + visible * VISIBLE_BYTES
            + intersections * (INTERSECTION_BYTES - GRADIENT_BYTES)
            + pixels * RENDER_BYTES
            + (self.trained * frozen_bytes).min(STAGED_BYTES);
        MemoryForecast {
            gaussians: self.trained * self.trained_bytes() + self.frozen * frozen_bytes + all * FLAG_BYTES,
            per_visible: visible * VISIBLE_BYTES,
            per_intersection: intersections * INTERSECTION_BYTES,
            pixels: pixels * pixel_bytes(self.settings),
            photographs: self.photographs(),
            transfers: read_back.max(uploaded),
            measuring: if self.measures { copy } else { 0 },
        }
    }

    /// Bytes of the photographs that the run keeps: each at every size at which it is seen, the latest ones.
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

/// Points that [`visible_in_fullest_view`] looks at, of each group, and views.
const MOST_POINTS: usize = 8192;
const MOST_VIEWS: usize = 512;

/// How many Gaussians views see.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Visible {
    /// In the picture of the view that has most of them.
    pub fullest: u64,
    /// As a mean over views.
    pub mean: f64,
}

/// [`Visible::fullest`] of [`visible_in_views`].
pub fn visible_in_fullest_view(
    views: impl ExactSizeIterator<Item = (PinholeCamera, Pose)>,
    groups: &[(&[DVec3], u64)],
) -> u64 {
    visible_in_views(views, groups).fullest
}

/// Gaussians that lie in the pictures of views.
///
/// `groups` are Gaussians (or the points for which they stand) with the number that there will be of them:
/// the share of the points before a view stands for the share of the Gaussians. Points and views are thinned
/// out evenly; a group without points counts as seen.
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
    fn under_half_a_kilobyte_a_gaussian_of_sh_3_with_compact_moments() {
        assert_eq!(trained_bytes(3, Moments::Compact), 416);
        assert_eq!(trained_bytes(3, Moments::F32), 736);
        // 1, 4, 9 and 16 coefficients lie in 1, 1, 3 and 4 groups of four.
        assert_eq!([0, 1, 2, 3].map(frozen_bytes), [96, 96, 192, 240]);
    }

    #[test]
    fn the_view_that_has_most_gaussians_counts_and_each_group_by_its_own_points() {
        let camera = PinholeCamera { width: 100, height: 100, fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0 };
        let looking = |at| (camera, Pose::looking_at(DVec3::ZERO, at, DVec3::Y));
        let ahead = DVec3::new(0.0, 0.0, 5.0);
        let (left, mixed) = ([ahead, ahead, -ahead, DVec3::X], [ahead, -ahead]);
        let views = [looking(DVec3::X), looking(DVec3::Z)];
        let visible = |groups: &[(&[DVec3], u64)]| visible_in_fullest_view(views.iter().copied(), groups);
        assert_eq!(visible(&[(&left, 1000)]), 500);
        assert_eq!(visible(&[(&left, 1000), (&mixed, 60)]), 530);
        assert_eq!(visible(&[(&left, 1000), (&[], 70)]), 570, "what has no points may be anywhere");
        // The other view sees one of the four and one of the two.
        let both = visible_in_views(views.iter().copied(), &[(&left, 1000), (&mixed, 60), (&[], 7)]);
        assert_eq!(both, Visible { fullest: 537, mean: 7.0 + (530.0 + 250.0) / 2.0 });
    }

    #[test]
    fn lists_are_no_longer_than_a_binding_and_then_sums_of_bands_come_on_top() {
        let config = TrainConfig::default();
        let pictures = [[1600, 1200]];
        let whole = run(&config, 800_000, &pictures);
        let cut = RunSize { binding_bytes: 48 << 20, ..whole.clone() };
        assert!(!whole.lists().in_bands && whole.lists().intersections > 1 << 20);
        assert_eq!(cut.lists(), Lists { visible: 1_000_000, intersections: 1 << 20, in_bands: true });
        assert_eq!(cut.forecast().gaussians - whole.forecast().gaussians, 48_000_000);
        // So do pictures of more tiles than are worked on at once: 200 by 164 of 8 pixels.
        let (most, more) = ([[1600, 1304]], [[1600, 1320]]);
        let bands = |pictures| RunSize { tile: 8, ..run(&config, 100_000, pictures) }.lists().in_bands;
        assert!(!bands(&most) && bands(&more));
    }

    #[test]
    fn photographs_count_at_every_size_at_which_they_are_seen_up_to_what_stays() {
        let long = TrainConfig { iterations: 1000, ..TrainConfig::default() };
        let at =
            |config: &TrainConfig, pictures: &[[u32; 2]]| run(config, 1, pictures).forecast().photographs;
        let full = 4 * 400 * 400;
        assert_eq!(at(&long, &[[400, 400]; 10]), 10 * (full + full / 4 + full / 16));
        assert_eq!(at(&long.clone().continued(), &[[400, 400]; 10]), 10 * full);
        // At most halved once, so that 96 pixels are left.
        assert_eq!(at(&long, &[[200, 200]; 10]), 10 * (full / 4 + full / 16));
        // 7 iterations at full size, 2 and 1 at the others.
        let short = TrainConfig { iterations: 10, ..TrainConfig::default() };
        assert!(at(&short, &[[400, 400]; 10]).abs_diff(7 * full + 2 * full / 4 + full / 16) < 10);
        assert_eq!(at(&long, &[[4000, 4000]; 50]), RESIDENT_BYTES);
    }
}
