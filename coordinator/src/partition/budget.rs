//! What a run may cost: iterations, Gaussians and the GPU memory that they will take.
//!
//! `train.iterations` and `train.max_gaussians` are totals of the job as if it were 1x1. A partition
//! gets iterations by its cameras, so that each photograph is seen as often as in one run, and Gaussians
//! by the points that it trains, so that its density is that of one run; the margins that it trains
//! besides its cell come on top and fall away at the merge.

use fathom_core::config::{JobConfig, Moments};

use super::plan::{Forecast, GlobalStage};

/// Fewest Gaussians that a run may have.
const MIN_GAUSSIANS: f64 = 16.0;
/// Bytes of a Gaussian's mean, quaternion, log scale and opacity: three vec4 of f32.
const TRANSFORM_BYTES: u64 = 48;
/// Bytes of the compact moments of all that (`shaders/shared/moments_compact.wgsl`).
const COMPACT_BYTES: u64 = 64;
/// Bytes besides that a trained Gaussian takes for its statistics and step count.
const STATS_BYTES: u64 = 16;
/// Bytes per Gaussian in the lists of a frame: its flag, the projected splat (three vec4), its index, segment and
/// offset, and depth keys and values in two buffers.
const VISIBLE_BYTES: u64 = 84;
/// Tiles that a Gaussian touches on average at a cap that fits the picture.
const INTERSECTS_PER_GAUSSIAN: u64 = 4;
/// Bytes per intersection: key and index in two buffers, and the slot of its gradient.
const INTERSECT_BYTES: u64 = 68;
/// Bytes per pixel: photograph, render, range, and the maps of SSIM and gradients of the loss.
const PIXEL_BYTES: u64 = 92;

/// Iterations of a partition with `chosen` of `training` cameras.
pub fn iterations(config: &JobConfig, chosen: usize, training: usize) -> u32 {
    match config.partition.iterations_per_partition {
        0 => share_of(config.train.iterations, chosen as f64 / training.max(1) as f64, 1.0),
        fixed => fixed,
    }
}

/// Cap of a run that trains `share` of the scene.
pub fn max_gaussians(config: &JobConfig, share: f64) -> u32 {
    share_of(config.train.max_gaussians, share, MIN_GAUSSIANS)
}

/// The run of the coarse model; `longest_side` is that of the partitions' pictures and `pixels` their area.
pub fn global_stage(config: &JobConfig, longest_side: u32, pixels: u64) -> GlobalStage {
    let max_gaussians = max_gaussians(config, config.partition.global_gaussians);
    GlobalStage {
        iterations: share_of(config.train.iterations, config.partition.global_iterations, 1.0),
        max_gaussians,
        max_resolution: longest_side.div_ceil(2).max(1),
        forecast: forecast(config, max_gaussians.into(), 0, pixels.div_ceil(4)),
    }
}

/// GPU memory of a run that trains `trained` Gaussians and renders `frozen` more.
pub fn forecast(config: &JobConfig, trained: u64, frozen: u64, pixels: u64) -> Forecast {
    // Coefficients of three channels in f32, four at a time.
    let coeffs = (u64::from(config.train.sh_degree) + 1).pow(2);
    let coeff_bytes = 48 * coeffs.div_ceil(4);
    let frozen_bytes = TRANSFORM_BYTES + coeff_bytes;
    // The values, their moments, and the statistics besides.
    let moment_bytes = match config.train.moments {
        Moments::Compact => COMPACT_BYTES + coeff_bytes / 2,
        Moments::F32 => 2 * frozen_bytes,
    };
    let trained_bytes = frozen_bytes + moment_bytes + STATS_BYTES;
    let all = trained + frozen;
    let frame_bytes = VISIBLE_BYTES + INTERSECTS_PER_GAUSSIAN * INTERSECT_BYTES;
    Forecast {
        bytes: trained * trained_bytes + frozen * frozen_bytes + all * frame_bytes + pixels * PIXEL_BYTES,
        formula: format!(
            "{trained} trained Gaussians x {trained_bytes} B + {frozen} frozen x {frozen_bytes} B \
             + {all} x ({VISIBLE_BYTES} B visible + {INTERSECTS_PER_GAUSSIAN} tiles x {INTERSECT_BYTES} B) \
             + {pixels} pixels x {PIXEL_BYTES} B"
        ),
    }
}

fn share_of(total: u32, share: f64, least: f64) -> u32 {
    (f64::from(total) * share).round().max(least) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_partition_with_all_cameras_gets_all_iterations_and_one_with_few_their_share() {
        let config = JobConfig::default();
        assert_eq!(iterations(&config, 100, 100), config.train.iterations);
        assert_eq!(iterations(&config, 25, 100), config.train.iterations / 4);
        assert_eq!(iterations(&config, 0, 100), 1);
    }

    #[test]
    fn iterations_per_partition_override_the_share() {
        let mut config = JobConfig::default();
        config.partition.iterations_per_partition = 77;
        assert_eq!(iterations(&config, 25, 100), 77);
    }

    #[test]
    fn a_cap_never_falls_below_sixteen() {
        let config = JobConfig::default();
        assert_eq!(max_gaussians(&config, 0.0), 16);
        assert_eq!(max_gaussians(&config, 1.0), config.train.max_gaussians);
    }

    #[test]
    fn the_formula_gives_the_bytes_beside_it() {
        let config = JobConfig::default();
        let forecast = forecast(&config, 1000, 50, 640 * 480);
        assert_eq!(forecast.bytes, 1000 * 416 + 50 * 240 + 1050 * (84 + 4 * 68) + 640 * 480 * 92);
        for number in ["1000 trained", "416 B", "50 frozen", "240 B", "307200 pixels"] {
            assert!(forecast.formula.contains(number), "{number} is missing in {}", forecast.formula);
        }
    }

    #[test]
    fn coefficients_are_kept_four_at_a_time() {
        let mut config = JobConfig::default();
        // 1, 4, 9 and 16 coefficients lie in 1, 1, 3 and 4 groups of 48 bytes.
        for (degree, frozen) in [(0, 96), (1, 96), (2, 192), (3, 240)] {
            config.train.sh_degree = degree;
            assert_eq!(forecast(&config, 0, 1, 0).bytes, frozen + 84 + 4 * 68, "degree {degree}");
            let frame = 84 + 4 * 68;
            config.train.moments = Moments::Compact;
            let compact = frozen + 64 + (frozen - 48) / 2 + 16 + frame;
            assert_eq!(forecast(&config, 1, 0, 0).bytes, compact, "degree {degree}");
            config.train.moments = Moments::F32;
            assert_eq!(forecast(&config, 1, 0, 0).bytes, 3 * frozen + 16 + frame, "degree {degree}");
        }
    }

    #[test]
    fn the_global_stage_takes_half_of_the_size_that_pictures_really_have() {
        let stage = global_stage(&JobConfig::default(), 479, 479 * 360);
        assert_eq!(stage.max_resolution, 240);
        assert_eq!(stage.iterations, 3000);
        assert_eq!(stage.max_gaussians, 750_000);
    }
}
